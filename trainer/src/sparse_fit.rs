//! Sparse models from one pass: sums of a whole library per fold, from which any of its subsets is
//! fitted without another look at the data, and rollouts of the fit over the windows of
//! [`score`](crate::score).

use std::collections::BTreeMap;

use firmware_core::Scalar;
use firmware_core::history::History;
use firmware_core::model::{ModelRepr, Space, Structure};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::arx::MAX_LAGS;
use crate::edmd::{Spread, solve_normal};
use crate::export::coordinate;
use crate::gram::NormalEquations;
use crate::library::{Chain, Frame, Term};
use crate::refine;
use crate::robot::{FitOptions, Robot, ScoreOptions};
use crate::score::{Counts, Plan, Role};
use crate::solve;
use crate::terms::{Names, robot_names};
use crate::trajectory::Trajectory;

/// How far a prediction may leave the range of the data, in widths of that range.
pub const MARGIN: f64 = 1.0;
/// Where a candidate first failed, and in how many windows it did.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rejection {
    /// Windows that failed; 0 when there is no fit.
    pub windows: usize,
    /// Trajectory of the first one, from 0, of those not held out.
    pub trajectory: usize,
    /// Row from which it predicts, from 0.
    pub row: usize,
    /// Step, from 1.
    pub step: usize,
    /// State that left its range; `None` when the prediction left the finite numbers.
    pub state: Option<usize>,
}

/// Squared errors per unit and state, or why there are none.
pub(crate) type Outcome = Result<Vec<Vec<f64>>, Rejection>;

/// A set of terms (sorted) in a frame, with its ridge.
pub(crate) type Model = (usize, Vec<usize>, u64);

/// A trajectory that is not held out.
pub(crate) struct Trial {
    /// Angles continuous, shape `[rows, states]`.
    pub(crate) states: Vec<f64>,
    pub(crate) inputs: Vec<f64>,
    /// As the controller takes them.
    pub(crate) narrow_states: Vec<f32>,
    pub(crate) narrow_inputs: Vec<f32>,
    /// A fold per row.
    pub(crate) folds: Vec<usize>,
}

/// A window predicts from `row` on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    pub(crate) trajectory: usize,
    pub(crate) unit: usize,
    pub(crate) fold: usize,
    pub(crate) row: usize,
}

/// Windows that are rolled out together.
#[derive(Clone, Debug, Default)]
pub(crate) struct WindowSet {
    pub(crate) windows: Vec<Window>,
    /// Rows predicted per unit.
    pub(crate) steps: Vec<f64>,
}

impl WindowSet {
    /// About so many of them, evenly spread over every unit, which keeps one at least.
    fn thinned(&self, most: usize, horizon: usize) -> Self {
        let every = self.windows.len().div_ceil(most).max(1);
        let mut thinned = Self { windows: Vec::new(), steps: vec![0.0; self.steps.len()] };
        for own in self.windows.chunk_by(|a, b| a.unit == b.unit) {
            for window in own.iter().step_by(every) {
                thinned.windows.push(*window);
                thinned.steps[window.unit] += horizon as f64;
            }
        }
        thinned
    }
}

/// Windows that a search looks at: those of a long log overlap, and say the same again.
pub(crate) const SEARCH_WINDOWS: usize = 400;

/// What data serve for.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Windows {
    /// Training and scoring, fold by fold, in windows behind [`MAX_LAGS`] samples.
    CrossValidated,
    /// Scoring of whole trajectories, in windows behind `first` samples.
    Tested {
        /// Samples before the first predicted one, without the present one.
        first: usize,
    },
}

/// Everything that is scored, in memory.
pub(crate) struct Data {
    pub(crate) n: usize,
    pub(crate) m: usize,
    pub(crate) spaces: Vec<Space>,
    pub(crate) plan: Plan,
    pub(crate) trials: Vec<Trial>,
    /// What a search scores by.
    pub(crate) searched: WindowSet,
    /// What tables are about.
    pub(crate) all: WindowSet,
    pub(crate) deviation: Vec<f64>,
    pub(crate) range: Vec<[f64; 2]>,
    pub(crate) horizon: usize,
    pub(crate) hash: [u8; 32],
}

impl Data {
    pub(crate) fn new(
        robot: &Robot,
        all: &[(String, Trajectory)],
        options: &ScoreOptions,
        first: Windows,
    ) -> Self {
        let (n, m) = (robot.states.len(), robot.inputs.len());
        let spaces: Vec<Space> = robot.states.iter().map(|s| s.space).collect();
        let rows: usize = all.iter().map(|(_, t)| t.states.len() / n).sum();
        let counts = Counts { trajectories: all.len(), rows: rows as u64 };
        let plan = match first {
            Windows::CrossValidated => Plan::cross_validation(options, counts, MAX_LAGS, &[]),
            Windows::Tested { .. } => Plan::All,
        };
        let first = match first {
            Windows::CrossValidated => MAX_LAGS,
            Windows::Tested { first } => first,
        };
        let horizon = options.horizon;
        let (mut trials, mut windows, mut steps) = (Vec::new(), Vec::new(), Vec::new());
        let mut spreads = vec![Spread::default(); n];
        let mut range = vec![[f64::INFINITY, f64::NEG_INFINITY]; n];
        let mut hash = Sha256::new();
        for (trajectory, (_, t)) in all.iter().enumerate() {
            hash.update((t.states.len() as u64).to_le_bytes());
            t.states.iter().chain(&t.inputs).for_each(|x| hash.update(x.to_bits().to_le_bytes()));
            let mut states = t.states.clone();
            for i in n..states.len() {
                if spaces[i % n] == Space::Circle {
                    states[i] = states[i - n] + (states[i] - states[i - n]).wrap();
                }
            }
            for row in states.chunks_exact(n) {
                for ((spread, [low, high]), x) in spreads.iter_mut().zip(&mut range).zip(row) {
                    spread.push(*x);
                    (*low, *high) = (low.min(*x), high.max(*x));
                }
            }
            let fold = |row: usize| match plan.role("", trajectory, row as u64) {
                Role::Fold(fold) => fold,
                _ => 0,
            };
            let folds: Vec<usize> = (0..states.len() / n).map(fold).collect();
            let mut start = 0;
            for unit in folds.chunk_by(|a, b| a == b) {
                let placed = windows.len();
                for row in (first..unit.len().saturating_sub(horizon)).step_by(options.stride) {
                    let row = start + row;
                    windows.push(Window { trajectory, unit: steps.len(), fold: unit[0], row });
                }
                if windows.len() > placed {
                    steps.push(((windows.len() - placed) * horizon) as f64);
                }
                start += unit.len();
            }
            let narrow = |(i, x): (usize, &f64)| coordinate(*x, spaces[i % n]);
            trials.push(Trial {
                narrow_states: t.states.iter().enumerate().map(narrow).collect(),
                narrow_inputs: t.inputs.iter().map(|u| *u as f32).collect(),
                inputs: t.inputs.clone(),
                states,
                folds,
            });
        }
        let deviation = spreads.iter().map(Spread::deviation).collect();
        let hash = hash.finalize().into();
        let all = WindowSet { windows, steps };
        Self {
            n,
            m,
            spaces,
            plan,
            trials,
            searched: all.thinned(SEARCH_WINDOWS, horizon),
            all,
            deviation,
            range,
            horizon,
            hash,
        }
    }

    /// What a refinement looks at: the windows that train a fold, or all, thinned out, with so many
    /// samples before the present one.
    fn training_windows(&self, lag: usize, fold: Option<usize>) -> Vec<refine::Window<'_>> {
        let trains = |w: &&Window| {
            let mut rows = (w.row - lag..=w.row + self.horizon).map(|row| row as u64);
            fold.is_none_or(|f| rows.all(|row| self.plan.trains(f, Role::Fold(w.fold), row)))
        };
        let all: Vec<&Window> = self.all.windows.iter().filter(trains).collect();
        let rows = |w: &&Window| {
            let (trial, first, end) =
                (&self.trials[w.trajectory], w.row - lag, w.row + self.horizon + 1);
            refine::Window {
                states: &trial.states[first * self.n..end * self.n],
                inputs: &trial.inputs[first * self.m..end * self.m],
            }
        };
        all.iter().step_by(refine::thinning(all.len())).map(rows).collect()
    }

    /// RMSE per state, and NRMSE, of summed squares over windows, without one unit if asked.
    pub(crate) fn errors(
        &self,
        set: &WindowSet,
        sums: &[Vec<f64>],
        without: Option<usize>,
    ) -> (Vec<f64>, f64) {
        let kept = |u: &usize| Some(*u) != without;
        let count: f64 = (0..sums.len()).filter(kept).map(|u| set.steps[u]).sum();
        let rmse: Vec<f64> = (0..self.n)
            .map(|i| ((0..sums.len()).filter(kept).map(|u| sums[u][i]).sum::<f64>() / count).sqrt())
            .collect();
        let moving: Vec<f64> = rmse
            .iter()
            .zip(&self.deviation)
            .filter(|(_, d)| **d > 0.0)
            .map(|(r, d)| r / d)
            .collect();
        let mean = moving.iter().sum::<f64>() / moving.len().max(1) as f64;
        (rmse, mean)
    }

    /// The jackknife's standard error, over the units, of a function of the summed squares.
    pub(crate) fn jackknife(&self, of: impl Fn(Option<usize>) -> f64) -> f64 {
        let units = self.all.steps.len();
        if units < 2 {
            return 0.0;
        }
        let left_out: Vec<f64> = (0..units).map(|u| of(Some(u))).collect();
        let mean = left_out.iter().sum::<f64>() / units as f64;
        let squares: f64 = left_out.iter().map(|x| (x - mean) * (x - mean)).sum();
        (squares * (units - 1) as f64 / units as f64).sqrt()
    }
}

/// Sums over the pairs that train the same folds and have as many earlier samples.
pub(crate) struct Group {
    pub(crate) trains: Vec<bool>,
    pub(crate) earlier: usize,
    pub(crate) pairs: u64,
    /// Upper half, shape `[columns, columns]`: the library behind the constant, then the targets.
    pub(crate) sums: Vec<f64>,
}

/// A frame, its library and the sums over all of it.
pub(crate) struct Problem<'r> {
    pub(crate) repr: ModelRepr<'r>,
    pub(crate) terms: Vec<Term>,
    pub(crate) names: Vec<String>,
    pub(crate) outputs: usize,
    pub(crate) groups: Vec<Group>,
    /// The whole library with the constant explained away.
    pub(crate) residual: Residual,
}

/// Rows that are summed at once.
pub(crate) const ROWS: usize = 4;

impl<'r> Problem<'r> {
    pub(crate) fn new(
        robot: &'r Robot,
        frame: &Frame,
        terms: Vec<Term>,
        data: &Data,
    ) -> Option<Self> {
        let repr = frame.repr(robot);
        let chain = Chain::new(&terms.iter().collect::<Vec<_>>());
        let structure = chain.structure(&repr).ok()?;
        let outputs = structure.outputs();
        let columns = 1 + terms.len() + outputs;
        let mut values = vec![0.0; chain.observables.len()];
        let (mut functions, mut entries) = (vec![0.0; chain.functions()], vec![0.0; chain.len()]);
        let mut targets = vec![0.0; outputs];
        let mut groups: Vec<Group> = Vec::new();
        let mut index: BTreeMap<(Vec<bool>, usize), usize> = BTreeMap::new();
        let mut buffers: Vec<Vec<f64>> = Vec::new();
        let arch = pulp::Arch::new();
        let mut history: History<f64> = History::default();
        let mut next = structure.sample(&[]);
        for trial in &data.trials {
            history.clear();
            let mut input: &[f64] = &[];
            for (row, states) in trial.states.chunks_exact(data.n).enumerate() {
                structure.sample_into(states, &mut next);
                if !history.is_empty() {
                    history.observe(&structure, input, &mut values);
                    history.targets(&structure, &next, &mut targets);
                    let role = Role::Fold(trial.folds[row]);
                    let trains = (0..data.plan.folds())
                        .map(|f| data.plan.trains(f, role, row as u64))
                        .collect();
                    let earlier = (history.len() - 1).min(MAX_LAGS);
                    let group = *index.entry((trains, earlier)).or_insert(groups.len());
                    if group == groups.len() {
                        let trains = (0..data.plan.folds())
                            .map(|f| data.plan.trains(f, role, row as u64))
                            .collect();
                        let sums = vec![0.0; columns * columns];
                        groups.push(Group { trains, earlier, pairs: 0, sums });
                        buffers.push(Vec::new());
                    }
                    chain.lift(&values, &mut functions, &mut entries);
                    let buffer = &mut buffers[group];
                    buffer.push(1.0);
                    buffer.extend(chain.place().iter().map(|p| entries[*p]));
                    buffer.extend_from_slice(&targets);
                    groups[group].pairs += 1;
                    if buffer.len() == ROWS * columns {
                        arch.dispatch(|| add_rows(buffer, columns, &mut groups[group].sums));
                        buffer.clear();
                    }
                }
                history.push(&structure, input, &next);
                input = &trial.inputs[row * data.m..][..data.m];
            }
        }
        for (buffer, group) in buffers.iter_mut().zip(&mut groups) {
            buffer.resize(ROWS * columns, 0.0);
            add_rows(buffer, columns, &mut group.sums);
        }
        let (states, inputs) = robot_names(robot);
        let names = Names { states: &states, inputs: &inputs };
        let names = terms.iter().map(|t| t.name(&names)).collect();
        let residual = Residual { n: 0, m: outputs, sums: Vec::new(), used: Vec::new() };
        let mut problem = Self { repr, terms, names, outputs, groups, residual };
        problem.residual = Residual::new(&problem);
        Some(problem)
    }

    /// The sums of some terms (the constant first) and the targets over the pairs that train a fold,
    /// or all: shape `[columns, columns]`, and the number of pairs.
    pub(crate) fn sums(&self, terms: &[usize], fold: Option<usize>) -> (Vec<f64>, u64) {
        let lag = terms.iter().map(|t| self.terms[*t].lag()).max().unwrap_or(0);
        let all = 1 + self.terms.len() + self.outputs;
        let columns: Vec<usize> = std::iter::once(0)
            .chain(terms.iter().map(|t| t + 1))
            .chain(1 + self.terms.len()..all)
            .collect();
        let n = columns.len();
        let (mut sums, mut pairs) = (vec![0.0; n * n], 0);
        for group in &self.groups {
            if group.earlier < lag || fold.is_some_and(|f| !group.trains[f]) {
                continue;
            }
            pairs += group.pairs;
            for (i, a) in columns.iter().enumerate() {
                for (j, b) in columns[..=i].iter().enumerate() {
                    sums[i * n + j] += group.sums[*a.min(b) * all + *a.max(b)];
                }
            }
        }
        for i in 0..n {
            for j in 0..i {
                sums[j * n + i] = sums[i * n + j];
            }
        }
        (sums, pairs)
    }

    pub(crate) fn chain(&self, terms: &[usize]) -> Chain {
        Chain::new(&terms.iter().map(|t| &self.terms[*t]).collect::<Vec<_>>())
    }

    /// The controller's coefficients, shape `[entries, outputs]`, refined if asked.
    pub(crate) fn coefficients(
        &self,
        chain: &Chain,
        terms: &[usize],
        ridge: f64,
        fold: Option<usize>,
        refinement: Option<Refinement<'_>>,
    ) -> Option<Vec<f32>> {
        let mut fitted = self.fit(terms, ridge, fold)?;
        if let Some(Refinement { data, kappa, threads }) = refinement {
            let structure = chain.structure(&self.repr).ok()?;
            let (m, len, entries) = (self.outputs, chain.len(), chain.controller_entries()?);
            let expand = |matrix: &[f64]| {
                let mut coefficients = vec![0.0; len * m];
                let places = std::iter::once(&0).chain(chain.place());
                for (place, row) in places.zip(matrix.chunks_exact(m)) {
                    row.iter().enumerate().for_each(|(o, c)| coefficients[o * len + place] = *c);
                }
                coefficients
            };
            let entries = Some(&entries[..]);
            let shape = refine::Shape { structure: &structure, entries, expand: &expand };
            let windows = data.training_windows(structure.lag(), fold);
            refine::refine(shape, &mut fitted, &windows, kappa, threads);
        }
        let mut coefficients = vec![0.0; chain.len() * self.outputs];
        let places = std::iter::once(&0).chain(chain.place());
        for (place, row) in places.zip(fitted.chunks_exact(self.outputs)) {
            for (to, c) in coefficients[place * self.outputs..].iter_mut().zip(row) {
                *to = *c as f32;
            }
        }
        Some(coefficients)
    }

    /// How much more of what is left of the targets would be left without each of the terms, summed
    /// over the targets.
    pub(crate) fn losses(&self, terms: &[usize], ridge: f64) -> Vec<f64> {
        let (mut sums, _) = self.sums(terms, None);
        let (n, m) = (terms.len() + 1, self.outputs);
        let width = n + m;
        let norm: Vec<f64> =
            (0..n).map(|i| sums[i * width + i].sqrt().max(f64::MIN_POSITIVE)).collect();
        let mut gram = vec![0.0; n * n];
        for i in 0..n {
            for j in 0..width {
                sums[i * width + j] /= norm[i];
            }
            for j in 0..n {
                gram[i * n + j] = sums[i * width + j] / norm[j];
            }
            gram[i * n + i] += ridge;
        }
        let Ok(l) = solve::cholesky(&gram, n) else { return vec![0.0; terms.len()] };
        let cross: Vec<f64> = (0..n).flat_map(|i| sums[i * width + n..][..m].to_vec()).collect();
        let mut x = cross.clone();
        solve::solve_cholesky(&l, &mut x, n, m);
        let mut inverse = vec![0.0; n * n];
        (0..n).for_each(|i| inverse[i * n + i] = 1.0);
        solve::solve_cholesky(&l, &mut inverse, n, n);
        let left: Vec<f64> = (0..m)
            .map(|o| {
                sums[(n + o) * width + n + o]
                    - (0..n).map(|i| cross[i * m + o] * x[i * m + o]).sum::<f64>()
            })
            .collect();
        let loss = |i: usize, o: usize| {
            x[i * m + o] * x[i * m + o] / (inverse[i * n + i] * left[o].max(f64::MIN_POSITIVE))
        };
        (1..n).map(|i| (0..m).map(|o| loss(i, o)).sum()).collect()
    }

    /// Coefficients, shape `[terms + 1, outputs]`, of the pairs that train a fold, or all.
    pub(crate) fn fit(&self, terms: &[usize], ridge: f64, fold: Option<usize>) -> Option<Vec<f64>> {
        let (sums, pairs) = self.sums(terms, fold);
        let (n, m) = (terms.len() + 1, self.outputs);
        let rows = || sums.chunks_exact(n + m).take(n);
        let equations = NormalEquations {
            terms: n,
            outputs: m,
            pairs,
            gram: rows().flat_map(|r| &r[..n]).copied().collect(),
            cross: rows().flat_map(|r| &r[n..]).copied().collect(),
        };
        let options = FitOptions { ridge, ..FitOptions::default() };
        let operator = solve_normal(&equations, &options).ok()?;
        (pairs > 0 && operator.matrix.iter().all(|x| x.is_finite())).then_some(operator.matrix)
    }
}

/// Adds the outer products of [`ROWS`] rows to the upper half, in a fixed order.
#[inline(always)]
pub(crate) fn add_rows(rows: &[f64], columns: usize, sums: &mut [f64]) {
    let row = |k: usize| &rows[k * columns..][..columns];
    let (a, b, c, d) = (row(0), row(1), row(2), row(3));
    for (i, to) in sums.chunks_exact_mut(columns).enumerate() {
        let x = [a[i], b[i], c[i], d[i]];
        let tail = to[i..].iter_mut().zip(&a[i..]).zip(&b[i..]).zip(&c[i..]).zip(&d[i..]);
        for ((((g, a), b), c), d) in tail {
            *g += (x[0] * a + x[1] * b) + (x[2] * c + x[3] * d);
        }
    }
}

/// What is left of columns and targets once some terms have explained what they can, on columns of
/// unit norm: the Schur complement of the Gram matrix.
#[derive(Clone)]
pub(crate) struct Residual {
    pub(crate) n: usize,
    pub(crate) m: usize,
    /// Shape `[n + m, n + m]`, symmetric.
    pub(crate) sums: Vec<f64>,
    pub(crate) used: Vec<bool>,
}

/// A column of which less than this is left depends on those before it.
pub(crate) const DEPENDENT: f64 = 1e-9;

impl Residual {
    /// Of the whole library, the constant explained away.
    pub(crate) fn new(problem: &Problem<'_>) -> Self {
        let all: Vec<usize> = (0..problem.terms.len()).collect();
        let (mut sums, _) = problem.sums(&all, None);
        let (n, m) = (all.len() + 1, problem.outputs);
        let width = n + m;
        let norm: Vec<f64> =
            (0..width).map(|i| sums[i * width + i].sqrt().max(f64::MIN_POSITIVE)).collect();
        for i in 0..width {
            for j in 0..width {
                sums[i * width + j] /= norm[i] * norm[j];
            }
        }
        let mut residual = Self { n, m, sums, used: vec![false; n] };
        residual.explain(0);
        residual
    }

    /// Explains everything by one more column.
    pub(crate) fn explain(&mut self, column: usize) {
        let width = self.n + self.m;
        let pivot = self.sums[column * width + column];
        self.used[column] = true;
        if pivot <= DEPENDENT {
            return;
        }
        let own: Vec<f64> = self.sums[column * width..][..width].to_vec();
        for (row, x) in self.sums.chunks_exact_mut(width).zip(&own) {
            let factor = x / pivot;
            if factor != 0.0 {
                row.iter_mut().zip(&own).for_each(|(s, y)| *s -= factor * y);
            }
        }
    }

    /// Which fraction of what is left of each target a term would explain.
    pub(crate) fn gains(&self, term: usize) -> Option<Vec<f64>> {
        let (width, column) = (self.n + self.m, term + 1);
        let row = &self.sums[column * width..][..width];
        if self.used[column] || row[column] <= DEPENDENT {
            return None;
        }
        let gain = |o: usize| {
            let left = self.sums[(self.n + o) * width + self.n + o];
            if left > 0.0 { row[self.n + o] * row[self.n + o] / (row[column] * left) } else { 0.0 }
        };
        Some((0..self.m).map(gain).collect())
    }

    /// The terms with the largest gains: by their sum over the targets, and for each target.
    pub(crate) fn shortlist(&self, count: usize) -> Vec<usize> {
        let gains: Vec<(usize, Vec<f64>)> =
            (0..self.n - 1).filter_map(|t| Some((t, self.gains(t)?))).collect();
        let by = |key: &dyn Fn(&[f64]) -> f64| {
            let mut order: Vec<(usize, f64)> = gains.iter().map(|(t, g)| (*t, key(g))).collect();
            order.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
            order.into_iter().map(|(t, _)| t).collect::<Vec<_>>()
        };
        let mut lists = vec![by(&|g| g.iter().sum())];
        lists.extend((0..self.m).map(|o| by(&|g| g[o])));
        let mut chosen = Vec::new();
        for rank in 0..gains.len() {
            for list in &lists {
                if chosen.len() < count && !chosen.contains(&list[rank]) {
                    chosen.push(list[rank]);
                }
            }
        }
        chosen
    }
}

/// How fits are refined by their rollouts over the training windows.
#[derive(Clone, Copy)]
pub(crate) struct Refinement<'d> {
    pub(crate) data: &'d Data,
    /// How firmly the one-step fit holds.
    pub(crate) kappa: f64,
    /// The result does not depend on it.
    pub(crate) threads: usize,
}

/// A model and the fold whose windows it is rolled out over; `None` for all windows.
pub(crate) type Without = (Option<usize>, Vec<f32>);

/// Fits a candidate without any one fold and rolls it out over the windows of that fold.
pub(crate) fn evaluate(
    (problems, data): (&[Problem<'_>], &Data),
    (frame, terms, ridge): &Model,
    refinement: Option<Refinement<'_>>,
    set: &WindowSet,
) -> Outcome {
    let problem = &problems[*frame];
    let chain = problem.chain(terms);
    let ridge = f64::from_bits(*ridge);
    let fit = |fold| {
        Some((Some(fold), problem.coefficients(&chain, terms, ridge, Some(fold), refinement)?))
    };
    let models: Option<Vec<_>> = (0..data.plan.folds()).map(fit).collect();
    roll_out((data, set), problem, &chain, models, &data.range)
}

/// Where a candidate, fitted without any one fold, fails in all windows, those of training included.
pub(crate) fn stress(
    problems: &[Problem<'_>],
    data: &Data,
    (frame, terms, ridge): &Model,
    refinement: Option<Refinement<'_>>,
) -> Option<Rejection> {
    let problem = &problems[*frame];
    let chain = problem.chain(terms);
    (0..data.plan.folds()).find_map(|fold| {
        let ridge = f64::from_bits(*ridge);
        let model = problem.coefficients(&chain, terms, ridge, Some(fold), refinement);
        let everywhere = model.map(|m| vec![(None, m)]);
        roll_out((data, &data.all), problem, &chain, everywhere, &data.range).err()
    })
}

/// Rolls models out over their windows.
pub(crate) fn roll_out(
    (data, set): (&Data, &WindowSet),
    problem: &Problem<'_>,
    chain: &Chain,
    models: Option<Vec<Without>>,
    range: &[[f64; 2]],
) -> Outcome {
    let unfit = Rejection { windows: 0, trajectory: 0, row: 0, step: 0, state: None };
    let (Ok(structure), Some(models)) = (chain.structure(&problem.repr), models) else {
        return Err(unfit);
    };
    let mut rollout = Rollout::new(&structure, chain, range);
    let mut sums = vec![vec![0.0; data.n]; set.steps.len()];
    let mut rejection: Option<Rejection> = None;
    for window in &set.windows {
        let own = models.iter().filter(|(fold, _)| fold.is_none_or(|f| f == window.fold));
        for (_, model) in own {
            if let Err((step, state)) = rollout.run(data, window, model, &mut sums[window.unit]) {
                let Window { trajectory, row, .. } = *window;
                let first = Rejection { windows: 0, trajectory, row, step, state };
                rejection.get_or_insert(first).windows += 1;
            }
        }
    }
    rejection.map_or(Ok(sums), Err)
}

/// A sparse model in f32, as the controller runs it.
pub(crate) struct Rollout<'r, 'a> {
    pub(crate) structure: &'r Structure<'a>,
    pub(crate) chain: &'r Chain,
    pub(crate) values: Vec<f32>,
    pub(crate) functions: Vec<f32>,
    pub(crate) entries: Vec<f32>,
    pub(crate) outputs: Vec<f32>,
    pub(crate) coordinates: Vec<f32>,
    /// The range of the data, widened, of states on ℝ that the symmetry does not exclude.
    pub(crate) bounds: Vec<[f32; 2]>,
}

impl<'r, 'a> Rollout<'r, 'a> {
    pub(crate) fn new(structure: &'r Structure<'a>, chain: &'r Chain, range: &[[f64; 2]]) -> Self {
        let bound = |(i, [low, high]): (usize, &[f64; 2])| {
            let excluded = structure.symmetry().excludes(i as u8);
            if structure.states()[i].space == Space::Circle || excluded {
                return [f32::NEG_INFINITY, f32::INFINITY];
            }
            let room = MARGIN * (high - low);
            [(low - room) as f32, (high + room) as f32]
        };
        Self {
            bounds: range.iter().enumerate().map(bound).collect(),
            structure,
            chain,
            values: vec![0.0; chain.observables.len()],
            functions: vec![0.0; chain.functions()],
            entries: vec![0.0; chain.len()],
            outputs: vec![0.0; structure.outputs()],
            coordinates: vec![0.0; structure.states().len()],
        }
    }

    /// Adds the squared errors of a window; the step and state where it fails otherwise.
    pub(crate) fn run(
        &mut self,
        data: &Data,
        window: &Window,
        coefficients: &[f32],
        sums: &mut [f64],
    ) -> Result<(), (usize, Option<usize>)> {
        let (n, m) = (data.n, data.m);
        let trial = &data.trials[window.trajectory];
        let input = |row: usize| &trial.narrow_inputs[row * m..][..m];
        let structure = self.structure;
        let mut history: History<f32> = History::default();
        let mut next = structure.sample(&[]);
        let first = window.row - structure.lag();
        for row in first..=window.row {
            structure.sample_into(&trial.narrow_states[row * n..][..n], &mut next);
            let applied = if row > first { input(row - 1) } else { &[] };
            history.push(structure, applied, &next);
        }
        for step in 1..=data.horizon {
            let applied = input(window.row + step - 1);
            history.observe(structure, applied, &mut self.values);
            self.chain.lift(&self.values, &mut self.functions, &mut self.entries);
            self.outputs.fill(0.0);
            for (term, row) in
                self.entries.iter().zip(coefficients.chunks_exact(self.outputs.len()))
            {
                for (z, c) in self.outputs.iter_mut().zip(row) {
                    *z += c * term;
                }
            }
            let sample = history.retract(structure, &self.outputs).ok_or((step, None))?;
            history.push(structure, applied, &sample);
            history.coordinates(structure, &mut self.coordinates);
            let measured = &trial.states[(window.row + step) * n..][..n];
            for (i, (p, x)) in self.coordinates.iter().zip(measured).enumerate() {
                if !(*p >= self.bounds[i][0] && *p <= self.bounds[i][1]) {
                    return Err((step, Some(i)));
                }
                let error = match data.spaces[i] {
                    Space::Line => f64::from(*p) - x,
                    Space::Circle => (f64::from(*p) - x).wrap(),
                };
                sums[i] += error * error;
            }
        }
        Ok(())
    }
}
