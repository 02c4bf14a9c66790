//! The model beside the robot: once per sample it predicts where the robot is now, takes what is
//! measured, and looks ahead.
//!
//! What is measured is compared twice: with the prediction from the last measurement, where sudden things
//! show (a spike, wheels that slip), and every [`SHADOW`] samples with a second prediction that has not
//! been corrected since, where slow ones do (a leak, a valve that is stuck, a sensor that stands still). The
//! second one begins where all samples that the model looks at are measured: with gaps closer together
//! than that, only the first one watches.

use crate::capacity::{MAX_KEPT, MAX_STATES};
use crate::control_loop::ControlLoopError;
use crate::control_loop::monitor::{GATE, Monitor, Verdict};
use crate::control_loop::supervisor::Alarms;
use crate::device::PositionSensor;
use crate::model::{Model, Space};
use crate::predictor::SavedState;
use crate::scalar::Scalar;
use crate::{PredictError, Predictor, PredictorState};

/// Measurements in a row that may be NaN or unreadable before the sensor counts as bad.
pub const BAD_MEASUREMENTS: u8 = 3;
/// Measurements in a row that are not believed; the next one is taken as it comes.
pub const OUTLIERS: u8 = 3;

/// Samples over which the second prediction runs, fewer where the model's error bounds do not reach so
/// far.
pub const SHADOW: u32 = 10;

/// What a sensor said at a sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Measurement<const N: usize> {
    /// Coordinates in the model's units.
    Taken([f32; N]),
    /// Nothing new.
    Missing,
    /// Something that belongs to an earlier sample.
    Late,
    /// The sensor could not be read.
    Unreadable,
}

/// One sample of the robot beside its model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tracked<const N: usize> {
    /// Where the model says the robot is; `None` while its history fills.
    pub predicted: Option<[f32; N]>,
    /// Where it was measured, angles in (−π, π], if the measurement was used.
    pub measured: Option<[f32; N]>,
    /// Measured − predicted, angles on the circle; also of a measurement that was not believed.
    pub residual: Option<[f32; N]>,
    /// Steps predicted since the last measurement that was used; 0 when nothing was predicted.
    pub steps: u32,
    /// Steps whose error bound holds for this prediction: more than `steps` while the model looks back at
    /// samples that were predicted themselves.
    pub bound_steps: u32,
    /// The largest residual as a multiple of its error bound; 0 without bounds.
    pub ratio: f32,
    /// What was noticed at this sample.
    pub alarms: Alarms,
}

/// Predictor, history and monitor of a robot with `N` coordinates and `M` inputs, looking `H` samples
/// ahead.
///
/// What it predicts for a sample is bit by bit what `trainer evaluate` predicts on the recorded log:
/// rolled out from the last measurement that was used, with the inputs that were applied. After a gap
/// that holds once the model looks back at measurements only; until then the predictions in the gap
/// stand in for them.
///
/// Most of the work is the path ahead. A loop with several ticks per sample [takes](Self::take) the sample at its
/// tick, and [goes on](Self::go_on) at those after it, in its [`Rhythm`](crate::control_loop::Rhythm); a loop that
/// acts upon the path at once has all of it from [`sample`](Self::sample).
#[derive(Clone, Debug)]
pub struct Tracker<'m, 'a, const N: usize, const M: usize, const H: usize> {
    beside: Beside<'m, 'a>,
    /// The last sample, and what acted before it and is held from it on.
    seen: Seen,
    predicted: [f32; N],
    measured: [f32; N],
    residual: [f32; N],
    applied: [f32; M],
    held: [f32; M],
    path: [[f32; N]; H],
}

impl<'m, 'a, const N: usize, const M: usize, const H: usize> Tracker<'m, 'a, N, M, H> {
    /// A tracker that has seen nothing; it tolerates at most `blind_samples` in a row without a
    /// measurement, fewer where the model's error bounds do not reach so far.
    ///
    /// # Errors
    /// [`ControlLoopError::DimensionMismatch`].
    #[inline(always)]
    pub fn new(model: &'m Model<'a>, blind_samples: u32) -> Result<Self, ControlLoopError> {
        let structure = model.structure();
        for (field, expected, found) in [
            ("states", N, structure.states().len()),
            ("inputs", M, structure.inputs().len()),
            // Fewer than there is room for are as good.
            ("numbers of the history", MAX_KEPT, structure.kept().max(MAX_KEPT)),
        ] {
            if expected != found {
                return Err(ControlLoopError::DimensionMismatch { field, expected, found });
            }
        }
        Ok(Self {
            seen: Seen::default(),
            predicted: [0.0; N],
            measured: [0.0; N],
            residual: [0.0; N],
            applied: [0.0; M],
            held: [0.0; M],
            path: [[0.0; N]; H],
            beside: Beside::new(model, blind_samples),
        })
    }

    /// The model.
    pub fn model(&self) -> &'m Model<'a> {
        self.beside.model()
    }

    /// Whether measured and predicted can be compared: the model has error bounds.
    pub fn monitored(&self) -> bool {
        self.model().error_bounds().is_some()
    }

    /// Asks a sensor. A measurement that is older than half a sample belongs to an earlier one.
    pub fn measure(&self, sensor: &mut impl PositionSensor<N>) -> Measurement<N> {
        // Casts to integers saturate.
        let half_us = (self.model().structure().sample_time_s() * 0.5e6) as u32;
        match sensor.measure() {
            Ok(Some(_)) if sensor.age_us() > half_us => Measurement::Late,
            Ok(Some(coordinates)) => Measurement::Taken(coordinates),
            Ok(None) => Measurement::Missing,
            Err(_) => Measurement::Unreadable,
        }
    }

    /// Whether the last sample had a measurement that was used, and measurements come often enough for the
    /// model to predict.
    pub fn sees(&self) -> bool {
        let Beside { blind, unpredicted, unpredicted_limit, .. } = self.beside;
        let is_there = self.seen.used || !self.beside.present.is_empty();
        blind == 0 && unpredicted <= unpredicted_limit && is_there
    }

    /// Where the robot will be at each of the coming samples with the inputs held, as far as it has been
    /// predicted since the last one; shorter than `H`, too, when the prediction diverges on the way, and
    /// empty while the history fills.
    pub fn path(&self) -> &[[f32; N]] {
        self.path.get(..self.beside.ahead).unwrap_or(&[])
    }

    /// The last sample; its alarms include those noticed since.
    pub fn tracked(&self) -> Tracked<N> {
        let Seen { predicted, used, compared, steps, bound_steps, ratio, alarms } = self.seen;
        Tracked {
            predicted: predicted.then_some(self.predicted),
            measured: used.then_some(self.measured),
            residual: compared.then_some(self.residual),
            steps,
            bound_steps,
            ratio,
            alarms,
        }
    }

    /// What a frame says of it.
    #[inline(always)]
    pub(crate) fn told(&self) -> Told<'_> {
        let Seen { predicted, used, compared, steps, bound_steps, .. } = self.seen;
        let none: &[f32] = &[];
        Told {
            applied: &self.applied,
            measured: if used { &self.measured } else { none },
            predicted: if predicted { &self.predicted } else { none },
            residual: if compared { &self.residual } else { none },
            ahead: self.path().last().map_or(none, <[f32; N]>::as_slice),
            steps,
            bound_steps,
        }
    }

    /// Takes a sample: what was `applied` since the one before it, on average, and what is `measured`
    /// now. Then looks ahead with the inputs `held`, and compares with the second prediction.
    pub fn sample(
        &mut self,
        applied: &[f32; M],
        measured: Measurement<N>,
        held: &[f32; M],
    ) -> Tracked<N> {
        self.take(applied, measured, held);
        self.go_on(usize::MAX);
        self.tracked()
    }

    /// The part of [`sample`](Self::sample) that cannot wait: the robot is predicted, measured, and compared. What
    /// the sample before has left to do is dropped, but for its measurement. What was noticed.
    pub fn take(
        &mut self,
        applied: &[f32; M],
        measured: Measurement<N>,
        held: &[f32; M],
    ) -> Alarms {
        if !self.is_done() {
            self.beside.drop_rest(&self.applied, self.seen.used.then_some(&self.measured));
        }
        (self.applied, self.held) = (*applied, *held);
        let reading = match measured {
            Measurement::Taken(coordinates) => {
                self.measured = coordinates;
                Reading::Taken
            }
            Measurement::Missing => Reading::Missing,
            Measurement::Late => Reading::Late,
            Measurement::Unreadable => Reading::Unreadable,
        };
        let rows = Rows {
            predicted: &mut self.predicted,
            measured: &mut self.measured,
            residual: &mut self.residual,
        };
        self.seen = self.beside.take(applied, reading, rows);
        self.seen.alarms
    }

    /// So many `steps` of what the last sample has left to do: that it becomes part of the history, its path, and,
    /// in a call of its own unless there is no limit, the second prediction. What was noticed.
    pub fn go_on(&mut self, steps: usize) -> Alarms {
        let used = self.seen.used.then_some(self.measured.as_slice());
        let path = self.path.as_flattened_mut();
        let alarms = self.beside.go_on(steps, &self.applied, &self.held, used, path);
        self.seen.alarms |= alarms;
        alarms
    }

    /// Whether the last sample has left nothing to do.
    pub fn is_done(&self) -> bool {
        self.beside.due == Due::Nothing
    }

    /// Forgets the residuals that have added up, not the history.
    pub fn forget_residuals(&mut self) {
        self.beside.forget_residuals();
    }
}

/// What a frame says of a sample: lists of [`Frame`](crate::control_loop::Frame), empty where there is nothing.
pub(crate) struct Told<'t> {
    pub(crate) applied: &'t [f32],
    pub(crate) measured: &'t [f32],
    pub(crate) predicted: &'t [f32],
    pub(crate) residual: &'t [f32],
    pub(crate) ahead: &'t [f32],
    pub(crate) steps: u32,
    pub(crate) bound_steps: u32,
}

/// A [`Measurement`] whose coordinates are elsewhere.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reading {
    Taken,
    Missing,
    Late,
    Unreadable,
}

/// Where the numbers of a sample are, shape `[states]`.
struct Rows<'r> {
    predicted: &'r mut [f32],
    measured: &'r mut [f32],
    residual: &'r mut [f32],
}

/// Which of them there are, and the rest of a [`Tracked`].
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    predicted: bool,
    used: bool,
    compared: bool,
    steps: u32,
    bound_steps: u32,
    ratio: f32,
    alarms: Alarms,
}

/// What a sample leaves to do, in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Due {
    History,
    Path,
    Shadow,
    Nothing,
}

/// A tracker of any number of coordinates and inputs: a controller has it once, whatever loops it runs.
#[derive(Clone, Debug)]
struct Beside<'m, 'a> {
    predictor: Predictor<'m, 'a>,
    /// Where every prediction is made: the robot at the last sample, once that has left nothing to do.
    state: PredictorState,
    /// The robot at the last sample.
    present: SavedState,
    monitor: Monitor,
    /// A prediction without corrections, its monitor, and its length.
    shadow: SavedState,
    slow: Monitor,
    shadow_steps: u32,
    /// What comes next, and rows of the path that are there.
    due: Due,
    ahead: usize,
    /// The last sample does not go on where the one before it was.
    begins_anew: bool,
    /// Nothing was forgotten since the last sample: a second prediction may begin there.
    may_begin: bool,
    /// Samples without a measurement that was used, and the most of them that are allowed.
    blind: u32,
    blind_limit: u32,
    /// Samples in a row for which nothing was predicted, and the most of them that are allowed.
    unpredicted: u32,
    unpredicted_limit: u32,
    /// Which of the last samples were predicted, a bit each, the newest the lowest, as many as the model
    /// looks at.
    guessed: u32,
    looks_at: u32,
    bad: u8,
    outliers: u8,
}

impl<'m, 'a> Beside<'m, 'a> {
    #[inline(always)]
    fn new(model: &'m Model<'a>, blind_samples: u32) -> Self {
        let lag = model.structure().lag();
        let reach = model.error_bounds().and_then(|bounds| bounds.horizons().last().copied());
        let monitor = model.error_bounds().map_or_else(Monitor::default, Monitor::new);
        let blind_limit = reach.map_or(blind_samples, |reach| reach.min(blind_samples));
        let fills = u32::try_from(lag).unwrap_or(u32::MAX).saturating_add(1);
        let shadow_steps = reach.map_or(SHADOW, |reach| reach.min(SHADOW));
        Self {
            predictor: Predictor::new(model),
            monitor,
            slow: monitor,
            shadow_steps,
            due: Due::Nothing,
            ahead: 0,
            begins_anew: false,
            may_begin: false,
            blind: 0,
            blind_limit,
            unpredicted: 0,
            unpredicted_limit: blind_limit.saturating_add(fills),
            guessed: 0,
            // At least the present sample; lags are few.
            looks_at: u32::MAX >> (31 - lag.min(31)),
            bad: 0,
            outliers: 0,
            // Last: what is large is then made in its place.
            present: SavedState::empty(),
            shadow: SavedState::empty(),
            state: PredictorState::new(),
        }
    }

    fn model(&self) -> &'m Model<'a> {
        self.predictor.model()
    }

    #[inline(never)]
    fn step(&mut self, input: &[f32]) -> Result<(), PredictError> {
        self.predictor.step(&mut self.state, input)
    }

    /// [`Tracker::take`]. A measurement that is taken is turned into (−π, π] where it lies.
    #[inline(never)]
    fn take(&mut self, applied: &[f32], reading: Reading, rows: Rows<'_>) -> Seen {
        let Rows { predicted, measured, residual } = rows;
        let mut alarms = Alarms::none();
        let mut is_predicted = false;
        match self.step(applied) {
            Ok(()) => {
                self.coordinates(predicted);
                is_predicted = true;
            }
            Err(PredictError::NotReady { .. }) => {}
            // Inputs are finite and of the right number: what is left is divergence.
            Err(_) => alarms |= Alarms::DIVERGED,
        }
        if self.state.out_of_range().is_some() {
            alarms |= Alarms::OUT_OF_RANGE;
        }
        self.unpredicted = if is_predicted { 0 } else { self.unpredicted.saturating_add(1) };
        if self.unpredicted > self.unpredicted_limit {
            alarms |= Alarms::SENSOR_LOST;
        }
        let steps = if is_predicted { self.state.step() } else { 0 };
        let guesses = (self.guessed & self.looks_at).count_ones();
        let bound_steps = if is_predicted { steps.max(1 + guesses) } else { 0 };

        let is_taken = match reading {
            Reading::Taken if measured.iter().all(|x| x.is_finite()) => {
                self.bad = 0;
                self.turn(measured);
                true
            }
            Reading::Missing => false,
            Reading::Late => {
                alarms |= Alarms::SENSOR_LATE;
                false
            }
            Reading::Taken | Reading::Unreadable => {
                self.bad = self.bad.saturating_add(1);
                if self.bad >= BAD_MEASUREMENTS {
                    alarms |= Alarms::SENSOR_BAD;
                }
                false
            }
        };
        let is_compared = is_taken && is_predicted;
        if is_compared {
            self.compare(measured, predicted, residual);
        }
        let verdict = match self.model().error_bounds() {
            Some(bounds) if is_compared => self.monitor.update(bounds, bound_steps, residual),
            _ => Verdict::default(),
        };
        if verdict.alarm {
            alarms |= Alarms::RESIDUAL;
        }
        let believed = verdict.ratio <= GATE || self.outliers >= OUTLIERS;
        if is_taken {
            self.outliers = if believed { 0 } else { self.outliers + 1 };
        }
        let is_used = is_taken && believed;
        self.guessed = (self.guessed << 1) | u32::from(!is_used);
        if is_used {
            // A robot that really is elsewhere: its history belongs to the place before.
            self.begins_anew = verdict.ratio > GATE;
            if self.begins_anew {
                self.guessed = 0;
            }
            self.blind = 0;
        } else {
            // A gap in a history that was not full, or no prediction.
            self.begins_anew = !is_predicted;
            if is_taken {
                alarms |= Alarms::OUTLIER;
            }
            self.blind = self.blind.saturating_add(1);
            if self.blind > self.blind_limit {
                alarms |= Alarms::SENSOR_LOST;
            }
        }
        (self.due, self.ahead, self.may_begin) = (Due::History, 0, true);
        Seen {
            predicted: is_predicted,
            used: is_used,
            compared: is_compared,
            steps,
            bound_steps,
            ratio: verdict.ratio,
            alarms,
        }
    }

    /// Makes a sample part of the history, measured or else as it was predicted.
    fn settle(&mut self, applied: &[f32], used: Option<&[f32]>) {
        if self.begins_anew {
            self.state.clear();
        } else if used.is_some() {
            self.present.restore(&mut self.state);
        }
        if let Some(measured) = used {
            // Finite, and of the right length: it cannot be refused.
            let _ = self.predictor.observe(&mut self.state, applied, measured);
        }
        self.present.save(&self.state);
    }

    /// The next sample comes before all is done.
    #[cold]
    #[inline(never)]
    fn drop_rest(&mut self, applied: &[f32], used: Option<&[f32]>) {
        match self.due {
            Due::History => self.settle(applied, used),
            _ => self.present.restore(&mut self.state),
        }
        self.shadow.clear();
    }

    /// [`Tracker::go_on`].
    #[inline(never)]
    fn go_on(
        &mut self,
        steps: usize,
        applied: &[f32],
        held: &[f32],
        used: Option<&[f32]>,
        path: &mut [f32],
    ) -> Alarms {
        let mut alarms = Alarms::none();
        let states = self.model().structure().states().len();
        let mut left = steps;
        while left > 0 {
            match self.due {
                Due::History => {
                    self.settle(applied, used);
                    self.due = Due::Path;
                    left -= 1;
                }
                Due::Path => {
                    let start = self.ahead.saturating_mul(states);
                    let place = path.get_mut(start..).and_then(|rest| rest.get_mut(..states));
                    match place.map(|place| (self.step(held), place)) {
                        Some((Ok(()), place)) => {
                            self.coordinates(place);
                            self.ahead += 1;
                            left -= 1;
                        }
                        Some((Err(error), _)) => {
                            self.due = Due::Shadow;
                            if !matches!(error, PredictError::NotReady { .. }) {
                                alarms |= Alarms::DIVERGED;
                            }
                        }
                        None => self.due = Due::Shadow,
                    }
                }
                // It takes more than a step.
                Due::Shadow if left < steps && steps < usize::MAX => break,
                Due::Shadow => {
                    self.due = Due::Nothing;
                    if self.follow(applied, used) {
                        alarms |= Alarms::RESIDUAL;
                    }
                }
                Due::Nothing => break,
            }
        }
        alarms
    }

    /// Moves the second prediction on; at its end, whether it has been too far off too often.
    fn follow(&mut self, applied: &[f32], used: Option<&[f32]>) -> bool {
        self.shadow.restore(&mut self.state);
        let mut alarm = false;
        let mut is_over = true;
        // An error: its history is not full, or it diverged, which the first prediction does not miss.
        if self.step(applied).is_ok() {
            is_over = self.state.step() >= self.shadow_steps;
            if !is_over {
                self.shadow.save(&self.state);
            } else if let (Some(x), Some(bounds)) = (used, self.model().error_bounds()) {
                let (mut expected, mut residual) = ([0.0; MAX_STATES], [0.0; MAX_STATES]);
                // No model has more states.
                let expected = expected.get_mut(..x.len()).unwrap_or_default();
                let residual = residual.get_mut(..x.len()).unwrap_or_default();
                self.coordinates(expected);
                self.compare(x, expected, residual);
                alarm = self.slow.update(bounds, self.state.step(), residual).alarm;
            }
        }
        self.present.restore(&mut self.state);
        // It starts from measurements alone: what it is compared with are the bounds of those.
        match self.guessed & self.looks_at {
            _ if !is_over => {}
            0 if self.may_begin => self.shadow.save(&self.state),
            _ => self.shadow.clear(),
        }
        alarm
    }

    fn forget_residuals(&mut self) {
        self.monitor.reset();
        self.slow.reset();
        self.shadow.clear();
        self.may_begin = false;
    }

    #[inline(never)]
    fn coordinates(&self, out: &mut [f32]) {
        // Of the right length: it cannot be refused.
        let _ = self.predictor.coordinates(&self.state, out);
    }

    /// Coordinates with angles in (−π, π]: sensors count turns, and the trainer wraps the angles of a
    /// log before it narrows them to f32.
    fn turn(&self, x: &mut [f32]) {
        for (x, state) in x.iter_mut().zip(self.model().structure().states()) {
            if state.space == Space::Circle {
                *x = x.wrap();
            }
        }
    }

    /// Measured − predicted.
    #[inline(never)]
    fn compare(&self, measured: &[f32], predicted: &[f32], residual: &mut [f32]) {
        let pairs = measured.iter().zip(predicted).zip(self.model().structure().states());
        for (to, ((x, expected), state)) in residual.iter_mut().zip(pairs) {
            *to = state.space.difference(*x, *expected);
        }
    }
}
