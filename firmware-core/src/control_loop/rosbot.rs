//! The loop of a robot with two driven sides, such as the ROSbot: two motors with PWM and a direction pin,
//! an encoder on each side, and a pose that is measured now and then.
//!
//! Every tick (10 ms) each side's speed controller reads its encoder and sets its motor. Every
//! `ticks_per_sample` ticks (100 ms) is a sample of the model, whose inputs are the mean commanded wheel
//! speeds since the sample before: the pose is predicted from them, and corrected where it is measured. At the
//! ticks that follow it is predicted over the horizon, a few steps at each.
//!
//! Speed controller, per side (as in the robot's own firmware, a PI):
//!
//! ```text
//! ω̂ = 2π/N (n_k − n_{k−1}) / T                 N counts per turn of the wheel, T the tick
//! e = ω_commanded − ω̂
//! U = min(max(k_p e + I, −U_s), U_s),  I ← I + k_i e T   unless that drives U further into ±U_s
//! ```

use embedded_hal::digital::OutputPin;
use embedded_hal::pwm::SetDutyCycle;

use crate::control_loop::rhythm::Rhythm;
use crate::control_loop::supervisor::{Alarms, Mode, Supervisor, Timing};
use crate::control_loop::telemetry::Telemetry;
use crate::control_loop::tracker::Tracker;
use crate::control_loop::{
    ActuatorError, Actuators, Command, ControlLoop, ControlLoopError, limited, set_share,
};
use crate::device::{EncoderCount, PositionSensor};
use crate::model::Model;

/// A motor behind an H-bridge.
#[derive(Debug)]
pub struct Motor<P, D> {
    /// The duty is the size of the voltage as a share of the supply.
    pub pwm: P,
    /// High: backwards.
    pub backwards: D,
    /// What the pin says, once it is known.
    reverse: Option<bool>,
}

impl<P: SetDutyCycle, D: OutputPin> Motor<P, D> {
    /// A motor whose pin has not been set yet.
    pub fn new(pwm: P, backwards: D) -> Self {
        Self { pwm, backwards, reverse: None }
    }

    /// Applies a share of the supply, −1 to 1; to turn round, the duty goes to 0 first.
    ///
    /// # Errors
    /// When the duty or the direction cannot be set; the direction is then set anew the next time.
    pub fn apply(&mut self, share: f32) -> Result<(), ActuatorError> {
        let reverse = share < 0.0;
        if share != 0.0 && self.reverse != Some(reverse) {
            // A bridge that is turned round under load short-circuits the motor's own voltage.
            self.reverse = None;
            set_share(&mut self.pwm, 0.0)?;
            self.backwards.set_state(reverse.into()).map_err(|_| ActuatorError)?;
            self.reverse = Some(reverse);
        }
        set_share(&mut self.pwm, share.abs())
    }
}

/// The two sides of a robot, each with the motors of its wheels on one bridge.
#[derive(Debug)]
pub struct Sides<PR, DR, PL, DL> {
    /// Right.
    pub right: Motor<PR, DR>,
    /// Left.
    pub left: Motor<PL, DL>,
}

impl<PR, DR, PL, DL> Actuators<2> for Sides<PR, DR, PL, DL>
where
    PR: SetDutyCycle,
    DR: OutputPin,
    PL: SetDutyCycle,
    DL: OutputPin,
{
    fn apply(&mut self, [right, left]: [f32; 2]) -> Result<(), ActuatorError> {
        let (right, left) = (self.right.apply(right), self.left.apply(left));
        right.and(left)
    }

    fn stop(&mut self) -> Result<(), ActuatorError> {
        self.apply([0.0; 2])
    }
}

/// The counters of the right and the left side.
pub trait Encoders {
    /// Both counts; `None` when one cannot be read.
    fn counts(&mut self) -> Option<[u16; 2]>;
}

impl<R: EncoderCount, L: EncoderCount> Encoders for (R, L) {
    fn counts(&mut self) -> Option<[u16; 2]> {
        Some([self.0.count().ok()?, self.1.count().ok()?])
    }
}

/// What fixes the loop of a ROSbot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RosbotSettings {
    /// Ticks per sample of the model; from four on the look-ahead is spread over them.
    pub ticks_per_sample: u8,
    /// Encoder counts N per turn of a wheel.
    pub counts_per_turn: f32,
    /// Supply voltage U_s (V).
    pub supply_volt: f32,
    /// Proportional gain k_p of the speed controllers (V s/rad).
    pub proportional_gain: f32,
    /// Integral gain k_i of the speed controllers (V/rad).
    pub integral_gain: f32,
    /// No wheel turns faster (rad/s): a count that says so is not believed.
    pub fastest_radps: f32,
    /// A wheel that is this much slower or faster than commanded, on average over about a second, is an
    /// alarm (rad/s).
    pub wheel_tolerance_radps: f32,
    /// Voltage with which every wheel turns, whatever it has to push (V): a motor that has it for 0.3 s
    /// without a wheel that is counted to turn stops the robot.
    pub stall_volt: f32,
    /// A running robot stops after this time without a command (µs).
    pub watchdog_us: u32,
    /// Samples in a row without a measured pose after which it stops, or fewer where the model's error
    /// bounds do not reach so far.
    pub blind_samples: u32,
}

impl Default for RosbotSettings {
    /// A ROSbot 2.0: 10 ticks of 10 ms per sample, 12 V motors geared down 34 : 1 with 48 counts per turn,
    /// one second without a command or a pose.
    fn default() -> Self {
        Self {
            ticks_per_sample: 10,
            counts_per_turn: 1632.0,
            supply_volt: 12.0,
            proportional_gain: 0.7,
            integral_gain: 9.0,
            fastest_radps: 60.0,
            wheel_tolerance_radps: 2.5,
            stall_volt: 4.0,
            watchdog_us: 1_000_000,
            blind_samples: 10,
        }
    }
}

/// Ticks in a row that an encoder may be unreadable or implausible.
const BAD_COUNTS: u8 = 5;
/// A motor that has had the stall voltage for so long (s) while its wheel was not counted to turn its way by
/// as much as the stall speed (rad/s) has a dead or swapped encoder, or is blocked: the integral of its
/// controller would drive it to full voltage. One that has to brake so hard for so long is stopped, too.
const STALL_S: f32 = 0.3;
const STALL_RADPS: f32 = 0.5;
/// Share of the newest sample in the mean deviation of a wheel's speed: about ten samples.
const WHEEL_SHARE: f32 = 0.1;

/// One side's speed controller.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Side {
    /// Count at the last tick.
    count: u16,
    /// Speed as counted (rad/s).
    speed: f32,
    /// Integral part (V).
    integral: f32,
    /// Counted minus commanded speed, summed over the ticks of this sample (rad/s).
    deviation: f32,
    /// Its mean over samples.
    mean_deviation: f32,
    /// How long the motor has had the stall voltage in vain (s).
    stalled_s: f32,
}

impl Side {
    /// The voltage for a commanded speed.
    fn control(&mut self, command: f32, settings: &RosbotSettings, period_s: f32) -> f32 {
        let RosbotSettings { supply_volt, proportional_gain, integral_gain, .. } = *settings;
        let error = command - self.speed;
        let wanted = proportional_gain * error + self.integral;
        let volt = limited(wanted, -supply_volt, supply_volt);
        let winds_up = volt != wanted && error * wanted > 0.0;
        if !winds_up {
            self.integral += integral_gain * error * period_s;
        }
        let in_vain =
            volt.abs() >= settings.stall_volt && self.speed * 1.0_f32.copysign(volt) < STALL_RADPS;
        self.stalled_s = if in_vain { self.stalled_s + period_s } else { 0.0 };
        volt
    }
}

/// The loop. `A` drives the sides, `E` counts their wheels, `S` sees the pose, `H` samples are looked
/// ahead.
pub struct Rosbot<'m, 'a, 'q, A, E, S, const H: usize> {
    actuators: A,
    encoders: E,
    sensor: S,
    settings: RosbotSettings,
    period_s: f32,
    tracker: Tracker<'m, 'a, 3, 2, H>,
    supervisor: Supervisor,
    telemetry: Telemetry<'q>,
    /// What the host wants (rad/s), right and left.
    wanted: [f32; 2],
    /// What is commanded since the last tick (rad/s).
    applied: [f32; 2],
    rhythm: Rhythm<2>,
    sides: [Side; 2],
    /// Whether there is a count to compare the next one with.
    counted: bool,
    bad_counts: u8,
}

impl<'m, 'a, 'q, A, E, S, const H: usize> Rosbot<'m, 'a, 'q, A, E, S, H>
where
    A: Actuators<2>,
    E: Encoders,
    S: PositionSensor<3>,
{
    /// A robot that is idle; the model's sample time is `ticks_per_sample` periods of its ticks.
    ///
    /// # Errors
    /// [`ControlLoopError`]: the model is not one of three states and two inputs, or a setting is out of
    /// range.
    #[inline(always)]
    pub fn new(
        model: &'m Model<'a>,
        (actuators, encoders, sensor): (A, E, S),
        settings: RosbotSettings,
        telemetry: Telemetry<'q>,
    ) -> Result<Self, ControlLoopError> {
        let tracker = Tracker::new(model, settings.blind_samples)?;
        for (field, value) in [
            ("counts_per_turn", settings.counts_per_turn),
            ("supply_volt", settings.supply_volt),
            ("proportional_gain", settings.proportional_gain),
            ("integral_gain", settings.integral_gain),
            ("fastest_radps", settings.fastest_radps),
            ("wheel_tolerance_radps", settings.wheel_tolerance_radps),
            ("stall_volt", settings.stall_volt),
        ] {
            // Gains of a million and more are typing errors that would overflow.
            if !(value > 0.0 && value < 1e6) {
                return Err(ControlLoopError::Setting { field });
            }
        }
        let rhythm = Rhythm::new(settings.ticks_per_sample, H)?;
        let timing = Timing::new(model, settings.ticks_per_sample.into(), settings.watchdog_us)?;
        Ok(Self {
            actuators,
            encoders,
            sensor,
            settings,
            period_s: timing.period_us as f32 * 1e-6,
            tracker,
            supervisor: Supervisor::new(timing),
            telemetry,
            wanted: [0.0; 2],
            applied: [0.0; 2],
            rhythm,
            sides: [Side::default(); 2],
            counted: false,
            bad_counts: 0,
        })
    }

    /// The devices, to look at.
    pub fn devices(&self) -> (&A, &E, &S) {
        (&self.actuators, &self.encoders, &self.sensor)
    }

    /// Reads the encoders.
    fn count(&mut self) {
        let settings = &self.settings;
        let per_count = core::f32::consts::TAU / settings.counts_per_turn / self.period_s;
        let Some(counts) = self.encoders.counts() else {
            self.counted = false;
            return self.bad_count();
        };
        let mut plausible = true;
        for (side, count) in self.sides.iter_mut().zip(counts) {
            let change = count.wrapping_sub(side.count) as i16;
            side.count = count;
            let speed = f32::from(change) * per_count;
            if self.counted && speed.abs() <= settings.fastest_radps {
                side.speed = speed;
            } else {
                // The last speed is the best guess.
                plausible = false;
            }
        }
        // The first count of all says nothing, neither good nor bad.
        match (self.counted, plausible) {
            (true, true) => self.bad_counts = 0,
            (true, false) => self.bad_count(),
            (false, _) => {}
        }
        self.counted = true;
    }

    fn bad_count(&mut self) {
        self.bad_counts = self.bad_counts.saturating_add(1);
        if self.bad_counts >= BAD_COUNTS {
            self.supervisor.raise(Alarms::ENCODER);
        }
    }

    /// A sample of the model.
    fn sample(&mut self, now_us: u64) {
        let ticks = self.rhythm.ticks();
        let applied = self.rhythm.sample(now_us);
        for side in &mut self.sides {
            let deviation = side.deviation / ticks;
            side.mean_deviation += WHEEL_SHARE * (deviation - side.mean_deviation);
            side.deviation = 0.0;
            if side.mean_deviation.abs() > self.settings.wheel_tolerance_radps {
                self.supervisor.raise(Alarms::WHEEL);
            }
        }
        let measured = self.tracker.measure(&mut self.sensor);
        let held = if self.supervisor.mode() == Mode::Running { self.wanted } else { [0.0; 2] };
        let noticed = self.tracker.take(&applied, measured, &held);
        self.supervisor.judge(noticed, &mut self.tracker);
    }

    /// What a robot that stands still does not carry on.
    #[inline(never)]
    fn forget(&mut self) {
        for side in &mut self.sides {
            side.integral = 0.0;
            side.deviation = 0.0;
            side.mean_deviation = 0.0;
            side.stalled_s = 0.0;
        }
    }
}

impl<A, E, S, const H: usize> ControlLoop<2> for Rosbot<'_, '_, '_, A, E, S, H>
where
    A: Actuators<2>,
    E: Encoders,
    S: PositionSensor<3>,
{
    fn command(&mut self, command: Command<2>) {
        self.supervisor.follow(command, &mut self.wanted, &self.tracker);
        if self.supervisor.mode() != Mode::Running {
            // Also when a start follows before the next tick.
            self.forget();
        }
    }

    /// One tick: counts, and controls the wheels' speeds; at a sample it measures and predicts, at the ticks
    /// after it it looks ahead, and reports.
    fn tick(&mut self, now_us: u64) -> Mode {
        self.supervisor.begin(now_us);
        self.count();
        // The first tick is a sample, and every `ticks_per_sample`th from there on.
        if self.rhythm.begin(self.applied) {
            self.sample(now_us);
        }
        self.rhythm.go_on(&mut self.tracker, &mut self.supervisor);

        let mut shares = [0.0; 2];
        if self.supervisor.mode() == Mode::Running {
            for ((share, side), command) in shares.iter_mut().zip(&mut self.sides).zip(self.wanted)
            {
                let volt = side.control(command, &self.settings, self.period_s);
                *share = volt / self.settings.supply_volt;
            }
            if self.sides.iter().any(|side| side.stalled_s > STALL_S) {
                self.supervisor.raise(Alarms::ENCODER);
            }
        } else {
            self.forget();
        }
        let mode = self.supervisor.act(&mut self.actuators, shares);
        self.applied = if mode == Mode::Running { self.wanted } else { [0.0; 2] };
        for (side, command) in self.sides.iter_mut().zip(self.applied) {
            side.deviation += side.speed - command;
        }
        self.rhythm.end(&self.tracker, &mut self.supervisor, &mut self.telemetry);
        mode
    }

    fn finish(&mut self, now_us: u64) -> Mode {
        self.supervisor.finish(now_us, &mut self.actuators)
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
