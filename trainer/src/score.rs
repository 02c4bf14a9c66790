//! Scoring: rollouts over windows of recorded trajectories, beside *no motion*, a linear ARX
//! and, where it applies, a unicycle.
//!
//! All models of one table see the same windows. A window starts at a sample with enough earlier
//! ones for every model, and predicts the next `horizon` samples with the inputs as recorded. RMSE
//! is over all steps of all windows, at the first step, and at the last; angles are compared on the
//! circle. NRMSE is the RMSE over all steps divided by the standard deviation of the scored data,
//! mean over the states that move.

use std::collections::VecDeque;
use std::io::Write;

use firmware_core::model::{Model, Space, Structure};
use firmware_core::{Predictor, PredictorState, Scalar};

use crate::arx::{Arx, ArxAccumulator, MAX_LAGS};
use crate::chain::Chain;
use crate::edmd::{Operator, Regression, Spread};
use crate::export::{controller_coefficients, coordinate};
use crate::recording::Visitor;
use crate::refine::{Collected, refine_operator};
use crate::robot::{FitOptions, ScoreOptions};
use crate::snapshots::{PairSink, Snapshots};
use crate::trajectory::Trajectories;
use crate::unicycle::{Axes, Unicycle, UnicycleAccumulator};

/// What trajectories serve for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Plan {
    /// Trajectory number i (of those not skipped) is scored in fold i mod `folds`, by models
    /// trained on the other folds.
    Folds {
        /// Number of folds.
        folds: usize,
        /// Trajectories whose names match one of these patterns are left out.
        skip: Vec<String>,
    },
    /// The one trajectory is cut into blocks; a block is scored by models trained on the samples
    /// that are more than `gap` away from it.
    Blocks {
        /// Number of blocks.
        folds: usize,
        /// Samples of the trajectory.
        rows: u64,
        /// Samples left out on either side.
        gap: u64,
        /// As in `Folds`.
        skip: Vec<String>,
    },
    /// Trajectories whose names match one of these patterns are scored by models trained on the
    /// others.
    HoldOut {
        /// Patterns with `*` and `?`.
        patterns: Vec<String>,
    },
    /// All trajectories are scored by one and the same model (or train it).
    All,
}

/// What one row serves for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    Skipped,
    /// Scored in this fold, trains the others.
    Fold(usize),
    /// Trains the only fold.
    Train,
    /// Scored in the only fold.
    Test,
    /// Both.
    Both,
}

impl Plan {
    /// Whole-trajectory cross-validation, or blocks where there is only one trajectory.
    pub fn cross_validation(
        options: &ScoreOptions,
        counts: Counts,
        lag: usize,
        skip: &[String],
    ) -> Self {
        let skip = skip.to_vec();
        if counts.trajectories > 1 {
            Self::Folds { folds: options.folds.min(counts.trajectories), skip }
        } else {
            let gap = (lag.max(MAX_LAGS) + options.horizon) as u64;
            Self::Blocks { folds: options.folds, rows: counts.rows, gap, skip }
        }
    }

    pub(crate) fn folds(&self) -> usize {
        match self {
            Self::Folds { folds, .. } | Self::Blocks { folds, .. } => *folds,
            Self::HoldOut { .. } | Self::All => 1,
        }
    }

    /// `index` counts the trajectories that are not skipped.
    pub(crate) fn role(&self, name: &str, index: usize, row: u64) -> Role {
        match self {
            Self::Folds { skip, .. } | Self::Blocks { skip, .. } if matches_any(skip, name) => {
                Role::Skipped
            }
            Self::Folds { folds, .. } => Role::Fold(index % folds),
            Self::Blocks { folds, rows, .. } => {
                Role::Fold((row * *folds as u64 / (*rows).max(1)) as usize)
            }
            Self::HoldOut { patterns } if matches_any(patterns, name) => Role::Test,
            Self::HoldOut { .. } => Role::Train,
            Self::All => Role::Both,
        }
    }

    /// Whether a row trains a fold's models.
    pub(crate) fn trains(&self, fold: usize, role: Role, row: u64) -> bool {
        match (self, role) {
            (_, Role::Skipped | Role::Test) => false,
            (_, Role::Train | Role::Both) => true,
            (Self::Blocks { folds, rows, gap, .. }, _) => {
                // Rows whose number times `folds` lies in [fold, fold + 1) · rows are the block.
                let (folds, fold) = (*folds as u64, fold as u64);
                let (start, end) =
                    ((fold * rows).div_ceil(folds), ((fold + 1) * rows).div_ceil(folds));
                row + gap < start || row >= end + gap
            }
            (_, Role::Fold(own)) => own != fold,
        }
    }
}

/// Whether a name matches one of the patterns; `*` stands for any text, `?` for one character.
pub(crate) fn matches_any(patterns: &[String], name: &str) -> bool {
    fn matches(pattern: &[u8], name: &[u8]) -> bool {
        match (pattern.split_first(), name.split_first()) {
            (None, None) => true,
            (Some((b'*', rest)), _) => {
                matches(rest, name) || !name.is_empty() && matches(pattern, &name[1..])
            }
            (Some((b'?', rest)), Some((_, tail))) => matches(rest, tail),
            (Some((p, rest)), Some((n, tail))) => p == n && matches(rest, tail),
            _ => false,
        }
    }
    patterns.iter().any(|pattern| matches(pattern.as_bytes(), name.as_bytes()))
}

/// How many trajectories and rows there are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Trajectories.
    pub trajectories: usize,
    /// Rows of all of them.
    pub rows: u64,
}

/// Why there is no score.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ScoreError<E> {
    /// The trajectories cannot be read.
    #[error(transparent)]
    Trajectories(E),
    /// No trajectory holds a whole window.
    #[error(
        "nothing to score: a window needs {need} rows, {first} before its first step and the horizon \
         behind it, and no scored trajectory (or block of the only one) has as many; \
         lower `[score] horizon` or --horizon"
    )]
    NoWindow {
        /// Rows of a window.
        need: usize,
        /// Rows before the first predicted one.
        first: usize,
    },
    /// The patterns leave nothing to score, or nothing to train on.
    #[error(
        "`[score] hold_out` matches {matched} of {of} trajectories; expected it to match some and \
         leave some to be trained on (a trajectory is called as its file without .csv, with \
         #episode behind where there is an episode column)"
    )]
    HoldOut {
        /// Trajectories that match.
        matched: usize,
        /// All trajectories.
        of: usize,
    },
    /// A fold has nothing to be trained on.
    #[error(
        "fold {fold} cannot be scored: the other trajectories do not determine a model; \
         use fewer folds in `[score]`, or add trajectories"
    )]
    Untrained {
        /// The fold, from 0.
        fold: usize,
    },
    /// The file of predictions cannot be written.
    #[error("the predictions cannot be written: {0}")]
    Write(std::io::Error),
}

/// The score of one model.
#[derive(Clone, Debug, PartialEq)]
pub struct Contender {
    /// `model`, `no motion`, `ARX 3 lags`.
    pub name: String,
    /// Windows whose rollout diverged; they are not part of the errors below.
    pub diverged: usize,
    /// RMSE of the first step per state, in its unit.
    pub one_step: Vec<f64>,
    /// RMSE over all steps.
    pub rollout: Vec<f64>,
    /// RMSE of the last step.
    pub last_step: Vec<f64>,
    /// Infinite when a window diverged.
    pub nrmse: f64,
}

/// A table of scores.
#[derive(Clone, Debug, PartialEq)]
pub struct Score {
    /// What trained and what was scored.
    pub plan: Plan,
    /// Steps of a rollout.
    pub horizon: usize,
    /// Samples between windows.
    pub stride: usize,
    /// Samples before the first predicted one.
    pub first: usize,
    /// Number of windows.
    pub windows: usize,
    /// Standard deviation of the scored data per state.
    pub deviation: Vec<f64>,
    /// Model, no motion, the chosen ARX, and a unicycle where there is one.
    pub contenders: Vec<Contender>,
    /// NRMSE of every ARX, 0 to [`MAX_LAGS`] lags, on the scored data.
    pub arx: Vec<f64>,
    /// The chosen number of lags.
    pub arx_lags: usize,
}

/// A model that is scored: its structure and the f32 coefficients of the controller.
#[derive(Clone, Debug)]
struct FoldModel<'a> {
    structure: Structure<'a>,
    chain: Option<Vec<[u8; 2]>>,
    coefficients: Vec<f32>,
}

/// What competes in one fold.
#[derive(Clone, Debug)]
struct Fold<'a> {
    model: Option<FoldModel<'a>>,
    arx: Vec<Arx>,
    unicycle: Option<Unicycle>,
}

/// Where a fold's lifted model comes from.
#[derive(Clone, Copy, Debug)]
pub enum Lifted<'l, 'a> {
    /// It is fitted in every fold, with the scaling of the structure.
    Fitted(&'l Structure<'a>, Option<&'l Chain>, &'l FitOptions),
    /// It is the same in every fold: the blob under test.
    Given(&'l Model<'a>),
}

impl<'l, 'a> Lifted<'l, 'a> {
    fn structure(&self) -> &'l Structure<'a> {
        match self {
            Self::Fitted(structure, ..) => structure,
            Self::Given(model) => model.structure(),
        }
    }
}

/// Scores by cross-validation, or on held-out trajectories, of one source.
///
/// # Errors
/// [`ScoreError`].
pub fn score<'a, T: Trajectories>(
    source: &T,
    counts: Counts,
    lifted: Lifted<'_, 'a>,
    options: &ScoreOptions,
    predictions: Option<&mut dyn Write>,
    progress: &dyn Fn(u64),
) -> Result<Score, ScoreError<T::Error>> {
    let lag = lifted.structure().lag();
    if options.hold_out.is_empty() {
        let plan = Plan::cross_validation(options, counts, lag, &[]);
        let folds = train(source, &plan, lifted, (true, options), progress)?;
        let task = Task { plan: &plan, lifted, options, folds: &folds, arx_lags: None };
        return run(source, task, predictions, progress);
    }
    let (of, left) = (counts.trajectories, count(source, &options.hold_out)?.trajectories);
    if left == 0 || left == of {
        return Err(ScoreError::HoldOut { matched: of - left, of });
    }
    let arx_lags = best_arx(source, counts, lifted, options, &options.hold_out, progress)?;
    let plan = Plan::HoldOut { patterns: options.hold_out.clone() };
    let folds = train(source, &plan, lifted, (true, options), progress)?;
    let task = Task { plan: &plan, lifted, options, folds: &folds, arx_lags: Some(arx_lags) };
    run(source, task, predictions, progress)
}

/// Scores a given model on all of `source`, with the ARX trained on other data.
///
/// # Errors
/// [`ScoreError`].
pub fn score_elsewhere<'a, T: Trajectories>(
    source: &T,
    (training, counts): (&T, Counts),
    model: &Model<'a>,
    options: &ScoreOptions,
    predictions: Option<&mut dyn Write>,
    progress: &dyn Fn(u64),
) -> Result<Score, ScoreError<T::Error>> {
    let lifted = Lifted::Given(model);
    let arx_lags = best_arx(training, counts, lifted, options, &[], progress)?;
    let folds = train(training, &Plan::All, lifted, (true, options), progress)?;
    let task = Task { plan: &Plan::All, lifted, options, folds: &folds, arx_lags: Some(arx_lags) };
    run(source, task, predictions, progress)
}

/// The number of lags with the smallest cross-validated NRMSE over the trajectories not skipped.
fn best_arx<T: Trajectories>(
    source: &T,
    counts: Counts,
    lifted: Lifted<'_, '_>,
    options: &ScoreOptions,
    skip: &[String],
    progress: &dyn Fn(u64),
) -> Result<usize, ScoreError<T::Error>> {
    let counts = if skip.is_empty() { counts } else { count(source, skip)? };
    let plan = Plan::cross_validation(options, counts, lifted.structure().lag(), skip);
    let folds = train(source, &plan, lifted, (false, options), progress)?;
    let task = Task { plan: &plan, lifted, options, folds: &folds, arx_lags: None };
    Ok(run(source, task, None, progress)?.arx_lags)
}

/// Trajectories and rows that are not skipped.
///
/// # Errors
/// [`ScoreError::Trajectories`].
pub fn count<T: Trajectories>(source: &T, skip: &[String]) -> Result<Counts, ScoreError<T::Error>> {
    struct Counter<'s> {
        skip: &'s [String],
        counted: bool,
        counts: Counts,
    }
    impl Visitor for Counter<'_> {
        fn begin(&mut self, name: &str) {
            self.counted = !matches_any(self.skip, name);
            self.counts.trajectories += usize::from(self.counted);
        }
        fn row(&mut self, _: &[f64], _: &[f64]) {
            self.counts.rows += u64::from(self.counted);
        }
    }
    let mut counter = Counter { skip, counted: false, counts: Counts::default() };
    source.visit(&mut counter).map_err(ScoreError::Trajectories)?;
    Ok(counter.counts)
}

/// Makes angles continuous within a trajectory and knows each row's role.
pub(crate) struct Rows<'p> {
    plan: &'p Plan,
    circles: Vec<bool>,
    name: String,
    /// Trajectories begun that are not skipped.
    begun: usize,
    row: u64,
    /// States, then inputs, of the present row.
    present: Vec<f64>,
    role: Role,
}

impl<'p> Rows<'p> {
    pub(crate) fn new(plan: &'p Plan, structure: &Structure<'_>) -> Self {
        Self {
            plan,
            circles: structure.states().iter().map(|s| s.space == Space::Circle).collect(),
            name: String::new(),
            begun: 0,
            row: 0,
            present: Vec::new(),
            role: Role::Skipped,
        }
    }

    /// Number, in its trajectory, of the row that comes next.
    pub(crate) fn row(&self) -> u64 {
        self.row
    }

    /// States (angles continuous), then inputs, of the row taken last.
    pub(crate) fn present(&self) -> &[f64] {
        &self.present
    }

    /// The folds whose models the row taken last, which had this number, trains.
    pub(crate) fn trains(&self, row: u64) -> Vec<bool> {
        (0..self.plan.folds()).map(|fold| self.plan.trains(fold, self.role, row)).collect()
    }

    pub(crate) fn begin(&mut self, name: &str) {
        name.clone_into(&mut self.name);
        self.row = 0;
        self.present.clear();
        if self.plan.role(name, 0, 0) != Role::Skipped {
            self.begun += 1;
        }
    }

    /// Takes a row; `true` when a new segment starts: a trajectory, or a block of the only one.
    pub(crate) fn take(&mut self, states: &[f64], inputs: &[f64]) -> bool {
        let first = self.present.is_empty();
        let mut next = Vec::with_capacity(states.len() + inputs.len());
        for (i, x) in states.iter().enumerate() {
            let continuous = match self.present.get(i) {
                Some(before) if self.circles[i] => before + (x - before).wrap(),
                _ => *x,
            };
            next.push(continuous);
        }
        next.extend(inputs);
        self.present = next;
        let role = self.plan.role(&self.name, self.begun.saturating_sub(1), self.row);
        let changed = first || role != self.role;
        self.role = role;
        self.row += 1;
        changed
    }
}

/// Fits the models of every fold.
fn train<'a, T: Trajectories>(
    source: &T,
    plan: &Plan,
    lifted: Lifted<'_, 'a>,
    (with_model, score): (bool, &ScoreOptions),
    progress: &dyn Fn(u64),
) -> Result<Vec<Fold<'a>>, ScoreError<T::Error>> {
    struct Sink<'p> {
        plan: &'p Plan,
        role: Role,
        regressions: Vec<Option<Regression>>,
    }
    impl PairSink for Sink<'_> {
        fn pair(&mut self, row: u64, values: &[f64], targets: &[f64]) {
            for (fold, regression) in self.regressions.iter_mut().enumerate() {
                if let Some(regression) = regression
                    && self.plan.trains(fold, self.role, row)
                {
                    regression.push(values, targets);
                }
            }
        }
    }
    struct Pass<'p, 's, 'a> {
        rows: Rows<'p>,
        snapshots: Snapshots<'s, 'a, Sink<'p>>,
        recent: VecDeque<Vec<f64>>,
        arx: Vec<ArxAccumulator>,
        unicycles: Option<Vec<UnicycleAccumulator>>,
        progress: &'p dyn Fn(u64),
    }
    impl Visitor for Pass<'_, '_, '_> {
        fn begin(&mut self, name: &str) {
            self.rows.begin(name);
            self.snapshots.begin(name);
            self.recent.clear();
        }
        fn row(&mut self, states: &[f64], inputs: &[f64]) {
            self.rows.take(states, inputs);
            let row = self.rows.row - 1;
            self.snapshots.sink_mut().role = self.rows.role;
            self.snapshots.row(states, inputs);
            for (fold, arx) in self.arx.iter_mut().enumerate() {
                if self.rows.plan.trains(fold, self.rows.role, row) {
                    arx.row(&self.rows.present);
                    if !self.recent.is_empty() {
                        arx.pair(
                            self.recent.iter().map(Vec::as_slice),
                            &self.rows.present[..states.len()],
                        );
                    }
                }
            }
            if let (Some(unicycles), Some(before)) = (&mut self.unicycles, self.recent.front()) {
                for (fold, unicycle) in unicycles.iter_mut().enumerate() {
                    if self.rows.plan.trains(fold, self.rows.role, row) {
                        unicycle.pair(before, &self.rows.present);
                    }
                }
            }
            self.recent.push_front(self.rows.present.clone());
            self.recent.truncate(MAX_LAGS + 1);
        }
        fn progress(&mut self, bytes: u64) {
            (self.progress)(bytes);
        }
    }

    let structure = lifted.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let regression = |_| match lifted {
        Lifted::Fitted(s, chain, options) if with_model => {
            Some(Regression::new(s.dictionary(), chain, s.outputs(), options.method))
        }
        _ => None,
    };
    let regressions = (0..plan.folds()).map(regression).collect();
    let mut pass = Pass {
        rows: Rows::new(plan, structure),
        snapshots: Snapshots::new(structure, Sink { plan, role: Role::Skipped, regressions }),
        recent: VecDeque::new(),
        arx: vec![ArxAccumulator::new(n, m); plan.folds()],
        unicycles: Axes::of(structure)
            .map(|axes| vec![UnicycleAccumulator::new(axes); plan.folds()]),
        progress,
    };
    source.visit(&mut pass).map_err(ScoreError::Trajectories)?;
    let regressions = pass.snapshots.into_sink().regressions;
    let refined = match lifted {
        Lifted::Fitted(structure, _, FitOptions { refine: Some(_), .. }) if with_model => {
            let read = Collected::read(source, structure, plan, score);
            Some(read.map_err(ScoreError::Trajectories)?)
        }
        _ => None,
    };
    let mut folds = Vec::new();
    for (fold, (regression, arx)) in regressions.into_iter().zip(pass.arx).enumerate() {
        let untrained = ScoreError::Untrained { fold };
        let model = match (lifted, regression) {
            (Lifted::Fitted(structure, chain, options), Some(regression)) => {
                let solved = regression.solve(options, structure.outputs());
                let Ok(mut operator @ Operator { pairs: 1.., .. }) = solved else {
                    return Err(untrained);
                };
                if let (Some(collected), Some(kappa)) = (&refined, options.refine) {
                    let windows = collected.of(fold);
                    refine_operator(structure, chain, &mut operator, &windows, kappa);
                }
                let dictionary = structure.dictionary();
                Some(FoldModel {
                    structure: structure.clone(),
                    chain: chain.map(|c| c.entries().to_vec()),
                    coefficients: controller_coefficients(dictionary, chain, &operator),
                })
            }
            (Lifted::Given(model), _) if with_model => Some(FoldModel {
                structure: model.structure().clone(),
                chain: model.terms().map(|terms| terms.entries().to_vec()),
                coefficients: model.coefficients().to_vec(),
            }),
            _ => None,
        };
        let arx: Option<Vec<Arx>> = (0..=MAX_LAGS).map(|lags| arx.fit(lags)).collect();
        let Some(arx) = arx else { return Err(untrained) };
        let unicycle = pass.unicycles.as_ref().and_then(|u| u.get(fold)?.fit());
        folds.push(Fold { model, arx, unicycle });
    }
    Ok(folds)
}

/// Everything that a scoring pass needs.
#[derive(Clone, Copy)]
struct Task<'t, 'a> {
    plan: &'t Plan,
    lifted: Lifted<'t, 'a>,
    options: &'t ScoreOptions,
    folds: &'t [Fold<'a>],
    /// Chosen elsewhere, or the best of this pass.
    arx_lags: Option<usize>,
}

/// Squared errors of one contender.
#[derive(Clone, Debug)]
struct Errors {
    diverged: usize,
    windows: usize,
    one_step: Vec<f64>,
    rollout: Vec<f64>,
    last_step: Vec<f64>,
}

impl Errors {
    fn new(states: usize) -> Self {
        let zeros = vec![0.0; states];
        Self {
            diverged: 0,
            windows: 0,
            one_step: zeros.clone(),
            rollout: zeros.clone(),
            last_step: zeros,
        }
    }

    fn contender(&self, name: String, horizon: usize, deviation: &[f64]) -> Contender {
        let windows = self.windows as f64;
        let rmse =
            |sums: &[f64], count: f64| sums.iter().map(|s| (s / count).sqrt()).collect::<Vec<_>>();
        let rollout = rmse(&self.rollout, windows * horizon as f64);
        let moving: Vec<f64> =
            rollout.iter().zip(deviation).filter(|(_, d)| **d > 0.0).map(|(r, d)| r / d).collect();
        let mean = moving.iter().sum::<f64>() / moving.len().max(1) as f64;
        Contender {
            name,
            diverged: self.diverged,
            one_step: rmse(&self.one_step, windows),
            last_step: rmse(&self.last_step, windows),
            rollout,
            nrmse: if self.diverged == 0 && mean.is_finite() { mean } else { f64::INFINITY },
        }
    }
}

/// Contenders before the ARX models.
const MODEL: usize = 0;
const NO_MOTION: usize = 1;
const ARX: usize = 2;
/// Behind them.
const UNICYCLE: usize = ARX + MAX_LAGS + 1;

struct Scorer<'t, 'a, 'w> {
    rows: Rows<'t>,
    task: Task<'t, 'a>,
    models: Vec<Option<Model<'t>>>,
    window: VecDeque<Vec<f64>>,
    /// Rows of the present segment.
    segment: usize,
    first: usize,
    errors: Vec<Errors>,
    spreads: Vec<Spread>,
    predicted: Vec<f64>,
    predictions: Option<&'w mut dyn Write>,
    written: std::io::Result<()>,
    progress: &'t dyn Fn(u64),
}

fn run<T: Trajectories>(
    source: &T,
    task: Task<'_, '_>,
    mut predictions: Option<&mut dyn Write>,
    progress: &dyn Fn(u64),
) -> Result<Score, ScoreError<T::Error>> {
    let structure = task.lifted.structure();
    let (n, horizon) = (structure.states().len(), task.options.horizon);
    let models = task.folds.iter().map(|fold| {
        let model = fold.model.as_ref()?;
        // Coefficients beyond f32 make no model: its windows count as diverged.
        let structure = model.structure.clone();
        match &model.chain {
            Some(chain) => Model::new_sparse(structure, chain, &model.coefficients, None).ok(),
            None => Model::new(structure, &model.coefficients, None).ok(),
        }
    });
    if let Some(out) = predictions.as_mut() {
        let names =
            structure.states().iter().map(|s| format!(",{0}_measured,{0}_predicted", s.name));
        writeln!(out, "trajectory,window_row,step{}", names.collect::<String>())
            .map_err(ScoreError::Write)?;
    }
    let mut scorer = Scorer {
        rows: Rows::new(task.plan, structure),
        task,
        models: models.collect(),
        window: VecDeque::new(),
        segment: 0,
        first: task.options.first(structure.lag()),
        errors: vec![Errors::new(n); UNICYCLE + 1],
        spreads: vec![Spread::default(); n],
        predicted: vec![0.0; n * horizon],
        predictions,
        written: Ok(()),
        progress,
    };
    source.visit(&mut scorer).map_err(ScoreError::Trajectories)?;
    scorer.written.map_err(ScoreError::Write)?;
    let windows = scorer.errors[NO_MOTION].windows;
    if windows == 0 {
        return Err(ScoreError::NoWindow { need: scorer.first + 1 + horizon, first: scorer.first });
    }
    let deviation: Vec<f64> = scorer.spreads.iter().map(Spread::deviation).collect();
    let contender =
        |i: usize, name: &str| scorer.errors[i].contender(name.to_owned(), horizon, &deviation);
    let arx: Vec<Contender> = (0..=MAX_LAGS)
        .map(|lags| {
            contender(ARX + lags, &format!("ARX, {lags} lag{}", if lags == 1 { "" } else { "s" }))
        })
        .collect();
    let nrmse: Vec<f64> = arx.iter().map(|c| c.nrmse).collect();
    let best = (0..arx.len()).min_by(|a, b| nrmse[*a].total_cmp(&nrmse[*b])).unwrap_or(0);
    let arx_lags = task.arx_lags.unwrap_or(best);
    Ok(Score {
        plan: task.plan.clone(),
        horizon,
        stride: task.options.stride,
        first: scorer.first,
        windows,
        contenders: [
            Some(contender(MODEL, "model")),
            Some(contender(NO_MOTION, "no motion")),
            Some(arx[arx_lags].clone()),
            task.folds
                .iter()
                .all(|fold| fold.unicycle.is_some())
                .then(|| contender(UNICYCLE, "unicycle")),
        ]
        .into_iter()
        .flatten()
        .collect(),
        deviation,
        arx: nrmse,
        arx_lags,
    })
}

impl Visitor for Scorer<'_, '_, '_> {
    fn begin(&mut self, name: &str) {
        self.rows.begin(name);
    }

    fn row(&mut self, states: &[f64], inputs: &[f64]) {
        if self.rows.take(states, inputs) {
            self.window.clear();
            self.segment = 0;
        }
        let fold = match self.rows.role {
            Role::Fold(fold) => fold,
            Role::Test | Role::Both => 0,
            Role::Skipped | Role::Train => return,
        };
        for (spread, x) in self.spreads.iter_mut().zip(&self.rows.present) {
            spread.push(*x);
        }
        let length = self.first + 1 + self.task.options.horizon;
        if self.window.len() == length {
            self.window.pop_front();
        }
        self.window.push_back(self.rows.present.clone());
        self.segment += 1;
        if self.segment >= length
            && (self.segment - length).is_multiple_of(self.task.options.stride)
        {
            self.window.make_contiguous();
            self.score_window(fold);
        }
    }

    fn progress(&mut self, bytes: u64) {
        (self.progress)(bytes);
    }
}

impl Scorer<'_, '_, '_> {
    fn score_window(&mut self, fold: usize) {
        let n = self.spreads.len();
        let (window, _) = self.window.as_slices();
        let (past, future) = window.split_at(self.first + 1);
        let present = &past[self.first];
        let structure = self.task.lifted.structure();
        for (contender, errors) in self.errors.iter_mut().enumerate() {
            let predicted = &mut self.predicted;
            let finite = match contender {
                MODEL => match self.models.get(fold) {
                    Some(Some(model)) => roll_out_model(model, past, future, predicted),
                    _ => false,
                },
                NO_MOTION => {
                    predicted
                        .chunks_exact_mut(n)
                        .for_each(|row| row.copy_from_slice(&present[..n]));
                    true
                }
                UNICYCLE => match &self.task.folds[fold].unicycle {
                    Some(unicycle) => unicycle.roll_out(past, future, predicted),
                    None => continue,
                },
                _ => roll_out_arx(
                    &self.task.folds[fold].arx[contender - ARX],
                    past,
                    future,
                    predicted,
                ),
            };
            if !finite {
                errors.diverged += 1;
                continue;
            }
            errors.windows += 1;
            for (step, (row, measured)) in predicted.chunks_exact(n).zip(future).enumerate() {
                for (i, (p, x)) in row.iter().zip(measured).enumerate() {
                    let error = structure.states()[i].space.difference(*p, *x);
                    let square = error * error;
                    errors.rollout[i] += square;
                    if step == 0 {
                        errors.one_step[i] += square;
                    }
                    if step + 1 == future.len() {
                        errors.last_step[i] += square;
                    }
                }
            }
            if contender == MODEL
                && let Some(out) = self.predictions.as_mut()
                && self.written.is_ok()
            {
                let start = self.rows.row as usize - future.len() - 1;
                self.written =
                    write_window(out, &self.rows.name, start, structure, future, predicted);
            }
        }
    }
}

/// One line per step: predicted angles are shown on the turn of the measured ones.
fn write_window(
    out: &mut dyn Write,
    name: &str,
    start: usize,
    structure: &Structure<'_>,
    future: &[Vec<f64>],
    predicted: &[f64],
) -> std::io::Result<()> {
    let name = if name.contains([',', '"', '\n']) {
        format!("\"{}\"", name.replace('"', "\"\""))
    } else {
        name.to_owned()
    };
    let states = structure.states();
    for (step, (row, measured)) in predicted.chunks_exact(states.len()).zip(future).enumerate() {
        write!(out, "{name},{start},{}", step + 1)?;
        for ((p, x), state) in row.iter().zip(measured).zip(states) {
            let p = if state.space == Space::Circle { x + (p - x).wrap() } else { *p };
            write!(out, ",{x},{p}")?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// The controller's f32 predictor over a window; `false` when it diverges.
pub(crate) fn roll_out_model(
    model: &Model<'_>,
    past: &[Vec<f64>],
    future: &[Vec<f64>],
    predicted: &mut [f64],
) -> bool {
    let structure = model.structure();
    let states = structure.states();
    let n = states.len();
    let predictor = Predictor::new(model);
    let mut state = PredictorState::new();
    let narrow = |row: &[f64]| -> Vec<f32> {
        row.iter().zip(states).map(|(x, s)| coordinate(*x, s.space)).collect()
    };
    let input = |row: &[f64]| -> Vec<f32> { row[n..].iter().map(|u| *u as f32).collect() };
    let needed = &past[past.len() - 1 - structure.lag()..];
    let mut applied: Vec<f32> = Vec::new();
    for row in needed {
        if predictor.observe(&mut state, &applied, &narrow(&row[..n])).is_err() {
            return false;
        }
        applied = input(row);
    }
    let mut coordinates = vec![0.0_f32; n];
    for (out, row) in predicted.chunks_exact_mut(n).zip(future) {
        if predictor.step(&mut state, &applied).is_err()
            || predictor.coordinates(&state, &mut coordinates).is_err()
        {
            return false;
        }
        for (to, x) in out.iter_mut().zip(&coordinates) {
            *to = f64::from(*x);
        }
        applied = input(row);
    }
    true
}

/// The ARX over a window; `false` when it leaves the finite numbers.
fn roll_out_arx(arx: &Arx, past: &[Vec<f64>], future: &[Vec<f64>], predicted: &mut [f64]) -> bool {
    let Some(present) = past.last() else { return false };
    let n = predicted.len() / future.len().max(1);
    let mut recent: VecDeque<Vec<f64>> = past.iter().rev().take(arx.lags + 1).cloned().collect();
    let width = present.len();
    for (out, row) in predicted.chunks_exact_mut(n).zip(future) {
        arx.predict(recent.iter().map(Vec::as_slice), out);
        let mut next = recent.pop_back().unwrap_or_else(|| vec![0.0; width]);
        next[..n].copy_from_slice(out);
        next[n..].copy_from_slice(&row[n..]);
        recent.push_front(next);
    }
    predicted.iter().all(|x| x.is_finite())
}
