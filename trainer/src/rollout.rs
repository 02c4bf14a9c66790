//! Rollouts of a model in f64 or in the controller's f32, and the errors of both over test logs.
//!
//! A test trajectory is rolled out once, from the first sample at which the model can start (its
//! largest lag), over a fixed number of steps: started from the true state, where the logs are free
//! of noise. f64 shows what the fit can do, f32 what is left of it on the controller. An f32 has 24
//! binary digits for a coordinate: 1 µm at 10 m, but 0.06 mm at 1 km, so that a pose far from the origin
//! drowns in rounding, and on the controller rollouts start from a local origin.

use std::fmt::Write;

use firmware_core::model::Space;
use firmware_core::{PredictError, Predictor, PredictorState, Scalar};
use serde::Serialize;

use crate::edmd::Fit;
use crate::export::{coefficients, controller_coefficients, controller_model};
use crate::report::significant;
use crate::trajectory::Trajectory;

/// A number type that logs can be narrowed to.
pub trait Real: Scalar + Into<f64> {
    /// The nearest number.
    fn from_f64(x: f64) -> Self;
}

impl Real for f32 {
    fn from_f64(x: f64) -> Self {
        x as f32
    }
}

impl Real for f64 {
    fn from_f64(x: f64) -> Self {
        x
    }
}

/// The state of a predictor that has observed the samples of a trajectory up to `present`, as far
/// back as the model looks; `present` is at least its lag, and a sample of the trajectory.
///
/// # Errors
/// [`PredictError`].
pub fn observe<S: Real>(
    predictor: &Predictor<'_, '_, S>,
    trajectory: &Trajectory,
    present: usize,
) -> Result<PredictorState<S>, PredictError> {
    let structure = predictor.model().structure();
    let (states, m) = (structure.states(), structure.inputs().len());
    let n = states.len();
    let mut state = PredictorState::new();
    let mut applied: Vec<S> = Vec::new();
    for k in present.saturating_sub(structure.lag())..=present {
        // Angles are wrapped before they lose digits.
        let x = trajectory.states[k * n..][..n].iter().zip(states);
        let x: Vec<S> = x
            .map(|(x, s)| S::from_f64(if s.space == Space::Circle { x.wrap() } else { *x }))
            .collect();
        predictor.observe(&mut state, &applied, &x)?;
        applied = input(trajectory, m, k);
    }
    Ok(state)
}

/// The inputs of a row.
pub(crate) fn input<S: Real>(trajectory: &Trajectory, inputs: usize, row: usize) -> Vec<S> {
    trajectory.inputs[row * inputs..][..inputs].iter().map(|u| S::from_f64(*u)).collect()
}

/// Rolls a model out from sample `present` of a trajectory under the inputs as recorded, into
/// `predicted`, shape `[steps, states]`; the state that it ends in.
///
/// # Errors
/// [`PredictError`]; the rows before the step that failed are valid.
pub fn roll_out<S: Real>(
    predictor: &Predictor<'_, '_, S>,
    trajectory: &Trajectory,
    present: usize,
    predicted: &mut [f64],
) -> Result<PredictorState<S>, PredictError> {
    let structure = predictor.model().structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let mut state = observe(predictor, trajectory, present)?;
    let mut x = vec![S::ZERO; n];
    for (step, out) in predicted.chunks_exact_mut(n).enumerate() {
        predictor.step(&mut state, &input::<S>(trajectory, m, present + step))?;
        predictor.coordinates(&state, &mut x)?;
        for (to, x) in out.iter_mut().zip(&x) {
            *to = (*x).into();
        }
    }
    Ok(state)
}

/// Why there are no errors over test logs.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TestError {
    /// No trajectory is long enough.
    #[error(
        "no test trajectory has the {need} rows of a rollout over {horizon} steps; lower --horizon"
    )]
    TooShort {
        /// Rows needed.
        need: usize,
        /// Steps.
        horizon: usize,
    },
    /// The model is refused.
    #[error("the model is refused: {0:?}")]
    Model(firmware_core::model::ModelError),
}

/// Errors of a fitted model over logs that it was not fitted on.
///
/// ```
/// use std::path::Path;
/// use trainer::{edmd, robot::Robot, rollout::TestReport, trajectory::{InMemory, Trajectory}};
///
/// let robot = Robot::parse(
///     "name = \"cart\"\nsample_time_s = 0.1\nstates = [{ name = \"x\", space = \"R\", unit = \"m\" }]\n\
///      [dictionary]\nstandardise = false\n",
///     Path::new("robot.toml"),
/// )?;
/// // x⁺ = x/2 in training; in the test the first step goes to 3 instead of 2.
/// let halves = |first: f64| (0..4).map(|k| first / f64::from(1 << k)).collect();
/// let log = |states: Vec<f64>| Trajectory { states, inputs: Vec::new() };
/// let training = [log(halves(8.0)), log(halves(-2.0))];
/// let source = InMemory { trajectories: &training, states: 1, inputs: 0 };
/// let fit = edmd::fit(&robot, &source, &|_| {})?;
/// let report = TestReport::measure(&fit, &[log(vec![4.0, 3.0, 1.0])], 2)?;
/// let [wide, narrow, still] = &report.contenders[..] else { panic!() };
/// assert!((wide.mse[0] - 0.5).abs() < 1e-12); // predicted 2, 1: errors 1, 0
/// assert!((narrow.mse[0] - 0.5).abs() < 1e-6);
/// assert_eq!(still.mse, [5.0]); // 4, 4: errors 1, 3
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TestReport {
    /// Steps of a rollout.
    pub horizon: usize,
    /// The sample that rollouts start from.
    pub first_sample: usize,
    /// Rollouts: trajectories that are long enough.
    pub windows: usize,
    /// Names of the states.
    pub states: Vec<String>,
    /// Their units.
    pub units: Vec<String>,
    /// The model in f64, the model in f32, no motion.
    pub contenders: Vec<TestErrors>,
}

/// Errors of one contender per state, over all steps of all rollouts.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TestErrors {
    /// Name.
    pub name: &'static str,
    /// Rollouts that diverged; they are left out of the errors.
    pub diverged_windows: usize,
    /// Mean squared error, in the squared unit of the state.
    pub mse: Vec<f64>,
    /// Its root.
    pub rmse: Vec<f64>,
}

impl TestReport {
    /// Rolls the fitted model out over every trajectory that has `horizon` steps.
    ///
    /// # Errors
    /// [`TestError`].
    pub fn measure(fit: &Fit<'_>, test: &[Trajectory], horizon: usize) -> Result<Self, TestError> {
        let structure = &fit.structure;
        let (n, lag) = (structure.states().len(), structure.lag());
        let need = lag + 1 + horizon;
        let long: Vec<&Trajectory> = test.iter().filter(|t| t.states.len() / n >= need).collect();
        if long.is_empty() || horizon == 0 {
            return Err(TestError::TooShort { need, horizon });
        }
        let wide = coefficients(structure.dictionary(), fit.chain, &fit.operator);
        let narrow = controller_coefficients(structure.dictionary(), fit.chain, &fit.operator);
        let wide = controller_model(structure.clone(), fit.chain, &wide, None);
        let narrow = controller_model(structure.clone(), fit.chain, &narrow, None);
        let (wide, narrow) = (wide.map_err(TestError::Model)?, narrow.map_err(TestError::Model)?);
        let (wide, narrow) = (Predictor::new(&wide), Predictor::new(&narrow));
        let errors = |name, predict: &dyn Fn(&Trajectory, &mut [f64]) -> bool| {
            let mut sums = vec![0.0; n];
            let mut diverged_windows = 0;
            let mut predicted = vec![0.0; horizon * n];
            for t in &long {
                if !predict(t, &mut predicted) {
                    diverged_windows += 1;
                    continue;
                }
                let measured = &t.states[(lag + 1) * n..];
                for (k, (p, x)) in predicted.iter().zip(measured).enumerate() {
                    let error = structure.states()[k % n].space.difference(*p, *x);
                    sums[k % n] += error * error;
                }
            }
            let count = ((long.len() - diverged_windows) * horizon) as f64;
            let mse: Vec<f64> = sums.iter().map(|s| s / count).collect();
            TestErrors { name, diverged_windows, rmse: mse.iter().map(|x| x.sqrt()).collect(), mse }
        };
        let stay = |t: &Trajectory, predicted: &mut [f64]| {
            let rows = predicted.chunks_exact_mut(n);
            rows.for_each(|row| row.copy_from_slice(&t.states[lag * n..][..n]));
            true
        };
        let labels = structure.states();
        Ok(Self {
            horizon,
            first_sample: lag,
            windows: long.len(),
            states: labels.iter().map(|s| s.name.to_owned()).collect(),
            units: labels.iter().map(|s| s.unit.to_owned()).collect(),
            contenders: vec![
                errors("model in f64", &|t, p| roll_out(&wide, t, lag, p).is_ok()),
                errors("model in f32", &|t, p| roll_out(&narrow, t, lag, p).is_ok()),
                errors("no motion", &stay),
            ],
        })
    }

    /// A table.
    pub fn text(&self) -> String {
        let s = if self.windows == 1 { "" } else { "s" };
        let mut text = format!(
            "{} rollout{s} of {} steps from sample {} of each trajectory, inputs as recorded.\n\n",
            self.windows, self.horizon, self.first_sample
        );
        let label = |i: usize, power: &str| match self.units[i].as_str() {
            "" => self.states[i].clone(),
            unit if unit.contains('/') && !power.is_empty() => {
                format!("{} [({unit}){power}]", self.states[i])
            }
            unit => format!("{} [{unit}{power}]", self.states[i]),
        };
        for (title, power) in [("mean squared error", "²"), ("RMSE", "")] {
            let _ = write!(text, "{title:20}");
            for c in &self.contenders {
                let _ = write!(text, "{:>14}", c.name);
            }
            let _ = writeln!(text);
            for i in 0..self.states.len() {
                let _ = write!(text, "  {:18}", label(i, power));
                for c in &self.contenders {
                    let numbers = if power.is_empty() { &c.rmse } else { &c.mse };
                    let _ = write!(text, "{:>14}", significant(numbers[i]));
                }
                let _ = writeln!(text);
            }
        }
        for c in self.contenders.iter().filter(|c| c.diverged_windows > 0) {
            let _ = writeln!(
                text,
                "{}: {} of {} rollouts diverged and are left out",
                c.name, c.diverged_windows, self.windows
            );
        }
        text
    }
}
