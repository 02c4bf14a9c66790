//! Extended dynamic mode decomposition with targets: z⁺ = Ψ(x, u) F by least squares over all
//! snapshot pairs of all trajectories (Williams, Kevrekidis & Rowley 2015; Shi & Karydis 2021,
//! equations 2 and 3, with F = K B solved for directly).

use firmware_core::dictionary::{Dictionary, Source};
use firmware_core::model::{ModelError, Provenance, Space, Structure};

use crate::chain::Chain;
use crate::gram::{GramAccumulator, NormalEquations};
use crate::recording::{Summary, Visitor};
use crate::refine::{Collected, Refined, refine_operator};
use crate::robot::{FitOptions, Method, Robot, Scaling};
use crate::score::Plan;
use crate::snapshots::{PairSink, Snapshots};
use crate::solve::{self, RFactor, Svd};
use crate::terms::distinct_terms;
use crate::trajectory::Trajectories;

/// Why there is no operator.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FitError<E> {
    /// The trajectories cannot be read.
    #[error(transparent)]
    Trajectories(E),
    /// No trajectory is long enough for the delays of the model.
    #[error("the logs hold no snapshot pair: every trajectory needs at least {need} rows")]
    NoPairs {
        /// Rows needed.
        need: usize,
    },
    /// Plain least squares and QR need data in which all terms move independently.
    #[error(
        "the data do not determine the operator: {} of {terms} terms depend on the terms before \
         them: {}; let the inputs and states move, leave the terms out of the dictionary, or accept \
         it in robot.toml with `[fit] ridge = 1e-8` or `[fit] method = \"svd\"`",
        dependent.len(), list(dependent)
    )]
    RankDeficient {
        /// Terms of the dictionary.
        terms: usize,
        /// The dependent ones, as [`Form::Hermite`](crate::terms::Form) indices of distinct terms.
        dependent: Vec<String>,
    },
    /// The controller computes in f32.
    #[error(
        "`{observable}` goes beyond the controller's f32 numbers (3.4e38): log it in a larger unit"
    )]
    TooLarge {
        /// Name of the observable.
        observable: String,
    },
    /// A number became infinite on the way: values too large for the orders of the dictionary.
    #[error(
        "a coefficient is not finite: the logs hold values too large for the orders of the dictionary"
    )]
    NotFinite,
    /// The core refuses the structure.
    #[error("the model is refused: {0:?}")]
    Model(ModelError),
}

fn list(names: &[String]) -> String {
    const SHOWN: usize = 8;
    let mut text =
        names.iter().take(SHOWN).map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ");
    if names.len() > SHOWN {
        text += &format!(" and {} more", names.len() - SHOWN);
    }
    text
}

/// The solution of one least-squares problem.
#[derive(Clone, Debug, PartialEq)]
pub struct Operator {
    /// F, shape `[terms, outputs]`, over the terms of the [`Lift`].
    pub matrix: Vec<f64>,
    /// Terms, n.
    pub terms: usize,
    /// Outputs, m.
    pub outputs: usize,
    /// Snapshot pairs.
    pub pairs: u64,
    /// Numerical rank of the lifted data.
    pub rank: usize,
    /// Factor of the lifted data, columns scaled as asked, without the ridge.
    factor: Vec<f64>,
}

impl Operator {
    /// Condition number of the lifted data, with columns scaled as in the fit: largest over
    /// smallest singular value.
    pub fn condition(&self) -> f64 {
        solve::condition(&self.factor, self.terms)
    }
}

/// The terms that a fit is about: the distinct ones of a dictionary's blocks in Hermite form, or
/// those of a chain in powers.
#[derive(Clone, Debug)]
pub struct Lift {
    dictionary: Dictionary,
    terms: Terms,
    /// Scratch for all terms, those that are not fitted among them.
    all: Vec<f64>,
}

#[derive(Clone, Debug)]
enum Terms {
    /// Dense indices.
    Distinct(Vec<usize>),
    Chain(Chain),
}

impl Lift {
    /// The terms of a chain, or all distinct ones.
    pub fn new(dictionary: &Dictionary, chain: Option<&Chain>) -> Self {
        let (terms, all) = match chain {
            None => (Terms::Distinct(distinct_terms(dictionary)), dictionary.dense_terms()),
            Some(chain) => (Terms::Chain(chain.clone()), chain.fitted().len()),
        };
        Self { dictionary: dictionary.clone(), terms, all: vec![0.0; all] }
    }

    /// Number of terms.
    pub fn count(&self) -> usize {
        match &self.terms {
            Terms::Distinct(distinct) => distinct.len(),
            Terms::Chain(chain) => chain.count(),
        }
    }

    /// The terms at the values of the observables, in `lifted`, shape `[count]`.
    pub fn lift(&mut self, values: &[f64], lifted: &mut [f64]) {
        match &self.terms {
            Terms::Distinct(distinct) => {
                self.dictionary.lift_dense(values, &mut self.all);
                for (to, term) in lifted.iter_mut().zip(distinct) {
                    *to = self.all[*term];
                }
            }
            Terms::Chain(chain) => chain.lift(&self.dictionary, values, &mut self.all, lifted),
        }
    }
}

/// What a least-squares problem over snapshot pairs is summed into: memory does not grow with them.
#[derive(Clone, Debug)]
pub enum Regression {
    /// The normal equations.
    Gram(Box<GramAccumulator>),
    /// The R factor, and a buffer for the lift.
    Qr {
        /// The terms.
        lift: Box<Lift>,
        /// Scratch for them.
        lifted: Vec<f64>,
        /// R so far.
        factor: RFactor,
        /// Pairs so far.
        pairs: u64,
    },
}

impl Regression {
    /// An empty problem for `outputs` targets. The terms of a chain go through the R factor whatever
    /// the method says.
    pub fn new(
        dictionary: &Dictionary,
        chain: Option<&Chain>,
        outputs: usize,
        method: Method,
    ) -> Self {
        match (method, chain) {
            (Method::Cholesky, None) => {
                Self::Gram(Box::new(GramAccumulator::new(dictionary, outputs)))
            }
            _ => {
                let lift = Lift::new(dictionary, chain);
                Self::Qr {
                    lifted: vec![0.0; lift.count()],
                    factor: RFactor::new(lift.count(), outputs),
                    pairs: 0,
                    lift: Box::new(lift),
                }
            }
        }
    }

    /// Adds a snapshot pair.
    #[inline]
    pub fn push(&mut self, values: &[f64], targets: &[f64]) {
        match self {
            Self::Gram(gram) => gram.push(values, targets),
            Self::Qr { lift, lifted, factor, pairs } => {
                lift.lift(values, lifted);
                factor.push(lifted, targets);
                *pairs += 1;
            }
        }
    }

    /// Solves it.
    ///
    /// # Errors
    /// The indices of the terms that depend on earlier ones, where the options do not accept that.
    pub fn solve(self, options: &FitOptions, outputs: usize) -> Result<Operator, Vec<usize>> {
        match self {
            Self::Gram(gram) => solve_normal(&gram.finish(), options),
            Self::Qr { lifted, factor, pairs, .. } => {
                let (r, c) = factor.finish();
                solve_factor(r, c, lifted.len(), outputs, pairs, options)
            }
        }
    }
}

/// F from the normal equations.
///
/// # Errors
/// As [`Regression::solve`].
pub fn solve_normal(
    equations: &NormalEquations,
    options: &FitOptions,
) -> Result<Operator, Vec<usize>> {
    let (n, m) = (equations.terms, equations.outputs);
    let mean = 1.0 / equations.pairs.max(1) as f64;
    let rms: Vec<f64> = (0..n).map(|i| (equations.gram[i * n + i] * mean).sqrt()).collect();
    let norms = column_scales(&rms, options);
    let mut gram = vec![0.0; n * n];
    for i in 0..n {
        for j in 0..n {
            gram[i * n + j] = equations.gram[i * n + j] * mean / (norms[i] * norms[j]);
        }
    }
    let mut x = vec![0.0; n * m];
    for i in 0..n {
        for j in 0..m {
            x[i * m + j] = equations.cross[i * m + j] * mean / norms[i];
        }
    }
    let data = factor(&gram, n);
    let rank = n - data.as_ref().map_or_else(Vec::len, |_| 0);
    let (l, data) = if options.ridge == 0.0 {
        let l = data?;
        (l.clone(), l)
    } else {
        let mut ridged = gram;
        for i in 0..n {
            ridged[i * n + i] += options.ridge;
        }
        (factor(&ridged, n)?, data.unwrap_or_else(|_| vec![0.0; n * n]))
    };
    solve::solve_cholesky(&l, &mut x, n, m);
    let matrix = finish(x, (&norms, &rms), (n, m), &l);
    Ok(Operator { matrix, terms: n, outputs: m, pairs: equations.pairs, rank, factor: data })
}

/// What the columns are divided by: their root mean square, or nothing.
fn column_scales(rms: &[f64], options: &FitOptions) -> Vec<f64> {
    rms.iter().map(|rms| if options.scale_columns && *rms > 0.0 { *rms } else { 1.0 }).collect()
}

/// The Cholesky factor of a Gram matrix, whose rank is judged on columns of unit norm, whatever
/// scaling the solution uses.
fn factor(gram: &[f64], n: usize) -> Result<Vec<f64>, Vec<usize>> {
    let scale: Vec<f64> = (0..n).map(|i| gram[i * n + i].sqrt()).collect();
    let mut unit = gram.to_vec();
    for (row, a) in unit.chunks_exact_mut(n).zip(&scale) {
        for (g, b) in row.iter_mut().zip(&scale) {
            *g = if a * b > 0.0 { *g / (a * b) } else { 0.0 };
        }
    }
    let mut l = solve::cholesky(&unit, n)?;
    for (row, scale) in l.chunks_exact_mut(n).zip(&scale) {
        for x in row {
            *x *= scale;
        }
    }
    Ok(l)
}

/// F from the R factor of the lifted data and C beside it.
fn solve_factor(
    mut r: Vec<f64>,
    mut c: Vec<f64>,
    n: usize,
    m: usize,
    pairs: u64,
    options: &FitOptions,
) -> Result<Operator, Vec<usize>> {
    let root = (pairs.max(1) as f64).sqrt();
    let norm =
        |r: &[f64], j: usize| (0..=j).map(|i| r[i * n + j] * r[i * n + j]).sum::<f64>().sqrt();
    let unit: Vec<f64> = (0..n).map(|j| norm(&r, j)).collect();
    let mut scaled = r.clone();
    for row in scaled.chunks_exact_mut(n) {
        for (x, norm) in row.iter_mut().zip(&unit) {
            *x = if *norm > 0.0 { *x / norm } else { 0.0 };
        }
    }
    let dependent = solve::dependent_columns(&scaled, n);
    let rms: Vec<f64> = unit.iter().map(|u| u / root).collect();
    let norms = column_scales(&rms, options);
    for row in r.chunks_exact_mut(n) {
        for (x, norm) in row.iter_mut().zip(&norms) {
            *x /= norm * root;
        }
    }
    for x in &mut c {
        *x /= root;
    }
    if options.method == Method::Svd {
        let svd = Svd::new(&r, n);
        let (x, rank) = svd.solve(&c, m, options.truncation, options.ridge);
        let matrix = finish(x, (&norms, &rms), (n, m), &r);
        return Ok(Operator { matrix, terms: n, outputs: m, pairs, rank, factor: r });
    }
    let (rank, data) = (n - dependent.len(), r.clone());
    if options.ridge > 0.0 {
        // √λ I below R, zeros below C.
        let mut ridged = RFactor::new(n, m);
        for (r, c) in r.chunks_exact(n).zip(c.chunks_exact(m)) {
            ridged.push(r, c);
        }
        for j in 0..n {
            let mut row = vec![0.0; n];
            row[j] = options.ridge.sqrt();
            ridged.push(&row, &vec![0.0; m]);
        }
        (r, c) = ridged.finish();
    } else if !dependent.is_empty() {
        return Err(dependent);
    }
    solve::solve_upper(&r, n, &mut c, n, m);
    let matrix = finish(c, (&norms, &rms), (n, m), &r);
    Ok(Operator { matrix, terms: n, outputs: m, pairs, rank, factor: data })
}

/// Undoes the column scaling and drops what is rounding noise; `factor` is what was solved with.
fn finish(
    mut x: Vec<f64>,
    (norms, rms): (&[f64], &[f64]),
    (n, m): (usize, usize),
    factor: &[f64],
) -> Vec<f64> {
    // Coefficients are compared by their root-mean-square contributions to the output. The
    // error of the solution is about ε κ for QR and ε κ² for Cholesky; the ratio of the factor's
    // diagonal entries bounds κ from below, cheaply and the same on every machine.
    let diagonal = || (0..n).map(|i| factor[i * n + i].abs()).filter(|d| *d > 0.0);
    let (low, high) = diagonal().fold((f64::INFINITY, 0.0_f64), |(a, b), d| (a.min(d), b.max(d)));
    let kappa = if low.is_finite() { high / low } else { 1.0 };
    let floor = (8.0 * f64::EPSILON * kappa * kappa).min(ROUNDING_FLOOR);
    for j in 0..m {
        for i in 0..n {
            x[i * m + j] /= norms[i];
        }
        let contribution = |x: &[f64], i: usize| (x[i * m + j] * rms[i]).abs();
        let largest = (0..n).fold(0.0_f64, |max, i| max.max(contribution(&x, i)));
        for i in 0..n {
            if contribution(&x, i) <= floor * largest {
                x[i * m + j] = 0.0;
            }
        }
    }
    x
}

/// No coefficient above this fraction of its column's largest contribution is taken for noise.
const ROUNDING_FLOOR: f64 = 1e-9;

/// Everything that one pass over the logs gives.
#[derive(Clone, Debug)]
pub struct Fit<'r> {
    /// Spaces, symmetry, dictionary with its scaling, limits, provenance.
    pub structure: Structure<'r>,
    /// The terms, where they are listed one by one.
    pub chain: Option<&'r Chain>,
    /// F.
    pub operator: Operator,
    /// How F was refined, if that was asked for.
    pub refined: Option<Refined>,
    /// Smallest and largest raw value of every observable, shape `[observables, 2]`.
    pub ranges: Vec<f32>,
    /// A snapshot from the data: coordinates at the lags and the present sample, oldest first, and
    /// the inputs at the same samples.
    pub example: (Vec<f64>, Vec<f64>),
    /// Standard deviation of every coordinate (wrapped on S¹).
    pub spread: Vec<f64>,
    /// What was read.
    pub summary: Summary,
}

/// Fits the robot's operator to all its trajectories.
///
/// One pass over the data, two when the dictionary is standardised, two more when the operator is
/// refined by its rollouts; memory does not grow with them.
///
/// # Errors
/// [`FitError`].
pub fn fit<'r, T: Trajectories>(
    robot: &'r Robot,
    trajectories: &T,
    progress: &dyn Fn(u64),
) -> Result<Fit<'r>, FitError<T::Error>> {
    let provenance = Provenance { logs: [0; 32], robot: robot.sha256 };
    let scaling = match robot.standardise {
        true => standardisation(robot, trajectories, progress)?,
        false => robot.identity_scaling(),
    };
    let structure =
        robot.structure(&scaling, &robot.limits(), provenance).map_err(FitError::Model)?;
    let (dictionary, chain) = (structure.dictionary(), robot.chain.as_ref());
    let regression = Regression::new(dictionary, chain, structure.outputs(), robot.fit.method);
    let sink = FitSink { regression, extremes: Extremes::new(scaling.len()), progress };
    let mut pass = FitPass {
        snapshots: Snapshots::new(&structure, sink),
        coordinates: vec![Spread::default(); robot.states.len()],
        example: Example::new(structure.lag() + 1),
    };
    let summary = trajectories.visit(&mut pass).map_err(FitError::Trajectories)?;
    let FitPass { snapshots, coordinates, example } = pass;
    let FitSink { regression, extremes, .. } = snapshots.into_sink();
    if extremes.is_empty() {
        return Err(FitError::NoPairs { need: structure.lag() + 2 });
    }
    let ranges = extremes.raw(&scaling);
    if let Some(bound) = ranges.iter().position(|bound| !bound.is_finite()) {
        let observable = crate::terms::observable_name(robot, robot.observables[bound / 2]);
        return Err(FitError::TooLarge { observable });
    }
    let mut operator = solve_named(robot, &structure, regression)?;
    let mut refined = None;
    if let Some(kappa) = robot.fit.refine {
        let collected = Collected::read(trajectories, &structure, &Plan::All, &robot.score);
        let collected = collected.map_err(FitError::Trajectories)?;
        let windows = collected.of(0);
        refined = Some(refine_operator(&structure, chain, &mut operator, &windows, kappa));
    }

    let mut limits = robot.limits();
    for (i, (limit, state)) in limits.iter_mut().zip(&robot.states).enumerate() {
        let excluded = robot.symmetry.excludes(i as u8);
        if state.limit.is_none() && state.space == Space::Line && !excluded {
            *limit = coordinates[i].limit();
        }
    }
    let provenance = Provenance { logs: summary.sha256, robot: robot.sha256 };
    let structure = robot.structure(&scaling, &limits, provenance).map_err(FitError::Model)?;
    let spread = coordinates.iter().map(Spread::deviation).collect();
    Ok(Fit {
        structure,
        chain: robot.chain.as_ref(),
        operator,
        refined,
        ranges,
        example: example.take(),
        spread,
        summary,
    })
}

/// Solves a regression, naming dependent terms by the robot's words.
pub(crate) fn solve_named<E>(
    robot: &Robot,
    structure: &Structure<'_>,
    regression: Regression,
) -> Result<Operator, FitError<E>> {
    let operator = regression
        .solve(&robot.fit, structure.outputs())
        .map_err(|dependent| rank_deficient(robot, structure, &dependent))?;
    if operator.matrix.iter().all(|x| x.is_finite()) {
        Ok(operator)
    } else {
        Err(FitError::NotFinite)
    }
}

/// Names dependent terms, given as indices of distinct terms, by the robot's words.
pub(crate) fn rank_deficient<E>(
    robot: &Robot,
    structure: &Structure<'_>,
    dependent: &[usize],
) -> FitError<E> {
    let dictionary = structure.dictionary();
    let (states, inputs) = crate::terms::robot_names(robot);
    let names = crate::terms::Names { states: &states, inputs: &inputs };
    let terms = match &robot.chain {
        Some(chain) => chain.names(dictionary, names),
        None => distinct_terms(dictionary)
            .iter()
            .map(|i| names.term(dictionary, *i, crate::terms::Form::Hermite))
            .collect(),
    };
    FitError::RankDeficient {
        terms: terms.len(),
        dependent: dependent.iter().map(|i| terms[*i].clone()).collect(),
    }
}

struct FitSink<'p> {
    regression: Regression,
    extremes: Extremes,
    progress: &'p dyn Fn(u64),
}

impl PairSink for FitSink<'_> {
    #[inline]
    fn pair(&mut self, _: u64, values: &[f64], targets: &[f64]) {
        self.extremes.push(values);
        self.regression.push(values, targets);
    }

    fn progress(&mut self, bytes: u64) {
        (self.progress)(bytes);
    }
}

/// The main pass: pairs, the spread of the coordinates, and an example for the self-test.
struct FitPass<'s, 'a, 'p> {
    snapshots: Snapshots<'s, 'a, FitSink<'p>>,
    coordinates: Vec<Spread>,
    example: Example,
}

impl Visitor for FitPass<'_, '_, '_> {
    fn begin(&mut self, name: &str) {
        self.example.begin();
        self.snapshots.begin(name);
    }

    fn row(&mut self, states: &[f64], inputs: &[f64]) {
        for (spread, x) in self.coordinates.iter_mut().zip(states) {
            spread.push(*x);
        }
        self.example.row(states, inputs);
        self.snapshots.row(states, inputs);
    }

    fn progress(&mut self, bytes: u64) {
        self.snapshots.progress(bytes);
    }
}

/// Rows after the first possible one that the example is taken at: the robot has begun to move.
const EXAMPLE_ROW: usize = 20;

/// The latest of the first rows of the first trajectory that is long enough.
struct Example {
    window: usize,
    states: Vec<Vec<f64>>,
    inputs: Vec<Vec<f64>>,
    rows: usize,
    done: bool,
}

impl Example {
    fn new(window: usize) -> Self {
        Self { window, states: Vec::new(), inputs: Vec::new(), rows: 0, done: false }
    }

    fn begin(&mut self) {
        self.done |= self.states.len() == self.window;
        if !self.done {
            self.states.clear();
            self.inputs.clear();
        }
    }

    fn row(&mut self, states: &[f64], inputs: &[f64]) {
        if self.done {
            return;
        }
        if self.states.len() == self.window {
            self.states.remove(0);
            self.inputs.remove(0);
        }
        self.states.push(states.to_vec());
        self.inputs.push(inputs.to_vec());
        self.rows += 1;
        self.done = self.rows == self.window + EXAMPLE_ROW;
    }

    fn take(self) -> (Vec<f64>, Vec<f64>) {
        (self.states.concat(), self.inputs.concat())
    }
}

/// Smallest and largest value of every observable.
#[derive(Clone, Debug)]
struct Extremes {
    low: Vec<f64>,
    high: Vec<f64>,
    any: bool,
}

impl Extremes {
    fn new(observables: usize) -> Self {
        Self {
            low: vec![f64::INFINITY; observables],
            high: vec![f64::NEG_INFINITY; observables],
            any: false,
        }
    }

    #[inline]
    fn push(&mut self, values: &[f64]) {
        self.any = true;
        for ((low, high), v) in self.low.iter_mut().zip(&mut self.high).zip(values) {
            *low = if *v < *low { *v } else { *low };
            *high = if *v > *high { *v } else { *high };
        }
    }

    fn is_empty(&self) -> bool {
        !self.any
    }

    /// In raw units and widened by the rounding to f32, so that the data lie inside.
    fn raw(&self, scaling: &[[f32; 2]]) -> Vec<f32> {
        let mut ranges = Vec::with_capacity(2 * scaling.len());
        for ((low, high), [centre, gain]) in self.low.iter().zip(&self.high).zip(scaling) {
            let raw = |v: f64| v / f64::from(*gain) + f64::from(*centre);
            let margin = 4.0 * f64::from(f32::EPSILON) * raw(*low).abs().max(raw(*high).abs());
            ranges.push((raw(*low) - margin) as f32);
            ranges.push((raw(*high) + margin) as f32);
        }
        ranges
    }
}

/// Mean, standard deviation and extremes of one number, from sums of its differences to the first
/// value: no division per sample, and no digits lost when the mean is far from 0.
#[derive(Clone, Debug)]
pub(crate) struct Spread {
    count: f64,
    first: f64,
    sum: f64,
    squares: f64,
    low: f64,
    high: f64,
}

impl Default for Spread {
    fn default() -> Self {
        let (low, high) = (f64::INFINITY, f64::NEG_INFINITY);
        Self { count: 0.0, first: 0.0, sum: 0.0, squares: 0.0, low, high }
    }
}

impl Spread {
    #[inline]
    pub(crate) fn push(&mut self, x: f64) {
        if self.count == 0.0 {
            self.first = x;
        }
        self.count += 1.0;
        let difference = x - self.first;
        self.sum += difference;
        self.squares += difference * difference;
        self.low = if x < self.low { x } else { self.low };
        self.high = if x > self.high { x } else { self.high };
    }

    fn mean(&self) -> f64 {
        self.first + self.sum / self.count.max(1.0)
    }

    /// Population standard deviation.
    pub(crate) fn deviation(&self) -> f64 {
        let count = self.count.max(1.0);
        let mean = self.sum / count;
        (self.squares / count - mean * mean).max(0.0).sqrt()
    }

    /// Ten times the width of the data to either side: nothing physical, but far from overflow.
    fn limit(&self) -> [f32; 2] {
        let width =
            (self.high - self.low).max(f64::from(f32::MIN_POSITIVE)).max(self.high.abs() * 1e-3);
        [(self.low - 10.0 * width) as f32, (self.high + 10.0 * width) as f32]
    }
}

/// Mean and standard deviation of every observable on ℝ, as centre and gain.
pub(crate) fn standardisation<T: Trajectories>(
    robot: &Robot,
    trajectories: &T,
    progress: &dyn Fn(u64),
) -> Result<Scaling, FitError<T::Error>> {
    struct Sink<'p> {
        spreads: Vec<Spread>,
        progress: &'p dyn Fn(u64),
    }
    impl PairSink for Sink<'_> {
        fn pair(&mut self, _: u64, values: &[f64], _: &[f64]) {
            for (spread, v) in self.spreads.iter_mut().zip(values) {
                spread.push(*v);
            }
        }
        fn progress(&mut self, bytes: u64) {
            (self.progress)(bytes);
        }
    }
    let identity = robot.identity_scaling();
    let provenance = Provenance { logs: [0; 32], robot: robot.sha256 };
    let structure =
        robot.structure(&identity, &robot.limits(), provenance).map_err(FitError::Model)?;
    let spreads = vec![Spread::default(); identity.len()];
    let mut snapshots = Snapshots::new(&structure, Sink { spreads, progress });
    trajectories.visit(&mut snapshots).map_err(FitError::Trajectories)?;
    let spreads = snapshots.into_sink().spreads;
    let pairs = robot.observables.iter().zip(&spreads);
    Ok(pairs
        .map(|((source, _), spread)| match source {
            Source::Sin(_) | Source::Cos(_) => [0.0, 1.0],
            _ => {
                let deviation = spread.deviation();
                // A number that never moves is left as it is; the fit will say so.
                let gain = if deviation > 0.0 { (1.0 / deviation) as f32 } else { 1.0 };
                let usable = gain.is_finite() && gain != 0.0 && (spread.mean() as f32).is_finite();
                if usable { [spread.mean() as f32, gain] } else { [0.0, 1.0] }
            }
        })
        .collect())
}
