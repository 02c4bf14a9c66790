//! A Koopman operator with any dictionary of robot.toml as a [`Forecast`]: what `trainer fit`
//! learns and the controller's own f32 predictor, without the way through a blob.

use firmware_core::model::{Provenance, Structure};
use firmware_core::{Predictor, PredictorState};

use crate::edmd::{self, FitError, Operator, Regression};
use crate::export::{controller_coefficients, controller_model, coordinate};
use crate::forecast::{Data, Forecast};
use crate::robot::{FitOptions, Method, Robot, Scaling};
use crate::snapshots::{PairSink, Snapshots};
use crate::trajectory::Trajectories;

/// A fitted operator and the robot it belongs to.
#[derive(Clone, Debug, PartialEq)]
pub struct Koopman {
    robot: Robot,
    scaling: Scaling,
    limits: Vec<[f32; 2]>,
    /// Shape `[outputs, dense terms]`.
    coefficients: Vec<f32>,
}

/// What an in-memory fit can fail with.
pub type KoopmanError = FitError<std::convert::Infallible>;

impl Koopman {
    /// Fits the robot's operator to all pairs of all trajectories in one pool (Shi & Karydis 2021,
    /// equation 3).
    ///
    /// # Errors
    /// [`FitError`].
    pub fn fit(robot: &Robot, training: Data<'_>) -> Result<Self, KoopmanError> {
        let fit = edmd::fit(robot, &training.source(), &|_| {})?;
        Ok(Self::new(robot, &fit.structure, &fit.operator))
    }

    /// Fits an operator to each trajectory and averages them, as the paper's published program does
    /// instead of pooling.
    ///
    /// # Errors
    /// [`FitError`].
    pub fn fit_averaged(robot: &Robot, training: Data<'_>) -> Result<Self, KoopmanError> {
        struct Sink(Regression);
        impl PairSink for Sink {
            fn pair(&mut self, _: u64, values: &[f64], targets: &[f64]) {
                self.0.push(values, targets);
            }
        }
        // One trajectory may not determine all terms: that program takes the pseudoinverse.
        let fit = FitOptions { method: Method::Svd, ..robot.fit };
        let robot = &Robot { fit, ..robot.clone() };
        let provenance = Provenance { logs: [0; 32], robot: robot.sha256 };
        let scaling = robot.identity_scaling();
        let structure =
            robot.structure(&scaling, &robot.limits(), provenance).map_err(FitError::Model)?;
        let dictionary = structure.dictionary();
        let mut mean: Option<Operator> = None;
        for trajectory in training.trajectories {
            let empty =
                Regression::new(dictionary, robot.chain.as_ref(), structure.outputs(), fit.method);
            let mut snapshots = Snapshots::new(&structure, Sink(empty));
            let trajectories = std::slice::from_ref(trajectory);
            Data { trajectories, ..training }
                .source()
                .visit(&mut snapshots)
                .map_err(FitError::Trajectories)?;
            let regression = snapshots.into_sink().0;
            let operator = edmd::solve_named(robot, &structure, regression)?;
            match &mut mean {
                None => mean = Some(operator),
                Some(mean) => {
                    for (sum, x) in mean.matrix.iter_mut().zip(&operator.matrix) {
                        *sum += x;
                    }
                }
            }
        }
        let Some(mut mean) = mean else { return Err(FitError::NoPairs { need: 2 }) };
        for x in &mut mean.matrix {
            *x /= training.trajectories.len() as f64;
        }
        Ok(Self::new(robot, &structure, &mean))
    }

    fn new(robot: &Robot, structure: &Structure<'_>, operator: &Operator) -> Self {
        let observables = structure.dictionary().observables();
        Self {
            robot: robot.clone(),
            scaling: observables.iter().map(|o| [o.centre, o.gain]).collect(),
            limits: structure.states().iter().map(|s| s.limit).collect(),
            coefficients: controller_coefficients(
                structure.dictionary(),
                robot.chain.as_ref(),
                operator,
            ),
        }
    }
}

impl Forecast for Koopman {
    fn numbers(&self) -> usize {
        self.coefficients.iter().filter(|c| **c != 0.0).count()
    }

    fn predict(&self, states: &[f64], inputs: &[f64], next: &mut [f64]) -> bool {
        let n = next.len();
        self.roll_out(states, inputs, next, n)
    }

    /// A model that looks back further than there are samples takes the robot to have rested at the
    /// first one with no input.
    fn roll_out(&self, states: &[f64], inputs: &[f64], predicted: &mut [f64], n: usize) -> bool {
        let m = self.robot.inputs.len();
        let provenance = Provenance { logs: [0; 32], robot: self.robot.sha256 };
        let Ok(structure) = self.robot.structure(&self.scaling, &self.limits, provenance) else {
            return false;
        };
        let chain = self.robot.chain.as_ref();
        let Ok(model) = controller_model(structure, chain, &self.coefficients, None) else {
            return false;
        };
        let structure = model.structure();
        let narrow = |row: &[f64]| -> Vec<f32> {
            row.iter().zip(structure.states()).map(|(x, s)| coordinate(*x, s.space)).collect()
        };
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        let (past, needed) = (states.len() / n.max(1), structure.lag() + 1);
        let mut applied = vec![0.0_f32; m];
        for _ in past..needed {
            if predictor.observe(&mut state, &applied, &narrow(&states[..n])).is_err() {
                return false;
            }
        }
        let mut rows = inputs.chunks_exact(m.max(1)).map(|u| u.iter().map(|u| *u as f32));
        for (k, x) in states.chunks_exact(n).enumerate() {
            if k + needed >= past && predictor.observe(&mut state, &applied, &narrow(x)).is_err() {
                return false;
            }
            applied.splice(.., rows.next().into_iter().flatten());
        }
        let mut coordinates = vec![0.0_f32; n];
        for out in predicted.chunks_exact_mut(n) {
            if predictor.step(&mut state, &applied).is_err()
                || predictor.coordinates(&state, &mut coordinates).is_err()
            {
                return false;
            }
            for (to, x) in out.iter_mut().zip(&coordinates) {
                *to = f64::from(*x);
            }
            applied.splice(.., rows.next().into_iter().flatten());
        }
        true
    }
}
