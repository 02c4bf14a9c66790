//! How the estimate converges: the operator from the first M snapshot pairs over dictionaries of N
//! terms, scored on other data.
//!
//! Shi & Karydis 2021, theorem 3.1: K estimated from M samples over N Hermite functions tends to
//! the Koopman operator as both grow, for observables that are square-integrable under the
//! Gaussian weight. Where the dictionary's variables are normally distributed, as the paper's wheel
//! speeds are, the mean over test data is that weight's integral.

use firmware_core::model::Provenance;

use crate::edmd::{FitError, Regression};
use crate::forecast::Data;
use crate::koopman::KoopmanError;
use crate::robot::Robot;
use crate::snapshots::{PairSink, Snapshots};
use crate::terms::distinct_terms;
use crate::trajectory::Trajectories;

/// One dictionary of the study.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// Terms N.
    pub terms: usize,
    /// Root mean square of what the operator from M pairs predicts wrongly on the test data, over
    /// the outputs asked for, per number of samples; `None` where M pairs do not determine it.
    pub error: Vec<Option<f64>>,
    /// Root mean square difference on the test data between the predictions of the operator from M
    /// pairs and of that from all: how far the estimate is from its own limit.
    pub distance: Vec<Option<f64>>,
}

/// Fits operators to the first `samples[i]` pairs of `training` for every robot (the same robot
/// with dictionaries of growing order) and scores the first `outputs` outputs on `test`.
///
/// # Errors
/// [`FitError`]: a robot that the core refuses, or all pairs do not determine its operator.
pub fn study(
    robots: &[Robot],
    samples: &[u64],
    outputs: usize,
    training: Data<'_>,
    test: Data<'_>,
) -> Result<Vec<Column>, KoopmanError> {
    robots.iter().map(|robot| column(robot, samples, outputs, training, test)).collect()
}

fn column(
    robot: &Robot,
    samples: &[u64],
    outputs: usize,
    training: Data<'_>,
    test: Data<'_>,
) -> Result<Column, KoopmanError> {
    let provenance = Provenance { logs: [0; 32], robot: robot.sha256 };
    let scaling = robot.identity_scaling();
    let structure =
        robot.structure(&scaling, &robot.limits(), provenance).map_err(FitError::Model)?;
    let m = structure.outputs();

    struct Training<'s> {
        regression: Regression,
        pairs: u64,
        samples: &'s [u64],
        snapshots: Vec<Regression>,
    }
    impl PairSink for Training<'_> {
        fn pair(&mut self, _: u64, values: &[f64], targets: &[f64]) {
            self.regression.push(values, targets);
            self.pairs += 1;
            if self.samples.contains(&self.pairs) {
                self.snapshots.push(self.regression.clone());
            }
        }
    }
    let regression = Regression::new(structure.dictionary(), m, robot.fit.method);
    let sink = Training { regression, pairs: 0, samples, snapshots: Vec::new() };
    let mut pass = Snapshots::new(&structure, sink);
    training.source().visit(&mut pass).map_err(FitError::Trajectories)?;
    let Training { regression, snapshots, .. } = pass.into_sink();
    let last = crate::edmd::solve_named(robot, &structure, regression)?;
    let operators: Vec<Option<Vec<f64>>> = (0..samples.len())
        .map(|i| snapshots.get(i)?.clone().solve(&robot.fit, m).ok().map(|o| o.matrix))
        .collect();

    struct Test<'o> {
        dictionary: firmware_core::dictionary::Dictionary,
        distinct: Vec<usize>,
        dense: Vec<f64>,
        outputs: (usize, usize),
        last: &'o [f64],
        operators: &'o [Option<Vec<f64>>],
        /// Squared errors and squared distances.
        sums: Vec<(f64, f64)>,
        count: f64,
    }
    impl PairSink for Test<'_> {
        fn pair(&mut self, _: u64, values: &[f64], targets: &[f64]) {
            self.dictionary.lift_dense(values, &mut self.dense);
            let (scored, m) = self.outputs;
            let predict = |matrix: &[f64], j: usize| -> f64 {
                self.distinct
                    .iter()
                    .enumerate()
                    .map(|(i, t)| self.dense[*t] * matrix[i * m + j])
                    .sum()
            };
            for (sum, operator) in self.sums.iter_mut().zip(self.operators) {
                let Some(operator) = operator else { continue };
                for (j, target) in targets.iter().enumerate().take(scored) {
                    let predicted = predict(operator, j);
                    sum.0 += (predicted - target) * (predicted - target);
                    let distance = predicted - predict(self.last, j);
                    sum.1 += distance * distance;
                }
            }
            self.count += 1.0;
        }
    }
    let sink = Test {
        distinct: distinct_terms(structure.dictionary()),
        dense: vec![0.0; structure.dictionary().dense_terms()],
        dictionary: structure.dictionary().clone(),
        outputs: (outputs, m),
        last: &last.matrix,
        operators: &operators,
        sums: vec![(0.0, 0.0); samples.len()],
        count: 0.0,
    };
    let mut pass = Snapshots::new(&structure, sink);
    test.source().visit(&mut pass).map_err(FitError::Trajectories)?;
    let Test { sums, count, .. } = pass.into_sink();
    let mean = |pick: fn(&(f64, f64)) -> f64| {
        let root = |sum| (pick(sum) / count).sqrt();
        sums.iter().zip(&operators).map(|(s, o)| o.as_ref().map(|_| root(s))).collect()
    };
    Ok(Column { terms: last.terms, error: mean(|s| s.0), distance: mean(|s| s.1) })
}
