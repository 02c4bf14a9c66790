//! Every fault on every robot at several intensities, against what is expected of it.
//!
//! What is expected is written down here, and the sweep is held against it. A fault may end better than
//! expected (a weak one may be survived where one may be noticed), and must not end worse.
//!
//! A fault shows only when the robot uses what is broken, and under random driving that takes some levels,
//! each of up to two seconds: strong faults of the ROSbot have 15 s, weak ones and those of the leg until 3 s
//! after their end.

use crate::fault::{Fault, FaultKind};
use crate::run::scenario::{FaultText, Scenario};
use crate::run::summary::{AFTERMATH_S, FaultReport, Outcome};
use crate::run::{Robot, RunError, run};
use firmware_core::model::Model;
use std::fmt::Write as _;

/// When the fault begins, and how long it lasts (s).
const FROM_S: f64 = 20.0;
const LASTS_S: f64 = 30.0;
/// Virtual time of a run (s).
const SECONDS: f64 = 55.0;

/// The worst that may come of a fault.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Expected {
    /// The true motion stays within the error bounds, and nothing is noticed.
    Survived,
    /// It is survived, or noticed within this time (s), whether the robot goes on or stops.
    Noticed(f64),
    /// The actuators are off within this time (s).
    MustStop(f64),
}

impl Expected {
    /// Whether a fault ended no worse.
    pub fn holds(self, found: &FaultReport) -> bool {
        let within = |s: Option<f64>, most: f64| s.is_some_and(|s| s <= most);
        let stopped = |most| {
            matches!(found.outcome, Outcome::Safe | Outcome::Reset) && within(found.off_s, most)
        };
        let noticed = |most| {
            matches!(found.outcome, Outcome::Flagged | Outcome::Safe)
                && within(found.detection_s, most)
        };
        // An encoder need not wrap.
        let survived = matches!(found.outcome, Outcome::Survived | Outcome::Idle);
        match self {
            Self::Survived => survived,
            Self::Noticed(most) => survived || noticed(most),
            Self::MustStop(most) => stopped(most),
        }
    }

    /// As it is printed.
    fn text(self) -> String {
        match self {
            Self::Survived => "survived".to_owned(),
            Self::Noticed(most) => format!("noticed in {most} s"),
            Self::MustStop(most) => format!("off in {most} s"),
        }
    }
}

/// The watchdog period (s): a robot that cannot go on is off within it.
const WATCHDOG_S: f64 = 1.0;

/// What is swept: a fault, its unit, an intensity, and what is expected of it.
type Case = (FaultKind, Option<usize>, f64, Expected);

/// The cases of a robot.
pub fn cases(robot: Robot) -> Vec<Case> {
    use Expected::{MustStop, Noticed, Survived};
    use FaultKind::*;
    // A step of the robot's own clock beyond the watchdog: it is noticed at the tick after.
    let off = WATCHDOG_S + 0.1;
    let weak = LASTS_S + AFTERMATH_S;
    let strong = match robot {
        Robot::Rosbot => 15.0,
        // A chamber is used for one direction at a time.
        Robot::SoftLeg => weak,
    };
    let mut cases = vec![
        // A measurement in ten is bridged, one in two for most of the time; none at all is not.
        (Dropout, None, 0.1, Survived),
        (Dropout, None, 0.5, Noticed(weak)),
        (Dropout, None, 1.0, MustStop(off)),
        (Nan, None, 0.1, Noticed(weak)),
        (Nan, None, 0.5, MustStop(weak)),
        (Nan, None, 1.0, MustStop(off)),
        // A sensor that stands still is told from the robot when that moves.
        (Freeze, None, 0.5, Noticed(strong)),
        (Freeze, None, 1.0, Noticed(strong)),
        (Spike, None, 0.1, Noticed(strong)),
        (Spike, None, 1.0, Noticed(strong)),
        // What arrives after its sample belongs to no later one, however little it is late.
        (Delay, None, 0.01, MustStop(off)),
        (Delay, None, 0.2, MustStop(off)),
        (Delay, None, 1.0, MustStop(off)),
        // Jitter of less than a quarter of a period is allowed.
        (LateTick, None, 0.1, Survived),
        (LateTick, None, 0.4, MustStop(weak)),
        (LateTick, None, 1.0, MustStop(off)),
        (Silence, None, 0.1, Survived),
        (Silence, None, 0.5, Survived),
        (Silence, None, 1.0, MustStop(off)),
        // 3.3 V less a tenth is above the brown-out level.
        (BrownOut, None, 0.1, Survived),
        (BrownOut, None, 0.5, MustStop(0.1)),
        (BrownOut, None, 1.0, MustStop(0.1)),
    ];
    match robot {
        Robot::Rosbot => cases.extend([
            (MissedCounts, Some(0), 0.1, Noticed(weak)),
            (MissedCounts, Some(0), 0.5, Noticed(strong)),
            // A dead encoder, as soon as the wheel is commanded to turn: its controller would drive it at
            // full voltage.
            (MissedCounts, Some(0), 1.0, MustStop(10.0)),
            // 16 bits wrap every eight seconds anyway.
            (Wrap, None, 0.999, Survived),
            (Slip, None, 0.1, Noticed(weak)),
            (Slip, Some(1), 0.3, Noticed(strong)),
            (Slip, None, 0.5, Noticed(strong)),
            (Slip, None, 1.0, Noticed(strong)),
            // The speed controllers make up for a weak battery while there is voltage left.
            (Sag, None, 0.1, Survived),
            (Sag, None, 0.5, Noticed(weak)),
            (Sag, None, 1.0, Noticed(strong)),
        ]),
        Robot::SoftLeg => cases.extend([
            (StuckValve, Some(0), 1.0, Noticed(weak)),
            (StuckValve, Some(1), 1.0, Noticed(weak)),
            (OpenValve, Some(0), 0.5, Noticed(weak)),
            (OpenValve, Some(0), 1.0, Noticed(strong)),
            (OpenValve, Some(1), 1.0, Noticed(strong)),
            (Leak, Some(0), 0.05, Noticed(weak)),
            (Leak, Some(0), 0.5, Noticed(strong)),
            (Leak, Some(0), 1.0, Noticed(strong)),
            (Leak, Some(1), 0.5, Noticed(strong)),
            (Pump, Some(0), 0.5, Noticed(weak)),
            (Pump, Some(0), 1.0, Noticed(strong)),
            (Pump, Some(1), 1.0, Noticed(strong)),
            (Sag, None, 0.1, Noticed(weak)),
            (Sag, None, 0.5, Noticed(weak)),
            (Sag, None, 1.0, Noticed(strong)),
        ]),
    }
    cases
}

/// What the runs of one case showed.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// The fault.
    pub fault: Fault,
    /// What was expected.
    pub expected: Expected,
    /// One report per seed.
    pub found: Vec<FaultReport>,
    /// Ticks after which something was driven though it must not be.
    pub driven_at_rest: u64,
}

impl Row {
    /// Whether every run ended no worse than expected.
    pub fn holds(&self) -> bool {
        self.driven_at_rest == 0 && self.found.iter().all(|report| self.expected.holds(report))
    }
}

/// Runs every case of a model's robot with `seeds` seeds, on its random driving; `progress` is told the
/// cases that are done and all.
///
/// # Errors
/// [`RunError`].
pub fn sweep(
    model: &Model<'_>,
    seeds: u64,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<Row>, RunError> {
    let robot = Robot::of(model.structure())?;
    let cases = cases(robot);
    let mut rows = Vec::with_capacity(cases.len());
    for (done, (kind, unit, intensity, expected)) in cases.iter().enumerate() {
        progress(done, cases.len());
        // The wrap acts from the beginning on.
        let from_s = if *kind == FaultKind::Wrap { 0.0 } else { FROM_S };
        let until_s = FROM_S + LASTS_S;
        let fault = Fault::new(*kind, *unit, from_s, until_s, *intensity);
        let fault = fault.expect("the cases are faults that can be");
        let mut scenario = Scenario::random(robot.limit());
        scenario.seconds = SECONDS;
        scenario.restart = false;
        scenario.faults = vec![FaultText(fault)];
        let mut row = Row { fault, expected: *expected, found: Vec::new(), driven_at_rest: 0 };
        for seed in 1..=seeds {
            let summary = run(model, &scenario, seed, &mut |_| Ok(()))?;
            row.driven_at_rest += summary.driven_at_rest;
            row.found.extend(summary.faults);
        }
        rows.push(row);
    }
    progress(cases.len(), cases.len());
    Ok(rows)
}

/// The table of a sweep: how the runs ended, the longest times, and whether that is as expected.
pub fn table(rows: &[Row]) -> String {
    let mut text = format!(
        "{:18} {:>9}  {:18} {:28} {:>10} {:>8} {:>8}\n",
        "fault", "intensity", "expected", "found", "detected", "off", "within"
    );
    for row in rows {
        let unit = row.fault.unit().map_or_else(String::new, |unit| format!(":{unit}"));
        let mut found: Vec<(Outcome, usize)> = Vec::new();
        for report in &row.found {
            match found.iter_mut().find(|(outcome, _)| *outcome == report.outcome) {
                Some((_, count)) => *count += 1,
                None => found.push((report.outcome, 1)),
            }
        }
        found.sort_by_key(|(outcome, _)| outcome.name());
        let found: Vec<String> =
            found.iter().map(|(outcome, count)| format!("{count} {}", outcome.name())).collect();
        let longest = |of: &dyn Fn(&FaultReport) -> Option<f64>| {
            let all = row.found.iter().filter_map(of);
            all.fold(None, |most: Option<f64>, s| Some(most.map_or(s, |m| m.max(s))))
        };
        let seconds = |s: Option<f64>| s.map_or_else(|| "-".to_owned(), |s| format!("{s:.2} s"));
        let least = row.found.iter().filter_map(|r| r.within).fold(f64::INFINITY, f64::min);
        let within =
            if least.is_finite() { format!("{:.1} %", 100.0 * least) } else { "-".to_owned() };
        let _ = writeln!(
            text,
            "{:18} {:>9}  {:18} {:28} {:>10} {:>8} {within:>8}{}",
            format!("{}{unit}", row.fault.kind()),
            row.fault.intensity(),
            row.expected.text(),
            found.join(", "),
            seconds(longest(&|r| r.detection_s)),
            seconds(longest(&|r| r.off_s)),
            if row.holds() { "" } else { "  WORSE THAN EXPECTED" }
        );
    }
    text
}
