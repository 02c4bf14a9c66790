//! The model beside the robot: once per sample it predicts where the robot is now, takes what is
//! measured, and looks ahead.
//!
//! What is measured is compared twice: with the prediction from the last measurement, where sudden things
//! show (a spike, wheels that slip), and every [`SHADOW`] samples with a second prediction that has not
//! been corrected since, where slow ones do (a leak, a valve that is stuck, a sensor that stands still). The
//! second one begins where all samples that the model looks at are measured: with gaps closer together
//! than that, only the first one watches.

use crate::capacity::MAX_STATES;
use crate::control_loop::ControlLoopError;
use crate::control_loop::monitor::{GATE, Monitor, Verdict};
use crate::control_loop::supervisor::Alarms;
use crate::device::PositionSensor;
use crate::model::{Model, Space};
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
#[derive(Clone, Debug)]
pub struct Tracker<'m, 'a, const N: usize, const M: usize, const H: usize> {
    beside: Beside<'m, 'a>,
    path: [[f32; N]; H],
    /// How much of the path is there.
    ahead: usize,
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
        for (field, expected, found) in
            [("states", N, structure.states().len()), ("inputs", M, structure.inputs().len())]
        {
            if expected != found {
                return Err(ControlLoopError::DimensionMismatch { field, expected, found });
            }
        }
        Ok(Self { beside: Beside::new(model, blind_samples), path: [[0.0; N]; H], ahead: 0 })
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
        blind == 0 && unpredicted <= unpredicted_limit && !self.beside.state.history().is_empty()
    }

    /// Where the robot will be at each of the coming samples with the inputs held; shorter than `H`
    /// when the prediction diverges on the way, empty while the history fills.
    pub fn path(&self) -> &[[f32; N]] {
        self.path.get(..self.ahead).unwrap_or(&[])
    }

    /// Takes a sample: what was `applied` since the one before it, on average, and what is `measured`
    /// now; then looks ahead with the inputs `held`.
    pub fn sample(
        &mut self,
        applied: &[f32; M],
        measured: Measurement<N>,
        held: &[f32; M],
    ) -> Tracked<N> {
        let (mut predicted, mut residual) = ([0.0; N], [0.0; N]);
        let (reading, mut measured) = match measured {
            Measurement::Taken(coordinates) => (Reading::Taken, coordinates),
            Measurement::Missing => (Reading::Missing, [0.0; N]),
            Measurement::Late => (Reading::Late, [0.0; N]),
            Measurement::Unreadable => (Reading::Unreadable, [0.0; N]),
        };
        let rows = Rows {
            predicted: &mut predicted,
            measured: &mut measured,
            residual: &mut residual,
            path: self.path.as_flattened_mut(),
        };
        let seen = self.beside.sample(applied, reading, held, rows);
        self.ahead = seen.ahead;
        Tracked {
            predicted: seen.predicted.then_some(predicted),
            measured: seen.used.then_some(measured),
            residual: seen.compared.then_some(residual),
            steps: seen.steps,
            bound_steps: seen.bound_steps,
            ratio: seen.ratio,
            alarms: seen.alarms,
        }
    }

    /// Forgets the residuals that have added up, not the history.
    pub fn forget_residuals(&mut self) {
        self.beside.forget_residuals();
    }
}

/// A [`Measurement`] whose coordinates are elsewhere.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reading {
    Taken,
    Missing,
    Late,
    Unreadable,
}

/// Where the numbers of a sample are, shape `[states]`, and its path, shape `[samples, states]`.
struct Rows<'r> {
    predicted: &'r mut [f32],
    measured: &'r mut [f32],
    residual: &'r mut [f32],
    path: &'r mut [f32],
}

/// Which of them there are, and the rest of a [`Tracked`].
#[derive(Clone, Copy, Debug)]
struct Seen {
    predicted: bool,
    used: bool,
    compared: bool,
    ahead: usize,
    steps: u32,
    bound_steps: u32,
    ratio: f32,
    alarms: Alarms,
}

/// A tracker of any number of coordinates and inputs: a controller has it once, whatever loops it runs.
#[derive(Clone, Debug)]
struct Beside<'m, 'a> {
    predictor: Predictor<'m, 'a>,
    state: PredictorState,
    /// Where the next samples are predicted; nothing in it is kept.
    trial: PredictorState,
    monitor: Monitor,
    /// A prediction without corrections, its monitor, and its length.
    shadow: PredictorState,
    slow: Monitor,
    shadow_steps: u32,
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
            blind: 0,
            blind_limit,
            unpredicted: 0,
            unpredicted_limit: blind_limit.saturating_add(fills),
            guessed: 0,
            // At least the present sample; lags are few.
            looks_at: u32::MAX >> (31 - lag.min(31)),
            bad: 0,
            outliers: 0,
            // Last: what is a kilobyte each is then made in its place.
            state: PredictorState::new(),
            trial: PredictorState::new(),
            shadow: PredictorState::new(),
        }
    }

    fn model(&self) -> &'m Model<'a> {
        self.predictor.model()
    }

    /// [`Tracker::sample`]. A measurement that is taken is turned into (−π, π] where it lies.
    #[inline(never)]
    fn sample(&mut self, applied: &[f32], reading: Reading, held: &[f32], rows: Rows<'_>) -> Seen {
        let Rows { predicted, measured, residual, path } = rows;
        let mut alarms = Alarms::none();
        self.trial.clone_from(&self.state);
        let mut is_predicted = false;
        match self.predictor.step(&mut self.trial, applied) {
            Ok(()) => {
                self.coordinates(&self.trial, predicted);
                is_predicted = true;
            }
            Err(PredictError::NotReady { .. }) => {}
            // Inputs are finite and of the right number: what is left is divergence.
            Err(_) => alarms |= Alarms::DIVERGED,
        }
        if self.trial.out_of_range().is_some() {
            alarms |= Alarms::OUT_OF_RANGE;
        }
        self.unpredicted = if is_predicted { 0 } else { self.unpredicted.saturating_add(1) };
        if self.unpredicted > self.unpredicted_limit {
            alarms |= Alarms::SENSOR_LOST;
        }
        let steps = if is_predicted { self.trial.step() } else { 0 };
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
        if self.beside(applied, is_used.then_some(&*measured)) {
            alarms |= Alarms::RESIDUAL;
        }
        self.guessed = (self.guessed << 1) | u32::from(!is_used);
        if is_used {
            if verdict.ratio > GATE {
                // The robot really is elsewhere: its history belongs to the place before.
                self.state.clear();
                self.guessed = 0;
            }
            // Finite, and of the right length: it cannot be refused.
            let _ = self.predictor.observe(&mut self.state, applied, measured);
            self.blind = 0;
        } else {
            if is_taken {
                alarms |= Alarms::OUTLIER;
            }
            self.blind = self.blind.saturating_add(1);
            if self.blind > self.blind_limit {
                alarms |= Alarms::SENSOR_LOST;
            }
            // A gap in a history that was not full, or no prediction: begin anew.
            if is_predicted {
                self.state.clone_from(&self.trial);
            } else {
                self.state.clear();
            }
        }

        if self.shadow.step() >= self.shadow_steps || self.shadow.history().is_empty() {
            // It starts from measurements alone: what it is compared with are the bounds of those.
            match self.guessed & self.looks_at {
                0 => self.shadow.clone_from(&self.state),
                _ => self.shadow.clear(),
            }
        }

        self.trial.clone_from(&self.state);
        let mut ahead = 0;
        for place in path.chunks_exact_mut(predicted.len().max(1)) {
            match self.predictor.step(&mut self.trial, held) {
                Ok(()) => {}
                Err(PredictError::NotReady { .. }) => break,
                Err(_) => {
                    alarms |= Alarms::DIVERGED;
                    break;
                }
            }
            self.coordinates(&self.trial, place);
            ahead += 1;
        }
        Seen {
            predicted: is_predicted,
            used: is_used,
            compared: is_compared,
            ahead,
            steps,
            bound_steps,
            ratio: verdict.ratio,
            alarms,
        }
    }

    /// Moves the second prediction on; at its end, whether it has been too far off too often.
    fn beside(&mut self, applied: &[f32], used: Option<&[f32]>) -> bool {
        if self.predictor.step(&mut self.shadow, applied).is_err() {
            // Its history is not full, or it diverged, which the first prediction does not miss.
            self.shadow.clear();
            return false;
        }
        if self.shadow.step() < self.shadow_steps {
            return false;
        }
        let (Some(x), Some(bounds)) = (used, self.model().error_bounds()) else { return false };
        let (mut expected, mut residual) = ([0.0; MAX_STATES], [0.0; MAX_STATES]);
        // No model has more states.
        let expected = expected.get_mut(..x.len()).unwrap_or_default();
        let residual = residual.get_mut(..x.len()).unwrap_or_default();
        self.coordinates(&self.shadow, expected);
        self.compare(x, expected, residual);
        self.slow.update(bounds, self.shadow.step(), residual).alarm
    }

    fn forget_residuals(&mut self) {
        self.monitor.reset();
        self.slow.reset();
        self.shadow.clear();
    }

    #[inline(never)]
    fn coordinates(&self, state: &PredictorState, out: &mut [f32]) {
        // Of the right length: it cannot be refused.
        let _ = self.predictor.coordinates(state, out);
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
