//! Control loops: sense, predict, act, once per tick.
//!
//! ```text
//!            commands ──┐                                   ┌──> telemetry
//!  sensors ──> [Tracker: step, compare, look ahead] ──> [Supervisor: Idle, Running, Safe] ──> actuators
//! ```
//!
//! | module | what lives there |
//! |---|---|
//! | [`supervisor`] | the state machine, its alarms, the command watchdog, deadlines |
//! | [`tracker`] | the model beside the robot: predicted against measured, and the path ahead |
//! | [`monitor`] | whether what is measured is what the model says, by its own error bounds |
//! | [`rhythm`] | which ticks are samples, and what is done at those between them |
//! | [`telemetry`] | frames, and the queue that never blocks a loop |
//! | [`soft_leg`] | a leg with two valves and two pumps |
//! | [`rosbot`] | a robot with two driven sides |
//!
//! A loop does a bounded amount of work per tick, never waits, and takes time as an argument:
//!
//! ```text
//! loop { wait for the timer; let start = clock.now_us(); robot.tick(start); robot.finish(clock.now_us()); }
//! ```
//!
//! In [`Mode::Safe`] and [`Mode::Idle`] every tick switches the actuators off anew, when it acts and when it
//! ends.
//!
//! A loop for a robot of one's own is made of the same parts, as [`soft_leg`] and docs/your-robot.md show:
//! what is the same for every robot is in [`Supervisor`], what is left is who measures and who moves.

pub mod monitor;
pub mod rhythm;
pub mod rosbot;
pub mod soft_leg;
pub mod supervisor;
pub mod telemetry;
pub mod tracker;

pub use rhythm::Rhythm;
pub use rosbot::Rosbot;
pub use soft_leg::SoftLeg;
pub use supervisor::{Alarms, Mode, Supervisor, Timing};
pub use telemetry::{Frame, Telemetry};
pub use tracker::{Measurement, Tracker};

/// What the host asks for; `M` inputs in the model's order and units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Command<const M: usize> {
    /// Idle → Running. Refused without a measurement.
    Start,
    /// The inputs from the next tick on, or from the next sample on where the model wants them constant in
    /// between; each is held within the range of the model. Only a running robot follows them. They also say
    /// that the host is alive.
    Inputs([f32; M]),
    /// → Idle.
    Stop,
    /// Safe → Idle, alarms forgotten.
    Reset,
}

/// The loop of a robot with `M` inputs, as a firmware runs it.
pub trait ControlLoop<const M: usize> {
    /// What the host asks for.
    fn command(&mut self, command: Command<M>);

    /// One tick, which begins at `now_us`.
    fn tick(&mut self, now_us: u64) -> Mode;

    /// The tick is over: was it in time? If not, or after a stop during the tick, the actuators go off at
    /// once.
    fn finish(&mut self, now_us: u64) -> Mode;

    /// Where the robot will be at the samples after the last one, shape `[samples, states]` (model's units), as
    /// far as it has been predicted.
    fn path(&self) -> &[f32];

    /// Its state machine.
    fn supervisor(&self) -> &Supervisor;

    /// Its state machine, to be [held](Supervisor::hold).
    fn supervisor_mut(&mut self) -> &mut Supervisor;

    /// What the loop may do.
    fn mode(&self) -> Mode {
        self.supervisor().mode()
    }

    /// What was noticed since the last start or reset.
    fn alarms(&self) -> Alarms {
        self.supervisor().alarms()
    }
}

/// Everything that moves the robot.
///
/// An implementation that cannot say whether it succeeded does both: it tries everything, and returns
/// the error.
pub trait Actuators<const M: usize> {
    /// Applies inputs, each in −1 to 1 of what the actuator can do.
    ///
    /// # Errors
    /// When some device cannot be set: the loop goes to Safe.
    fn apply(&mut self, shares: [f32; M]) -> Result<(), ActuatorError>;

    /// Switches everything off.
    ///
    /// # Errors
    /// When some device cannot be set; the others are off.
    fn stop(&mut self) -> Result<(), ActuatorError>;
}

/// A device could not be set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActuatorError;

/// Why there is no control loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ControlLoopError {
    /// The model is one of another robot.
    DimensionMismatch {
        /// Of what.
        field: &'static str,
        /// What the loop has.
        expected: usize,
        /// What the model has.
        found: usize,
    },
    /// A setting makes no sense.
    Setting {
        /// Which.
        field: &'static str,
    },
}

/// `x`, or what is nearest to it from `low` to `high`; `low` for NaN. Methods of f32 that do this are calls on a
/// Cortex-M4F, or panic for a range that is none.
#[inline(always)]
pub(crate) fn limited(x: f32, low: f32, high: f32) -> f32 {
    let x = if x > low { x } else { low };
    if x < high { x } else { high }
}

/// A duty of `share`, 0 to 1, of the most.
pub(crate) fn set_share(
    pwm: &mut impl embedded_hal::pwm::SetDutyCycle,
    share: f32,
) -> Result<(), ActuatorError> {
    // Casts to integers saturate, and NaN gives 0.
    let duty = (limited(share, 0.0, 1.0) * f32::from(pwm.max_duty_cycle()) + 0.5) as u16;
    pwm.set_duty_cycle(duty.min(pwm.max_duty_cycle())).map_err(|_| ActuatorError)
}
