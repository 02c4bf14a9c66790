//! Refinement: an operator fitted to one step, moved towards where its *rollouts* fit best.
//!
//! Least squares over snapshot pairs minimises the error of one step from a measured sample. Where
//! measurements are noisy, or the dictionary is too small for the robot, the rollouts of that operator
//! drift. Refinement starts from it and takes a few Gauss-Newton steps, damped as by Marquardt (1963),
//! on
//!
//! > Σᵢ ΣΣ rᵢ² / ΣΣ rᵢ²(F₀) + n κ Σₖ hₖ (Fₖ − F₀ₖ)²
//!
//! with the residuals rᵢ of state i over all steps of all windows, the one-step fit F₀, the number of
//! states n, and hₖ, what a change of coefficient k does to the one-step errors, in units of these
//! errors themselves: hₖ = Σᵢ ⟨(∂rᵢ/∂Fₖ)²⟩ / ⟨rᵢ²⟩ over the first steps. So every state counts by what it
//! gains, and κ says how firmly the one-step fit holds the operator; what the data do not determine
//! stays where that fit put it. κ is chosen by cross-validation (`trainer select` does), and given as
//! `[fit] refine`. The Jacobian is by forward differences of the core's own predictor in f64.

use firmware_core::model::{Model, Space, Structure};
use firmware_core::{Predictor, PredictorState, Scalar};

use crate::chain::Chain;
use crate::edmd::Operator;
use crate::export::coefficients;
use crate::recording::Visitor;
use crate::robot::ScoreOptions;
use crate::score::{Plan, Rows};
use crate::solve;
use crate::trajectory::Trajectories;

/// Windows that a refinement looks at: more are thinned out evenly, so that neither memory nor time
/// grow with the logs.
pub const MAX_WINDOWS: usize = 200;
/// Gauss-Newton steps: the later ones gain little.
const STEPS: usize = 3;
/// The damping at the start, relative to the diagonal of the normal equations.
const DAMPING: f64 = 1e-3;
/// Factor on the damping after a step that did not help, and its inverse after one that did.
const CAUTION: f64 = 10.0;
/// Dampings tried before a step is given up.
const ATTEMPTS: usize = 5;
/// Relative step of the forward differences: their own error is then about as large as that of
/// rounding.
const DIFFERENCE: f64 = 1e-6;
/// Parts that the windows are summed in: a fixed number, so that the threads do not matter.
const PARTS: usize = 16;

/// A measured window: samples up to the present one, and the horizon behind it.
#[derive(Clone, Copy, Debug)]
pub struct Window<'w> {
    /// Shape `[past + horizon, states]`, angles in radians, any turn.
    pub states: &'w [f64],
    /// Shape `[past + horizon, inputs]`.
    pub inputs: &'w [f64],
}

/// What a refinement did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refined {
    /// How firmly the one-step fit held.
    pub kappa: f64,
    /// Windows looked at.
    pub windows: usize,
    /// Gauss-Newton steps that were of use; 0 without windows, and where one of them diverges.
    pub steps: usize,
}

/// From the matrix of an [`Operator`], shape `[terms, outputs]`, to the model's coefficients.
pub type Expand<'e> = dyn Fn(&[f64]) -> Vec<f64> + Sync + 'e;

/// A model without its numbers.
#[derive(Clone, Copy)]
pub struct Shape<'s, 'a> {
    /// Spaces, symmetry, dictionary.
    pub structure: &'s Structure<'a>,
    /// `[parent, function]` of the terms of a sparse model; `None` for a dense one.
    pub entries: Option<&'s [[u8; 2]]>,
    /// The coefficients of its operator.
    pub expand: &'s Expand<'s>,
}

impl Shape<'_, '_> {
    /// Shows the model with this operator to `of`; `None` if the core refuses it.
    fn with_model<R>(
        &self,
        matrix: &[f64],
        of: impl FnOnce(&Model<'_, f64>) -> Option<R>,
    ) -> Option<R> {
        let coefficients = (self.expand)(matrix);
        let structure = self.structure.clone();
        let model = match self.entries {
            Some(entries) => Model::new_sparse(structure, entries, &coefficients, None),
            None => Model::new(structure, &coefficients, None),
        };
        of(&model.ok()?)
    }
}

/// Moves `matrix`, shape `[terms, outputs]`, towards where the rollouts over the windows, which all
/// have the model's lag + 1 samples up to the present one, fit best, held by κ; what is 0 stays 0.
/// Returns the number of steps that were of use. With no windows, or one in which the model diverges, nothing is moved.
pub fn refine(
    shape: Shape<'_, '_>,
    matrix: &mut [f64],
    windows: &[Window<'_>],
    kappa: f64,
    threads: usize,
) -> usize {
    let n = shape.structure.states().len();
    let free: Vec<usize> = (0..matrix.len()).filter(|k| matrix[*k] != 0.0).collect();
    let Some(start) = squares(shape, matrix, windows, threads) else { return 0 };
    // A state that is met exactly has nothing to gain.
    let weights: Vec<f64> = start.iter().map(|s| if *s > 0.0 { 1.0 / s } else { 0.0 }).collect();
    let origin = matrix.to_vec();
    let mut held: Vec<f64> = Vec::new();
    let total = |squares: &[f64], at: &[f64], held: &[f64]| {
        let errors: f64 = squares.iter().zip(&weights).map(|(s, w)| s * w).sum();
        let moved = |(k, h): (&usize, &f64)| h * (at[*k] - origin[*k]) * (at[*k] - origin[*k]);
        errors + free.iter().zip(held).map(moved).sum::<f64>()
    };
    let mut error = total(&start, matrix, &held);
    let mut damping = DAMPING;
    for step in 0..STEPS {
        let Some(mut normal) = normal_equations(shape, matrix, (&free, &weights), windows, threads)
        else {
            return step;
        };
        if step == 0 {
            held = normal.first.iter().map(|h| n as f64 * kappa * h).collect();
        }
        for (i, (k, h)) in free.iter().zip(&held).enumerate() {
            normal.matrix[i * free.len() + i] += h;
            normal.right[i] += h * (matrix[*k] - origin[*k]);
        }
        let mut moved = false;
        for _ in 0..ATTEMPTS {
            let found = normal.change(damping).and_then(|change| {
                let mut trial = matrix.to_vec();
                free.iter().zip(&change).for_each(|(k, d)| trial[*k] += d);
                let lower = total(&squares(shape, &trial, windows, threads)?, &trial, &held);
                (lower < error).then_some((trial, lower))
            });
            if let Some((trial, lower)) = found {
                matrix.copy_from_slice(&trial);
                error = lower;
                damping /= CAUTION;
                moved = true;
                break;
            }
            damping *= CAUTION;
        }
        if !moved {
            return step;
        }
    }
    STEPS
}

/// JᵀJ and Jᵀr over the free coefficients.
struct Normal {
    size: usize,
    matrix: Vec<f64>,
    right: Vec<f64>,
    /// Squared sensitivities of the first steps, in units of their mean squared errors.
    first: Vec<f64>,
}

impl Normal {
    fn new(size: usize, states: usize) -> Self {
        Self {
            size,
            matrix: vec![0.0; size * size],
            right: vec![0.0; size],
            first: vec![0.0; size * states],
        }
    }

    /// The change that solves (JᵀJ + damping · diag JᵀJ) δ = −Jᵀr.
    fn change(&self, damping: f64) -> Option<Vec<f64>> {
        let n = self.size;
        let diagonal = (0..n).map(|i| self.matrix[i * n + i].sqrt());
        let scale: Vec<f64> = diagonal.map(|d| if d > 0.0 { d } else { 1.0 }).collect();
        let mut unit = vec![0.0; n * n];
        for i in 0..n {
            for j in 0..n {
                unit[i * n + j] = self.matrix[i * n + j] / (scale[i] * scale[j]);
            }
            unit[i * n + i] += damping;
        }
        let l = solve::cholesky(&unit, n).ok()?;
        let mut x: Vec<f64> = self.right.iter().zip(&scale).map(|(r, s)| -r / s).collect();
        solve::solve_cholesky(&l, &mut x, n, 1);
        x.iter_mut().zip(&scale).for_each(|(x, s)| *x /= s);
        x.iter().all(|x| x.is_finite()).then_some(x)
    }
}

/// Runs `of` on [`PARTS`] parts of the windows, on so many threads; results in the order of the parts.
fn in_parts<R: Send>(
    windows: &[Window<'_>],
    threads: usize,
    of: impl Fn(&[Window<'_>]) -> R + Sync,
) -> Vec<R> {
    let parts: Vec<&[Window<'_>]> = windows.chunks(windows.len().div_ceil(PARTS).max(1)).collect();
    let threads = threads.clamp(1, parts.len().max(1));
    let mut results: Vec<Option<R>> = Vec::new();
    results.resize_with(parts.len(), || None);
    let share = parts.len().div_ceil(threads).max(1);
    std::thread::scope(|scope| {
        let mut shares = results.chunks_mut(share).zip(parts.chunks(share));
        let own = shares.next();
        let work = |(results, parts): (&mut [Option<R>], &[&[Window<'_>]])| {
            for (to, part) in results.iter_mut().zip(parts) {
                *to = Some(of(part));
            }
        };
        for share in shares {
            scope.spawn(move || work(share));
        }
        own.into_iter().for_each(work);
    });
    results.into_iter().flatten().collect()
}

/// Sums of squared errors per state; `None` where a window diverges, or none is there.
fn squares(
    shape: Shape<'_, '_>,
    matrix: &[f64],
    windows: &[Window<'_>],
    threads: usize,
) -> Option<Vec<f64>> {
    let n = shape.structure.states().len();
    let parts = shape.with_model(matrix, |model| {
        Some(in_parts(windows, threads, |part| {
            let (mut sums, mut residuals) = (vec![0.0; n], Vec::new());
            for window in part {
                roll_out(model, *window, &mut residuals)?;
                for row in residuals.chunks_exact(n) {
                    sums.iter_mut().zip(row).for_each(|(s, r)| *s += r * r);
                }
            }
            Some(sums)
        }))
    })?;
    let mut parts = parts.into_iter();
    let mut sums = parts.next()??;
    for part in parts {
        sums.iter_mut().zip(part?).for_each(|(s, p)| *s += p);
    }
    Some(sums)
}

/// The normal equations of the residuals, the squares of every state times its weight.
fn normal_equations(
    shape: Shape<'_, '_>,
    matrix: &[f64],
    (free, weights): (&[usize], &[f64]),
    windows: &[Window<'_>],
    threads: usize,
) -> Option<Normal> {
    let (size, n) = (free.len(), weights.len());
    let roots: Vec<f64> = weights.iter().map(|w| w.sqrt()).collect();
    // The residuals of a part under the operator with one coefficient changed.
    let residuals = |part: &[Window<'_>], changed: Option<usize>| {
        let mut operator = matrix.to_vec();
        if let Some(k) = changed {
            operator[k] *= 1.0 + DIFFERENCE;
        }
        shape.with_model(&operator, |model| {
            let (mut all, mut own) = (Vec::new(), Vec::new());
            for window in part {
                roll_out(model, *window, &mut own)?;
                all.extend_from_slice(&own);
            }
            Some(all)
        })
    };
    let parts = in_parts(windows, threads, |part| {
        let mut normal = Normal::new(size, n);
        let mut base = residuals(part, None)?;
        let rows = base.len();
        let mut columns: Vec<f64> = Vec::with_capacity(rows * size);
        let horizon = rows / part.len().max(1);
        for (i, k) in free.iter().enumerate() {
            let step = 1.0 / (matrix[*k] * DIFFERENCE);
            let other = residuals(part, Some(*k))?;
            columns.extend(other.iter().zip(&base).map(|(a, b)| (a - b) * step));
            for first in columns[i * rows..].chunks_exact(horizon.max(1)) {
                let own = &mut normal.first[i * n..][..n];
                own.iter_mut().zip(first).for_each(|(sum, x)| *sum += x * x);
            }
        }
        let mut one_step = vec![0.0; n];
        for first in base.chunks_exact(horizon.max(1)) {
            one_step.iter_mut().zip(first).for_each(|(sum, x)| *sum += x * x);
        }
        for column in columns.chunks_exact_mut(rows.max(1)) {
            column.iter_mut().zip(roots.iter().cycle()).for_each(|(x, w)| *x *= w);
        }
        base.iter_mut().zip(roots.iter().cycle()).for_each(|(r, w)| *r *= w);
        for (i, a) in columns.chunks_exact(rows.max(1)).enumerate() {
            normal.right[i] += dot(a, &base);
            for (j, b) in columns.chunks_exact(rows.max(1)).enumerate().take(i + 1) {
                normal.matrix[i * size + j] += dot(a, b);
            }
        }
        Some((normal, one_step))
    });
    let mut sum = Normal::new(size, n);
    let mut one_step = vec![0.0; n];
    for part in parts {
        let (part, errors) = part?;
        let add = |to: &mut [f64], from: &[f64]| {
            to.iter_mut().zip(from).for_each(|(s, p)| *s += p);
        };
        add(&mut sum.matrix, &part.matrix);
        add(&mut sum.right, &part.right);
        add(&mut sum.first, &part.first);
        add(&mut one_step, &errors);
    }
    for i in 0..size {
        for j in 0..i {
            sum.matrix[j * size + i] = sum.matrix[i * size + j];
        }
    }
    let ratio = |own: &[f64]| {
        let states = own.iter().zip(&one_step).filter(|(_, e)| **e > 0.0);
        states.map(|(s, e)| s / e).sum::<f64>()
    };
    sum.first = sum.first.chunks_exact(n).map(ratio).collect();
    Some(sum)
}

/// Summed in four lanes, in a fixed order.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a4, rest_a), (b4, rest_b)) = (a.as_chunks::<4>(), b.as_chunks::<4>());
    let mut lanes = [0.0; 4];
    for (a, b) in a4.iter().zip(b4) {
        for (lane, (x, y)) in lanes.iter_mut().zip(a.iter().zip(b)) {
            *lane += x * y;
        }
    }
    let rest: f64 = rest_a.iter().zip(rest_b).map(|(x, y)| x * y).sum();
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]) + rest
}

/// Predicted less measured of every step and state, shape `[horizon, states]`, angles on the circle.
fn roll_out(model: &Model<'_, f64>, window: Window<'_>, residuals: &mut Vec<f64>) -> Option<()> {
    let structure = model.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let predictor = Predictor::new(model);
    let mut state = PredictorState::new();
    let input = |row: usize| window.inputs.get(row * m..(row + 1) * m).unwrap_or(&[]);
    let mut rows = window.states.chunks_exact(n).enumerate();
    for (row, x) in rows.by_ref().take(structure.lag() + 1) {
        let applied = if row > 0 { input(row - 1) } else { &[] };
        predictor.observe(&mut state, applied, x).ok()?;
    }
    residuals.clear();
    for (row, measured) in rows {
        predictor.step(&mut state, input(row - 1)).ok()?;
        let first = residuals.len();
        residuals.resize(first + n, 0.0);
        let own = &mut residuals[first..];
        predictor.coordinates(&state, own).ok()?;
        for ((r, x), state) in own.iter_mut().zip(measured).zip(structure.states()) {
            *r -= x;
            if state.space == Space::Circle {
                *r = r.wrap();
            }
        }
    }
    Some(())
}

/// Which windows of a list of so many are looked at: one of so many.
pub(crate) fn thinning(count: usize) -> usize {
    count.div_ceil(MAX_WINDOWS).max(1)
}

/// Windows of some trajectories, each for the folds that it trains.
#[derive(Debug)]
pub struct Collected {
    states: usize,
    /// States, inputs, and whether it is looked at in a fold.
    windows: Vec<(Vec<f64>, Vec<f64>, Vec<bool>)>,
}

impl Collected {
    /// The windows that scoring would roll out, as far as all of their rows train a fold; at most
    /// [`MAX_WINDOWS`] for each fold.
    ///
    /// # Errors
    /// The source's own.
    pub fn read<T: Trajectories>(
        source: &T,
        structure: &Structure<'_>,
        plan: &Plan,
        options: &ScoreOptions,
    ) -> Result<Self, T::Error> {
        let mut reader = Reader {
            rows: Rows::new(plan, structure),
            lag: structure.lag(),
            first: options.first(structure.lag()),
            options,
            recent: std::collections::VecDeque::new(),
            segment: 0,
            found: vec![0; plan.folds()],
            every: None,
            kept: Self { states: structure.states().len(), windows: Vec::new() },
        };
        source.visit(&mut reader)?;
        // The trajectories are counted from the first one again.
        reader.rows = Rows::new(plan, structure);
        reader.every = Some(reader.found.iter().map(|count| thinning(*count)).collect());
        reader.found.fill(0);
        source.visit(&mut reader)?;
        Ok(reader.kept)
    }

    /// Those of a fold.
    pub fn of(&self, fold: usize) -> Vec<Window<'_>> {
        let own = self.windows.iter().filter(|w| w.2.get(fold) == Some(&true));
        own.map(|(states, inputs, _)| Window { states, inputs }).collect()
    }
}

struct Reader<'p> {
    rows: Rows<'p>,
    lag: usize,
    first: usize,
    options: &'p ScoreOptions,
    /// Rows, and the folds that they train.
    recent: std::collections::VecDeque<(Vec<f64>, Vec<bool>)>,
    segment: usize,
    /// Windows so far that train each fold.
    found: Vec<usize>,
    /// The first pass only counts.
    every: Option<Vec<usize>>,
    kept: Collected,
}

impl Visitor for Reader<'_> {
    fn begin(&mut self, name: &str) {
        self.rows.begin(name);
    }

    fn row(&mut self, states: &[f64], inputs: &[f64]) {
        let row = self.rows.row();
        if self.rows.take(states, inputs) {
            self.recent.clear();
            self.segment = 0;
        }
        self.recent.push_back((self.rows.present().to_vec(), self.rows.trains(row)));
        self.segment += 1;
        let length = self.lag + 1 + self.options.horizon;
        while self.recent.len() > length {
            self.recent.pop_front();
        }
        // The same windows as scoring, whatever is in front of them.
        let whole = self.first + 1 + self.options.horizon;
        if self.segment < whole || !(self.segment - whole).is_multiple_of(self.options.stride) {
            return;
        }
        let mut looked_at = vec![false; self.found.len()];
        for (fold, (found, looked_at)) in self.found.iter_mut().zip(&mut looked_at).enumerate() {
            if self.recent.iter().all(|(_, trains)| trains[fold]) {
                *looked_at =
                    self.every.as_ref().is_some_and(|every| found.is_multiple_of(every[fold]));
                *found += 1;
            }
        }
        if looked_at.contains(&true) {
            let n = self.kept.states;
            let states = self.recent.iter().flat_map(|(row, _)| row[..n].to_vec()).collect();
            let inputs = self.recent.iter().flat_map(|(row, _)| row[n..].to_vec()).collect();
            self.kept.windows.push((states, inputs, looked_at));
        }
    }
}

/// Refines the operator of a fit, whose terms are those of a chain or the distinct ones of the
/// dictionary, on windows of its training data.
pub fn refine_operator(
    structure: &Structure<'_>,
    chain: Option<&Chain>,
    operator: &mut Operator,
    windows: &[Window<'_>],
    kappa: f64,
) -> Refined {
    let plain = operator.clone();
    let expand = |matrix: &[f64]| {
        let mut moved = plain.clone();
        moved.matrix.copy_from_slice(matrix);
        coefficients(structure.dictionary(), chain, &moved)
    };
    let shape = Shape { structure, entries: chain.map(Chain::entries), expand: &expand };
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let steps = refine(shape, &mut operator.matrix, windows, kappa, threads);
    Refined { kappa, windows: windows.len(), steps }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edmd;
    use crate::robot::Robot;
    use crate::trajectory::{InMemory, Trajectory};
    use rand::{RngExt, SeedableRng};
    use std::path::Path;

    const CART: &str = "name = \"cart\"\nsample_time_s = 0.1\n[[states]]\nname = \"x\"\nspace = \"R\"\n\
        [[inputs]]\nname = \"u\"\nrange = [-1, 1]\n[dictionary]\nterms = [\"x\", \"u\"]\nstandardise = false\n\
        [score]\nstride = 5\nfolds = 3\nhorizon = 20\n";

    fn robot(refine: &str) -> Robot {
        Robot::parse(&format!("{CART}[fit]\n{refine}"), Path::new("robot.toml")).unwrap()
    }

    /// x⁺ = 0.9 x + 0.5 u, measured with noise of this deviation.
    fn measured(noise: f64) -> Vec<Trajectory> {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let one = |_| {
            let (mut x, mut t) = (0.0, Trajectory::default());
            for _ in 0..200 {
                let u: f64 = random.random_range(-1.0..1.0);
                // Uniform with the deviation asked for.
                let off = noise * 12_f64.sqrt() * random.random_range(-0.5..0.5);
                t.states.push(x + off);
                t.inputs.push(u);
                x = 0.9 * x + 0.5 * u;
            }
            t
        };
        (0..6).map(one).collect()
    }

    fn fitted(refine: &str, noise: f64) -> Vec<f64> {
        let (robot, trajectories) = (robot(refine), measured(noise));
        let source = InMemory { trajectories: &trajectories, states: 1, inputs: 1 };
        edmd::fit(&robot, &source, &|_| {}).unwrap().operator.matrix
    }

    #[test]
    fn what_noise_biases_in_one_step_is_mended_by_rollouts() {
        // Noise in the state that is lifted pulls its coefficient towards 0 (errors in variables).
        let one_step = fitted("", 0.3);
        assert!(one_step[1] < 0.86, "{one_step:?}");
        let refined = fitted("refine = 0.001", 0.3);
        assert!((refined[1] - 0.9).abs() < 0.015 && (refined[2] - 0.5).abs() < 0.04, "{refined:?}");
        // Held firmly, it stays.
        let held = fitted("refine = 1e6", 0.3);
        assert!((held[1] - one_step[1]).abs() < 1e-3, "{held:?} {one_step:?}");
    }

    #[test]
    fn an_exact_operator_is_left_alone_and_repeats_to_the_bit() {
        let exact = fitted("refine = 0.1", 0.0);
        assert!((exact[1] - 0.9).abs() < 1e-12 && (exact[2] - 0.5).abs() < 1e-12, "{exact:?}");
        assert_eq!(fitted("refine = 0.1", 0.3), fitted("refine = 0.1", 0.3));
    }

    #[test]
    fn threads_change_nothing_and_without_windows_nothing_moves() {
        let robot = robot("refine = 0.1");
        let trajectories = measured(0.3);
        let source = InMemory { trajectories: &trajectories, states: 1, inputs: 1 };
        let fit = edmd::fit(&robot, &source, &|_| {}).unwrap();
        let collected = Collected::read(&source, &fit.structure, &Plan::All, &robot.score).unwrap();
        let windows = collected.of(0);
        // Six trajectories of 200 rows: from row 5 on, every fifth as far as 20 rows follow.
        assert_eq!(windows.len(), thinned(6 * 35));
        let chain = fit.chain.unwrap();
        let expand = |matrix: &[f64]| chain.spread(matrix, 1);
        let shape =
            Shape { structure: &fit.structure, entries: Some(chain.entries()), expand: &expand };
        let run = |windows: &[Window<'_>], threads| {
            let mut matrix = vec![0.1, 0.7, 0.4];
            (refine(shape, &mut matrix, windows, 0.01, threads), matrix)
        };
        assert_eq!(run(&windows, 1), run(&windows, 3));
        assert!(run(&windows, 1).0 > 0);
        assert_eq!(run(&[], 1), (0, vec![0.1, 0.7, 0.4]));
        // A model that leaves the finite numbers stays as it is.
        let mut wild = vec![0.0, 1e30, 0.4];
        assert_eq!((refine(shape, &mut wild, &windows, 0.01, 1), wild[1]), (0, 1e30));
    }

    fn thinned(count: usize) -> usize {
        count.div_ceil(thinning(count))
    }

    #[test]
    fn a_fold_is_refined_on_the_windows_of_the_others_alone() {
        let robot = robot("refine = 0.1");
        // Their number is no multiple of that of the folds.
        let mut trajectories = measured(0.3);
        trajectories.pop();
        let fit = |t: &[Trajectory]| {
            let source = InMemory { trajectories: t, states: 1, inputs: 1 };
            let fit = edmd::fit(&robot, &source, &|_| {}).unwrap();
            let plan = Plan::Folds { folds: 3, skip: Vec::new() };
            let all = Collected::read(&source, &fit.structure, &plan, &robot.score).unwrap();
            let of = |fold| {
                let own = all.of(fold);
                own.iter().map(|w| (w.states.to_vec(), w.inputs.to_vec())).collect::<Vec<_>>()
            };
            (0..3).map(of).collect::<Vec<_>>()
        };
        let before = fit(&trajectories);
        trajectories[1].states.iter_mut().for_each(|x| *x += 7.0);
        let after = fit(&trajectories);
        assert_eq!(before[1], after[1], "trajectory 1 is in fold 1");
        assert!(before[0] != after[0] && before[2] != after[2]);
    }
}
