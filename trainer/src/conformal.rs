//! How far to trust a prediction: split-conformal error bounds (Vovk, Gammerman & Shafer 2005;
//! Lei et al. 2018, "Distribution-free predictive inference for regression", algorithm 2), per state
//! and step, from logs that the fit has not seen.
//!
//! A calibration unit is a stretch of a log over which the model is rolled out once: one per
//! trajectory, or, where there are too few trajectories for a finite bound, one per contiguous block.
//! With n units, the bound for a state and a step is the ⌈(n + 1) c⌉-th smallest error: a further unit
//! like them stays within it with a probability of at least the coverage c. Blocks of one
//! trajectory are not independent of each other; the guarantee then is as good as they are alike.

use firmware_core::blob::{self, EmitError, SelfTest};
use firmware_core::error_bounds::ErrorBounds;
use firmware_core::model::{Model, Structure};
use serde::Serialize;

use crate::arx::MAX_LAGS;
use crate::score::roll_out_model;
use crate::trajectory::Trajectory;

/// What a calibration unit is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Unit {
    /// A whole trajectory, of which one window is used.
    Trajectory,
    /// A contiguous block of a trajectory.
    Block,
}

/// Why there are no bounds.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ConformalError {
    /// The coverage is not between 0 and 1.
    #[error("the coverage must lie between 0 and 1, not at {0}")]
    Coverage(f64),
    /// No stretch of the logs is long enough.
    #[error(
        "no trajectory has the {need} rows of a window, {first} before its first step and the horizon \
         behind it; lower --horizon"
    )]
    NoWindow {
        /// Rows of a window.
        need: usize,
        /// Rows before the first predicted one.
        first: usize,
    },
    /// A finite bound needs more units.
    #[error(
        "{found} units (blocks of {rows} rows) are too few for a finite bound of {percent} %: it needs \
         {need}; nothing is stored"
    )]
    TooFew {
        /// Units found.
        found: usize,
        /// Rows of a block.
        rows: usize,
        /// Coverage in percent.
        percent: f64,
        /// Units needed.
        need: usize,
    },
    /// Too many rollouts diverged.
    #[error(
        "the rollout diverged in {diverged} of {units} units: no bound holds for {percent} %; nothing \
         is stored"
    )]
    Diverged {
        /// Units that diverged.
        diverged: usize,
        /// Units.
        units: usize,
        /// Coverage in percent.
        percent: f64,
    },
    /// A bound is beyond f32.
    #[error("an error bound is not finite")]
    NotFinite,
}

/// Absolute errors of one rollout per unit.
#[derive(Clone, Debug, PartialEq)]
pub struct Residuals {
    /// What the units are.
    pub unit: Unit,
    /// State coordinates.
    pub states: usize,
    /// Steps of a rollout.
    pub horizon: usize,
    /// Shape `[units, horizon, states]`; infinite where the rollout diverged.
    pub errors: Vec<f64>,
    /// Units whose rollout diverged.
    pub diverged: usize,
}

impl Residuals {
    /// Rolls the model out over each unit of `trajectories`; `least` is the number of trajectories
    /// from which on they are the units.
    ///
    /// # Errors
    /// [`ConformalError::NoWindow`].
    pub fn measure(
        model: &Model<'_>,
        trajectories: &[Trajectory],
        horizon: usize,
        least: usize,
    ) -> Result<Self, ConformalError> {
        let mut residuals = Self::empty(model.structure(), trajectories, horizon, least)?;
        trajectories.iter().for_each(|t| residuals.add(model, t));
        Ok(residuals)
    }

    /// Samples before the first step that is predicted: the same for every model of a few lags.
    fn before(structure: &Structure<'_>) -> usize {
        structure.lag().max(MAX_LAGS)
    }

    /// None yet; what the units will be is decided by how many of all trajectories are long enough.
    pub(crate) fn empty(
        structure: &Structure<'_>,
        trajectories: &[Trajectory],
        horizon: usize,
        least: usize,
    ) -> Result<Self, ConformalError> {
        let first = Self::before(structure);
        let need = first + 1 + horizon;
        let states = structure.states().len();
        let rows = |t: &Trajectory| t.states.len() / states.max(1);
        let long = trajectories.iter().filter(|t| rows(t) >= need).count();
        if long == 0 {
            return Err(ConformalError::NoWindow { need, first });
        }
        let unit = if long >= least { Unit::Trajectory } else { Unit::Block };
        Ok(Self { unit, states, horizon, errors: Vec::new(), diverged: 0 })
    }

    /// The units of one more trajectory; one that is too short has none.
    pub(crate) fn add(&mut self, model: &Model<'_>, t: &Trajectory) {
        let (structure, n) = (model.structure(), self.states);
        let (m, first) = (structure.inputs().len(), Self::before(structure));
        let need = first + 1 + self.horizon;
        let mut predicted = vec![0.0; self.horizon * n];
        let blocks = t.states.len() / n.max(1) / need;
        let starts = match self.unit {
            Unit::Trajectory => blocks.min(1),
            Unit::Block => blocks,
        };
        for start in (0..starts).map(|block| block * need) {
            let row = |k: usize| [&t.states[k * n..][..n], &t.inputs[k * m..][..m]].concat();
            let window: Vec<Vec<f64>> = (start..start + need).map(row).collect();
            let (past, future) = window.split_at(first + 1);
            if !roll_out_model(model, past, future, &mut predicted) {
                self.diverged += 1;
                self.errors.extend(std::iter::repeat_n(f64::INFINITY, predicted.len()));
                continue;
            }
            for (p, x) in predicted.chunks_exact(n).zip(future) {
                for (i, state) in structure.states().iter().enumerate() {
                    self.errors.push(state.space.difference(p[i], x[i]).abs());
                }
            }
        }
    }

    /// Number of units.
    pub fn units(&self) -> usize {
        self.errors.len() / (self.horizon * self.states).max(1)
    }

    /// The bounds, shape `[horizon, states]`, one for each step.
    ///
    /// # Errors
    /// [`ConformalError`]: too few units, or too many that diverged.
    pub fn bounds(&self, coverage: f64) -> Result<Vec<f32>, ConformalError> {
        let (units, percent) = (self.units(), 100.0 * coverage);
        let need = least_units(coverage)?;
        if units < need {
            let rows = self.horizon + 1 + MAX_LAGS;
            return Err(ConformalError::TooFew { found: units, rows, percent, need });
        }
        let rank = rank(units, coverage);
        let cells = self.horizon * self.states;
        let mut bounds = Vec::with_capacity(cells);
        for cell in 0..cells {
            let mut errors: Vec<f64> =
                self.errors.iter().skip(cell).step_by(cells).copied().collect();
            errors.sort_by(f64::total_cmp);
            let bound = errors[rank - 1];
            if bound == f64::INFINITY {
                let diverged = self.diverged;
                return Err(ConformalError::Diverged { diverged, units, percent });
            }
            // Upwards: rounding must not push the unit that made the bound out of it.
            let rounded = bound as f32;
            let up = if f64::from(rounded) < bound { rounded.next_up() } else { rounded };
            if !up.is_finite() {
                return Err(ConformalError::NotFinite);
            }
            bounds.push(up);
        }
        Ok(bounds)
    }

    /// The share of units within the bounds of a model, per cell, shape `[horizon, states]`; `None`
    /// where the model has no bound.
    pub fn coverage(&self, bounds: ErrorBounds<'_>) -> Vec<Option<f64>> {
        let cells = self.horizon * self.states;
        (0..cells)
            .map(|cell| {
                let step = u32::try_from(cell / self.states + 1).ok()?;
                let bound = f64::from(bounds.bound(step, cell % self.states)?);
                let errors = self.errors.iter().skip(cell).step_by(cells);
                let within = errors.filter(|e| **e <= bound).count();
                Some(within as f64 / self.units() as f64)
            })
            .collect()
    }
}

/// The fewest units with which ⌈(n + 1) c⌉ ≤ n.
///
/// # Errors
/// [`ConformalError::Coverage`].
///
/// ```
/// use trainer::conformal::least_units;
/// assert_eq!(least_units(0.9), Ok(9));
/// assert_eq!(least_units(0.5), Ok(1));
/// assert!(least_units(1.0).is_err());
/// ```
pub fn least_units(coverage: f64) -> Result<usize, ConformalError> {
    if !(coverage > 0.0 && coverage < 1.0) {
        return Err(ConformalError::Coverage(coverage));
    }
    let estimate = libm::ceil(coverage / (1.0 - coverage) - ROUNDING).max(1.0);
    Ok(estimate as usize)
}

/// 0.9 · 10 is 9 in decimals.
const ROUNDING: f64 = 1e-9;

/// Which of the sorted errors is the bound, from 1.
fn rank(units: usize, coverage: f64) -> usize {
    libm::ceil((units + 1) as f64 * coverage - ROUNDING) as usize
}

/// The probability of every number of `test` units, 0 to all, within a bound from `calibration`
/// others; `None` where there is no bound.
///
/// The bound is the r-th of n exchangeable errors, so that the number is beta-binomial with the
/// parameters r and n + 1 − r, whatever the distribution of the errors (Vovk 2012, "Conditional
/// validity of inductive conformal predictors").
///
/// ```
/// use trainer::conformal::chance;
/// // The largest of 9: one more is within it with 9/10, both of two with 9/11.
/// let one = chance(9, 1, 0.9).unwrap();
/// assert!((one[0] - 0.1).abs() < 1e-15 && (one[1] - 0.9).abs() < 1e-15);
/// assert!((chance(9, 2, 0.9).unwrap()[2] - 9.0 / 11.0).abs() < 1e-15);
/// assert_eq!(chance(8, 1, 0.9), None);
/// ```
pub fn chance(calibration: usize, test: usize, coverage: f64) -> Option<Vec<f64>> {
    if calibration < least_units(coverage).ok()? {
        return None;
    }
    let rank = rank(calibration, coverage);
    let (a, b, n) = (rank as f64, (calibration + 1 - rank) as f64, test as f64);
    // Logarithms from p(k + 1)/p(k), the largest taken out: nothing under- or overflows.
    let mut logarithms = vec![0.0; test + 1];
    for k in 0..test {
        let x = k as f64;
        let ratio = (n - x) * (x + a) / ((x + 1.0) * (n - x - 1.0 + b));
        logarithms[k + 1] = logarithms[k] + libm::log(ratio);
    }
    let largest = logarithms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let masses: Vec<f64> = logarithms.iter().map(|l| libm::exp(l - largest)).collect();
    let sum: f64 = masses.iter().sum();
    Some(masses.iter().map(|mass| mass / sum).collect())
}

/// The shares of `test` units between which a cell lies with a probability of at least `probability`
/// by [`chance`] alone; what is left out is split evenly between the two ends.
///
/// ```
/// use trainer::conformal::chance_range;
/// // 1,000 and 1,000 units: a standard deviation of 1.3 %.
/// assert_eq!(chance_range(1000, 1000, 0.9, 0.95), Some([0.873, 0.925]));
/// // Calibrated on plenty, the test alone decides: 0.9 ± 1.96 · 0.0095.
/// assert_eq!(chance_range(1_000_000, 1000, 0.9, 0.95), Some([0.881, 0.918]));
/// ```
pub fn chance_range(
    calibration: usize,
    test: usize,
    coverage: f64,
    probability: f64,
) -> Option<[f64; 2]> {
    let masses = chance(calibration, test, coverage)?;
    let tail = (1.0 - probability) / 2.0;
    // Numbers from one end on that the tail leaves out.
    let left_out = |masses: &mut dyn Iterator<Item = &f64>| {
        let mut sum = 0.0;
        let within = masses.take_while(|mass| {
            sum += **mass;
            sum <= tail
        });
        within.count()
    };
    let (low, high) = (left_out(&mut masses.iter()), left_out(&mut masses.iter().rev()));
    (test > 0).then(|| [low, test - high].map(|k| k as f64 / test as f64))
}

/// A blob with its error bounds replaced.
///
/// # Errors
/// [`EmitError`]: the model does not predict its own self-test, which a parsed one does.
pub fn with_bounds(
    model: Model<'_>,
    test: &SelfTest<'_>,
    coverage: f64,
    residuals: &Residuals,
    bounds: &[f32],
    bytes: usize,
) -> Result<Vec<u8>, EmitError> {
    let horizons: Vec<u32> = (1..).take(residuals.horizon).collect();
    let units = u32::try_from(residuals.units()).unwrap_or(u32::MAX);
    let bounds = ErrorBounds::new(residuals.states, coverage as f32, units, &horizons, bounds)
        .map_err(|_| EmitError::SelfTest)?;
    let room = bytes + 4 * (bounds.bounds().len() + horizons.len()) + 64;
    let model = model.with_error_bounds(bounds).map_err(|_| EmitError::SelfTest)?;
    let mut out = vec![0; room];
    let length = blob::emit(&model, test.states, test.inputs, test.tolerance, &mut out)?;
    out.truncate(length);
    Ok(out)
}

/// How well bounds hold on other logs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CoverageReport {
    /// Coverage that was asked for.
    pub nominal: f64,
    /// Units the bounds were made from.
    pub calibration_units: u32,
    /// What the units are here.
    pub unit: Unit,
    /// Units here.
    pub units: usize,
    /// Cells: states × steps with a bound.
    pub cells: usize,
    /// Mean over the cells.
    pub mean: f64,
    /// Least and most of all cells.
    pub range: [f64; 2],
    /// State of the cell that is farthest from nominal.
    pub worst_state: String,
    /// Its step.
    pub worst_step: usize,
    /// Its coverage.
    pub worst: f64,
    /// Where chance alone puts 19 of 20 cells, for units that are whole trajectories.
    pub chance: Option<[f64; 2]>,
}

/// Share of the cells that lie in [`CoverageReport::chance`].
const USUAL: f64 = 0.95;

impl CoverageReport {
    /// `None` when no step has a bound.
    pub fn new(residuals: &Residuals, bounds: ErrorBounds<'_>, names: &[&str]) -> Option<Self> {
        let nominal = f64::from(bounds.coverage());
        Self::of(nominal, bounds.units(), residuals, &residuals.coverage(bounds), names)
    }

    /// The same of the shares of units within bounds that were made elsewhere, shape `[horizon, states]`.
    pub(crate) fn of(
        nominal: f64,
        calibration_units: u32,
        residuals: &Residuals,
        shares: &[Option<f64>],
        names: &[&str],
    ) -> Option<Self> {
        let cells = shares.iter().enumerate().filter_map(|(cell, share)| Some((cell, (*share)?)));
        let cells: Vec<(usize, f64)> = cells.collect();
        let off = |share: f64| (share - nominal).abs();
        let (cell, worst) = cells.iter().copied().max_by(|a, b| off(a.1).total_cmp(&off(b.1)))?;
        let shares = cells.iter().map(|c| c.1);
        Some(Self {
            nominal,
            calibration_units,
            unit: residuals.unit,
            units: residuals.units(),
            cells: cells.len(),
            mean: shares.clone().sum::<f64>() / cells.len() as f64,
            range: [
                shares.clone().fold(f64::INFINITY, f64::min),
                shares.fold(f64::NEG_INFINITY, f64::max),
            ],
            worst_state: names.get(cell % residuals.states).map_or("?", |n| n).to_owned(),
            worst_step: cell / residuals.states + 1,
            worst,
            // Blocks of one trajectory depend on each other: no theory says how far apart they lie.
            chance: (residuals.unit == Unit::Trajectory)
                .then(|| {
                    let calibration = calibration_units as usize;
                    chance_range(calibration, residuals.units(), nominal, USUAL)
                })
                .flatten(),
        })
    }

    /// Two or three lines.
    pub fn text(&self) -> String {
        let unit = match self.unit {
            Unit::Trajectory => "trajectories",
            Unit::Block => "contiguous blocks",
        };
        let chance = self.chance.map_or_else(String::new, |[low, high]| {
            format!(
                "With these numbers of units, chance alone puts 19 of 20 cells between {:.1} % and {:.1} %.\n",
                100.0 * low,
                100.0 * high
            )
        });
        format!(
            "Error bounds for {:.1} % from {} units: on {} {unit}, {:.1} % to {:.1} % are within them \
             ({} cells of state and step, mean {:.1} %).\nFarthest off: {} at step {}, {:.1} %.\n{chance}",
            100.0 * self.nominal,
            self.calibration_units,
            self.units,
            100.0 * self.range[0],
            100.0 * self.range[1],
            self.cells,
            100.0 * self.mean,
            self.worst_state,
            self.worst_step,
            100.0 * self.worst
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn residuals(errors: Vec<f64>) -> Residuals {
        Residuals { unit: Unit::Trajectory, states: 1, horizon: 1, errors, diverged: 0 }
    }

    #[test]
    fn the_bound_is_an_order_statistic() {
        // Nine units, 90 %: ⌈10 · 0.9⌉ = 9, the largest.
        let nine = residuals((1..=9).rev().map(f64::from).collect());
        assert_eq!(nine.bounds(0.9).unwrap(), [9.0]);
        // 50 %: ⌈10 · 0.5⌉ = 5.
        assert_eq!(nine.bounds(0.5).unwrap(), [5.0]);
        let message = nine.bounds(0.95).unwrap_err().to_string();
        assert!(message.contains("9 units") && message.contains("it needs 19"), "{message}");
        assert!(nine.bounds(1.5).is_err() && nine.bounds(f64::NAN).is_err());
    }

    #[test]
    fn a_diverged_unit_counts_as_infinitely_far_off() {
        let mut errors: Vec<f64> = (1..=19).map(f64::from).collect();
        errors[3] = f64::INFINITY;
        let some = Residuals { diverged: 1, ..residuals(errors) };
        assert_eq!(some.bounds(0.9).unwrap(), [19.0]);
        let message = some.bounds(0.95).unwrap_err().to_string();
        assert!(message.contains("diverged in 1 of 19"), "{message}");
    }

    #[test]
    fn the_units_that_made_a_bound_are_within_it() {
        // 0.1 is no f32: the bound is rounded up.
        let all = residuals(vec![0.1; 9]);
        let bounds = all.bounds(0.9).unwrap();
        let bounds = ErrorBounds::new(1, 0.9, 9, &[1], &bounds).unwrap();
        assert_eq!(all.coverage(bounds), [Some(1.0)]);
        let other = residuals(vec![0.05, 0.1, 0.2, f64::INFINITY]);
        assert_eq!(other.coverage(bounds), [Some(0.5)]);
        let report = CoverageReport::new(&other, bounds, &["x"]).unwrap();
        assert_eq!((report.worst, report.worst_state.as_str(), report.cells), (0.5, "x", 1));
    }
}
