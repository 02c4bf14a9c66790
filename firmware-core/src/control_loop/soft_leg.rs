//! The loop of a soft pneumatic leg: two chambers, each behind a solenoid valve, a pump for pressure and
//! one for vacuum.
//!
//! The model's inputs are signed voltages: the sign chooses the pump (+ input, − exhaust), the size opens
//! the valve. Every tick (2 ms) sets valves and pumps anew: what ends the motion, whether a stop, a silent
//! host, a late tick or a device that fails, ends it then. Every `ticks_per_sample` ticks (50 ms) is a sample
//! of the model: the tip is predicted, and compared with the measured one where there is one. At the ticks that
//! follow it is predicted over the horizon with the voltages that are commanded then, a step at each.
//!
//! The model assumes inputs that are constant from one sample to the next: commanded voltages act from the
//! next sample on. A leg that is started between two samples has its valves closed until then. One that was
//! switched off between them is predicted with the mean of what acted.

use embedded_hal::digital::OutputPin;
use embedded_hal::pwm::SetDutyCycle;

use crate::control_loop::rhythm::Rhythm;
use crate::control_loop::supervisor::{Mode, Supervisor, Timing};
use crate::control_loop::telemetry::Telemetry;
use crate::control_loop::tracker::Tracker;
use crate::control_loop::{
    ActuatorError, Actuators, Command, ControlLoop, ControlLoopError, limited, set_share,
};
use crate::device::PositionSensor;
use crate::model::Model;

/// A chamber: its valve, and the pin that connects the valve with the input pump (high) or the exhaust
/// pump (low).
#[derive(Debug)]
pub struct Chamber<V, L> {
    /// The valve's coil: the duty is the size of the voltage as a share of the supply.
    pub valve: V,
    /// Which pump the valve is connected with.
    pub line: L,
    /// What the pin says, once it is known.
    pressure: Option<bool>,
}

/// Valves and pumps of a leg.
#[derive(Debug)]
pub struct Pneumatics<V0, L0, V1, L1, I, X> {
    /// Bending.
    pub bending: Chamber<V0, L0>,
    /// Extension.
    pub extension: Chamber<V1, L1>,
    /// Switches the pump for pressure.
    pub input_pump: I,
    /// Switches the pump for vacuum.
    pub exhaust_pump: X,
}

impl<V: SetDutyCycle, L: OutputPin> Chamber<V, L> {
    /// A chamber whose pin has not been set yet.
    pub fn new(valve: V, line: L) -> Self {
        Self { valve, line, pressure: None }
    }

    fn apply(&mut self, share: f32) -> Result<(), ActuatorError> {
        let pressure = share > 0.0;
        if share != 0.0 && self.pressure != Some(pressure) {
            // On the wrong line an open valve does the opposite: it closes first, and stays closed when the
            // line cannot be switched.
            self.pressure = None;
            set_share(&mut self.valve, 0.0)?;
            self.line.set_state(pressure.into()).map_err(|_| ActuatorError)?;
            self.pressure = Some(pressure);
        }
        set_share(&mut self.valve, share.abs())
    }
}

fn switch(pump: &mut impl OutputPin, on: bool) -> Result<(), ActuatorError> {
    pump.set_state(on.into()).map_err(|_| ActuatorError)
}

impl<V0, L0, V1, L1, I, X> Actuators<2> for Pneumatics<V0, L0, V1, L1, I, X>
where
    V0: SetDutyCycle,
    L0: OutputPin,
    V1: SetDutyCycle,
    L1: OutputPin,
    I: OutputPin,
    X: OutputPin,
{
    fn apply(&mut self, shares: [f32; 2]) -> Result<(), ActuatorError> {
        let [bending, extension] = shares;
        let input = switch(&mut self.input_pump, shares.iter().any(|share| *share > 0.0));
        let exhaust = switch(&mut self.exhaust_pump, shares.iter().any(|share| *share < 0.0));
        let (bending, extension) = (self.bending.apply(bending), self.extension.apply(extension));
        input.and(exhaust).and(bending).and(extension)
    }

    fn stop(&mut self) -> Result<(), ActuatorError> {
        self.apply([0.0; 2])
    }
}

/// What fixes the loop of a leg.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoftLegSettings {
    /// Ticks per sample of the model; from four on the look-ahead is spread over them.
    pub ticks_per_sample: u8,
    /// Voltage of the supply: the full duty of a valve (V).
    pub supply_volt: f32,
    /// A running leg stops after this time without a command (µs).
    pub watchdog_us: u32,
    /// Samples in a row without a measurement after which it stops, or fewer where the model's error
    /// bounds do not reach so far.
    pub blind_samples: u32,
}

impl Default for SoftLegSettings {
    /// 25 ticks of 2 ms per sample, 12 V, one second without a command, half a second without a measurement
    /// at 20 Hz.
    fn default() -> Self {
        Self { ticks_per_sample: 25, supply_volt: 12.0, watchdog_us: 1_000_000, blind_samples: 10 }
    }
}

/// The loop. `A` moves the leg, `S` sees the tip, `H` samples are looked ahead.
pub struct SoftLeg<'m, 'a, 'q, A, S, const H: usize> {
    actuators: A,
    sensor: S,
    settings: SoftLegSettings,
    tracker: Tracker<'m, 'a, 2, 2, H>,
    supervisor: Supervisor,
    telemetry: Telemetry<'q>,
    /// What the host wants (V).
    wanted: [f32; 2],
    /// What is commanded from the last sample to the next (V); 0 once the leg has not been running.
    held: [f32; 2],
    /// What acts since the last tick (V).
    applied: [f32; 2],
    rhythm: Rhythm<2>,
}

impl<'m, 'a, 'q, A, S, const H: usize> SoftLeg<'m, 'a, 'q, A, S, H>
where
    A: Actuators<2>,
    S: PositionSensor<2>,
{
    /// A leg that is idle; the model's sample time is `ticks_per_sample` periods of its ticks.
    ///
    /// # Errors
    /// [`ControlLoopError`]: the model is not one of two states and two inputs, or a setting is out of
    /// range.
    #[inline(always)]
    pub fn new(
        model: &'m Model<'a>,
        actuators: A,
        sensor: S,
        settings: SoftLegSettings,
        telemetry: Telemetry<'q>,
    ) -> Result<Self, ControlLoopError> {
        let tracker = Tracker::new(model, settings.blind_samples)?;
        if !(settings.supply_volt > 0.0 && settings.supply_volt.is_finite()) {
            return Err(ControlLoopError::Setting { field: "supply_volt" });
        }
        let rhythm = Rhythm::new(settings.ticks_per_sample, H)?;
        let timing = Timing::new(model, settings.ticks_per_sample.into(), settings.watchdog_us)?;
        Ok(Self {
            actuators,
            sensor,
            settings,
            tracker,
            supervisor: Supervisor::new(timing),
            telemetry,
            wanted: [0.0; 2],
            held: [0.0; 2],
            applied: [0.0; 2],
            rhythm,
        })
    }

    /// The devices, to look at.
    pub fn devices(&self) -> (&A, &S) {
        (&self.actuators, &self.sensor)
    }

    /// A sample of the model.
    fn sample(&mut self, now_us: u64) {
        let applied = self.rhythm.sample(now_us);
        let measured = self.tracker.measure(&mut self.sensor);
        self.held = if self.supervisor.mode() == Mode::Running { self.wanted } else { [0.0; 2] };
        let noticed = self.tracker.take(&applied, measured, &self.held);
        self.supervisor.judge(noticed, &mut self.tracker);
    }
}

impl<A, S, const H: usize> ControlLoop<2> for SoftLeg<'_, '_, '_, A, S, H>
where
    A: Actuators<2>,
    S: PositionSensor<2>,
{
    fn command(&mut self, command: Command<2>) {
        self.supervisor.follow(command, &mut self.wanted, &self.tracker);
        // A model may have been trained with a larger supply: what is predicted and reported is what acts.
        let most = self.settings.supply_volt;
        self.wanted = self.wanted.map(|u| limited(u, -most, most));
        if self.supervisor.mode() != Mode::Running {
            // Also when a start follows before the next tick.
            self.held = [0.0; 2];
        }
    }

    /// One tick: acts; at a sample it measures and predicts, at the ticks after it it looks ahead, and reports.
    fn tick(&mut self, now_us: u64) -> Mode {
        self.supervisor.begin(now_us);
        if self.rhythm.begin(self.applied) {
            self.sample(now_us);
        }
        self.rhythm.go_on(&mut self.tracker, &mut self.supervisor);

        let shares = self.held.map(|u| u / self.settings.supply_volt);
        let mode = self.supervisor.act(&mut self.actuators, shares);
        if mode != Mode::Running {
            self.held = [0.0; 2];
        }
        self.applied = self.held;
        self.rhythm.end(&self.tracker, &mut self.supervisor, &mut self.telemetry);
        mode
    }

    fn finish(&mut self, now_us: u64) -> Mode {
        let mode = self.supervisor.finish(now_us, &mut self.actuators);
        if mode != Mode::Running {
            (self.held, self.applied) = ([0.0; 2], [0.0; 2]);
        }
        mode
    }

    fn path(&self) -> &[f32] {
        self.tracker.path().as_flattened()
    }

    fn supervisor(&self) -> &Supervisor {
        &self.supervisor
    }

    fn supervisor_mut(&mut self) -> &mut Supervisor {
        &mut self.supervisor
    }
}
