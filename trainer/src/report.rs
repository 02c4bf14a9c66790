//! What the commands print: tables for people, JSON for programs.

use std::fmt::Write;

use serde::Serialize;

use crate::arx::MAX_LAGS;
use crate::score::{Plan, Score};

/// A score as JSON: errors in the unit of each state; `null` stands for a number that does not
/// exist (no finite value).
#[derive(Debug, Serialize)]
pub struct ScoreReport {
    /// `cross-validation`, `blocks`, `hold-out` or `all`.
    pub scheme: &'static str,
    /// Folds.
    pub folds: usize,
    /// Steps of a rollout.
    pub horizon: usize,
    /// Samples between windows.
    pub stride: usize,
    /// Samples before the first predicted one of a window.
    pub first_sample: usize,
    /// Windows scored.
    pub windows: usize,
    /// States in order.
    pub states: Vec<StateReport>,
    /// Model, no motion, best ARX.
    pub contenders: Vec<ContenderReport>,
    /// Lags of the ARX that was chosen by cross-validation.
    pub arx_lags: usize,
    /// NRMSE of the ARX with 0, 1, … lags on the scored data.
    pub arx_nrmse: Vec<f64>,
}

/// A state of a score.
#[derive(Debug, Serialize)]
pub struct StateReport {
    /// Name.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Standard deviation of the scored data.
    pub deviation: f64,
}

/// A line of a score.
#[derive(Debug, Serialize)]
pub struct ContenderReport {
    /// Name.
    pub name: String,
    /// Windows that diverged, not part of the errors.
    pub diverged_windows: usize,
    /// RMSE of the first step per state.
    pub one_step_rmse: Vec<f64>,
    /// RMSE over all steps per state.
    pub rollout_rmse: Vec<f64>,
    /// RMSE of the last step per state.
    pub last_step_rmse: Vec<f64>,
    /// RMSE over all steps divided by the deviation, mean over states; null when a window diverged.
    pub nrmse: f64,
}

impl ScoreReport {
    /// From a score and the states' names and units.
    pub fn new(score: &Score, states: &[(&str, &str)]) -> Self {
        let (scheme, folds) = match &score.plan {
            Plan::Folds { folds, .. } => ("cross-validation", *folds),
            Plan::Blocks { folds, .. } => ("blocks", *folds),
            Plan::HoldOut { .. } => ("hold-out", 1),
            Plan::All => ("all", 1),
        };
        let contenders = score.contenders.iter().map(|c| ContenderReport {
            name: c.name.clone(),
            diverged_windows: c.diverged,
            one_step_rmse: c.one_step.clone(),
            rollout_rmse: c.rollout.clone(),
            last_step_rmse: c.last_step.clone(),
            nrmse: c.nrmse,
        });
        Self {
            scheme,
            folds,
            horizon: score.horizon,
            stride: score.stride,
            first_sample: score.first,
            windows: score.windows,
            states: states
                .iter()
                .zip(&score.deviation)
                .map(|((name, unit), deviation)| StateReport {
                    name: (*name).to_owned(),
                    unit: (*unit).to_owned(),
                    deviation: *deviation,
                })
                .collect(),
            contenders: contenders.collect(),
            arx_lags: score.arx_lags,
            arx_nrmse: score.arx.clone(),
        }
    }

    /// The table, with a caption that says what was trained on what. `given` is the blob under
    /// test; otherwise the model was fitted anew in every fold.
    pub fn table(&self, given: bool) -> String {
        let plural =
            |n: usize, one: &str| if n == 1 { format!("1 {one}") } else { format!("{n} {one}s") };
        let mut text = String::new();
        let who = if given { "the ARX was" } else { "model and ARX were" };
        let trained = match self.scheme {
            "cross-validation" => format!(
                "{}-fold cross-validation over whole trajectories: {who} fitted on the other folds",
                self.folds
            ),
            "blocks" => format!(
                "one trajectory in {} blocks: {who} fitted on the samples away from the block that is scored",
                self.folds
            ),
            "hold-out" => format!("scored on held-out trajectories: {who} fitted on the others"),
            _ => "all trajectories scored; the ARX was fitted on the training logs".to_owned(),
        };
        let _ = writeln!(
            text,
            "{trained}.\n{} of {} steps, one every {} from sample {} on; inputs as recorded; the model in the controller's f32.",
            plural(self.windows, "window"),
            self.horizon,
            plural(self.stride, "sample"),
            self.first_sample,
        );
        if !given {
            let _ = writeln!(text, "The model that is written is fitted on all trajectories.");
        }
        let _ = writeln!(text);

        let groups = [
            "RMSE of one step".to_owned(),
            format!("RMSE over {}", plural(self.horizon, "step")),
            format!("RMSE at step {}", self.horizon),
        ];
        let labels: Vec<String> = self
            .states
            .iter()
            .map(|s| {
                if s.unit.is_empty() { s.name.clone() } else { format!("{} [{}]", s.name, s.unit) }
            })
            .collect();
        let label_width = labels.iter().map(|l| l.chars().count()).max().unwrap_or(0).max(8);
        let width = self.contenders.iter().map(|c| c.name.len()).max().unwrap_or(0).max(9);
        let group_width = self.contenders.len() * (width + 2);
        let _ = write!(text, "{:label_width$}", "");
        for group in &groups {
            let _ = write!(text, " |{group:^group_width$}");
        }
        let _ = write!(text, "\n{:label_width$}", "");
        for _ in &groups {
            let _ = write!(text, " |");
            for contender in &self.contenders {
                let _ = write!(text, "{:>w$}", contender.name, w = width + 2);
            }
        }
        let _ = writeln!(text);
        for (i, label) in labels.iter().enumerate() {
            let _ = write!(text, "{label:label_width$}");
            for group in 0..groups.len() {
                let _ = write!(text, " |");
                for c in &self.contenders {
                    let rmse = [&c.one_step_rmse, &c.rollout_rmse, &c.last_step_rmse][group][i];
                    let _ = write!(text, "{:>w$}", significant(rmse), w = width + 2);
                }
            }
            let _ = writeln!(text);
        }
        let _ = write!(text, "{:label_width$} |{:group_width$} |", "NRMSE", "");
        for c in &self.contenders {
            let _ = write!(text, "{:>w$}", significant(c.nrmse), w = width + 2);
        }
        let _ = writeln!(text, " |");
        if self.contenders.iter().any(|c| c.diverged_windows > 0) {
            let _ = write!(text, "{:label_width$} |{:group_width$} |", "diverged", "");
            for c in &self.contenders {
                let _ = write!(text, "{:>w$}", c.diverged_windows, w = width + 2);
            }
            let _ = writeln!(text, " |  windows, left out of the errors above");
        }
        let list = self.arx_nrmse.iter().map(|n| significant(*n)).collect::<Vec<_>>().join(", ");
        let _ = writeln!(text, "\nNRMSE of the ARX with 0 to {MAX_LAGS} lags: {list}.");
        let _ = write!(text, "{}", self.verdict());
        text
    }

    /// Where the model does not win, in words.
    fn verdict(&self) -> String {
        let Some((model, others)) = self.contenders.split_first() else { return String::new() };
        let mut lines = String::new();
        if model.diverged_windows > 0 {
            let _ = writeln!(
                lines,
                "The model diverged in {} of {} windows: do not trust its rollouts.",
                model.diverged_windows, self.windows
            );
        }
        for other in others {
            let behind: Vec<&str> = self
                .states
                .iter()
                .enumerate()
                .filter(|(i, _)| model.rollout_rmse[*i] > other.rollout_rmse[*i])
                .map(|(_, s)| s.name.as_str())
                .collect();
            if !behind.is_empty() {
                let _ = writeln!(
                    lines,
                    "Over {} steps the model does not beat {} in {}.",
                    self.horizon,
                    other.name,
                    behind.join(", ")
                );
            }
        }
        lines
    }
}

/// Four significant digits, or `diverged` where there is no finite number.
///
/// ```
/// use trainer::report::significant;
/// assert_eq!(significant(0.0123456), "0.01235");
/// assert_eq!(significant(12345.6), "12346");
/// assert_eq!(significant(1.5e-9), "1.500e-9");
/// ```
pub fn significant(x: f64) -> String {
    if !x.is_finite() {
        return "diverged".to_owned();
    }
    let magnitude = x.abs();
    if magnitude == 0.0 {
        "0".to_owned()
    } else if !(1e-4..1e6).contains(&magnitude) {
        format!("{x:.3e}")
    } else {
        let decimals = (3 - libm::floor(libm::log10(magnitude)) as i32).max(0) as usize;
        format!("{x:.decimals$}")
    }
}

/// A hash as lower-case hexadecimal.
pub fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// `1,234,567`.
///
/// ```
/// assert_eq!(trainer::report::grouped(1234567), "1,234,567");
/// ```
pub fn grouped(n: u64) -> String {
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
