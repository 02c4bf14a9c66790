//! Whether a model's predictions can be left alone: what becomes of small deviations along the data,
//! and where rollouts leave the data.
//!
//! **Linearised.** The state of a rollout is the present sample and the earlier ones that the model
//! looks at. Its one-step map is differentiated in f64 at samples spread over the logs; a spectral
//! radius above 1 says that some small deviation would grow for ever if the robot stayed there.
//! Coordinates that a symmetry excludes only add up what the others do: their eigenvalues are 1
//! whatever the model, so that the pose itself is left out and only its earlier increments, in the
//! body frame under se2, are part of the state. A radius below 1 at every sample does not bound a
//! product of different Jacobians; therefore the growth over a whole rollout is differentiated too.
//!
//! **Watched.** The controller's f32 rollouts over windows of the logs: which diverged, which left the
//! range of the logs widened by its own width, which set the predictor's flag for the trained range.

use std::fmt::Write;

use faer::Mat;
use firmware_core::model::{Model, ModelError, Space, Structure, Symmetry};
use firmware_core::{PredictError, Predictor, Scalar};
use serde::Serialize;

use crate::edmd::Spread;
use crate::report::significant;
use crate::robot::ScoreOptions;
use crate::rollout::{input, observe, roll_out};
use crate::spectrum::radius;
use crate::terms::Names;
use crate::trajectory::Trajectory;

/// Samples at which the model is linearised, spread evenly over the logs.
const POINTS: usize = 200;

/// Step of the central differences in standard deviations: its square, the error of the formula, and
/// ε over it, the rounding, are both about 1e-11 to 1e-10.
const STEP: f64 = 1e-5;

/// Why there is no report.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum StabilityError {
    /// No trajectory is long enough.
    #[error(
        "no trajectory has the {need} rows of a window, {lag} before the present sample and the \
         horizon behind it; lower --horizon"
    )]
    NoWindow {
        /// Rows needed.
        need: usize,
        /// Largest lag.
        lag: usize,
    },
    /// The model is refused.
    #[error("the model is refused: {0:?}")]
    Model(ModelError),
}

/// A sample of the logs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Place {
    /// Name of the trajectory.
    pub trajectory: String,
    /// Its row, from 0: the last measured one.
    pub row: usize,
}

/// A figure over the samples at which the model is linearised.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Distribution {
    /// Half of the samples have no more.
    pub median: f64,
    /// 95 % of them have no more.
    pub high: f64,
    /// The largest.
    pub largest: f64,
    /// Where that is.
    pub place: Place,
}

impl Distribution {
    fn new(mut found: Vec<(f64, Place)>) -> Option<Self> {
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        let at = |share: f64| {
            let rank = libm::ceil(share * found.len() as f64) as usize;
            found.get(rank.saturating_sub(1)).map(|f| f.0)
        };
        let (median, high) = (at(0.5)?, at(0.95)?);
        found.pop().map(|(largest, place)| Self { median, high, largest, place })
    }
}

/// Something that happened in a rollout.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// Where the rollout started.
    #[serde(flatten)]
    pub place: Place,
    /// The step, from 1.
    pub step: usize,
    /// What left: a state, or an observable of the dictionary.
    pub what: String,
    /// Its value, in its unit.
    pub value: f64,
    /// Where it was expected.
    pub range: [f64; 2],
}

/// How often something happened.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Watch {
    /// Windows in which it did.
    pub windows: usize,
    /// The first one, in the order of the logs.
    pub first: Option<Event>,
}

impl Watch {
    fn count(&mut self, event: impl FnOnce() -> Event) {
        self.windows += 1;
        if self.first.is_none() {
            self.first = Some(event());
        }
    }
}

/// The report.
///
/// ```
/// use std::path::Path;
/// use trainer::{edmd, export, robot::{Robot, ScoreOptions}, stability::Stability};
/// use trainer::trajectory::{InMemory, Trajectory};
///
/// // x⁺ = 1.25 x − 0.375 x@1, whose companion matrix has the eigenvalues 0.75 and 0.5.
/// let robot = Robot::parse(
///     "name = \"spring\"\nsample_time_s = 0.1\nstates = [{ name = \"x\", space = \"R\", unit = \"m\" }]\n\
///      [dictionary]\nstandardise = false\ndelays = { states = 1 }\n",
///     Path::new("robot.toml"),
/// )?;
/// let mut states = vec![8.0, -4.0];
/// for k in 1..12 {
///     states.push(1.25 * states[k] - 0.375 * states[k - 1]);
/// }
/// let logs = [Trajectory { states, inputs: Vec::new() }];
/// let source = InMemory { trajectories: &logs, states: 1, inputs: 0 };
/// let fit = edmd::fit(&robot, &source, &|_| {})?;
/// let numbers =
///     export::controller_coefficients(fit.structure.dictionary(), None, &fit.operator);
/// let model = export::controller_model(fit.structure, None, &numbers, Some(&fit.ranges)).unwrap();
///
/// let logs = [("swing".to_owned(), logs[0].clone())];
/// let options = ScoreOptions { horizon: 5, stride: 1, ..ScoreOptions::default() };
/// let report = Stability::measure(&model, &logs, &options)?;
/// assert!((report.spectral_radius.unwrap().largest - 0.75).abs() < 1e-7);
/// assert_eq!((report.windows, report.diverged.windows), (7, 0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stability {
    /// Steps of a rollout.
    pub horizon: usize,
    /// Samples at which the model was linearised.
    pub points: usize,
    /// Samples beside them from which the model does not predict a step.
    pub unpredicted: usize,
    /// Spectral radius of one step; `None` where nothing is left once the pose is excluded.
    pub spectral_radius: Option<Distribution>,
    /// Per state, its change after the horizon, in its standard deviations, when the measured samples
    /// change by a small fraction of theirs in the worst direction, divided by that fraction; `None`
    /// where no rollout came to its end.
    pub growth: Vec<Option<Distribution>>,
    /// Names of the states.
    pub states: Vec<String>,
    /// Windows watched.
    pub windows: usize,
    /// Samples between two of them.
    pub stride: usize,
    /// Rollouts that diverged; `what` is the state that was farthest from the logs just before.
    pub diverged: Watch,
    /// Rollouts in which a state on ℝ that no symmetry excludes left the range of the logs, widened by
    /// its width to either side.
    pub beyond_logs: Watch,
    /// Rollouts that set the flag for the trained range; `None` when the model does not hold it.
    pub beyond_training: Option<Watch>,
}

impl Stability {
    /// Examines a model over named trajectories, of which `options` gives the horizon and the stride.
    ///
    /// # Errors
    /// [`StabilityError`].
    pub fn measure(
        model: &Model<'_>,
        logs: &[(String, Trajectory)],
        options: &ScoreOptions,
    ) -> Result<Self, StabilityError> {
        let structure = model.structure();
        let (n, lag, horizon) = (structure.states().len(), structure.lag(), options.horizon);
        let need = lag + 1 + horizon;
        // Present samples with enough before and behind them.
        let starts = |t: &Trajectory| lag..(t.states.len() / n + lag + 1).saturating_sub(need);
        let count = |t: &Trajectory| starts(t).len();
        let total: usize = logs.iter().map(|(_, t)| count(t)).sum();
        if total == 0 || horizon == 0 {
            return Err(StabilityError::NoWindow { need, lag });
        }

        let numbers: Vec<f64> = model.coefficients().iter().copied().map(f64::from).collect();
        let wide = match model.terms() {
            Some(terms) => Model::new_sparse(structure.clone(), terms.entries(), &numbers, None),
            None => Model::new(structure.clone(), &numbers, None),
        };
        let wide = wide.map_err(StabilityError::Model)?;
        let linear = Linear::new(&wide, logs);
        let points = total.min(POINTS);
        let (mut radii, mut growth) = (Vec::new(), vec![Vec::new(); n]);
        let mut unpredicted = 0;
        for point in 0..points {
            let mut index = point * total / points;
            let found = logs.iter().find(|(_, t)| {
                let inside = index < count(t);
                index -= if inside { 0 } else { count(t) };
                inside
            });
            let Some((name, t)) = found else { continue };
            let place = Place { trajectory: name.clone(), row: lag + index };
            let Some(jacobian) = linear.step(t, place.row) else {
                unpredicted += 1;
                continue;
            };
            faer::set_global_parallelism(faer::Par::Seq);
            let values = jacobian.eigenvalues().unwrap_or_default();
            let values: Vec<(f64, f64)> = values.into_iter().map(|z| (z.re, z.im)).collect();
            radii.extend(radius(&values).map(|r| (r, place.clone())));
            for (list, grown) in growth.iter_mut().zip(linear.growth(t, place.row, horizon)) {
                list.push((grown, place.clone()));
            }
        }
        let mut report = Self {
            horizon,
            points: points - unpredicted,
            unpredicted,
            spectral_radius: Distribution::new(radii),
            growth: growth.into_iter().map(Distribution::new).collect(),
            states: structure.states().iter().map(|s| s.name.to_owned()).collect(),
            windows: 0,
            stride: options.stride,
            diverged: Watch::default(),
            beyond_logs: Watch::default(),
            beyond_training: model.ranges().map(|_| Watch::default()),
        };
        for (name, t) in logs {
            for row in starts(t).step_by(options.stride.max(1)) {
                report.watch(model, &linear.ranges, t, &Place { trajectory: name.clone(), row });
            }
        }
        Ok(report)
    }

    /// One rollout of the controller's predictor.
    fn watch(&mut self, model: &Model<'_>, ranges: &[[f64; 2]], t: &Trajectory, place: &Place) {
        self.windows += 1;
        let structure = model.structure();
        let (n, m) = (structure.states().len(), structure.inputs().len());
        let predictor = Predictor::new(model);
        let event = |step, what: &str, value, range| {
            let what = what.to_owned();
            Event { place: place.clone(), step, what, value, range }
        };
        let mut x: Vec<f64> = t.states[place.row * n..][..n].to_vec();
        // How far outside of the logs a state is, in widths of its range.
        let distance = |x: &[f64], i: usize| {
            let [low, high] = ranges[i];
            (low - x[i]).max(x[i] - high) / (high - low).max(f64::MIN_POSITIVE)
        };
        let watched = |i: usize| {
            structure.states()[i].space == Space::Line && !structure.symmetry().excludes(i as u8)
        };
        let farthest = |x: &[f64]| {
            let states = (0..n).filter(|i| watched(*i));
            states.max_by(|a, b| distance(x, *a).total_cmp(&distance(x, *b)))
        };
        let (mut left, mut narrow) = (false, vec![0.0_f32; n]);
        let mut state = observe(&predictor, t, place.row).ok();
        for step in 1..=self.horizon {
            let moved = state.as_mut().map(|state| {
                predictor.step(state, &input::<f32>(t, m, place.row + step - 1))?;
                predictor.coordinates(state, &mut narrow)
            });
            if !matches!(moved, Some(Ok(()))) {
                let step = match moved {
                    Some(Err(PredictError::Diverged { step })) => step as usize,
                    _ => step,
                };
                let i = farthest(&x).unwrap_or(0);
                let what = structure.states()[i].name;
                self.diverged.count(|| event(step, what, x[i], ranges[i]));
                break;
            }
            for (to, x) in x.iter_mut().zip(&narrow) {
                *to = f64::from(*x);
            }
            if let Some(i) = farthest(&x)
                && distance(&x, i) > 1.0
                && !left
            {
                left = true;
                let what = structure.states()[i].name;
                self.beyond_logs.count(|| event(step, what, x[i], ranges[i]));
            }
        }
        if let (Some(watch), Some(bounds), Some(out)) = (
            self.beyond_training.as_mut(),
            model.ranges(),
            state.as_ref().and_then(|state| state.out_of_range()),
        ) {
            watch.count(|| {
                let states: Vec<&str> = structure.states().iter().map(|s| s.name).collect();
                let inputs: Vec<&str> = structure.inputs().iter().map(|u| u.name).collect();
                let names = Names { states: &states, inputs: &inputs };
                let o = structure.dictionary().observables()[out.observable];
                let what = names.observable(o.source, o.lag);
                let range = [0, 1].map(|k| f64::from(bounds[2 * out.observable + k]));
                // Its value in that step: the same rollout, stopped before it.
                let before = out.step as usize - 1;
                let mut rows = vec![0.0; before * n];
                let there = roll_out(&predictor, t, place.row, &mut rows).ok();
                let acting = input::<f32>(t, m, place.row + before);
                let value = there
                    .and_then(|s| s.history().raw(structure, &acting).nth(out.observable))
                    .map_or(f64::NAN, f64::from);
                event(out.step as usize, &what, value, range)
            });
        }
    }

    /// The report for people.
    pub fn text(&self) -> String {
        let mut text = String::new();
        let at = |place: &Place| format!("{}, row {}", place.trajectory, place.row);
        let spread = |d: &Distribution| {
            format!(
                "median {}, 95 % up to {}, largest {} at {}",
                significant(d.median),
                significant(d.high),
                significant(d.largest),
                at(&d.place)
            )
        };
        let _ = writeln!(text, "linearised at {} samples spread over the logs", self.points);
        if self.unpredicted > 0 {
            let _ = writeln!(
                text,
                "  {} more do not predict a step: it diverges there",
                self.unpredicted
            );
        }
        let _ = match &self.spectral_radius {
            Some(d) => writeln!(text, "spectral radius of one step: {}", spread(d)),
            None => writeln!(
                text,
                "spectral radius of one step: none, the whole state is a pose that only adds up"
            ),
        };
        let _ = writeln!(
            text,
            "a small deviation after {} steps, as a multiple of what it began with (in standard \
             deviations, worst direction)",
            self.horizon
        );
        for (name, growth) in self.states.iter().zip(&self.growth) {
            let growth = growth.as_ref().map_or_else(|| "no rollout ended".to_owned(), &spread);
            let _ = writeln!(text, "  {name}: {growth}");
        }
        let _ = writeln!(
            text,
            "\n{} rollouts of {} steps, one every {} samples, in the controller's f32",
            self.windows, self.horizon, self.stride
        );
        let watch = |text: &mut String, title: &str, watch: &Watch, words: &str| {
            let Some(first) = &watch.first else {
                let _ = writeln!(text, "  {title}: none");
                return;
            };
            // As the controller has them; four digits where they tell the numbers apart.
            let [low, high] = first.range;
            let numbers = [first.value, low, high];
            let short = numbers.map(significant);
            let [value, low, high] = match short[1..].contains(&short[0]) {
                true => numbers.map(|x| (x as f32).to_string()),
                false => short,
            };
            let side = match first.range[0] <= first.value && first.value <= first.range[1] {
                true => "within",
                false => "outside",
            };
            let _ = writeln!(
                text,
                "  {title}: {}; the first at {}, step {}: {words} `{}` was {value}, {side} {low} to {high}",
                watch.windows,
                at(&first.place),
                first.step,
                first.what
            );
        };
        watch(
            &mut text,
            "diverged",
            &self.diverged,
            "no finite prediction within the limits; just before,",
        );
        watch(
            &mut text,
            "left the range of the logs by more than its width",
            &self.beyond_logs,
            "predicted",
        );
        match &self.beyond_training {
            Some(flag) => watch(&mut text, "left the trained range", flag, "observable"),
            None => text += "  left the trained range: the model does not hold it\n",
        }
        text
    }
}

/// What the derivatives need.
struct Linear<'m, 'a> {
    predictor: Predictor<'m, 'a, f64>,
    /// Standard deviation of every coordinate, and of the increments that are part of the state.
    deviations: Vec<f64>,
    increments: Vec<f64>,
    /// Least and largest value of every coordinate in the logs.
    ranges: Vec<[f64; 2]>,
}

impl<'m, 'a> Linear<'m, 'a> {
    fn new(model: &'m Model<'a, f64>, logs: &[(String, Trajectory)]) -> Self {
        let structure = model.structure();
        let states = structure.states();
        let n = states.len();
        let mut coordinates = vec![Spread::default(); n];
        let mut increments = vec![Spread::default(); n];
        let mut ranges = vec![[f64::INFINITY, f64::NEG_INFINITY]; n];
        for (_, t) in logs {
            let mut before: Option<&[f64]> = None;
            for x in t.states.chunks_exact(n) {
                for (i, x) in x.iter().enumerate() {
                    let turn = states[i].space == Space::Circle;
                    coordinates[i].push(if turn { x.wrap() } else { *x });
                    ranges[i] = [ranges[i][0].min(*x), ranges[i][1].max(*x)];
                }
                if let Some(before) = before {
                    let change = increment(structure, before, x);
                    increments.iter_mut().zip(change).for_each(|(s, d)| s.push(d));
                }
                before = Some(x);
            }
        }
        // What never moves is taken in its own unit.
        let unit = |spread: &Spread| Some(spread.deviation()).filter(|d| *d > 0.0).unwrap_or(1.0);
        Self {
            predictor: Predictor::new(model),
            deviations: coordinates.iter().map(unit).collect(),
            increments: increments.iter().map(unit).collect(),
            ranges,
        }
    }

    fn structure(&self) -> &Structure<'a> {
        self.predictor.model().structure()
    }

    /// The samples that the model looks at from `row`, oldest first.
    fn window(&self, t: &Trajectory, row: usize) -> Vec<Vec<f64>> {
        let (n, lag) = (self.structure().states().len(), self.structure().lag());
        (row - lag..=row).map(|k| t.states[k * n..][..n].to_vec()).collect()
    }

    /// `t` around `row` with other samples up to it.
    fn with_window(&self, t: &Trajectory, row: usize, window: &[Vec<f64>]) -> Trajectory {
        let m = self.structure().inputs().len();
        let first = row + 1 - window.len();
        Trajectory { states: window.concat(), inputs: t.inputs[first * m..].to_vec() }
    }

    /// The state of a rollout: free coordinates of all samples, and the increments that led from
    /// sample to sample of the others, newest first; with each, its standard deviation and whether it
    /// is an angle.
    fn reduce(&self, window: &[Vec<f64>]) -> Vec<(f64, f64, bool)> {
        let structure = self.structure();
        let mut reduced = Vec::new();
        for (k, x) in window.iter().enumerate().rev() {
            let change = (k > 0).then(|| increment(structure, &window[k - 1], x));
            for (i, state) in structure.states().iter().enumerate() {
                let angle = state.space == Space::Circle;
                if !structure.symmetry().excludes(i as u8) {
                    reduced.push((x[i], self.deviations[i], angle));
                } else if let Some(change) = &change {
                    reduced.push((change[i], self.increments[i], angle));
                }
            }
        }
        reduced
    }

    /// The samples again, from the oldest one's excluded coordinates and a state of [`reduce`].
    fn expand(&self, oldest: &[f64], reduced: &[f64]) -> Vec<Vec<f64>> {
        let structure = self.structure();
        let (n, samples) = (structure.states().len(), structure.lag() + 1);
        // The oldest sample's numbers come last.
        let mut rest = reduced.iter().copied();
        let mut read: Vec<Vec<f64>> = Vec::new();
        for age in 0..samples {
            let is_there = |i: usize| !structure.symmetry().excludes(i as u8) || age + 1 < samples;
            read.push(
                (0..n)
                    .map(|i| if is_there(i) { rest.next() } else { None }.unwrap_or(0.0))
                    .collect(),
            );
        }
        let mut window: Vec<Vec<f64>> = Vec::new();
        for numbers in read.iter().rev() {
            let mut x = match window.last() {
                Some(before) => compose(structure, before, numbers),
                None => oldest.to_vec(),
            };
            for (i, x) in x.iter_mut().enumerate() {
                if !structure.symmetry().excludes(i as u8) {
                    *x = numbers[i];
                }
            }
            window.push(x);
        }
        window
    }

    /// The Jacobian of one step of the state of a rollout; `None` where the model does not predict.
    fn step(&self, t: &Trajectory, row: usize) -> Option<Mat<f64>> {
        let n = self.structure().states().len();
        let window = self.window(t, row);
        let reduced = self.reduce(&window);
        let next = |numbers: &[f64]| {
            let mut window = self.expand(&window[0], numbers);
            let mut predicted = vec![0.0; n];
            let around = self.with_window(t, row, &window);
            roll_out(&self.predictor, &around, window.len() - 1, &mut predicted).ok()?;
            window.remove(0);
            window.push(predicted);
            Some(self.reduce(&window))
        };
        let numbers: Vec<f64> = reduced.iter().map(|r| r.0).collect();
        // A state without numbers of its own still has to predict.
        next(&numbers)?;
        let mut jacobian = Mat::zeros(numbers.len(), numbers.len());
        for (j, (_, deviation, _)) in reduced.iter().enumerate() {
            let step = STEP * deviation;
            let (mut above, mut below) = (numbers.clone(), numbers.clone());
            above[j] += step;
            below[j] -= step;
            // What the step really is, after rounding.
            let width = above[j] - below[j];
            for (i, (a, b)) in next(&above)?.iter().zip(next(&below)?).enumerate() {
                let space = if a.2 { Space::Circle } else { Space::Line };
                jacobian[(i, j)] = space.difference(a.0, b.0) / width;
            }
        }
        Some(jacobian)
    }

    /// Per state, the largest change after `horizon` steps, in its standard deviations, that a change
    /// of the measured samples of unit length in theirs makes. Empty where a rollout diverges.
    fn growth(&self, t: &Trajectory, row: usize, horizon: usize) -> Vec<f64> {
        let states = self.structure().states();
        let n = states.len();
        let window = self.window(t, row);
        let end = |window: &[Vec<f64>]| {
            let mut predicted = vec![0.0; n * horizon];
            let around = self.with_window(t, row, window);
            roll_out(&self.predictor, &around, window.len() - 1, &mut predicted).ok()?;
            Some(predicted[(horizon - 1) * n..].to_vec())
        };
        let mut squares = vec![0.0; n];
        for k in 0..window.len() {
            for j in 0..n {
                let (mut above, mut below) = (window.clone(), window.clone());
                above[k][j] += STEP * self.deviations[j];
                below[k][j] -= STEP * self.deviations[j];
                let width = above[k][j] - below[k][j];
                let (Some(a), Some(b)) = (end(&above), end(&below)) else { return Vec::new() };
                for i in 0..n {
                    let slope = states[i].space.difference(a[i], b[i]) / width;
                    let relative = slope * self.deviations[j] / self.deviations[i];
                    squares[i] += relative * relative;
                }
            }
        }
        squares.into_iter().map(f64::sqrt).collect()
    }
}

/// The change of all coordinates from one sample to the next: wrapped on S¹, a pose under se2 in the
/// frame of `from`.
fn increment(structure: &Structure<'_>, from: &[f64], to: &[f64]) -> Vec<f64> {
    let states = structure.states().iter().zip(to).zip(from);
    let mut change: Vec<f64> =
        states.map(|((s, to), from)| s.space.difference(*to, *from)).collect();
    if let Symmetry::Se2 { x, y, heading } = structure.symmetry() {
        let [x, y, heading] = [x, y, heading].map(usize::from);
        let (s, c) = Scalar::sin_cos(from[heading]);
        (change[x], change[y]) = (c * change[x] + s * change[y], c * change[y] - s * change[x]);
    }
    change
}

/// The sample that an increment leads to.
fn compose(structure: &Structure<'_>, from: &[f64], change: &[f64]) -> Vec<f64> {
    let mut change = change.to_vec();
    if let Symmetry::Se2 { x, y, heading } = structure.symmetry() {
        let [x, y, heading] = [x, y, heading].map(usize::from);
        let (s, c) = Scalar::sin_cos(from[heading]);
        (change[x], change[y]) = (c * change[x] - s * change[y], s * change[x] + c * change[y]);
    }
    from.iter().zip(change).map(|(x, d)| x + d).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edmd::{self, Fit};
    use crate::export::{controller_coefficients, controller_model};
    use crate::robot::Robot;
    use crate::trajectory::InMemory;

    /// Central differences of maps of order one, see [`STEP`], after a fit in f64 whose coefficients
    /// are numbers of a few binary digits and so survive f32 as they are.
    const EXACT: f64 = 1e-9;

    fn robot(text: &str) -> Robot {
        let head = "name = \"r\"\nsample_time_s = 0.1\n";
        Robot::parse(&format!("{head}{text}"), std::path::Path::new("robot.toml")).unwrap()
    }

    fn log(states: Vec<f64>, inputs: Vec<f64>) -> (String, Trajectory) {
        ("log".to_owned(), Trajectory { states, inputs })
    }

    fn fit<'r>(robot: &'r Robot, logs: &[(String, Trajectory)]) -> Fit<'r> {
        let trajectories: Vec<Trajectory> = logs.iter().map(|(_, t)| t.clone()).collect();
        let (states, inputs) = (robot.states.len(), robot.inputs.len());
        let source = InMemory { trajectories: &trajectories, states, inputs };
        edmd::fit(robot, &source, &|_| {}).unwrap()
    }

    fn report(fit: &Fit<'_>, logs: &[(String, Trajectory)], horizon: usize) -> Stability {
        let dictionary = fit.structure.dictionary();
        let mut numbers = controller_coefficients(dictionary, fit.chain, &fit.operator);
        // Coefficients of the tests are multiples of 1/64.
        numbers.iter_mut().for_each(|c| *c = (*c * 64.0).round() / 64.0);
        let model = controller_model(fit.structure.clone(), fit.chain, &numbers, Some(&fit.ranges));
        let options = ScoreOptions { horizon, stride: 1, ..ScoreOptions::default() };
        Stability::measure(&model.unwrap(), logs, &options).unwrap()
    }

    #[track_caller]
    fn near(found: f64, expected: f64) {
        assert!((found - expected).abs() < EXACT, "{found} instead of {expected}");
    }

    const PLANE: &str = "states = [{ name = \"x\", space = \"R\" }, { name = \"y\", space = \"R\" }]\n\
        [dictionary]\nstandardise = false\nblocks = [{ factors = [\"x\"] }, { factors = [\"y\"] }]\n";

    /// x⁺ = A x.
    fn plane(a: [[f64; 2]; 2], start: [f64; 2], rows: usize) -> (String, Trajectory) {
        let mut x = start;
        let mut states = Vec::new();
        for _ in 0..rows {
            states.extend(x);
            x = a.map(|row| row[0] * x[0] + row[1] * x[1]);
        }
        log(states, Vec::new())
    }

    #[test]
    fn a_linear_model_has_the_radius_and_the_growth_of_its_matrix() {
        // Trace 3/2, determinant 5/8: complex eigenvalues of modulus √(5/8).
        let a = [[1.0, 0.5], [-0.25, 0.5]];
        let logs = [plane(a, [1.0, 0.0], 12), plane(a, [-0.5, 1.0], 12)];
        let robot = robot(PLANE);
        let found = report(&fit(&robot, &logs), &logs, 3);
        let radius = found.spectral_radius.unwrap();
        near(radius.median, 0.625_f64.sqrt());
        near(radius.largest, 0.625_f64.sqrt());
        assert_eq!((found.points, found.unpredicted), (18, 0));
        // The rows of A³ in units of the deviations.
        let square = |m: [[f64; 2]; 2], n: [[f64; 2]; 2]| {
            [0, 1].map(|i| [0, 1].map(|j| m[i][0] * n[0][j] + m[i][1] * n[1][j]))
        };
        let cube = square(square(a, a), a);
        let values =
            |i: usize| logs.iter().flat_map(move |(_, t)| t.states.iter().skip(i).step_by(2));
        let deviation = |i: usize| {
            let mean = values(i).sum::<f64>() / 24.0;
            (values(i).map(|x| (x - mean) * (x - mean)).sum::<f64>() / 24.0).sqrt()
        };
        let ratio = deviation(1) / deviation(0);
        let growth: Vec<f64> = found.growth.iter().map(|g| g.as_ref().unwrap().largest).collect();
        near(growth[0], cube[0][0].hypot(cube[0][1] * ratio));
        near(growth[1], (cube[1][0] / ratio).hypot(cube[1][1]));
    }

    #[test]
    fn a_pose_that_adds_up_is_left_out_but_its_increments_are_not() {
        let translation = robot(
            "states = [{ name = \"x\", space = \"R\" }]\n\
             symmetry = { kind = \"translation\", coordinates = [\"x\"] }\n\
             [dictionary]\nstandardise = false\nblocks = [{ factors = [\"d(x)@1\"] }]\n",
        );
        // Δx⁺ = Δx/2 + 1.
        let (mut x, mut d) = (5.0, 4.0);
        let mut states = Vec::new();
        for _ in 0..10 {
            states.push(x);
            x += d;
            d = d / 2.0 + 1.0;
        }
        let logs = [log(states, Vec::new())];
        let found = report(&fit(&translation, &logs), &logs, 3);
        near(found.spectral_radius.unwrap().largest, 0.5);
        // x₃ = x₀ + (1/2 + 1/4 + 1/8)(x₀ − x₋₁).
        near(found.growth[0].as_ref().unwrap().largest, 1.875_f64.hypot(0.875));
    }

    /// A planar pose whose increments halve from step to step, in the frame of each step.
    const POSE: &str = "states = [{ name = \"x\", space = \"R\" }, { name = \"y\", space = \"R\" }, \
        { name = \"phi\", space = \"S1\" }]\n\
        symmetry = { kind = \"se2\", coordinates = [\"x\", \"y\", \"phi\"] }\n\
        [dictionary]\nstandardise = false\n\
        blocks = [{ factors = [\"d(x)@1\"] }, { factors = [\"d(y)@1\"] }, { factors = [\"d(phi)@1\"] }]\n";

    #[test]
    fn increments_of_a_pose_are_taken_in_the_body_frame() {
        let robot = robot(POSE);
        let coast = |start: [f64; 3], rate: [f64; 3]| {
            let (mut pose, mut rate) = (start, rate);
            let mut states = Vec::new();
            for _ in 0..6 {
                states.extend(pose);
                let (s, c) = Scalar::sin_cos(pose[2]);
                pose[0] += c * rate[0] - s * rate[1];
                pose[1] += s * rate[0] + c * rate[1];
                pose[2] += rate[2];
                rate = rate.map(|r| 0.5 * r);
            }
            log(states, Vec::new())
        };
        let logs = [
            coast([0.0, 0.0, 3.0], [1.0, 0.25, 1.0]),
            coast([4.0, -0.7, -1.0], [-1.0, 1.0, 0.5]),
            coast([1.0, 1.0, 0.0], [0.5, 1.0, -2.0]),
        ];
        let found = report(&fit(&robot, &logs), &logs, 2);
        let radius = found.spectral_radius.unwrap();
        near(radius.median, 0.5);
        near(radius.largest, 0.5);
    }

    #[test]
    fn nothing_but_a_pose_has_no_radius() {
        let robot = robot(
            "states = [{ name = \"x\", space = \"R\" }]\n\
             inputs = [{ name = \"u\", range = [-1, 1] }]\n\
             symmetry = { kind = \"translation\", coordinates = [\"x\"] }\n\
             [dictionary]\nstandardise = false\n",
        );
        let logs = [log(vec![0.0, 0.5, 0.5, 0.25], vec![1.0, 0.0, -0.5, 0.0])];
        let found = report(&fit(&robot, &logs), &logs, 2);
        assert_eq!((found.spectral_radius.clone(), found.points), (None, 2));
        near(found.growth[0].as_ref().unwrap().largest, 1.0);
        assert!(found.text().contains("none, the whole state is a pose"), "{}", found.text());
    }

    #[test]
    fn an_unstable_model_is_reported_with_the_step_where_it_leaves() {
        let robot = robot(
            "states = [{ name = \"x\", space = \"R\", limit = [-9, 9] }]\n\
             [dictionary]\nstandardise = false\n",
        );
        // x⁺ = 2 x, trained between −1 and 1.
        let training = [
            log(vec![0.5, 1.0], Vec::new()),
            log(vec![-1.0, -2.0], Vec::new()),
            log(vec![1.0, 2.0], Vec::new()),
        ];
        let fitted = fit(&robot, &training);
        let still = ("still".to_owned(), Trajectory { states: vec![0.0; 6], inputs: Vec::new() });
        let logs = [still, log(vec![0.25, 1.0, 0.5, 0.25, 0.0, 0.0], Vec::new())];
        let found = report(&fitted, &logs, 4);
        near(found.spectral_radius.as_ref().unwrap().largest, 2.0);
        near(found.growth[0].as_ref().unwrap().largest, 16.0);
        // From 1: 2, 4, 8 and beyond the limit in step 4. From 0.25: 0.5, 1, 2, 4.
        assert_eq!((found.windows, found.diverged.windows), (4, 1));
        let place = |row| Place { trajectory: "log".to_owned(), row };
        let diverged = found.diverged.first.clone().unwrap();
        assert_eq!((diverged.place, diverged.step, diverged.value), (place(1), 4, 8.0));
        assert_eq!((diverged.what.as_str(), diverged.range), ("x", [0.0, 1.0]));
        // The range of the logs is 0 to 1, and 1 more to either side: 4 > 2.
        assert_eq!(found.beyond_logs.windows, 2);
        let left = found.beyond_logs.first.clone().unwrap();
        assert_eq!((left.place, left.step, left.value), (place(0), 4, 4.0));
        // The trained range, −1 to 1, is left by what the step after 2 starts from.
        let flag = found.beyond_training.clone().unwrap();
        assert_eq!(flag.windows, 2);
        let first = flag.first.unwrap();
        assert_eq!((first.place, first.step, first.value), (place(0), 4, 2.0));
        let text = found.text();
        assert!(text.contains("the first at log, row 1, step 4"), "{text}");
    }

    #[test]
    fn logs_that_are_too_short_are_refused() {
        let robot = robot(PLANE);
        let logs = [plane([[0.5, 0.25], [0.0, 0.5]], [1.0, 1.0], 5)];
        let fitted = fit(&robot, &logs);
        let numbers =
            controller_coefficients(fitted.structure.dictionary(), None, &fitted.operator);
        let model = controller_model(fitted.structure, None, &numbers, None).unwrap();
        let options = ScoreOptions { horizon: 5, ..ScoreOptions::default() };
        let message = Stability::measure(&model, &logs, &options).unwrap_err().to_string();
        assert!(message.contains("the 6 rows of a window"), "{message}");
    }
}
