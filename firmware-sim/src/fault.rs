//! What goes wrong in a run, and when.
//!
//! | kind | what happens while it is active | unit | intensity, above 0 up to 1 |
//! |---|---|---|---|
//! | `dropout` | the sensor has no new measurement | | probability per measurement |
//! | `nan` | one coordinate is not a number | coordinate; else a random one | probability per measurement |
//! | `freeze` | the sensor repeats what it measured before | | probability per measurement |
//! | `spike` | in one of ten measurements a coordinate is off, up or down | coordinate; else a random one | share of the size that the wrapper was given |
//! | `delay` | measurements arrive later | | the delay (s) |
//! | `missed-counts` | the encoder misses counts | side: 0 right, 1 left | probability per count |
//! | `wrap` | the encoder starts near its wrap, from the beginning on, whatever its times | side | where it starts, in units of 65535 |
//! | `stuck-valve` | the valve stays at the opening that it has | chamber: 0 bending, 1 extension | probability, drawn every 50 ms |
//! | `open-valve` | the valve is open to the selected line, whatever its voltage | chamber | how far, 1 is fully |
//! | `leak` | the chamber leaks faster | chamber | i: by 1 + 99 i |
//! | `pump` | the pump reaches less pressure | 0 input, 1 exhaust | share that is lost; with 1 its line is open to the outside |
//! | `slip` | the wheels lose way | side | share that is lost |
//! | `sag` | the battery has less voltage | | share that is lost |
//! | `late-tick` | ticks of the loop come late | | most, in periods; uniform from 0 |
//! | `silence` | what the host sends is lost | | probability per write |
//! | `brown-out` | the microcontroller's supply dips | | share that is lost |
//!
//! Without a unit, all units are hit. A fault of the plant counts once per unit and tick, a stuck valve once
//! per draw. Sensors, encoders and the host's line are wrapped ([`faulty`](crate::faulty)); the plant's faults
//! act through the `apply` of a [`bench`](mod@crate::bench); ticks and the microcontroller's supply are the business of whoever
//! runs the loop, who asks [`Faults::late_by_us`] and [`Faults::act`].

use crate::log::stream;
use crate::mcu::VirtualClock;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;
use std::cell::{Cell, RefCell};
use std::fmt;
use std::rc::Rc;
use std::str::FromStr;

/// What goes wrong; the table is in the [module's documentation](self).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
#[non_exhaustive]
pub enum FaultKind {
    /// A sensor has no new measurement.
    Dropout,
    /// A coordinate is not a number.
    Nan,
    /// A sensor repeats its last measurement.
    Freeze,
    /// A coordinate is far off.
    Spike,
    /// Measurements arrive later.
    Delay,
    /// An encoder misses counts.
    MissedCounts,
    /// An encoder starts near its wrap.
    Wrap,
    /// A valve stays where it is.
    StuckValve,
    /// A valve is open whatever its voltage.
    OpenValve,
    /// A chamber leaks faster.
    Leak,
    /// A pump reaches less pressure.
    Pump,
    /// Wheels lose way.
    Slip,
    /// The battery has less voltage.
    Sag,
    /// Ticks of the loop come late.
    LateTick,
    /// What the host sends is lost.
    Silence,
    /// The supply of the microcontroller dips.
    BrownOut,
}

impl FaultKind {
    /// All kinds under their names.
    pub const ALL: [(&str, Self); 16] = [
        ("dropout", Self::Dropout),
        ("nan", Self::Nan),
        ("freeze", Self::Freeze),
        ("spike", Self::Spike),
        ("delay", Self::Delay),
        ("missed-counts", Self::MissedCounts),
        ("wrap", Self::Wrap),
        ("stuck-valve", Self::StuckValve),
        ("open-valve", Self::OpenValve),
        ("leak", Self::Leak),
        ("pump", Self::Pump),
        ("slip", Self::Slip),
        ("sag", Self::Sag),
        ("late-tick", Self::LateTick),
        ("silence", Self::Silence),
        ("brown-out", Self::BrownOut),
    ];
}

impl fmt::Display for FaultKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Self::ALL.iter().find(|(_, kind)| kind == self).map_or("", |(name, _)| name);
        f.pad(name)
    }
}

impl FromStr for FaultKind {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let found = Self::ALL.into_iter().find(|(name, _)| *name == text);
        found.map(|(_, kind)| kind).ok_or_else(|| FaultError::Kind { text: text.into() })
    }
}

impl TryFrom<String> for FaultKind {
    type Error = FaultError;

    fn try_from(text: String) -> Result<Self, FaultError> {
        text.parse()
    }
}

/// Why something is no fault.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum FaultError {
    /// The text has another form.
    #[error(
        "`{text}` is no fault: expected KIND@FROM..UNTIL=INTENSITY or KIND:UNIT@…, \
         such as slip:1@20..40=0.5"
    )]
    Syntax {
        /// What was given.
        text: String,
    },
    /// There is no such kind.
    #[error("unknown fault `{text}`: expected one of {}", FaultKind::ALL.map(|(name, _)| name).join(", "))]
    Kind {
        /// What was given.
        text: String,
    },
    /// The times do not follow each other.
    #[error(
        "a fault must last from 0 s or later until after its beginning, not {from_s}..{until_s}"
    )]
    Times {
        /// Beginning (s).
        from_s: f64,
        /// End (s).
        until_s: f64,
    },
    /// The intensity lies outside its range.
    #[error("the intensity of a fault must be above 0 and at most 1, not {intensity}")]
    Intensity {
        /// What was given.
        intensity: f64,
    },
}

/// One fault of a schedule, written `KIND@FROM..UNTIL=INTENSITY` or `KIND:UNIT@FROM..UNTIL=INTENSITY`
/// with times in s, or as a table with the names of its fields.
///
/// ```
/// use firmware_sim::fault::{Fault, FaultKind};
///
/// let fault: Fault = "slip:1@20..40=0.5".parse()?;
/// assert_eq!((fault.kind(), fault.unit()), (FaultKind::Slip, Some(1)));
/// assert_eq!(fault.to_string(), "slip:1@20..40=0.5");
/// let table = r#"
///     kind = "slip"
///     unit = 1
///     from_s = 20
///     until_s = 40
///     intensity = 0.5
/// "#;
/// assert_eq!(toml::from_str::<Fault>(table)?, fault);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(try_from = "FaultTable")]
pub struct Fault {
    kind: FaultKind,
    unit: Option<usize>,
    from_s: f64,
    until_s: f64,
    intensity: f64,
}

/// A [`Fault`] as a file has it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FaultTable {
    kind: FaultKind,
    unit: Option<usize>,
    from_s: f64,
    until_s: f64,
    intensity: f64,
}

impl TryFrom<FaultTable> for Fault {
    type Error = FaultError;

    fn try_from(table: FaultTable) -> Result<Self, FaultError> {
        let FaultTable { kind, unit, from_s, until_s, intensity } = table;
        Self::new(kind, unit, from_s, until_s, intensity)
    }
}

impl Fault {
    /// A fault of all units, or of one, at from ≤ t < until (s).
    ///
    /// # Errors
    ///
    /// [`FaultError`] for times or an intensity outside their ranges.
    pub fn new(
        kind: FaultKind,
        unit: Option<usize>,
        from_s: f64,
        until_s: f64,
        intensity: f64,
    ) -> Result<Self, FaultError> {
        if !(from_s >= 0.0 && from_s < until_s) {
            return Err(FaultError::Times { from_s, until_s });
        }
        if !(intensity > 0.0 && intensity <= 1.0) {
            return Err(FaultError::Intensity { intensity });
        }
        Ok(Self { kind, unit, from_s, until_s, intensity })
    }

    /// What goes wrong.
    pub fn kind(&self) -> FaultKind {
        self.kind
    }

    /// The one unit that is hit, or all.
    pub fn unit(&self) -> Option<usize> {
        self.unit
    }

    /// When it begins (s).
    pub fn from_s(&self) -> f64 {
        self.from_s
    }

    /// When it ends (s).
    pub fn until_s(&self) -> f64 {
        self.until_s
    }

    /// Whether it is active at a time (s).
    pub fn is_active(&self, t_s: f64) -> bool {
        (self.from_s..self.until_s).contains(&t_s)
    }

    /// How bad it is.
    pub fn intensity(&self) -> f64 {
        self.intensity
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.kind)?;
        if let Some(unit) = self.unit {
            write!(f, ":{unit}")?;
        }
        write!(f, "@{}..{}={}", self.from_s, self.until_s, self.intensity)
    }
}

impl FromStr for Fault {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let syntax = || FaultError::Syntax { text: text.into() };
        let (what, when) = text.split_once('@').ok_or_else(syntax)?;
        let (from, rest) = when.split_once("..").ok_or_else(syntax)?;
        let (until, intensity) = rest.split_once('=').ok_or_else(syntax)?;
        let (kind, unit) = match what.split_once(':') {
            Some((kind, unit)) => (kind, Some(unit.parse().map_err(|_| syntax())?)),
            None => (what, None),
        };
        let number = |text: &str| text.parse::<f64>().map_err(|_| syntax());
        Self::new(kind.parse()?, unit, number(from)?, number(until)?, number(intensity)?)
    }
}

/// The faults of a run, each with its own seeded randomness and a count of how often it acted.
/// Clones share the counts.
///
/// ```
/// use firmware_sim::{fault::{FaultKind, Faults}, mcu::VirtualClock};
///
/// let clock = VirtualClock::new();
/// let faults = Faults::new(&clock, ["slip@20..40=0.5".parse()?], 1);
/// assert_eq!(faults.act(FaultKind::Slip, Some(0)), None);
/// clock.advance_us(20_000_000);
/// assert_eq!(faults.act(FaultKind::Slip, Some(0)), Some(0.5));
/// assert_eq!(faults.injected(FaultKind::Slip), 1);
/// # Ok::<(), firmware_sim::fault::FaultError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Faults {
    clock: VirtualClock,
    scheduled: Rc<[Scheduled]>,
}

#[derive(Debug)]
pub(crate) struct Scheduled {
    pub(crate) fault: Fault,
    acted: Cell<u64>,
    rng: RefCell<ChaCha8Rng>,
}

impl Faults {
    /// Faults at the times of `clock`.
    pub fn new(clock: &VirtualClock, faults: impl IntoIterator<Item = Fault>, seed: u64) -> Self {
        let scheduled = (0..).zip(faults).map(|(number, fault)| Scheduled {
            fault,
            acted: Cell::new(0),
            rng: RefCell::new(stream(seed, number)),
        });
        Self { clock: clock.clone(), scheduled: scheduled.collect() }
    }

    /// The clock that the faults go by.
    pub fn clock(&self) -> &VirtualClock {
        &self.clock
    }

    /// The intensity of the worst active fault of a kind in a unit (`None`: in any), which thereby
    /// acts once more.
    pub fn act(&self, kind: FaultKind, unit: Option<usize>) -> Option<f64> {
        let worst = self.worst(kind, unit)?;
        worst.count();
        Some(worst.fault.intensity)
    }

    /// Draws whether the worst active fault of a kind in a unit, whose intensity is a probability,
    /// acts now.
    pub fn strikes(&self, kind: FaultKind, unit: Option<usize>) -> bool {
        let Some(worst) = self.worst(kind, unit) else { return false };
        let strikes = worst.uniform() < worst.fault.intensity;
        if strikes {
            worst.count();
        }
        strikes
    }

    /// Whether a fault of a kind in a unit is active, which does not count.
    pub fn is_active(&self, kind: FaultKind, unit: Option<usize>) -> bool {
        self.worst(kind, unit).is_some()
    }

    /// By how much the next tick of a loop with this period is late (µs).
    pub fn late_by_us(&self, period_us: u64) -> u64 {
        self.worst(FaultKind::LateTick, None).map_or(0, |worst| {
            worst.count();
            (worst.uniform() * worst.fault.intensity * period_us as f64) as u64
        })
    }

    /// How often faults of a kind have acted.
    pub fn injected(&self, kind: FaultKind) -> u64 {
        self.injections().filter(|(fault, _)| fault.kind == kind).map(|(_, times)| times).sum()
    }

    /// All faults, and how often each has acted.
    pub fn injections(&self) -> impl Iterator<Item = (Fault, u64)> + '_ {
        self.scheduled.iter().map(|scheduled| (scheduled.fault, scheduled.acted.get()))
    }

    /// The worst active fault of a kind in a unit.
    pub(crate) fn worst(&self, kind: FaultKind, unit: Option<usize>) -> Option<&Scheduled> {
        if self.scheduled.is_empty() {
            return None;
        }
        let now_s = self.clock.now_s();
        self.of(kind, unit)
            .filter(|scheduled| scheduled.fault.is_active(now_s))
            .max_by(|a, b| a.fault.intensity.total_cmp(&b.fault.intensity))
    }

    /// All faults of a kind in a unit.
    pub(crate) fn of(
        &self,
        kind: FaultKind,
        unit: Option<usize>,
    ) -> impl Iterator<Item = &Scheduled> {
        self.scheduled.iter().filter(move |scheduled| {
            let hit = scheduled.fault.unit;
            scheduled.fault.kind == kind && (hit.is_none() || unit.is_none() || hit == unit)
        })
    }
}

impl Scheduled {
    pub(crate) fn count(&self) {
        self.acted.set(self.acted.get() + 1);
    }

    /// A uniform draw from 0 to below 1.
    pub(crate) fn uniform(&self) -> f64 {
        self.rng.borrow_mut().random()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_kind_has_its_name() {
        for (name, kind) in FaultKind::ALL {
            assert_eq!(name.parse(), Ok(kind));
            assert_eq!(kind.to_string(), name);
        }
        let message = "ice".parse::<FaultKind>().unwrap_err().to_string();
        assert!(message.starts_with("unknown fault `ice`: expected one of dropout, nan, "));
    }

    #[test]
    fn what_is_no_fault_is_refused() {
        for text in ["", "slip", "slip@1..2", "slip@1=0.5", "slip:x@1..2=0.5", "slip@1..2=half"] {
            assert_eq!(text.parse::<Fault>(), Err(FaultError::Syntax { text: text.into() }));
        }
        assert!(matches!("ice@1..2=1".parse::<Fault>(), Err(FaultError::Kind { .. })));
        for text in ["slip@2..2=1", "slip@-1..2=1", "slip@NaN..2=1", "slip@1..NaN=1"] {
            assert!(matches!(text.parse::<Fault>(), Err(FaultError::Times { .. })), "{text}");
        }
        for text in ["slip@1..2=0", "slip@1..2=1.1", "slip@1..2=NaN", "slip@1..2=-1"] {
            assert!(matches!(text.parse::<Fault>(), Err(FaultError::Intensity { .. })), "{text}");
        }
        let table = "kind = \"slip\"\nfrom_s = 1\nuntil_s = 2\nintensity = 3";
        let message = toml::from_str::<Fault>(table).unwrap_err().to_string();
        assert!(message.contains("must be above 0 and at most 1, not 3"), "{message}");
        assert!(toml::from_str::<Fault>(&table.replace("slip", "ice")).is_err());
    }

    #[test]
    fn the_worst_active_fault_of_the_unit_acts() {
        let clock = VirtualClock::new();
        let faults = ["slip@0..10=0.2", "slip:1@5..inf=0.6", "sag@0..1=0.1"];
        let faults = Faults::new(&clock, faults.map(|text| text.parse().unwrap()), 1);
        assert_eq!(faults.act(FaultKind::Slip, Some(1)), Some(0.2));
        clock.advance_us(5_000_000);
        assert_eq!(faults.act(FaultKind::Slip, Some(1)), Some(0.6));
        assert_eq!(faults.act(FaultKind::Slip, Some(0)), Some(0.2));
        assert_eq!(faults.act(FaultKind::Slip, None), Some(0.6));
        assert_eq!(faults.act(FaultKind::Sag, None), None);
        clock.advance_us(5_000_000);
        assert_eq!(faults.act(FaultKind::Slip, Some(0)), None);
        let times: Vec<u64> = faults.injections().map(|(_, times)| times).collect();
        assert_eq!(times, [2, 2, 0]);
        assert_eq!(faults.injected(FaultKind::Slip), 4);
    }

    #[test]
    fn probabilities_and_late_ticks_are_those_of_the_seed() {
        let run = |seed| {
            let faults = ["nan@0..1=0.3".parse().unwrap(), "late-tick@0..1=0.5".parse().unwrap()];
            let faults = Faults::new(&VirtualClock::new(), faults, seed);
            let late: Vec<u64> = (0..1000).map(|_| faults.late_by_us(10_000)).collect();
            let strikes = (0..1000).filter(|_| faults.strikes(FaultKind::Nan, None)).count();
            assert_eq!(faults.injected(FaultKind::Nan), strikes as u64);
            (late, strikes)
        };
        let (late, strikes) = run(1);
        assert_eq!(run(1), (late.clone(), strikes));
        assert_ne!(run(2).0, late);
        // Four standard deviations: 300 ± 58.
        assert!((242..358).contains(&strikes), "{strikes}");
        assert!(late.iter().all(|us| *us < 5_000) && late.iter().any(|us| *us > 4_900));
    }

    proptest! {
        #[test]
        fn faults_are_read_back_as_written(
            kind in 0..16_usize, unit in prop::option::of(0..4_usize),
            from in 0.0..1e3, lasts in 1e-3..1e3, intensity in 1e-6..=1.0,
        ) {
            let kind = FaultKind::ALL[kind].1;
            let fault = Fault::new(kind, unit, from, from + lasts, intensity).unwrap();
            prop_assert_eq!(fault.to_string().parse::<Fault>(), Ok(fault));
        }
    }
}
