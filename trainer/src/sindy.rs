//! SINDy with control (Brunton, Proctor & Kutz 2016, "Sparse identification of nonlinear dynamics
//! with control"): ẋ = Ξᵀ Θ(x, u) with few terms of a large library Θ.
//!
//! With X = \[states, inputs\], angles raw (continuous, radians), the library is Θ = \[1, X, all
//! products xᵢ xⱼ with i ≤ j, sin X, cos X, sin 2X, cos 2X\]. ẋ is the forward difference
//! (xₖ₊₁ − xₖ) / T, wrapped on the circle, and a prediction is one Euler step x + T Ξᵀ Θ(x, u): the
//! exact inverse of the difference, so that a fit without residual predicts without error, whatever
//! integrator made the data.
//!
//! All sums over the data are made once: one Gram matrix of \[1, Θ, ẋ\] for each of [`GROUPS`] groups
//! of trajectories. Everything after that uses the sums alone: the path of a [`Solver`] on all groups
//! and, for each group, on the others; a penalty is chosen for each state by its squared error on the
//! groups left out, a quadratic form of their Gram matrix. The order of the sums is fixed and no multiply-add is fused: the bits do not
//! depend on the vector unit.

use firmware_core::model::Space;
use firmware_core::{Lanes, Number, Scalar};

use crate::forecast::{Baseline, BaselineError, Data, Forecast};
use crate::solve;

/// Groups of trajectories for cross-validation: trajectory i is in group i mod 5; with fewer
/// trajectories than groups, the groups are contiguous fifths of the pairs.
pub const GROUPS: usize = 5;
/// Penalties (λ or thresholds) on a path.
pub const PENALTIES: usize = 100;
/// From one penalty to the next, 10^(−4/99): the last one is 1e-4 of the first.
const STEP: f64 = 0.911_162_756_115_489_5;
/// The largest violation of the optimality conditions, in parts of λ_max, at which coordinate
/// descent stops: 1e-4 of the last λ of a path.
const TOLERANCE: f64 = 1e-8;
/// Sweeps of coordinate descent between Newton steps.
const SWEEPS: usize = 3;
/// Rounds of both before a λ is given up; see [`LassoPath::violation`].
const ROUNDS: usize = 200;
/// Ridge of thresholded least squares on the correlation matrix: columns that depend on each other
/// up to rounding share their coefficient.
const RIDGE: f64 = 1e-9;
/// A column whose standard deviation is this small beside its mean is a constant and rounding noise.
const NO_VARIANCE: f64 = 1e-9;
/// Held-out errors that differ by less than this part of the variance are equal: rounding of the
/// quadratic form.
const ROUNDING: f64 = 1e-12;

/// How the coefficients are made sparse.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Solver {
    /// LASSO (Tibshirani 1996), as in the paper: [`lasso_path`].
    #[default]
    Lasso,
    /// Sequentially thresholded least squares (Brunton, Proctor & Kutz 2016), as in the original
    /// SINDy: [`thresholded_path`].
    Thresholded,
}

/// What can be chosen; the default is the paper's method.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// How the coefficients are made sparse.
    pub solver: Solver,
    /// Products of two variables and squares are in the library.
    pub products: bool,
    /// sin 2X and cos 2X are in the library.
    pub second_harmonic: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self { solver: Solver::Lasso, products: true, second_harmonic: true }
    }
}

/// The functions Θ of the variables \[states, inputs\], in the order 1, X, products, sin X, cos X,
/// sin 2X, cos 2X.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Library {
    variables: usize,
    products: bool,
    second_harmonic: bool,
}

impl Library {
    /// Number of functions.
    pub fn terms(&self) -> usize {
        let v = self.variables;
        1 + 3 * v
            + if self.products { v * (v + 1) / 2 } else { 0 }
            + if self.second_harmonic { 2 * v } else { 0 }
    }

    /// Names of the functions, given those of the states and inputs.
    pub fn names(&self, variables: &[&str]) -> Vec<String> {
        let mut names = vec!["1".to_owned()];
        names.extend(variables.iter().map(|v| (*v).to_owned()));
        if self.products {
            for (i, a) in variables.iter().enumerate() {
                names.push(format!("{a}^2"));
                names.extend(variables[i + 1..].iter().map(|b| format!("{a}*{b}")));
            }
        }
        let harmonics = if self.second_harmonic { &["", "2*"][..] } else { &[""] };
        for harmonic in harmonics {
            for function in ["sin", "cos"] {
                names.extend(variables.iter().map(|v| format!("{function}({harmonic}{v})")));
            }
        }
        names
    }

    /// Θ, shape `[terms]`, at `variables`, shape `[states + inputs]`, angles in radians.
    pub fn evaluate(&self, variables: &[f64], terms: &mut [f64]) {
        let (sin, cos): (Vec<f64>, Vec<f64>) =
            variables.iter().copied().map(Scalar::sin_cos).unzip();
        self.fill(variables, &sin, &cos, terms);
    }

    #[inline(always)]
    fn fill<N: Number>(&self, x: &[N], sin: &[N], cos: &[N], terms: &mut [N]) {
        let mut terms = terms.iter_mut();
        let mut push = |value: N| {
            if let Some(term) = terms.next() {
                *term = value;
            }
        };
        push(N::ONE);
        x.iter().for_each(|x| push(*x));
        if self.products {
            for (i, a) in x.iter().enumerate() {
                x[i..].iter().for_each(|b| push(*a * *b));
            }
        }
        sin.iter().for_each(|s| push(*s));
        cos.iter().for_each(|c| push(*c));
        if self.second_harmonic {
            sin.iter().zip(cos).for_each(|(s, c)| push((N::ONE + N::ONE) * *s * *c));
            sin.iter().zip(cos).for_each(|(s, c)| push((*c - *s) * (*c + *s)));
        }
    }
}

/// Sparse dynamics.
///
/// ```
/// use firmware_core::model::Space;
/// use trainer::forecast::{Baseline, Data};
/// use trainer::sindy::{Settings, Sindy, Solver};
/// use trainer::trajectory::Trajectory;
/// // x' = −x² / 2 + u in steps of 0.1 s.
/// let inputs: Vec<f64> = (0..200).map(|k| f64::from(k * k % 17) / 8.0).collect();
/// let states = inputs.iter().scan(0.0, |x, u| {
///     let now = *x;
///     *x += 0.1 * (-0.5 * *x * *x + u);
///     Some(now)
/// });
/// let walk = Trajectory { states: states.collect(), inputs: inputs.clone() };
/// let data = Data { spaces: &[Space::Line], inputs: 1, sample_time_s: 0.1, trajectories: &[walk] };
/// let settings = Settings { solver: Solver::Thresholded, ..Settings::default() };
/// let fit = Sindy::fit(data, &settings)?;
/// let terms = fit.library().names(&["x", "u"]).into_iter().zip(fit.coefficients());
/// let found = terms.filter(|(_, c)| c.abs() > 1e-6).map(|(n, c)| format!("{c:.3} {n}"));
/// assert_eq!(found.collect::<Vec<_>>(), ["1.000 u", "-0.500 x^2"]);
/// # Ok::<(), trainer::forecast::BaselineError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Sindy {
    library: Library,
    sample_time_s: f64,
    /// Shape `[terms, states]`.
    coefficients: Vec<f64>,
    paths: Vec<Path>,
}

/// The path of one state equation, from the largest penalty to the smallest.
#[derive(Clone, Debug, PartialEq)]
pub struct Path {
    /// λ or thresholds, without unit: for library columns and ẋ of unit variance.
    pub penalties: Vec<f64>,
    /// Ξ in raw units (unit of the state, per second, per unit of the term), fitted to all groups,
    /// shape `[penalties, terms]`.
    pub coefficients: Vec<f64>,
    /// Mean squared error of ẋ on the group left out of the fit, averaged over the groups, for each
    /// penalty, in squared units of the state per second.
    pub errors: Vec<f64>,
    /// Index of the penalty that is used: the largest with the least error.
    pub chosen: usize,
}

impl Sindy {
    /// The library.
    pub fn library(&self) -> &Library {
        &self.library
    }

    /// Ξ, shape `[terms, states]`, in units of the state, per second, per unit of the term.
    pub fn coefficients(&self) -> &[f64] {
        &self.coefficients
    }

    /// The paths, one for each state, and the penalties chosen on them.
    pub fn paths(&self) -> &[Path] {
        &self.paths
    }

    /// Terms in the equation of each state, the constant included.
    pub fn nonzeros(&self) -> Vec<usize> {
        let n = self.paths.len();
        let count = |s| self.coefficients.iter().skip(s).step_by(n).filter(|c| **c != 0.0).count();
        (0..n).map(count).collect()
    }
}

impl Forecast for Sindy {
    fn numbers(&self) -> usize {
        self.nonzeros().iter().sum()
    }

    fn predict(&self, states: &[f64], inputs: &[f64], next: &mut [f64]) -> bool {
        let n = self.paths.len();
        let mut variables = Vec::with_capacity(self.library.variables);
        variables.extend_from_slice(&states[states.len() - n..]);
        variables.extend_from_slice(&inputs[inputs.len() + n - self.library.variables..]);
        let mut terms = vec![0.0; self.library.terms()];
        self.library.evaluate(&variables, &mut terms);
        next.fill(0.0);
        for (term, row) in terms.iter().zip(self.coefficients.chunks_exact(n)) {
            for (velocity, c) in next.iter_mut().zip(row) {
                // A term that is not in the equation must not make it infinite.
                if *c != 0.0 {
                    *velocity += c * term;
                }
            }
        }
        for (next, x) in next.iter_mut().zip(&variables) {
            *next = x + self.sample_time_s * *next;
        }
        next.iter().all(|x| x.is_finite())
    }
}

impl Baseline for Sindy {
    type Settings = Settings;

    fn fit(training: Data<'_>, settings: &Settings) -> Result<Self, BaselineError> {
        let Data { spaces, inputs, sample_time_s, trajectories } = training;
        if !(sample_time_s > 0.0 && sample_time_s.is_finite()) {
            let message = format!("the sample time must be positive: it is {sample_time_s} s");
            return Err(BaselineError::Settings(message));
        }
        let first = training.pairs().next().filter(|_| !spaces.is_empty());
        let Some(first) = first else { return Err(BaselineError::NoPairs) };
        let library = Library {
            variables: spaces.len() + inputs,
            products: settings.products,
            second_harmonic: settings.second_harmonic,
        };
        let columns = Columns::new(library, spaces, sample_time_s, first);
        let groups: Vec<Gram> = if trajectories.len() < GROUPS {
            let pairs = training.pairs().count();
            let edge = |group: usize| group * pairs / GROUPS;
            let group = |g| training.pairs().skip(edge(g)).take(edge(g + 1) - edge(g));
            (0..GROUPS).map(|g| columns.gram(group(g))).collect()
        } else {
            let alone = |t| Data { trajectories: std::slice::from_ref(t), ..training }.pairs();
            let group = |g| trajectories.iter().skip(g).step_by(GROUPS).flat_map(alone);
            (0..GROUPS).map(|g| columns.gram(group(g))).collect()
        };
        if !groups.iter().flat_map(|g| &g.sums).all(|x| x.is_finite()) {
            return Err(BaselineError::NotFinite);
        }
        let paths = columns.paths(&groups, settings);
        let terms = library.terms();
        let mut coefficients = Vec::with_capacity(terms * paths.len());
        for j in 0..terms {
            coefficients.extend(paths.iter().map(|p| p.coefficients[p.chosen * terms + j]));
        }
        if !coefficients.iter().all(|c| c.is_finite()) {
            return Err(BaselineError::NotFinite);
        }
        Ok(Self { library, sample_time_s, coefficients, paths })
    }
}

/// Samples side by side.
const LANES: usize = 4;
/// Groups of [`LANES`] samples that are evaluated and multiplied at once.
const CHUNK: usize = 32;
/// Columns and rows of the Gram matrix in a register tile.
const TILE: usize = 3;

type Lane = Lanes<f64, LANES>;

/// The columns \[1, Θ, ẋ\] of a Gram matrix. From each but the first its value at the first pair is
/// subtracted: keeps digits when the mean is far from 0, and makes a column that never moves
/// exactly 0.
struct Columns<'d> {
    library: Library,
    spaces: &'d [Space],
    sample_time_s: f64,
    origin: Vec<f64>,
}

/// Sums over the pairs of a group.
#[derive(Clone, Debug)]
struct Gram {
    /// Σ of products of two columns, shape `[columns, columns]`, symmetric; `[0]` is the number of
    /// pairs.
    sums: Vec<f64>,
}

type Pair<'d> = (&'d [f64], &'d [f64], &'d [f64]);

impl<'d> Columns<'d> {
    fn new(library: Library, spaces: &'d [Space], sample_time_s: f64, first: Pair<'_>) -> Self {
        let terms = library.terms();
        let mut origin = vec![0.0; terms + spaces.len()];
        library.evaluate(&[first.0, first.1].concat(), &mut origin[..terms]);
        origin[0] = 0.0;
        let mut columns = Self { library, spaces, sample_time_s, origin };
        for i in 0..spaces.len() {
            columns.origin[terms + i] = columns.velocity(i, first);
        }
        columns
    }

    fn velocity(&self, i: usize, (x, _, next): Pair<'_>) -> f64 {
        self.spaces[i].difference(next[i], x[i]) / self.sample_time_s
    }

    fn gram<'p>(&self, mut pairs: impl Iterator<Item = Pair<'p>>) -> Gram {
        let (terms, v) = (self.library.terms(), self.library.variables);
        let count = self.origin.len();
        // Up to a whole number of tiles, columns of zeros.
        let width = count.next_multiple_of(TILE);
        let mut rows = vec![Lane::ZERO; CHUNK * width];
        let mut values = vec![Lane::ZERO; CHUNK * 3 * v];
        let mut sums = vec![0.0; width * width];
        let arch = pulp::Arch::new();
        loop {
            let mut filled = 0;
            for pair in pairs.by_ref().take(CHUNK * LANES) {
                let (group, lane) = (filled / LANES, filled % LANES);
                let values = &mut values[group * 3 * v..][..3 * v];
                for (i, x) in pair.0.iter().chain(pair.1).enumerate() {
                    // By name: f64 has a method of its own, which is not libm's.
                    let (sin, cos) = Scalar::sin_cos(*x);
                    values[i].0[lane] = *x;
                    values[v + i].0[lane] = sin;
                    values[2 * v + i].0[lane] = cos;
                }
                for i in 0..self.spaces.len() {
                    let velocity = self.velocity(i, pair) - self.origin[terms + i];
                    rows[group * width + terms + i].0[lane] = velocity;
                }
                filled += 1;
            }
            if filled == 0 {
                break;
            }
            let groups = filled.div_ceil(LANES);
            arch.dispatch(
                #[inline(always)]
                || {
                    let rows = &mut rows[..groups * width];
                    for (row, x) in rows.chunks_exact_mut(width).zip(values.chunks_exact(3 * v)) {
                        self.library.fill(&x[..v], &x[v..2 * v], &x[2 * v..], &mut row[..terms]);
                        for (term, origin) in row[1..terms].iter_mut().zip(&self.origin[1..]) {
                            *term = *term - Lanes([*origin; LANES]);
                        }
                    }
                    // The lanes behind the last sample hold an older one: they must not count.
                    for lanes in &mut rows[(groups - 1) * width..] {
                        lanes.0[LANES - (groups * LANES - filled)..].fill(0.0);
                    }
                    add_gram(rows, width, &mut sums);
                },
            );
        }
        let symmetric = |k: usize| {
            let (i, j) = (k / count, k % count);
            sums[i.min(j) * width + i.max(j)]
        };
        Gram { sums: (0..count * count).map(symmetric).collect() }
    }

    /// The path of every state on all groups, and the choice by those left out.
    fn paths(&self, groups: &[Gram], settings: &Settings) -> Vec<Path> {
        let terms = self.library.terms();
        let whole = Gram::sum(groups.iter());
        let problem = Standardised::new(&whole, &self.origin, terms);
        let mut folds: Vec<(Standardised, &Gram)> = Vec::new();
        for (k, held) in groups.iter().enumerate() {
            let others = groups.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, g)| g);
            let rest = Gram::sum(others);
            if held.sums[0] > 0.0 && rest.sums[0] > 0.0 {
                folds.push((Standardised::new(&rest, &self.origin, terms), held));
            }
        }
        if folds.is_empty() {
            folds.push((problem.clone(), &whole));
        }
        let path = |state: usize| {
            let penalties = problem.penalties(state, settings.solver);
            let mut path = problem.path(state, settings.solver, &penalties);
            let mut errors = vec![0.0; PENALTIES];
            for (rest, held) in &folds {
                let fit = rest.path(state, settings.solver, &penalties);
                for (error, xi) in errors.iter_mut().zip(fit.chunks_exact(terms)) {
                    *error += held.squared_error(xi, terms + state) / folds.len() as f64;
                }
            }
            let deviation = problem.deviation[terms + state];
            let least = errors.iter().fold(f64::INFINITY, |least, e| e.min(least));
            let limit = least + ROUNDING * deviation * deviation;
            let chosen = errors.iter().position(|e| *e <= limit).unwrap_or(0);
            // From columns less their origin to the columns themselves.
            for xi in path.chunks_exact_mut(terms) {
                let shift: f64 = xi.iter().zip(&self.origin).map(|(c, o)| c * o).sum();
                xi[0] += self.origin[terms + state] - shift;
            }
            Path { penalties, coefficients: path, errors, chosen }
        };
        (0..self.spaces.len()).map(path).collect()
    }
}

/// `sums += rowsᵀ rows`, tiles on and above the diagonal; `rows` has shape `[groups, width]`.
#[inline(always)]
fn add_gram(rows: &[Lane], width: usize, sums: &mut [f64]) {
    for i in (0..width).step_by(TILE) {
        for j in (i..width).step_by(TILE) {
            let mut tile = [[Lane::ZERO; TILE]; TILE];
            for row in rows.chunks_exact(width) {
                for (sums, a) in tile.iter_mut().zip(&row[i..][..TILE]) {
                    for (sum, b) in sums.iter_mut().zip(&row[j..][..TILE]) {
                        *sum = *sum + *a * *b;
                    }
                }
            }
            for (k, tile) in tile.iter().enumerate() {
                for (sum, Lanes([a, b, c, d])) in sums[(i + k) * width + j..].iter_mut().zip(tile) {
                    *sum += (a + c) + (b + d);
                }
            }
        }
    }
}

impl Gram {
    fn sum<'g>(mut groups: impl Iterator<Item = &'g Self>) -> Self {
        let mut sum = groups.next().cloned().unwrap_or(Self { sums: Vec::new() });
        for group in groups {
            for (a, b) in sum.sums.iter_mut().zip(&group.sums) {
                *a += b;
            }
        }
        sum
    }

    /// Mean of (ξᵀΘ − y)², shape of `xi` `[terms]`, y in column `target`: the quadratic form of
    /// (ξ, −1).
    fn squared_error(&self, xi: &[f64], target: usize) -> f64 {
        let count = self.sums.len().isqrt();
        let row = |j: usize| &self.sums[j * count..][..count];
        let mut product: Vec<f64> = row(target).iter().map(|x| -x).collect();
        for (j, c) in xi.iter().enumerate().filter(|(_, c)| **c != 0.0) {
            for (p, x) in product.iter_mut().zip(row(j)) {
                *p += c * x;
            }
        }
        let form: f64 = xi.iter().zip(&product).map(|(c, p)| c * p).sum();
        let sum = form - product[target];
        // Rounding; what is not a number stays so.
        if sum < 0.0 { 0.0 } else { sum / self.sums[0] }
    }
}

/// The regression with all columns but the constant centred and of unit variance.
#[derive(Clone, Debug)]
struct Standardised {
    terms: usize,
    /// Of every column, less its origin.
    mean: Vec<f64>,
    /// Of every column; 0 where it never moves.
    deviation: Vec<f64>,
    /// Correlations of the columns without the constant, shape `[terms − 1, terms − 1]`.
    gram: Vec<f64>,
    /// Correlations with the targets, shape `[states, terms − 1]`.
    cross: Vec<f64>,
}

impl Standardised {
    fn new(gram: &Gram, origin: &[f64], terms: usize) -> Self {
        let count = origin.len();
        let pairs = gram.sums[0];
        let mean: Vec<f64> = gram.sums[..count].iter().map(|s| s / pairs).collect();
        let covariance = |i: usize, j: usize| gram.sums[i * count + j] / pairs - mean[i] * mean[j];
        let deviation = |i: usize| {
            let (variance, floor) = (covariance(i, i), NO_VARIANCE * (mean[i] + origin[i]));
            if variance > floor * floor { variance.sqrt() } else { 0.0 }
        };
        let deviation: Vec<f64> = (0..count).map(deviation).collect();
        let correlation = |i: usize, j: usize| {
            let scale = deviation[i] * deviation[j];
            if scale > 0.0 { covariance(i, j) / scale } else { 0.0 }
        };
        let rows = |from: usize, to: usize| {
            let row = |i| (1..terms).map(move |j| (i, j));
            (from..to).flat_map(row).map(|(i, j)| correlation(i, j)).collect()
        };
        let (gram, cross) = (rows(1, terms), rows(terms, count));
        Self { terms, mean, deviation, gram, cross }
    }

    fn cross(&self, state: usize) -> &[f64] {
        let p = self.terms - 1;
        &self.cross[state * p..][..p]
    }

    /// From λ_max, or from a threshold of one standard deviation of the target, downwards.
    fn penalties(&self, state: usize, solver: Solver) -> Vec<f64> {
        let first = match solver {
            Solver::Lasso => self.cross(state).iter().fold(0.0_f64, |a, c| a.max(c.abs())),
            Solver::Thresholded => 1.0,
        };
        std::iter::successors(Some(first), |p| Some(p * STEP)).take(PENALTIES).collect()
    }

    /// ξ for every penalty, shape `[penalties, terms]`, for columns less their origin.
    fn path(&self, state: usize, solver: Solver, penalties: &[f64]) -> Vec<f64> {
        let cross = self.cross(state);
        let path = match solver {
            Solver::Lasso => lasso_path(&self.gram, cross, penalties).coefficients,
            Solver::Thresholded => thresholded_path(&self.gram, cross, penalties),
        };
        let target = self.terms + state;
        let mut raw = vec![0.0; penalties.len() * self.terms];
        let p = self.terms - 1;
        for (xi, beta) in raw.chunks_exact_mut(self.terms).zip(path.chunks_exact(p)) {
            xi[0] = self.mean[target];
            for j in 1..self.terms {
                if beta[j - 1] != 0.0 {
                    xi[j] = beta[j - 1] * self.deviation[target] / self.deviation[j];
                    xi[0] -= xi[j] * self.mean[j];
                }
            }
        }
        raw
    }
}

/// Solutions of the LASSO.
#[derive(Clone, Debug, PartialEq)]
pub struct LassoPath {
    /// β for every λ, shape `[lambdas, p]`.
    pub coefficients: Vec<f64>,
    /// The largest violation of the optimality conditions on the path, in parts of λ_max. It is
    /// above 1e-8 only where columns depend on each other almost to rounding.
    pub violation: f64,
}

/// The LASSO path: β(λ) minimises ½ βᵀGβ − cᵀβ + λ ‖β‖₁ (Tibshirani 1996; with G = XᵀX/N and
/// c = Xᵀy/N this is ‖y − Xβ‖²/2N + λ ‖β‖₁) for every λ of `lambdas`, in descending order.
///
/// Cyclic coordinate descent with covariance updates and warm starts (Friedman, Hastie & Tibshirani
/// 2010, section 2). It finds the active set A; on it, where descent is slow for correlated columns,
/// the equations G_AA β_A = c_A − λ sign β_A are solved at once, going no further than the first
/// change of sign (Lee, Battle, Raina & Ng 2007, "Efficient sparse coding algorithms", algorithm 1).
/// It stops when, with g = c − Gβ, all |gⱼ − λ sign βⱼ| (βⱼ ≠ 0) and |gⱼ| − λ (βⱼ = 0) are at most
/// 1e-8 λ_max; from λ_max = max |cⱼ| on, β is 0.
///
/// `gram` has shape `[p, p]`, symmetric with a unit diagonal; columns with a diagonal entry of 0
/// get coefficient 0. `cross` has shape `[p]`.
///
/// ```
/// use trainer::sindy::lasso_path;
/// // Orthonormal columns: soft thresholding.
/// let path = lasso_path(&[1.0, 0.0, 0.0, 1.0], &[0.75, -0.5], &[0.75, 0.25]);
/// assert_eq!(path.coefficients, [0.0, 0.0, 0.5, -0.25]);
/// ```
pub fn lasso_path(gram: &[f64], cross: &[f64], lambdas: &[f64]) -> LassoPath {
    let mut descent = Descent {
        gram,
        cross,
        beta: vec![0.0; cross.len()],
        gradient: cross.to_vec(),
        active: Vec::new(),
        factor: None,
    };
    let largest = cross.iter().fold(0.0_f64, |a, c| a.max(c.abs()));
    let mut path = LassoPath { coefficients: Vec::new(), violation: 0.0 };
    for lambda in lambdas {
        let violation = descent.solve(*lambda, TOLERANCE * largest);
        if violation > path.violation * largest {
            path.violation = violation / largest;
        }
        path.coefficients.extend_from_slice(&descent.beta);
    }
    path
}

struct Descent<'g> {
    gram: &'g [f64],
    cross: &'g [f64],
    beta: Vec<f64>,
    /// c − Gβ.
    gradient: Vec<f64>,
    /// Indices of nonzero coefficients at the last Newton step, and the Cholesky factor of their
    /// G_AA; none when columns are dependent.
    active: Vec<usize>,
    factor: Option<Vec<f64>>,
}

impl Descent<'_> {
    /// Returns the violation of the optimality conditions.
    fn solve(&mut self, lambda: f64, tolerance: f64) -> f64 {
        let mut violation = f64::INFINITY;
        for _ in 0..ROUNDS {
            while self.newton(lambda) {}
            for _ in 0..SWEEPS {
                self.sweep(lambda);
                violation = self.violation(lambda);
                if violation <= tolerance {
                    return violation;
                }
            }
        }
        violation
    }

    fn sweep(&mut self, lambda: f64) {
        let p = self.beta.len();
        for j in 0..p {
            let row = &self.gram[j * p..][..p];
            let target = self.gradient[j] + self.beta[j];
            let new = if row[j] == 0.0 || target.abs() <= lambda {
                0.0
            } else {
                target - lambda.copysign(target)
            };
            let change = new - self.beta[j];
            if change != 0.0 {
                self.beta[j] = new;
                subtract(&mut self.gradient, change, row);
            }
        }
    }

    fn violation(&self, lambda: f64) -> f64 {
        if !self.gradient.iter().all(|g| g.is_finite()) {
            return f64::INFINITY;
        }
        let entries = self.beta.iter().zip(&self.gradient).enumerate();
        entries.fold(0.0_f64, |most, (j, (b, g))| {
            most.max(if *b != 0.0 {
                (g - lambda.copysign(*b)).abs()
            } else if self.gram[j * self.beta.len() + j] == 0.0 {
                0.0
            } else {
                g.abs() - lambda
            })
        })
    }

    /// Returns whether a coefficient became 0 on the way.
    fn newton(&mut self, lambda: f64) -> bool {
        let p = self.beta.len();
        let active: Vec<usize> = (0..p).filter(|j| self.beta[*j] != 0.0).collect();
        let a = active.len();
        if active != self.active {
            self.factor = solve::cholesky(&block(self.gram, p, &active, 0.0), a).ok();
            self.active = active;
        }
        let Some(factor) = &self.factor else { return false };
        let right = |j: &usize| self.cross[*j] - lambda.copysign(self.beta[*j]);
        let mut target: Vec<f64> = self.active.iter().map(right).collect();
        solve::solve_cholesky(factor, &mut target, a, 1);
        let (mut step, mut crossing) = (1.0, None);
        for (j, to) in self.active.iter().zip(&target) {
            let from = self.beta[*j];
            let until = from / (from - to);
            if from * to <= 0.0 && until < step {
                (step, crossing) = (until, Some(*j));
            }
        }
        for (j, to) in self.active.iter().zip(&target) {
            let from = self.beta[*j];
            self.beta[*j] = if crossing.is_none() { *to } else { from + step * (to - from) };
        }
        if let Some(j) = crossing {
            self.beta[j] = 0.0;
        }
        self.gradient.copy_from_slice(self.cross);
        for j in &self.active {
            subtract(&mut self.gradient, self.beta[*j], &self.gram[j * p..][..p]);
        }
        crossing.is_some()
    }
}

fn subtract(from: &mut [f64], factor: f64, row: &[f64]) {
    for (x, y) in from.iter_mut().zip(row) {
        *x -= factor * y;
    }
}

/// Rows and columns `indices` of a matrix of shape `[p, p]`, with `ridge` on the diagonal.
fn block(matrix: &[f64], p: usize, indices: &[usize], ridge: f64) -> Vec<f64> {
    let mut block = Vec::with_capacity(indices.len() * indices.len());
    for i in indices {
        block.extend(indices.iter().map(|j| matrix[i * p + j] + if i == j { ridge } else { 0.0 }));
    }
    block
}

/// Sequentially thresholded least squares (Brunton, Proctor & Kutz 2016): least squares on the
/// active columns (with a ridge of 1e-9), columns with |β| below the threshold leave, and again until
/// none does. Each threshold of `thresholds`, in descending order, starts from the columns that
/// the next smaller one left. The result has shape `[thresholds, p]`.
///
/// `gram` has shape `[p, p]`, symmetric with a unit diagonal; columns with a diagonal entry of 0
/// get coefficient 0. `cross` has shape `[p]`.
///
/// ```
/// use trainer::sindy::thresholded_path;
/// // Least squares gives 0.867 and 0.067; the second leaves, and the first is fitted anew.
/// let beta = thresholded_path(&[1.0, 0.5, 0.5, 1.0], &[0.9, 0.5], &[0.1]);
/// assert!((beta[0] - 0.9).abs() < 1e-8 && beta[1] == 0.0);
/// ```
pub fn thresholded_path(gram: &[f64], cross: &[f64], thresholds: &[f64]) -> Vec<f64> {
    let p = cross.len();
    let mut active: Vec<usize> = (0..p).filter(|j| gram[j * p + j] != 0.0).collect();
    let least_squares = |active: &[usize]| -> Vec<f64> {
        let mut beta: Vec<f64> = active.iter().map(|j| cross[*j]).collect();
        match solve::cholesky(&block(gram, p, active, RIDGE), active.len()) {
            Ok(factor) => solve::solve_cholesky(&factor, &mut beta, active.len(), 1),
            // Not with a Gram matrix: the ridge keeps it definite.
            Err(_) => beta.fill(0.0),
        }
        beta
    };
    let mut beta = least_squares(&active);
    let mut path = vec![0.0; thresholds.len() * p];
    for (k, threshold) in thresholds.iter().enumerate().rev() {
        while beta.iter().any(|b| b.abs() < *threshold) {
            let mut sizes = beta.iter();
            active.retain(|_| sizes.next().is_some_and(|b| b.abs() >= *threshold));
            beta = least_squares(&active);
        }
        for (j, b) in active.iter().zip(&beta) {
            path[k * p + j] = *b;
        }
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trajectory::Trajectory;
    use proptest::prelude::*;

    const FULL: Library = Library { variables: 3, products: true, second_harmonic: true };

    /// Numbers in [−1, 1) without structure.
    fn noise(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        }
    }

    /// A driven pendulum in Euler steps of 0.01 s, θ' = ω, ω' = −9.81 sin θ − 0.3 ω + 2 u, with the
    /// angle recorded in (−π, π].
    fn pendulum(trials: usize, samples: usize) -> Vec<Trajectory> {
        let mut next = noise(7);
        let trial = |_| {
            let (mut theta, mut omega) = (3.0 * next(), 6.0 * next());
            let mut t = Trajectory::default();
            for _ in 0..samples {
                let u = 4.0 * next();
                t.states.extend([theta.wrap(), omega]);
                t.inputs.push(u);
                let force = -9.81 * Scalar::sin_cos(theta).0 - 0.3 * omega + 2.0 * u;
                (theta, omega) = (theta + 0.01 * omega, omega + 0.01 * force);
            }
            t
        };
        (0..trials).map(trial).collect()
    }

    fn data(trajectories: &[Trajectory]) -> Data<'_> {
        let spaces = &[Space::Circle, Space::Line];
        Data { spaces, inputs: 1, sample_time_s: 0.01, trajectories }
    }

    fn settings(solver: Solver) -> Settings {
        Settings { solver, ..Settings::default() }
    }

    /// Correlations of `p` columns, mixed by `mixing`, with each other and a target.
    fn problem(p: usize, mixing: f64, seed: u64) -> (Vec<f64>, Vec<f64>) {
        let mut next = noise(seed);
        let rows: Vec<Vec<f64>> = (0..3 * p)
            .map(|_| {
                let common = next();
                (0..=p).map(|_| mixing * common + (1.0 - mixing) * next()).collect()
            })
            .collect();
        let product = |i: usize, j: usize| rows.iter().map(|r| r[i] * r[j]).sum::<f64>();
        let norm = |i: usize| product(i, i).sqrt();
        let unit =
            |i: usize, j: usize| if i == j { 1.0 } else { product(i, j) / norm(i) / norm(j) };
        let gram = (0..p * p).map(|k| unit(k / p, k % p)).collect();
        (gram, (0..p).map(|i| unit(i, p)).collect())
    }

    fn grid(cross: &[f64]) -> Vec<f64> {
        let first = cross.iter().fold(0.0_f64, |a, c| a.max(c.abs()));
        (0..PENALTIES).map(|k| first * STEP.powi(k as i32)).collect()
    }

    #[test]
    fn the_lasso_of_two_correlated_columns_has_its_closed_form() {
        let (r, c1, c2) = (0.6, 0.9, 0.7);
        // The second column enters where |c₂ − r (c₁ − λ)| = λ; from there on both are active.
        let enters = (c2 - r * c1) / (1.0 - r);
        let lambdas: Vec<f64> = (0..=90).map(|k| 0.9 - 0.01 * f64::from(k)).collect();
        let path = lasso_path(&[1.0, r, r, 1.0], &[c1, c2], &lambdas);
        for (lambda, beta) in lambdas.iter().zip(path.coefficients.chunks_exact(2)) {
            let expected = if *lambda > enters {
                [c1 - lambda, 0.0]
            } else {
                let both = |a: f64, b: f64| (a - lambda - r * (b - lambda)) / (1.0 - r * r);
                [both(c1, c2), both(c2, c1)]
            };
            for (b, e) in beta.iter().zip(expected) {
                assert!((b - e).abs() < 1e-8, "{lambda}: {beta:?} {expected:?}");
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn the_whole_lasso_path_is_optimal(p in 1_usize..12, mixing in 0.0..0.9999, seed: u64) {
            let (gram, cross) = problem(p, mixing, seed);
            let mut lambdas = grid(&cross);
            lambdas.push(0.0);
            let path = lasso_path(&gram, &cross, &lambdas);
            let tolerance = 2.0 * TOLERANCE * lambdas[0];
            prop_assert!(path.coefficients[..p].iter().all(|b| *b == 0.0), "λ_max is not empty");
            prop_assert!(path.coefficients[p..2 * p].iter().any(|b| *b != 0.0));
            // The optimality conditions; those at λ = 0 are the normal equations.
            for (lambda, beta) in lambdas.iter().zip(path.coefficients.chunks_exact(p)) {
                for (j, b) in beta.iter().enumerate() {
                    let g: f64 = cross[j] - (0..p).map(|i| gram[j * p + i] * beta[i]).sum::<f64>();
                    let violation = if *b == 0.0 {
                        g.abs() - lambda
                    } else {
                        (g - lambda * b.signum()).abs()
                    };
                    prop_assert!(violation <= tolerance, "λ {lambda} column {j}: {violation}");
                }
            }
        }
    }

    #[test]
    fn collinear_columns_stop_neither_solver() {
        // The first four columns are the same but for 1e-7, or exactly; the fifth is none.
        for difference in [1e-7, 0.0] {
            let p = 5;
            let mut gram = vec![1.0 - difference; p * p];
            (0..p).for_each(|j| gram[j * p + j] = 1.0);
            (0..p).for_each(|j| (gram[4 * p + j], gram[j * p + 4]) = (0.0, 0.0));
            let cross = [0.8, 0.8 - 0.5 * difference, 0.8 + 0.5 * difference, 0.8, 0.0];
            let path = lasso_path(&gram, &cross, &grid(&cross));
            assert!(path.violation <= TOLERANCE, "{}", path.violation);
            let thresholded = thresholded_path(&gram, &cross, &[0.1, 0.01]);
            for beta in path.coefficients.chunks_exact(p).chain(thresholded.chunks_exact(p)) {
                assert_eq!(beta[4], 0.0);
            }
            let sum: f64 = thresholded[..4].iter().sum();
            assert!((sum - 0.8).abs() < 1e-6, "{thresholded:?}");
        }
    }

    #[test]
    fn thresholds_find_the_pendulum() {
        let trials = pendulum(10, 60);
        let fit = Sindy::fit(data(&trials), &settings(Solver::Thresholded)).expect("fits");
        let names = fit.library().names(&["theta", "omega", "u"]);
        let truth = |name: &str| match name {
            "omega" => [1.0, -0.3],
            "sin(theta)" => [0.0, -9.81],
            "u" => [0.0, 2.0],
            _ => [0.0, 0.0],
        };
        for (name, row) in names.iter().zip(fit.coefficients().chunks_exact(2)) {
            for (c, truth) in row.iter().zip(truth(name)) {
                // The constant is never penalised: rounding of the angles stays in it.
                assert!((c - truth).abs() < 1e-6, "{name}: {row:?}");
                assert!(name == "1" || (*c == 0.0) == (truth == 0.0), "{name}: {row:?}");
            }
        }
        let mut next = [0.0; 2];
        assert!(fit.predict(&trials[0].states[..2], &trials[0].inputs[..1], &mut next));
        assert!((next[0] - trials[0].states[2]).wrap().abs() < 1e-8);
        assert!((next[1] - trials[0].states[3]).abs() < 1e-8);
        assert!(!fit.predict(&[1e300, f64::MAX], &[f64::MAX], &mut next));
    }

    #[test]
    fn the_lasso_comes_near_the_pendulum_and_says_how() {
        let trials = pendulum(3, 100);
        let fit = Sindy::fit(data(&trials), &Settings::default()).expect("fits");
        assert_eq!(fit, Sindy::fit(data(&trials), &Settings::default()).expect("fits again"));
        let rate = fit.coefficients()[2 * 2];
        assert!((rate - 1.0).abs() < 1e-3 && rate < 1.0, "shrunk a little: {rate}");
        let terms = fit.library().terms();
        for (path, (s, count)) in fit.paths().iter().zip(fit.nonzeros().iter().enumerate()) {
            assert_eq!(path.penalties.len(), PENALTIES);
            assert!((path.penalties[99] / path.penalties[0] - 1e-4).abs() < 1e-15);
            let chosen = &path.coefficients[path.chosen * terms..][..terms];
            assert_eq!(chosen.iter().filter(|c| **c != 0.0).count(), *count);
            assert!(
                chosen.iter().zip(fit.coefficients()[s..].iter().step_by(2)).all(|(a, b)| a == b)
            );
            assert!(path.coefficients[1..terms].iter().all(|c| *c == 0.0), "λ_max");
        }
    }

    #[test]
    fn a_penalty_is_judged_by_the_groups_left_out() {
        // x' = x, but −x in the last of five groups; x = ±1. Four fits have slope 1/2 and miss by
        // 1/2, the fifth has slope 1 and misses by 2.
        let trial = |i: usize| {
            let x = if i < GROUPS { 1.0 } else { -1.0 };
            let velocity = if i % GROUPS == 4 { -x } else { x };
            Trajectory { states: vec![x, x + 0.5 * velocity], inputs: Vec::new() }
        };
        let trials: Vec<Trajectory> = (0..2 * GROUPS).map(trial).collect();
        let spaces = &[Space::Line];
        let data = Data { spaces, inputs: 0, sample_time_s: 0.5, trajectories: &trials };
        for solver in [Solver::Lasso, Solver::Thresholded] {
            let fit = Sindy::fit(data, &settings(solver)).expect("fits");
            let error = fit.paths()[0].errors[PENALTIES - 1];
            assert!((error - (4.0 * 0.25 + 4.0) / 5.0).abs() < 1e-3, "{solver:?}: {error}");
        }
    }

    #[test]
    fn sums_and_errors_are_those_of_the_naive_loops() {
        // Two whole chunks and a part of a group of lanes.
        let trials = pendulum(1, 2 * CHUNK * LANES + 8);
        let data = data(&trials);
        let columns =
            Columns::new(FULL, data.spaces, 0.01, data.pairs().next().expect("has pairs"));
        let rows: Vec<Vec<f64>> = data
            .pairs()
            .map(|pair| {
                let mut row = vec![0.0; FULL.terms() + 2];
                FULL.evaluate(&[pair.0, pair.1].concat(), &mut row[..FULL.terms()]);
                (0..2).for_each(|i| row[FULL.terms() + i] = columns.velocity(i, pair));
                row.iter().zip(&columns.origin).map(|(x, o)| x - o).collect()
            })
            .collect();
        let gram = columns.gram(data.pairs());
        assert_eq!(gram.sums[0], rows.len() as f64);
        let count = FULL.terms() + 2;
        for k in 0..count * count {
            let mut sum = 0.0;
            for chunk in rows.chunks(CHUNK * LANES) {
                let mut lanes = [0.0; LANES];
                for (s, row) in chunk.iter().enumerate() {
                    lanes[s % LANES] += row[k / count] * row[k % count];
                }
                sum += (lanes[0] + lanes[2]) + (lanes[1] + lanes[3]);
            }
            // Bit by bit: no vector unit may change the order.
            assert_eq!(gram.sums[k].to_bits(), sum.to_bits(), "{k}");
        }
        let mut next = noise(5);
        let xi: Vec<f64> = (0..FULL.terms()).map(|_| next()).collect();
        let residual = |row: &Vec<f64>| {
            row.iter().zip(&xi).map(|(x, c)| c * x).sum::<f64>() - row[FULL.terms() + 1]
        };
        let naive = rows.iter().map(|r| residual(r) * residual(r)).sum::<f64>() / rows.len() as f64;
        assert!((gram.squared_error(&xi, FULL.terms() + 1) / naive - 1.0).abs() < 1e-12);
    }

    #[test]
    fn names_say_what_is_evaluated() {
        let library = Library { variables: 2, ..FULL };
        let names = library.names(&["x", "phi"]);
        let mut terms = vec![0.0; library.terms()];
        assert_eq!(
            names.join(" "),
            "1 x phi x^2 x*phi phi^2 sin(x) sin(phi) cos(x) cos(phi) sin(2*x) sin(2*phi) cos(2*x) \
             cos(2*phi)"
        );
        // Bit by bit libm's: std's differ in about one value in seventy.
        for k in 1..200 {
            let (x, phi) = (0.13 * f64::from(k), -0.37 * f64::from(k));
            library.evaluate(&[x, phi], &mut terms);
            assert_eq!(terms[..6], [1.0, x, phi, x * x, x * phi, phi * phi]);
            for (i, angle) in [x, phi].into_iter().enumerate() {
                assert_eq!((terms[6 + i], terms[8 + i]), Scalar::sin_cos(angle));
                let (sin, cos) = Scalar::sin_cos(2.0 * angle);
                assert!((terms[10 + i] - sin).abs() < 1e-15);
                assert!((terms[12 + i] - cos).abs() < 1e-15);
            }
        }
        let small = Library { products: false, second_harmonic: false, ..library };
        assert_eq!(small.names(&["x", "phi"]).len(), small.terms());
        assert_eq!(small.terms(), 7);
    }

    #[test]
    fn what_never_moves_gets_no_coefficient() {
        // A dead input, a state far from 0 that stands still, and an input given twice.
        let mut trials = pendulum(6, 50);
        for t in &mut trials {
            let states = t.states.chunks_exact(2).flat_map(|x| [x[0], x[1], 1e3]).collect();
            let inputs = t.inputs.iter().flat_map(|u| [*u, 0.0, *u]).collect();
            *t = Trajectory { states, inputs };
        }
        let spaces = &[Space::Circle, Space::Line, Space::Line];
        let data = Data { spaces, inputs: 3, sample_time_s: 0.01, trajectories: &trials };
        for solver in [Solver::Lasso, Solver::Thresholded] {
            let fit = Sindy::fit(data, &settings(solver)).expect("fits");
            let names = fit.library().names(&["theta", "omega", "still", "u", "dead", "twin"]);
            for (name, row) in names.iter().zip(fit.coefficients().chunks_exact(3)) {
                assert_eq!(row[2], 0.0, "{name}");
                let still = ["still", "still^2", "sin(still)", "cos(2*still)"];
                if name.contains("dead") || still.contains(&name.as_str()) {
                    assert_eq!(row, [0.0; 3], "{name}");
                }
            }
            let mut next = [0.0; 3];
            assert!(fit.predict(&trials[0].states[..3], &trials[0].inputs[..3], &mut next));
            for (x, truth) in next.iter().zip(&trials[0].states[3..]) {
                assert!((x - truth).wrap().abs() < 1e-3, "{solver:?} {next:?}");
            }
        }
    }

    #[test]
    fn one_pair_is_repeated_for_ever() {
        let trials = pendulum(1, 2);
        let fit = Sindy::fit(data(&trials), &Settings::default()).expect("fits");
        let mut next = [0.0; 2];
        assert!(fit.predict(&[0.0, 0.0], &[0.0], &mut next));
        let [x, y] = [0, 1].map(|i| trials[0].states[2 + i] - trials[0].states[i]);
        assert!((next[0] - x).abs() < 1e-15 && (next[1] - y).abs() < 1e-15, "{next:?}");
    }

    #[test]
    fn bad_data_are_errors() {
        let good = pendulum(5, 9);
        let fit = |trials: &[Trajectory], sample_time_s| {
            Sindy::fit(Data { sample_time_s, ..data(trials) }, &Settings::default()).err()
        };
        assert_eq!(fit(&good, 0.01), None);
        assert_eq!(fit(&pendulum(9, 1), 0.01), Some(BaselineError::NoPairs));
        assert_eq!(fit(&[], 0.01), Some(BaselineError::NoPairs));
        for bad in [f64::NAN, f64::INFINITY, 1e200] {
            let mut trials = good.clone();
            trials[2].states[4] = bad;
            assert_eq!(fit(&trials, 0.01), Some(BaselineError::NotFinite), "{bad}");
        }
        for time in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(fit(&good, time), Some(BaselineError::Settings(_))), "{time}");
        }
    }
}
