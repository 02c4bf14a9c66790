//! What a run showed.

use crate::fault::{Fault, FaultKind, Faults};
use crate::run::host::Counts;
use crate::run::scenario::Scenario;
use crate::run::{Robot, number};
use firmware_core::control_loop::monitor::Monitor;
use firmware_core::control_loop::tracker::SHADOW;
use firmware_core::control_loop::{Alarms, Frame, Mode};
use firmware_core::model::Model;
use firmware_core::{Predictor, PredictorState};
use serde::Serialize;
use std::collections::VecDeque;
use std::fmt::Write as _;

/// Time after the end of a fault in which what is noticed still is its doing (s).
pub(crate) const AFTERMATH_S: f64 = 3.0;

/// What came of a fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Outcome {
    /// It never acted.
    Idle,
    /// The true motion stayed within the prediction's error bounds, and nothing was noticed.
    Survived,
    /// It was flagged, and the robot went on.
    Flagged,
    /// The loop went to Safe.
    Safe,
    /// The microcontroller was reset, which switches everything off.
    Reset,
    /// The true motion left the error bounds and nothing noticed: a failure.
    Missed,
}

impl Outcome {
    /// As it is printed.
    pub fn name(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Survived => "survived",
            Self::Flagged => "flagged",
            Self::Safe => "safe",
            Self::Reset => "reset",
            Self::Missed => "MISSED",
        }
    }
}

/// A fault and what came of it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FaultReport {
    /// As in the scenario.
    pub fault: String,
    /// How often it acted.
    pub injected: u64,
    /// What came of it.
    pub outcome: Outcome,
    /// Alarms noticed while it was active or just after.
    pub noticed: Vec<&'static str>,
    /// From its beginning to the first alarm (s).
    pub detection_s: Option<f64>,
    /// From its beginning until the actuators were off for good reason (s).
    pub off_s: Option<f64>,
    /// Share of the samples of the running robot during the fault in which the true motion was within the
    /// prediction's error bounds; `None` without samples or bounds.
    pub within: Option<f64>,
}

/// Errors of rollouts over the telemetry, with the inputs that were applied.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HorizonReport {
    /// Steps.
    pub steps: usize,
    /// RMSE of measured against predicted per state, in its unit.
    pub rmse: Vec<f64>,
}

/// How often an alarm came up.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct AlarmReport {
    /// Its name.
    pub name: &'static str,
    /// Times it came up; one that is back within [`SHADOW`] samples, the time between two of the slow
    /// comparisons, goes on.
    pub times: u64,
    /// Of them with no fault active, nor one that had just ended.
    pub false_alarms: u64,
}

/// What a run showed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// The model's robot.
    pub robot: String,
    /// Seed of sensors, faults and random commands.
    pub seed: u64,
    /// Virtual time (s).
    pub seconds: f64,
    /// Ticks of the loop.
    pub ticks: u64,
    /// Time from one tick to the next (µs).
    pub period_us: u64,
    /// Ticks that ended after the next one was due.
    pub deadline_misses: u64,
    /// The first of them, from 0.
    pub first_miss: Option<u64>,
    /// The longest tick (µs).
    pub worst_tick_us: u64,
    /// What a tick that predicts costs by the cost table (µs).
    pub predicting_tick_us: u64,
    /// Seconds in Idle, Running, Safe, and without supply.
    pub time_s: [f64; 4],
    /// Ticks after which something was driven though the loop was not Running: must be 0.
    pub driven_at_rest: u64,
    /// Resets of the microcontroller.
    pub resets: u32,
    /// Frames that reached the host, were missing, dropped by the loop, damaged on the line.
    pub frames: [u64; 4],
    /// States with their units.
    pub states: Vec<(String, String)>,
    /// Windows over which the rollouts below were made.
    pub windows: u64,
    /// Further windows, whose rollouts diverged.
    pub diverged: u64,
    /// Errors by horizon.
    pub horizons: Vec<HorizonReport>,
    /// Share of samples, running and without a fault, within the one-step error bounds, per state.
    pub within: Option<Vec<f64>>,
    /// Alarms that came up.
    pub alarms: Vec<AlarmReport>,
    /// Faults.
    pub faults: Vec<FaultReport>,
}

/// A fault while the run goes on.
#[derive(Debug, Clone)]
struct Tracked {
    fault: Fault,
    noticed: Alarms,
    detected_us: Option<u64>,
    safe_us: Option<u64>,
    reset_us: Option<u64>,
    monitor: Monitor,
    beyond: bool,
    samples: u64,
    within: u64,
}

impl Tracked {
    fn covers(&self, t_s: f64) -> bool {
        t_s >= self.fault.from_s() && t_s < self.fault.until_s() + AFTERMATH_S
    }
}

/// A row of the telemetry.
type Row<const N: usize> = ([f32; N], [f32; 2]);

/// Watches a run.
#[derive(Debug)]
pub(crate) struct Watch<const N: usize> {
    summary: Summary,
    faults: Vec<Tracked>,
    rows: VecDeque<Row<N>>,
    next_sequence: Option<u32>,
    /// Frames since each alarm was last noticed, up to one more than make it a new one.
    quiet: [u32; 16],
    horizons: [usize; 3],
    squares: [[f64; N]; 3],
    /// Samples without a fault, and those within the bounds.
    samples: u64,
    within: [u64; N],
    times: [(u64, u64); 16],
    /// Ticks in Idle, Running, Safe, and without supply.
    ticks: [u64; 4],
}

impl<const N: usize> Watch<N> {
    pub(crate) fn new(
        model: &Model<'_>,
        robot: Robot,
        scenario: &Scenario,
        seed: u64,
        cost_us: [u64; 2],
    ) -> Self {
        let ahead = robot.ahead() as usize;
        let structure = model.structure();
        let named = |s: &firmware_core::model::State<'_>| (s.name.to_owned(), s.unit.to_owned());
        let tracked = |fault: Fault| Tracked {
            fault,
            noticed: Alarms::none(),
            detected_us: None,
            safe_us: None,
            reset_us: None,
            monitor: model.error_bounds().map_or_else(Monitor::default, Monitor::new),
            beyond: false,
            samples: 0,
            within: 0,
        };
        let summary = Summary {
            robot: structure.robot().to_owned(),
            seed,
            seconds: 0.0,
            ticks: 0,
            period_us: robot.tick_us(),
            deadline_misses: 0,
            first_miss: None,
            worst_tick_us: 0,
            predicting_tick_us: cost_us[0],
            time_s: [0.0; 4],
            driven_at_rest: 0,
            resets: 0,
            frames: [0; 4],
            states: structure.states().iter().map(named).collect(),
            windows: 0,
            diverged: 0,
            horizons: Vec::new(),
            within: None,
            alarms: Vec::new(),
            faults: Vec::new(),
        };
        Self {
            summary,
            faults: scenario.faults.iter().map(|fault| tracked(fault.0)).collect(),
            rows: VecDeque::new(),
            next_sequence: None,
            quiet: [SHADOW + 1; 16],
            horizons: [1, ahead / 2, ahead],
            squares: [[0.0; N]; 3],
            samples: 0,
            within: [0; N],
            times: [(0, 0); 16],
            ticks: [0; 4],
        }
    }

    /// A tick is over.
    pub(crate) fn tick(
        &mut self,
        tick: u64,
        [began_us, ended_us]: [u64; 2],
        mode: Mode,
        off: bool,
    ) {
        let summary = &mut self.summary;
        summary.ticks += 1;
        let took_us = ended_us - began_us;
        summary.worst_tick_us = summary.worst_tick_us.max(took_us);
        if ended_us > (tick + 1) * summary.period_us {
            summary.deadline_misses += 1;
            summary.first_miss.get_or_insert(tick);
        }
        self.ticks[number(mode)] += 1;
        summary.driven_at_rest += u64::from(mode != Mode::Running && !off);
        let t_s = began_us as f64 * 1e-6;
        for fault in self.faults.iter_mut().filter(|f| mode == Mode::Safe && f.covers(t_s)) {
            fault.safe_us.get_or_insert(ended_us);
        }
    }

    /// Ticks were left out while the robot was at rest.
    pub(crate) fn left_out(&mut self, mode: Mode, ticks: u64, off: bool) {
        self.ticks[number(mode)] += ticks;
        if !off {
            self.summary.driven_at_rest += ticks;
        }
    }

    /// The microcontroller has no supply.
    pub(crate) fn off(&mut self, now_us: u64, off: bool) {
        let summary = &mut self.summary;
        self.ticks[3] += 1;
        summary.driven_at_rest += u64::from(!off);
        let t_s = now_us as f64 * 1e-6;
        let brown_outs = self.faults.iter_mut().filter(|f| f.fault.kind() == FaultKind::BrownOut);
        for fault in brown_outs.filter(|f| f.covers(t_s)) {
            fault.reset_us.get_or_insert(now_us);
        }
        self.next_sequence = None;
        self.rows.clear();
    }

    /// A frame has reached the host.
    pub(crate) fn sample(&mut self, model: &Model<'_>, frame: &Frame, truth: &[f64; N]) {
        let t_s = frame.time_us as f64 * 1e-6;
        let free = !self.faults.iter().any(|fault| fault.covers(t_s));
        let running = frame.mode == Mode::Running;
        for (i, (alarm, _)) in Alarms::all().enumerate() {
            let quiet = &mut self.quiet[i];
            *quiet = (*quiet + 1).min(SHADOW + 1);
            if !frame.noticed.contains(alarm) {
                continue;
            }
            if std::mem::take(quiet) > SHADOW {
                let (times, wrong) = &mut self.times[i];
                *times += 1;
                *wrong += u64::from(free && (running || frame.alarms.intersects(Alarms::SAFE)));
            }
        }

        let structure = model.structure();
        let error: Option<[f32; N]> = (running && frame.predicted.len() == N).then(|| {
            std::array::from_fn(|i| {
                let predicted = f64::from(frame.predicted[i]);
                structure.states()[i].space.difference(truth[i], predicted) as f32
            })
        });
        let bounds = model.error_bounds();
        for fault in self.faults.iter_mut().filter(|fault| fault.covers(t_s)) {
            // A sensor out of its range is no verdict about the robot.
            let told = frame.noticed & Alarms::TELLING;
            fault.noticed |= told;
            if !told.is_empty() {
                fault.detected_us.get_or_insert(frame.time_us);
            }
            if let (Some(error), Some(bounds)) = (error, bounds) {
                let verdict = fault.monitor.update(bounds, frame.bound_steps, &error);
                fault.beyond |= verdict.alarm;
                fault.samples += 1;
                fault.within += u64::from(verdict.ratio <= 1.0);
            }
        }
        if let (Some(bounds), true, true) = (bounds, running && free, frame.residual.len() == N) {
            self.samples += 1;
            for (i, (count, residual)) in self.within.iter_mut().zip(&frame.residual).enumerate() {
                let bound = bounds.bound(frame.bound_steps, i);
                *count += u64::from(bound.is_some_and(|bound| residual.abs() <= bound));
            }
        }
        self.roll_out(model, frame, running && free);
    }

    /// Rollouts over telemetry without gaps, as on the logs that are made of it.
    fn roll_out(&mut self, model: &Model<'_>, frame: &Frame, counts: bool) {
        let contiguous = self.next_sequence == Some(frame.sequence);
        self.next_sequence = Some(frame.sequence.wrapping_add(1));
        let row =
            frame.measured.as_slice().try_into().ok().zip(frame.applied.as_slice().try_into().ok());
        let Some(row) = row.filter(|_| counts) else { return self.rows.clear() };
        if !contiguous {
            self.rows.clear();
        }
        self.rows.push_back(row);
        let (lag, horizon) = (model.structure().lag(), self.horizons[2]);
        if self.rows.len() < lag + 1 + horizon {
            return;
        }
        let predictor = Predictor::new(model);
        let mut state = PredictorState::new();
        let mut rows = self.rows.iter();
        for (i, (measured, applied)) in rows.by_ref().take(lag + 1).enumerate() {
            let applied: &[f32] = if i == 0 { &[] } else { applied };
            if predictor.observe(&mut state, applied, measured).is_err() {
                return;
            }
        }
        let mut predicted = [0.0_f32; N];
        let (mut squares, mut diverged) = (self.squares, false);
        for (step, (measured, applied)) in (1..).zip(rows) {
            if predictor.step(&mut state, applied).is_err()
                || predictor.coordinates(&state, &mut predicted).is_err()
            {
                diverged = true;
                break;
            }
            for (which, _) in self.horizons.iter().enumerate().filter(|(_, h)| **h == step) {
                for i in 0..N {
                    let (measured, predicted) = (measured[i].into(), predicted[i].into());
                    let space = model.structure().states()[i].space;
                    let error: f64 = space.difference(measured, predicted);
                    squares[which][i] += error * error;
                }
            }
        }
        if diverged {
            self.summary.diverged += 1;
        } else {
            self.summary.windows += 1;
            self.squares = squares;
        }
        self.rows.drain(..horizon);
    }

    /// The run is over.
    pub(crate) fn finish(self, faults: &Faults, resets: u32, host: Counts) -> Summary {
        let mut summary = self.summary;
        let seconds = |ticks: u64| (ticks * summary.period_us) as f64 / 1e6;
        summary.time_s = self.ticks.map(seconds);
        summary.seconds = seconds(self.ticks.iter().sum());
        summary.resets = resets;
        summary.frames = [host.frames, host.lost, host.dropped, host.damaged];
        let windows = summary.windows as f64;
        summary.horizons = self
            .horizons
            .iter()
            .zip(&self.squares)
            .filter(|_| summary.windows > 0)
            .map(|(steps, squares)| HorizonReport {
                steps: *steps,
                rmse: squares.iter().map(|s| libm::sqrt(s / windows)).collect(),
            })
            .collect();
        summary.within = (self.samples > 0)
            .then(|| self.within.iter().map(|n| *n as f64 / self.samples as f64).collect());
        summary.alarms = Alarms::all()
            .zip(self.times)
            .filter(|(_, (times, _))| *times > 0)
            .map(|((_, name), (times, false_alarms))| AlarmReport { name, times, false_alarms })
            .collect();
        summary.faults = self
            .faults
            .into_iter()
            .zip(faults.injections())
            .map(|(tracked, (fault, injected))| {
                let since = |us: u64| us as f64 * 1e-6 - fault.from_s();
                let outcome = match &tracked {
                    _ if injected == 0 => Outcome::Idle,
                    Tracked { reset_us: Some(_), .. } => Outcome::Reset,
                    Tracked { safe_us: Some(_), .. } => Outcome::Safe,
                    Tracked { detected_us: Some(_), .. } => Outcome::Flagged,
                    Tracked { beyond: true, .. } => Outcome::Missed,
                    _ => Outcome::Survived,
                };
                let within = tracked.within as f64 / tracked.samples as f64;
                FaultReport {
                    fault: fault.to_string(),
                    injected,
                    outcome,
                    noticed: tracked.noticed.iter().map(|(_, name)| name).collect(),
                    detection_s: tracked.detected_us.map(since),
                    off_s: tracked.reset_us.or(tracked.safe_us).map(since),
                    within: (tracked.samples > 0).then_some(within),
                }
            })
            .collect();
        summary
    }
}

/// Four significant digits.
pub(crate) fn digits(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return x.to_string();
    }
    let decimals = (3 - libm::floor(libm::log10(x.abs())) as i32).clamp(0, 12) as usize;
    format!("{x:.decimals$}")
}

/// Thousands set off by commas.
pub(crate) fn grouped(n: u64) -> String {
    let digits = n.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

impl Summary {
    /// Alarms without a fault, those that only say that the model was asked beyond its training left out.
    pub fn false_alarms(&self) -> u64 {
        let telling = Alarms::all().filter(|(alarm, _)| Alarms::TELLING.contains(*alarm));
        let names: Vec<&str> = telling.map(|(_, name)| name).collect();
        let alarms = self.alarms.iter().filter(|alarm| names.contains(&alarm.name));
        alarms.map(|alarm| alarm.false_alarms).sum()
    }

    /// Whether nothing happened that must not happen.
    pub fn holds(&self) -> bool {
        self.driven_at_rest == 0 && self.faults.iter().all(|f| f.outcome != Outcome::Missed)
    }

    /// As a table.
    pub fn text(&self) -> String {
        let mut text = String::new();
        let mut line = |name: &str, value: String| {
            let _ = writeln!(text, "{name:22} {value}");
        };
        line("virtual time", format!("{} s, seed {}", digits(self.seconds), self.seed));
        line("ticks", format!("{} of {} µs", grouped(self.ticks), grouped(self.period_us)));
        let first = self
            .first_miss
            .map_or_else(String::new, |t| format!(", the first at tick {}", grouped(t)));
        line("deadline misses", format!("{}{first}", grouped(self.deadline_misses)));
        line(
            "worst tick",
            format!(
                "{} µs; one that predicts costs {} µs by the cost table",
                grouped(self.worst_tick_us),
                grouped(self.predicting_tick_us)
            ),
        );
        let [idle, running, safe, off] = self.time_s.map(|s| format!("{s:.2}"));
        line(
            "seconds",
            format!("Running {running}, Idle {idle}, Safe {safe}, without supply {off}"),
        );
        if self.driven_at_rest > 0 {
            line("DRIVEN AT REST", format!("{} ticks", grouped(self.driven_at_rest)));
        }
        let [frames, lost, dropped, damaged] = self.frames.map(grouped);
        line(
            "telemetry",
            format!("{frames} frames, {lost} missing, {dropped} dropped, {damaged} damaged"),
        );
        if self.resets > 0 {
            line("resets", self.resets.to_string());
        }
        line("false alarms", grouped(self.false_alarms()));

        if self.diverged > 0 {
            let _ = writeln!(text, "{:22} {} rollouts", "DIVERGED", grouped(self.diverged));
        }
        if !self.horizons.is_empty() {
            let _ = writeln!(
                text,
                "\nRMSE, measured against predicted with the inputs that were applied, {} windows without a fault",
                grouped(self.windows)
            );
            let _ = write!(text, "{:14}", "");
            for h in &self.horizons {
                let _ = write!(
                    text,
                    "{:>12}",
                    format!("{} steps", h.steps).replace("1 steps", "1 step")
                );
            }
            text += if self.within.is_some() { "  within the one-step bound\n" } else { "\n" };
            for (i, (name, unit)) in self.states.iter().enumerate() {
                let _ = write!(text, "{:14}", format!("{name} [{unit}]"));
                for h in &self.horizons {
                    let _ = write!(text, "{:>12}", digits(h.rmse[i]));
                }
                if let Some(within) = &self.within {
                    let _ = write!(text, "{:>9.3} %", 100.0 * within[i]);
                }
                text.push('\n');
            }
        }
        if !self.alarms.is_empty() {
            let _ = writeln!(text, "\nalarm             times  without a fault");
            for alarm in &self.alarms {
                let (times, wrong) = (grouped(alarm.times), grouped(alarm.false_alarms));
                let _ = writeln!(text, "{:14} {times:>8} {wrong:>16}", alarm.name);
            }
        }
        if !self.faults.is_empty() {
            let _ = writeln!(
                text,
                "\n{:28} {:>9}  {:9} {:>10} {:>8} {:>8}  noticed",
                "fault", "injected", "outcome", "detected", "off", "within"
            );
            let seconds =
                |s: Option<f64>| s.map_or_else(|| "-".to_owned(), |s| format!("{s:.2} s"));
            for fault in &self.faults {
                let within =
                    fault.within.map_or_else(|| "-".to_owned(), |w| format!("{:.1} %", 100.0 * w));
                let _ = writeln!(
                    text,
                    "{:28} {:>9}  {:9} {:>10} {:>8} {within:>8}  {}",
                    fault.fault,
                    grouped(fault.injected),
                    fault.outcome.name(),
                    seconds(fault.detection_s),
                    seconds(fault.off_s),
                    fault.noticed.join(", ")
                );
            }
        }
        text
    }
}
