//! Whether the robot may move.
//!
//! ```text
//!          Start, measured                  any alarm of Alarms::SAFE
//!  Idle ────────────────────> Running ────────────────────────────────> Safe
//!    ^                           │                                        │
//!    └────────── Stop ───────────┘                                        │
//!    └────────────────────────────── Reset ───────────────────────────────┘
//! ```
//!
//! While a model is installed ([`hold`](Supervisor::hold)) a robot that was not running is in Safe, and
//! stays there.

use core::fmt;

use serde::{Deserialize, Serialize};

use crate::control_loop::tracker::Tracker;
use crate::control_loop::{Actuators, Command, ControlLoopError, limited};
use crate::model::Model;

/// What the loop is doing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Mode {
    /// Waiting for a start; actuators are off.
    #[default]
    Idle,
    /// Following the host's inputs.
    Running,
    /// Something is wrong; actuators are off until a reset.
    Safe,
}

/// What was noticed since the last start or reset: a set.
///
/// ```
/// use firmware_core::control_loop::Alarms;
/// let noticed = Alarms::RESIDUAL | Alarms::HOST_SILENT;
/// assert!(noticed.contains(Alarms::RESIDUAL) && noticed.intersects(Alarms::SAFE));
/// assert!(!Alarms::RESIDUAL.intersects(Alarms::SAFE), "flagged, the host decides");
/// assert_eq!(noticed.bits(), 0b1000_0001);
/// ```
#[derive(Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Alarms(u16);

impl Alarms {
    /// No command for the time of the watchdog.
    pub const HOST_SILENT: Self = Self(1);
    /// A tick began more than a quarter of a period late, or ended after the next one was due.
    pub const LATE: Self = Self(1 << 1);
    /// The clock stood still or went back, or a tick came after less than half a period.
    pub const CLOCK: Self = Self(1 << 2);
    /// Several measurements in a row were NaN, infinite or could not be read.
    pub const SENSOR_BAD: Self = Self(1 << 3);
    /// No measurement for longer than the prediction can be trusted, or for as long too few in a row for
    /// the model to predict at all.
    pub const SENSOR_LOST: Self = Self(1 << 4);
    /// An encoder could not be read, or counted faster than a wheel can turn, several times in a row; or a
    /// motor under voltage whose wheel is not counted to turn.
    pub const ENCODER: Self = Self(1 << 5);
    /// The prediction diverged.
    pub const DIVERGED: Self = Self(1 << 6);
    /// What is measured is not what the model says, by its error bounds: slip, a leak, a stuck valve.
    pub const RESIDUAL: Self = Self(1 << 7);
    /// One measurement was far beyond the error bounds and was not believed.
    pub const OUTLIER: Self = Self(1 << 8);
    /// A wheel does not turn as fast as commanded.
    pub const WHEEL: Self = Self(1 << 9);
    /// An actuator could not be set.
    pub const ACTUATOR: Self = Self(1 << 10);
    /// A command was not finite; it was not followed, and does not count for the watchdog.
    pub const BAD_COMMAND: Self = Self(1 << 11);
    /// The model looked at values outside the range it was trained in.
    pub const OUT_OF_RANGE: Self = Self(1 << 12);
    /// A measurement was too old to belong to its sample, and was not used.
    pub const SENSOR_LATE: Self = Self(1 << 13);
    /// A new model is being installed: the robot is held in Safe.
    pub const UPDATE: Self = Self(1 << 14);

    /// Those with which a robot does not go on.
    pub const SAFE: Self = Self(
        Self::HOST_SILENT.0
            | Self::LATE.0
            | Self::CLOCK.0
            | Self::SENSOR_BAD.0
            | Self::SENSOR_LOST.0
            | Self::ENCODER.0
            | Self::DIVERGED.0
            | Self::ACTUATOR.0,
    );

    /// Those that a robot may have while its actuators are off: the others say that it does not move as
    /// the running robot would.
    pub const AT_REST: Self = Self(Self::SENSOR_BAD.0 | Self::SENSOR_LOST.0 | Self::SENSOR_LATE.0);

    /// Those that tell of a fault: not that the model was asked beyond its training.
    pub const TELLING: Self = Self(!Self::OUT_OF_RANGE.0);

    const NAMES: [(Self, &'static str); 15] = [
        (Self::HOST_SILENT, "host silent"),
        (Self::LATE, "late"),
        (Self::CLOCK, "clock"),
        (Self::SENSOR_BAD, "sensor bad"),
        (Self::SENSOR_LOST, "sensor lost"),
        (Self::ENCODER, "encoder"),
        (Self::DIVERGED, "diverged"),
        (Self::RESIDUAL, "residual"),
        (Self::OUTLIER, "outlier"),
        (Self::WHEEL, "wheel"),
        (Self::ACTUATOR, "actuator"),
        (Self::BAD_COMMAND, "bad command"),
        (Self::OUT_OF_RANGE, "out of range"),
        (Self::SENSOR_LATE, "sensor late"),
        (Self::UPDATE, "update"),
    ];

    /// None.
    pub const fn none() -> Self {
        Self(0)
    }

    /// One bit each, in the order of the constants.
    pub const fn bits(self) -> u16 {
        self.0
    }

    /// Whether all of `other` are among these.
    pub const fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Whether some of `other` are among these.
    pub const fn intersects(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }

    /// Whether there is none.
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// Every alarm with its name, in the order of the bits.
    pub fn all() -> impl Iterator<Item = (Self, &'static str)> {
        Self::NAMES.into_iter()
    }

    /// Each of them with its name.
    pub fn iter(self) -> impl Iterator<Item = (Self, &'static str)> {
        Self::NAMES.into_iter().filter(move |(alarm, _)| self.contains(*alarm))
    }
}

impl core::ops::BitAnd for Alarms {
    type Output = Self;
    fn bitand(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }
}

impl core::ops::BitOr for Alarms {
    type Output = Self;
    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl core::ops::BitOrAssign for Alarms {
    fn bitor_assign(&mut self, other: Self) {
        self.0 |= other.0;
    }
}

/// Names, separated by commas; `none`.
impl fmt::Display for Alarms {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_empty() {
            return f.write_str("none");
        }
        let mut separator = "";
        for (_, name) in self.iter() {
            write!(f, "{separator}{name}")?;
            separator = ", ";
        }
        Ok(())
    }
}

impl fmt::Debug for Alarms {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Alarms({self})")
    }
}

/// Times of a loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Timing {
    /// Time from one tick to the next (µs).
    pub period_us: u32,
    /// A running robot stops after this time without a command (µs).
    pub watchdog_us: u32,
}

impl Timing {
    /// Times of a loop with `ticks` ticks per sample of a model.
    ///
    /// # Errors
    /// [`ControlLoopError::Setting`]: the period is shorter than 10 µs or longer than an hour.
    pub fn new(model: &Model<'_>, ticks: u32, watchdog_us: u32) -> Result<Self, ControlLoopError> {
        let sample_us = model.structure().sample_time_s() * 1e6;
        let period_us = (sample_us / ticks as f32 + 0.5) as u32;
        // A timer cannot tick faster, and an hour is no control loop.
        if (10..=3_600_000_000).contains(&period_us) {
            Ok(Self { period_us, watchdog_us })
        } else {
            Err(ControlLoopError::Setting { field: "sample_time_s" })
        }
    }
}

/// A [`Command`] whose inputs are elsewhere.
#[derive(Clone, Copy, Debug)]
enum Order {
    Start,
    Inputs,
    Stop,
    Reset,
}

/// What the loop is doing, and what was noticed, when a sample is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// What it may do.
    pub mode: Mode,
    /// What was noticed since the last start or reset.
    pub alarms: Alarms,
    /// What was noticed since the report before.
    pub noticed: Alarms,
    /// The longest tick since then (µs).
    pub worst_tick_us: u32,
}

/// The state machine.
///
/// ```
/// use firmware_core::control_loop::supervisor::{Alarms, Mode, Supervisor, Timing};
/// let mut supervisor = Supervisor::new(Timing { period_us: 10_000, watchdog_us: 1_000_000 });
/// supervisor.begin(0);
/// supervisor.start();
/// for tick in 1..=100 {
///     supervisor.begin(tick * 10_000);
///     assert_eq!(supervisor.mode(), Mode::Running);
/// }
/// supervisor.begin(1_010_000);
/// assert_eq!((supervisor.mode(), supervisor.alarms()), (Mode::Safe, Alarms::HOST_SILENT));
/// ```
#[derive(Clone, Debug)]
pub struct Supervisor {
    timing: Timing,
    mode: Mode,
    alarms: Alarms,
    /// Those noticed since they were last taken.
    recent: Alarms,
    /// When the last tick began.
    began_us: Option<u64>,
    /// When the host was last heard, by the clock of the ticks; `None`: the next one says.
    heard_us: Option<u64>,
    /// Ticks since then: they count on when the clock does not.
    silent_ticks: u32,
    worst_us: u32,
    /// Nothing leads out of Safe.
    held: bool,
    /// The actuators have been switched off since they acted.
    switched_off: bool,
}

impl Supervisor {
    /// Idle.
    pub fn new(timing: Timing) -> Self {
        Self {
            timing,
            mode: Mode::Idle,
            alarms: Alarms::none(),
            recent: Alarms::none(),
            began_us: None,
            heard_us: None,
            silent_ticks: 0,
            worst_us: 0,
            held: false,
            switched_off: true,
        }
    }

    /// What the loop may do.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Whether the robot is at rest and its actuators have been switched off since they acted. Between a
    /// stop and the next tick they act as they did.
    pub fn is_switched_off(&self) -> bool {
        self.mode != Mode::Running && self.switched_off
    }

    /// What was noticed since the last start or reset.
    pub fn alarms(&self) -> Alarms {
        self.alarms
    }

    /// A tick begins: was the last one a period ago, is the host alive?
    pub fn begin(&mut self, now_us: u64) {
        if let Some(last_us) = self.began_us.replace(now_us) {
            let period_us = u64::from(self.timing.period_us);
            match now_us.checked_sub(last_us) {
                None => self.raise(Alarms::CLOCK),
                Some(elapsed) if elapsed < period_us / 2 => self.raise(Alarms::CLOCK),
                Some(elapsed) if elapsed > period_us + period_us / 4 => self.raise(Alarms::LATE),
                Some(_) => {}
            }
        }
        if self.mode == Mode::Running {
            self.silent_ticks = self.silent_ticks.saturating_add(1);
            let ticked_us = u64::from(self.silent_ticks) * u64::from(self.timing.period_us);
            let heard_us = *self.heard_us.get_or_insert(now_us);
            let silent_us = now_us.saturating_sub(heard_us).max(ticked_us);
            if silent_us > u64::from(self.timing.watchdog_us) {
                self.raise(Alarms::HOST_SILENT);
            }
        }
    }

    /// Follows a command: `wanted`, in the model's units, is what a running robot does from its next
    /// tick on.
    pub fn follow<const N: usize, const M: usize, const H: usize>(
        &mut self,
        command: Command<M>,
        wanted: &mut [f32; M],
        tracker: &Tracker<'_, '_, N, M, H>,
    ) {
        let (order, inputs) = match &command {
            Command::Start => (Order::Start, &[][..]),
            Command::Inputs(inputs) => (Order::Inputs, inputs.as_slice()),
            Command::Stop => (Order::Stop, &[][..]),
            Command::Reset => (Order::Reset, &[][..]),
        };
        self.obey(order, inputs, wanted, tracker.sees(), tracker.model());
    }

    /// [`follow`](Self::follow), which a controller has once, whatever loops it runs.
    #[inline(never)]
    fn obey(
        &mut self,
        order: Order,
        inputs: &[f32],
        wanted: &mut [f32],
        sees: bool,
        model: &Model<'_>,
    ) {
        match order {
            Order::Start if sees => {
                if self.mode == Mode::Idle {
                    wanted.fill(0.0);
                }
                self.start();
            }
            Order::Start => {}
            Order::Inputs if inputs.iter().all(|u| u.is_finite()) => {
                let ranges = model.structure().inputs().iter().map(|input| input.range);
                for ((to, u), [low, high]) in wanted.iter_mut().zip(inputs).zip(ranges) {
                    *to = limited(*u, low, high);
                }
                self.heard();
            }
            Order::Inputs => self.raise(Alarms::BAD_COMMAND),
            Order::Stop => self.stop(),
            Order::Reset => self.reset(),
        }
    }

    /// Takes what a tracker has noticed. The model is one of a robot that runs: of one whose actuators
    /// are off only the sensor is judged. What was raised.
    pub fn judge<const N: usize, const M: usize, const H: usize>(
        &mut self,
        noticed: Alarms,
        tracker: &mut Tracker<'_, '_, N, M, H>,
    ) -> Alarms {
        let mut raised = noticed;
        if self.mode != Mode::Running {
            raised = noticed & Alarms::AT_REST;
            tracker.forget_residuals();
        }
        self.raise(raised);
        raised
    }

    /// These have been reported since they were raised.
    pub(crate) fn reported(&mut self, alarms: Alarms) {
        self.recent = self.recent & Alarms(!alarms.0);
    }

    /// A running robot acts, any other is switched off; so is one that cannot act as it should, which
    /// goes to Safe. The mode from here on.
    pub fn act<const M: usize>(
        &mut self,
        actuators: &mut impl Actuators<M>,
        shares: [f32; M],
    ) -> Mode {
        let running = self.mode == Mode::Running;
        if running && actuators.apply(shares).is_err() {
            self.raise(Alarms::ACTUATOR);
        }
        if self.mode != Mode::Running && actuators.stop().is_err() {
            self.raise(Alarms::ACTUATOR);
            // It may have been this once.
            let _ = actuators.stop();
        }
        self.switched_off = self.mode != Mode::Running;
        self.mode
    }

    /// The tick ends: was it in time? A robot that is not running, because it was not or because a
    /// command came during the tick, is switched off. The mode from here on.
    pub fn finish<const M: usize>(
        &mut self,
        now_us: u64,
        actuators: &mut impl Actuators<M>,
    ) -> Mode {
        self.end(now_us);
        if self.mode != Mode::Running && actuators.stop().is_err() {
            self.raise(Alarms::ACTUATOR);
        }
        self.switched_off = self.mode != Mode::Running;
        self.mode
    }

    /// Was the tick in time?
    #[inline(never)]
    fn end(&mut self, now_us: u64) {
        let began_us = self.began_us.unwrap_or(now_us);
        match now_us.checked_sub(began_us) {
            None => self.raise(Alarms::CLOCK),
            Some(taken_us) => {
                self.worst_us = self.worst_us.max(u32::try_from(taken_us).unwrap_or(u32::MAX));
                if taken_us > u64::from(self.timing.period_us) {
                    self.raise(Alarms::LATE);
                }
            }
        }
    }

    /// What a frame says of the loop.
    pub fn report(&mut self) -> Report {
        Report {
            mode: self.mode,
            alarms: self.alarms,
            noticed: self.take_recent(),
            worst_tick_us: self.take_worst_us(),
        }
    }

    /// The longest tick since the last call (µs).
    pub fn take_worst_us(&mut self) -> u32 {
        core::mem::take(&mut self.worst_us)
    }

    /// What was noticed since the last call.
    pub fn take_recent(&mut self) -> Alarms {
        core::mem::take(&mut self.recent)
    }

    /// The host is alive.
    pub fn heard(&mut self) {
        self.heard_us = self.began_us;
        self.silent_ticks = 0;
    }

    /// Idle → Running.
    pub fn start(&mut self) {
        if self.mode == Mode::Idle {
            self.mode = Mode::Running;
            self.alarms = Alarms::none();
            self.heard();
        }
    }

    /// Running → Idle.
    pub fn stop(&mut self) {
        if self.mode == Mode::Running {
            self.mode = Mode::Idle;
        }
    }

    /// Safe → Idle.
    pub fn reset(&mut self) {
        if self.mode == Mode::Safe && !self.held {
            self.mode = Mode::Idle;
            self.alarms = Alarms::none();
        }
    }

    /// Holds a robot that is not running in Safe, with [`Alarms::UPDATE`], from where no reset leads out
    /// until it is no longer held. A running robot is not held.
    pub fn hold(&mut self, held: bool) {
        self.held = held && self.mode != Mode::Running;
        if self.held {
            self.mode = Mode::Safe;
            if !self.alarms.contains(Alarms::UPDATE) {
                self.raise(Alarms::UPDATE);
            }
        }
    }

    /// A robot that is not running was kept waiting on purpose: its next tick comes late without being so.
    pub fn pause(&mut self) {
        if self.mode != Mode::Running {
            self.began_us = None;
        }
    }

    /// Something was noticed.
    pub fn raise(&mut self, alarms: Alarms) {
        self.alarms |= alarms;
        self.recent |= alarms;
        if self.mode == Mode::Running && alarms.intersects(Alarms::SAFE) {
            self.mode = Mode::Safe;
        }
    }
}
