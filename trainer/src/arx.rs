//! The baseline that a lifted model has to beat: a linear model with lags (ARX),
//! y⁺ = c + Σᵢ (Aᵢ yₖ₋ᵢ + Bᵢ uₖ₋ᵢ), i = 0 … L, by least squares on standardised columns with a ridge
//! of 1e-6 on the normalised Gram matrix (not on the constant). Angles are continuous.

use crate::forecast::{Data, Forecast};
use crate::solve;

/// Lags tried.
pub const MAX_LAGS: usize = 5;
/// Ridge on the Gram matrix of the standardised columns divided by the number of rows.
const RIDGE: f64 = 1e-6;

/// Sums the normal equations for every number of lags at once.
#[derive(Clone, Debug)]
pub struct ArxAccumulator {
    states: usize,
    inputs: usize,
    /// The first row seen, subtracted from all: keeps digits when the mean is far from 0.
    origin: Option<Vec<f64>>,
    rows: f64,
    sums: Vec<f64>,
    squares: Vec<f64>,
    /// Normal equations of the pairs with exactly k earlier samples, k = 0 … MAX_LAGS; the last one
    /// holds all pairs with more. A pair with k earlier samples serves every L ≤ k.
    equations: Vec<Equations>,
}

/// Normal equations over [1, v₀, v₁, …], v the states and inputs of a sample, latest first.
#[derive(Clone, Debug)]
struct Equations {
    pairs: f64,
    /// Upper half, shape `[columns, columns]`.
    gram: Vec<f64>,
    /// Shape `[columns, states]`.
    cross: Vec<f64>,
}

impl ArxAccumulator {
    /// For rows of `states` and `inputs`.
    pub fn new(states: usize, inputs: usize) -> Self {
        let width = states + inputs;
        let equations = (0..=MAX_LAGS)
            .map(|lags| {
                let columns = 1 + (lags + 1) * width;
                Equations {
                    pairs: 0.0,
                    gram: vec![0.0; columns * columns],
                    cross: vec![0.0; columns * states],
                }
            })
            .collect();
        Self {
            states,
            inputs,
            origin: None,
            rows: 0.0,
            sums: vec![0.0; width],
            squares: vec![0.0; width],
            equations,
        }
    }

    /// A row (states, then inputs) of the training data, for mean and standard deviation.
    pub fn row(&mut self, row: &[f64]) {
        let origin = self.origin.get_or_insert_with(|| row.to_vec());
        self.rows += 1.0;
        for (((sum, square), x), origin) in
            self.sums.iter_mut().zip(&mut self.squares).zip(row).zip(origin)
        {
            *sum += x - *origin;
            *square += (x - *origin) * (x - *origin);
        }
    }

    /// A pair: `recent` holds the rows k, k − 1, …, latest first (at most MAX_LAGS + 1 are used),
    /// `next` the states at k + 1.
    pub fn pair<'r>(&mut self, recent: impl Iterator<Item = &'r [f64]>, next: &[f64]) {
        let Some(origin) = &self.origin else { return };
        let mut columns = Vec::with_capacity(1 + (MAX_LAGS + 1) * (self.states + self.inputs));
        columns.push(1.0);
        for row in recent.take(MAX_LAGS + 1) {
            columns.extend(row.iter().zip(origin).map(|(x, o)| x - o));
        }
        let lags = (columns.len() - 1) / (self.states + self.inputs).max(1);
        let Some(equations) = lags.checked_sub(1).and_then(|l| self.equations.get_mut(l)) else {
            return;
        };
        let n = columns.len();
        equations.pairs += 1.0;
        for (i, x) in columns.iter().enumerate() {
            for (sum, y) in equations.gram[i * n + i..].iter_mut().zip(&columns[i..]) {
                *sum += x * y;
            }
            let cross = &mut equations.cross[i * self.states..][..self.states];
            for ((sum, y), o) in cross.iter_mut().zip(next).zip(origin) {
                *sum += x * (y - o);
            }
        }
    }

    /// The model with `lags` lags; `None` without data.
    pub fn fit(&self, lags: usize) -> Option<Arx> {
        let (states, width) = (self.states, self.states + self.inputs);
        let n = 1 + (lags + 1) * width;
        let (mut gram, mut x) = (vec![0.0; n * n], vec![0.0; n * states]);
        let mut pairs = 0.0;
        for (k, equations) in self.equations.iter().enumerate().skip(lags) {
            let columns = 1 + (k + 1) * width;
            pairs += equations.pairs;
            for i in 0..n {
                for j in i..n {
                    gram[i * n + j] += equations.gram[i * columns + j];
                }
            }
            for (to, c) in x.iter_mut().zip(&equations.cross) {
                *to += c;
            }
        }
        if pairs == 0.0 {
            return None;
        }
        // Standardise: column j becomes (column − mean) / deviation, the same for all lags.
        let (mut mean, mut deviation) = (vec![0.0; n], vec![1.0; n]);
        for j in 1..n {
            let v = (j - 1) % width;
            mean[j] = self.sums[v] / self.rows;
            let variance = self.squares[v] / self.rows - mean[j] * mean[j];
            deviation[j] = if variance > 0.0 { variance.sqrt() } else { 1.0 };
        }
        for i in 0..n {
            for j in 0..i {
                gram[i * n + j] = gram[j * n + i];
            }
        }
        let sums: Vec<f64> = (0..n).map(|j| gram[j]).collect();
        let totals: Vec<f64> = x[..states].to_vec();
        for i in 1..n {
            for j in 1..n {
                let g = gram[i * n + j] - mean[i] * sums[j] - mean[j] * sums[i]
                    + pairs * mean[i] * mean[j];
                gram[i * n + j] = g / (deviation[i] * deviation[j]);
            }
            let edge = (sums[i] - pairs * mean[i]) / deviation[i];
            (gram[i], gram[i * n]) = (edge, edge);
            for (s, total) in totals.iter().enumerate() {
                x[i * states + s] = (x[i * states + s] - mean[i] * total) / deviation[i];
            }
        }
        for g in gram.iter_mut().chain(&mut x) {
            *g /= pairs;
        }
        for i in 1..n {
            gram[i * n + i] += RIDGE;
        }
        // The constant's diagonal entry is 1; a column that never moves has only the ridge.
        let scale: Vec<f64> = (0..n).map(|i| gram[i * n + i].sqrt()).collect();
        for i in 0..n {
            for j in 0..n {
                gram[i * n + j] /= scale[i] * scale[j];
            }
            for y in &mut x[i * states..][..states] {
                *y /= scale[i];
            }
        }
        let l = solve::cholesky(&gram, n).ok()?;
        solve::solve_cholesky(&l, &mut x, n, states);
        // Back to raw units.
        let origin = self.origin.as_ref()?;
        let mut constant: Vec<f64> = (0..states).map(|s| x[s] / scale[0] + origin[s]).collect();
        let mut weights = vec![0.0; (n - 1) * states];
        for i in 1..n {
            for s in 0..states {
                let w = x[i * states + s] / (scale[i] * deviation[i]);
                weights[(i - 1) * states + s] = w;
                constant[s] -= w * (mean[i] + origin[(i - 1) % width]);
            }
        }
        Some(Arx { lags, states, constant, weights })
    }
}

/// A linear model with lags.
#[derive(Clone, Debug, PartialEq)]
pub struct Arx {
    /// L.
    pub lags: usize,
    states: usize,
    constant: Vec<f64>,
    /// Shape `[(L + 1) · (states + inputs), states]`.
    weights: Vec<f64>,
}

impl Arx {
    /// Predicts the next states from the rows k, k − 1, … (states, then inputs), latest first.
    pub fn predict<'r>(&self, recent: impl Iterator<Item = &'r [f64]>, next: &mut [f64]) {
        next.copy_from_slice(&self.constant);
        let values = recent.take(self.lags + 1).flatten();
        for (x, weights) in values.zip(self.weights.chunks_exact(self.states)) {
            for (y, w) in next.iter_mut().zip(weights) {
                *y += w * x;
            }
        }
    }
}

/// The ARX as a [`Forecast`]: the models with 0, 1, … lags. Where there are fewer earlier samples
/// than lags, the model with as many lags as there are predicts, or the robot is taken to have rested
/// at the first sample with no input.
#[derive(Clone, Debug, PartialEq)]
pub struct ArxForecast {
    models: Vec<Arx>,
    rested: bool,
}

impl ArxForecast {
    /// Fits the models with up to [`MAX_LAGS`] lags; `None` without data.
    pub fn fit(training: Data<'_>) -> Option<Self> {
        let (n, m) = (training.spaces.len(), training.inputs);
        let mut sums = ArxAccumulator::new(n, m);
        for trajectory in training.trajectories {
            let rows: Vec<Vec<f64>> = rows(&trajectory.states, &trajectory.inputs, n).collect();
            for (k, row) in rows.iter().enumerate() {
                sums.row(row);
                if k > 0 {
                    sums.pair(rows[..k].iter().rev().map(Vec::as_slice), &row[..n]);
                }
            }
        }
        let models = (0..=MAX_LAGS).map(|lags| sums.fit(lags)).collect::<Option<_>>()?;
        Some(Self { models, rested: false })
    }

    /// The same with no more than `lags` lags; `rested` says whether the robot rested before the
    /// first sample.
    pub fn with_lags(&self, lags: usize, rested: bool) -> Self {
        Self { models: self.models[..(lags + 1).min(self.models.len())].to_vec(), rested }
    }
}

/// States and inputs of each sample side by side.
fn rows<'t>(states: &'t [f64], inputs: &'t [f64], n: usize) -> impl Iterator<Item = Vec<f64>> + 't {
    let samples = states.len() / n.max(1);
    let m = inputs.len() / samples.max(1);
    (0..samples).map(move |k| [&states[k * n..][..n], &inputs[k * m..][..m]].concat())
}

impl Forecast for ArxForecast {
    fn numbers(&self) -> usize {
        let last = self.models.last();
        last.map_or(0, |arx| arx.constant.iter().chain(&arx.weights).filter(|w| **w != 0.0).count())
    }

    fn predict(&self, states: &[f64], inputs: &[f64], next: &mut [f64]) -> bool {
        let n = next.len();
        let samples = states.len() / n.max(1);
        let usable = if self.rested { self.models.len() } else { samples.min(self.models.len()) };
        let Some(model) = self.models[..usable].last() else { return false };
        let m = inputs.len() / samples.max(1);
        let used = samples.saturating_sub(1 + model.lags);
        let mut recent: Vec<Vec<f64>> = rows(&states[used * n..], &inputs[used * m..], n).collect();
        recent.reverse();
        if let Some(first) = recent.last() {
            let rest = [&first[..n], &vec![0.0; m]].concat();
            recent.resize(recent.len().max(model.lags + 1), rest);
        }
        model.predict(recent.iter().map(Vec::as_slice), next);
        next.iter().all(|x| x.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trajectory::Trajectory;
    use firmware_core::model::Space;

    /// x⁺ = 1.5 x − 0.7 x₋₁ + u₋₁: needs one lag.
    fn oscillator() -> Trajectory {
        let mut t = Trajectory { states: vec![1.0, 0.5], inputs: Vec::new() };
        t.inputs = (0..400).map(|k| f64::from(k * k % 17) / 17.0 - 0.4).collect();
        for k in 1..399 {
            let next = 1.5 * t.states[k] - 0.7 * t.states[k - 1] + t.inputs[k - 1];
            t.states.push(next);
        }
        t
    }

    #[test]
    fn a_forecast_uses_as_many_lags_as_there_are_samples() {
        let walk = [oscillator()];
        let data =
            Data { spaces: &[Space::Line], inputs: 1, sample_time_s: 1.0, trajectories: &walk };
        let arx = ArxForecast::fit(data).unwrap();
        let mut next = [0.0];
        let mut error = |arx: &ArxForecast, samples: usize| {
            assert!(arx.predict(&walk[0].states[..samples], &walk[0].inputs[..samples], &mut next));
            (next[0] - walk[0].states[samples]).abs()
        };
        // From the second sample on the lag is there; the ridge leaves a trace.
        let mut worst =
            |arx: &ArxForecast| (2..60).map(|k| error(arx, k)).fold(0.0_f64, |a, e| a.max(e));
        assert!(worst(&arx) < 1e-4);
        assert!(worst(&arx.with_lags(0, false)) > 0.1, "no lag, no oscillation");
        assert!(error(&arx, 1) > 1e-2, "nothing to look back at");
        // At rest at 1 before: 1.5 − 0.7.
        arx.with_lags(1, true).predict(&[1.0], &[0.3], &mut next);
        assert!((next[0] - 0.8).abs() < 1e-4, "{next:?}");
        assert!(ArxForecast::fit(Data { trajectories: &[], ..data }).is_none());
    }
}
