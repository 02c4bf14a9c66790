//! A loop that does nothing but follow its host.

use firmware_core::control_loop::{
    ActuatorError, Actuators, Command, ControlLoop, Mode, Supervisor, Timing,
};

struct Nothing;

impl Actuators<2> for Nothing {
    fn apply(&mut self, _: [f32; 2]) -> Result<(), ActuatorError> {
        Ok(())
    }

    fn stop(&mut self) -> Result<(), ActuatorError> {
        Ok(())
    }
}

/// A robot without actuators.
pub struct Robot {
    supervisor: Supervisor,
    /// What the host asked for.
    pub commands: Vec<Command<2>>,
}

impl Default for Robot {
    fn default() -> Self {
        let timing = Timing { period_us: 1_000, watchdog_us: 1_000_000 };
        Self { supervisor: Supervisor::new(timing), commands: Vec::new() }
    }
}

impl ControlLoop<2> for Robot {
    fn command(&mut self, command: Command<2>) {
        self.commands.push(command);
        match command {
            Command::Start => self.supervisor.start(),
            Command::Stop => self.supervisor.stop(),
            Command::Reset => self.supervisor.reset(),
            Command::Inputs(_) => self.supervisor.heard(),
        }
    }

    fn tick(&mut self, now_us: u64) -> Mode {
        self.supervisor.begin(now_us);
        self.mode()
    }

    fn finish(&mut self, now_us: u64) -> Mode {
        self.supervisor.finish(now_us, &mut Nothing)
    }

    fn path(&self) -> &[f32] {
        &[]
    }

    fn supervisor(&self) -> &Supervisor {
        &self.supervisor
    }

    fn supervisor_mut(&mut self) -> &mut Supervisor {
        &mut self.supervisor
    }
}
