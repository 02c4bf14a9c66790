//! EDMD with a direct sum of Hermite polynomials: one block [H¹(v), …, Hᵖ(v)] per state and input
//! and one constant, no products (Shi & Karydis 2021, section IV, the first of the methods that
//! they compare with). Angles are ordinary numbers here, so that they must be continuous.

use firmware_core::dictionary::{Basis, Block, Factor, Source};
use firmware_core::model::{Space, Symmetry, Target};

use crate::forecast::{Baseline, BaselineError, Data, Forecast};
use crate::koopman::{Koopman, KoopmanError};
use crate::recording::LogSchema;
use crate::robot::{FitOptions, Method, Robot, RobotInput, RobotState, ScoreOptions};

/// What can be chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Highest order p of every variable.
    pub order: u8,
}

impl Default for Settings {
    /// Up to the second order, as in the paper.
    fn default() -> Self {
        Self { order: 2 }
    }
}

/// A fitted model.
///
/// ```
/// use firmware_core::model::Space;
/// use trainer::forecast::{Baseline, Data, Forecast};
/// use trainer::hermite::Hermite;
/// use trainer::trajectory::Trajectory;
/// // x⁺ = 0.1 + 0.5 x − 0.1 x² + u is a sum of polynomials of one variable each.
/// let mut walk = Trajectory { states: vec![0.3], inputs: Vec::new() };
/// for k in 0..40 {
///     let (x, u) = (walk.states[k], [0.4, -0.7, 0.1, -0.2, 0.6][k * k % 5]);
///     walk.inputs.push(u);
///     walk.states.push(0.1 + 0.5 * x - 0.1 * x * x + u);
/// }
/// walk.inputs.push(0.0);
/// let data = Data { spaces: &[Space::Line], inputs: 1, sample_time_s: 0.1, trajectories: &[walk] };
/// let model = Hermite::fit(data, &Default::default())?;
/// let mut next = [0.0];
/// assert!(model.predict(&[0.5], &[-0.25], &mut next));
/// assert!((next[0] - 0.075).abs() < 1e-6);
/// # Ok::<(), trainer::forecast::BaselineError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Hermite(Koopman);

impl Forecast for Hermite {
    fn numbers(&self) -> usize {
        self.0.numbers()
    }

    fn predict(&self, states: &[f64], inputs: &[f64], next: &mut [f64]) -> bool {
        self.0.predict(states, inputs, next)
    }

    fn roll_out(&self, states: &[f64], inputs: &[f64], predicted: &mut [f64], n: usize) -> bool {
        self.0.roll_out(states, inputs, predicted, n)
    }
}

impl Baseline for Hermite {
    type Settings = Settings;

    fn fit(training: Data<'_>, settings: &Settings) -> Result<Self, BaselineError> {
        let order = settings.order;
        let sources = (0..training.spaces.len() as u8).map(Source::State);
        let sources = sources.chain((0..training.inputs as u8).map(Source::Input));
        let observables: Vec<_> = sources.map(|source| (source, 0)).collect();
        let factor = |i: usize| Factor { observable: i as u8, basis: Basis::Hermite, order };
        let robot = Robot {
            name: "hermite".to_owned(),
            schema: LogSchema::new(training.sample_time_s, Vec::new(), Vec::new()),
            states: (0..training.spaces.len()).map(state).collect(),
            inputs: (0..training.inputs).map(input).collect(),
            symmetry: Symmetry::None,
            factors: (0..observables.len()).map(factor).collect(),
            blocks: vec![Block { factors: 1, max_degree: 0 }; observables.len()],
            observables,
            chain: None,
            standardise: false,
            // An input that never moves is no reason to fail.
            fit: FitOptions { method: Method::Svd, ..Default::default() },
            score: ScoreOptions::default(),
            budget: Default::default(),
            sha256: [0; 32],
        };
        Koopman::fit(&robot, training).map(Self).map_err(|error| match error {
            KoopmanError::NoPairs { .. } => BaselineError::NoPairs,
            KoopmanError::NotFinite | KoopmanError::TooLarge { .. } => BaselineError::NotFinite,
            other => BaselineError::Settings(other.to_string()),
        })
    }
}

fn state(i: usize) -> RobotState {
    let (name, unit) = (format!("x{i}"), String::new());
    RobotState { name, unit, space: Space::Line, target: Target::Absolute, limit: None }
}

fn input(i: usize) -> RobotInput {
    let range = [f64::from(f32::MIN), f64::from(f32::MAX)];
    RobotInput { name: format!("u{i}"), unit: String::new(), range }
}
