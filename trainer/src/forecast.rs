//! What every method of prediction offers, and how all of them are scored on whole test
//! trajectories.
//!
//! | method | file |
//! |---|---|
//! | Koopman operator with any dictionary of robot.toml | [`koopman`](crate::koopman) |
//! | EDMD with a direct sum of Hermite polynomials | [`hermite`](crate::hermite) |
//! | EDMD with dictionary learning | [`edmd_dl`](crate::edmd_dl) |
//! | SINDy by LASSO or thresholded least squares | [`sindy`](crate::sindy) |
//! | linear ARX, no motion | [`arx`](crate::arx) |

use firmware_core::model::Space;

use crate::trajectory::{InMemory, Trajectory};

/// Trajectories in memory, and what their numbers mean.
#[derive(Clone, Copy, Debug)]
pub struct Data<'d> {
    /// Where each state coordinate lives; its length is the number of states.
    pub spaces: &'d [Space],
    /// Number of inputs.
    pub inputs: usize,
    /// Time between two samples, in seconds.
    pub sample_time_s: f64,
    /// The trajectories; angles are in radians and continuous.
    pub trajectories: &'d [Trajectory],
}

impl<'d> Data<'d> {
    /// The same trajectories as everything that streams takes them.
    pub fn source(self) -> InMemory<'d> {
        let (states, inputs) = (self.spaces.len(), self.inputs);
        InMemory { trajectories: self.trajectories, states, inputs }
    }

    /// Snapshot pairs of consecutive samples, as (states, inputs, next states); none spans two
    /// trajectories.
    ///
    /// ```
    /// use firmware_core::model::Space;
    /// use trainer::forecast::Data;
    /// use trainer::trajectory::Trajectory;
    /// let walk = Trajectory { states: vec![0.0, 1.0, 3.0], inputs: vec![1.0, 2.0, 9.0] };
    /// let data = Data { spaces: &[Space::Line], inputs: 1, sample_time_s: 0.1, trajectories: &[walk] };
    /// let pairs: Vec<_> = data.pairs().map(|(x, u, next)| (x[0], u[0], next[0])).collect();
    /// assert_eq!(pairs, [(0.0, 1.0, 1.0), (1.0, 2.0, 3.0)]);
    /// ```
    pub fn pairs(self) -> impl Iterator<Item = (&'d [f64], &'d [f64], &'d [f64])> + Clone {
        let (n, m) = (self.spaces.len(), self.inputs);
        self.trajectories.iter().flat_map(move |t| {
            let samples = t.states.len() / n.max(1);
            (1..samples).map(move |k| {
                (
                    &t.states[(k - 1) * n..][..n],
                    &t.inputs[(k - 1) * m..][..m],
                    &t.states[k * n..][..n],
                )
            })
        })
    }
}

/// Predicts the next sample of a robot from those before it.
pub trait Forecast {
    /// Numbers that the model consists of and that are not 0: what training has found.
    fn numbers(&self) -> usize;

    /// Predicts `next`, shape `[states]`, from the samples up to the present one: `states`, shape
    /// `[samples, n]`, and `inputs`, shape `[samples, m]`, oldest first, the last input being the
    /// one that acts until the next sample. A method uses as many of them as it looks back, at least
    /// one. Angles may come on any turn. `false` when there is no finite prediction.
    fn predict(&self, states: &[f64], inputs: &[f64], next: &mut [f64]) -> bool;

    /// Predicts `predicted`, shape `[steps, n]`, from `states`, shape `[samples, n]`, and `inputs`,
    /// shape `[samples − 1 + steps, m]`: every step starts from the prediction before it. `false`
    /// when it diverges.
    fn roll_out(&self, states: &[f64], inputs: &[f64], predicted: &mut [f64], n: usize) -> bool {
        let steps = predicted.len() / n.max(1);
        let past = states.len() / n.max(1);
        let m = inputs.len() / (past + steps).saturating_sub(1).max(1);
        let mut all = Vec::with_capacity(states.len() + predicted.len());
        all.extend_from_slice(states);
        for (step, next) in predicted.chunks_exact_mut(n.max(1)).enumerate() {
            if !self.predict(&all, &inputs[..(past + step) * m], next) {
                return false;
            }
            all.extend_from_slice(next);
        }
        true
    }
}

/// A method that learns from trajectories.
pub trait Baseline: Forecast + Sized {
    /// What can be chosen; the default is what the tables use.
    type Settings: Default;

    /// Learns from the training data.
    ///
    /// # Errors
    /// [`BaselineError`].
    fn fit(training: Data<'_>, settings: &Self::Settings) -> Result<Self, BaselineError>;
}

/// Why a baseline has nothing to predict with.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BaselineError {
    /// There is nothing to learn from.
    #[error("the training trajectories hold no snapshot pair: at least one needs two samples")]
    NoPairs,
    /// A setting makes no sense.
    #[error("{0}")]
    Settings(String),
    /// The numbers ran away.
    #[error("the fit left the finite numbers: the data hold values too large for the library")]
    NotFinite,
}

/// Squared errors of a method on test trajectories.
#[derive(Clone, Debug, PartialEq)]
pub struct Evaluation {
    /// Mean squared one-step error per state, each prediction from the true sample before it (the
    /// paper's MSE), in squared units; angles are compared on the circle.
    pub one_step: Vec<f64>,
    /// Mean squared error of rollouts from the first sample over all their steps.
    pub rollout: Vec<f64>,
    /// Mean squared error of the rollouts after each number of steps, shape `[steps, states]`.
    pub by_step: Vec<f64>,
    /// Trajectories whose rollout diverged; then `rollout` is infinite.
    pub diverged: usize,
    /// One-step predictions of the first trajectory, shape `[samples − 1, states]`, for plots.
    pub example_steps: Vec<f64>,
    /// Rollout of the first trajectory, shape `[steps, states]`, for plots; empty if it diverged.
    pub example: Vec<f64>,
}

/// Scores a method on all of `test`: errors of samples 1 to the last, from the first one on.
///
/// All trajectories are rolled out over `steps` steps; those that are shorter are left out of the
/// rollouts.
pub fn evaluate(method: &(impl Forecast + ?Sized), test: Data<'_>, steps: usize) -> Evaluation {
    let (n, m) = (test.spaces.len(), test.inputs);
    let square = |i: usize, predicted: f64, measured: f64| {
        let error = test.spaces[i].difference(predicted, measured);
        error * error
    };
    let mut one_step = vec![0.0; n];
    let mut by_step = vec![0.0; steps * n];
    let (mut pairs, mut rolled, mut diverged) = (0_usize, 0_usize, 0_usize);
    let (mut example_steps, mut example) = (Vec::new(), Vec::new());
    let mut next = vec![0.0; n];
    let mut predicted = vec![0.0; steps * n];
    for (number, t) in test.trajectories.iter().enumerate() {
        for k in 1..t.states.len() / n.max(1) {
            if method.predict(&t.states[..k * n], &t.inputs[..k * m], &mut next) {
                for (i, sum) in one_step.iter_mut().enumerate() {
                    *sum += square(i, next[i], t.states[k * n + i]);
                }
            } else {
                one_step.fill(f64::INFINITY);
                next.fill(f64::NAN);
            }
            if number == 0 {
                example_steps.extend_from_slice(&next);
            }
            pairs += 1;
        }
        let Some(measured) = t.states.get(n..(steps + 1) * n) else { continue };
        if method.roll_out(&t.states[..n], &t.inputs[..steps * m], &mut predicted, n) {
            rolled += 1;
            for (k, (p, x)) in predicted.iter().zip(measured).enumerate() {
                by_step[k] += square(k % n, *p, *x);
            }
            if number == 0 {
                example.clone_from(&predicted);
            }
        } else {
            diverged += 1;
        }
    }
    for sum in &mut one_step {
        *sum /= pairs as f64;
    }
    for sum in &mut by_step {
        *sum = if rolled > 0 { *sum / rolled as f64 } else { f64::INFINITY };
    }
    let mean = |i: usize| by_step[i..].iter().step_by(n).sum::<f64>() / steps as f64;
    let rollout = match diverged {
        0 => (0..n).map(mean).collect(),
        _ => vec![f64::INFINITY; n],
    };
    Evaluation { one_step, rollout, by_step, diverged, example_steps, example }
}

/// The prediction that nothing moves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NoMotion;

impl Forecast for NoMotion {
    fn numbers(&self) -> usize {
        0
    }

    fn predict(&self, states: &[f64], _: &[f64], next: &mut [f64]) -> bool {
        next.copy_from_slice(&states[states.len() - next.len()..]);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// x⁺ = 2x + u.
    struct Doubling;

    impl Forecast for Doubling {
        fn numbers(&self) -> usize {
            2
        }

        fn predict(&self, states: &[f64], inputs: &[f64], next: &mut [f64]) -> bool {
            next[0] = 2.0 * states[states.len() - 1] + inputs[inputs.len() - 1];
            next[0] < 1e3
        }
    }

    fn walk(states: &[f64]) -> Trajectory {
        Trajectory { states: states.to_vec(), inputs: vec![1.0; states.len()] }
    }

    fn score(
        space: Space,
        walks: &[Trajectory],
        method: &dyn Forecast,
        steps: usize,
    ) -> Evaluation {
        let spaces = [space];
        let data = Data { spaces: &spaces, inputs: 1, sample_time_s: 1.0, trajectories: walks };
        evaluate(method, data, steps)
    }

    #[test]
    fn one_step_starts_from_the_truth_and_a_rollout_from_the_prediction() {
        let result = score(Space::Line, &[walk(&[1.0, 3.0, 8.0])], &Doubling, 2);
        assert_eq!(result.one_step, [0.5]);
        assert_eq!(result.example, [3.0, 7.0]);
        assert_eq!(result.by_step, [0.0, 1.0]);
        assert_eq!(result.rollout, [0.5]);
        assert_eq!(result.diverged, 0);
    }

    #[test]
    fn angles_are_compared_on_the_circle() {
        let turn = std::f64::consts::TAU;
        let result = score(Space::Circle, &[walk(&[0.0, turn])], &NoMotion, 1);
        assert!(result.one_step[0] < 1e-30, "{:?}", result.one_step);
        let result = score(Space::Line, &[walk(&[0.0, turn])], &NoMotion, 1);
        assert_eq!(result.one_step, [turn * turn]);
    }

    #[test]
    fn one_divergence_makes_the_rollout_error_infinite() {
        let walks = [walk(&[1.0; 3]), walk(&[300.0; 3])];
        let result = score(Space::Line, &walks, &Doubling, 2);
        assert_eq!(result.diverged, 1);
        assert_eq!(result.rollout, [f64::INFINITY]);
    }
}
