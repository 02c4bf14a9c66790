//! What a loop tells the host: one frame per sample of the model.
//!
//! Frames in a row are a log for the trainer: the row of a frame holds its `measured` coordinates and
//! the `applied` inputs of the frame after it, which act from the one to the other. A frame without a
//! measurement, or a missing sequence number, ends a trajectory.

use heapless::Vec;
use heapless::spsc;
use serde::{Deserialize, Serialize};

use crate::capacity::{MAX_INPUTS, MAX_STATES};
use crate::control_loop::supervisor::{Alarms, Mode, Report};
use crate::control_loop::tracker::{Told, Tracker};
use crate::encoding::Writer;

/// One sample.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Number of the sample, counted on also when a frame is dropped; wraps.
    pub sequence: u32,
    /// Time of the sample (µs).
    pub time_us: u64,
    /// What the loop was doing after the tick of the sample, however much later the frame is sent.
    pub mode: Mode,
    /// What was noticed since the last start or reset.
    pub alarms: Alarms,
    /// What was noticed since the frame before.
    pub noticed: Alarms,
    /// Mean inputs that acted since the sample before, in the model's order and units.
    pub applied: Vec<f32, MAX_INPUTS>,
    /// Coordinates as measured now, in the model's order and units; empty without a measurement that was
    /// used.
    pub measured: Vec<f32, MAX_STATES>,
    /// Coordinates that the model predicted for now; empty while its history fills.
    pub predicted: Vec<f32, MAX_STATES>,
    /// Measured − predicted, angles on the circle; empty where one of them is missing. It is here for
    /// measurements, too, that were not believed.
    pub residual: Vec<f32, MAX_STATES>,
    /// Steps predicted since the last measurement that was used.
    pub steps: u32,
    /// Steps whose error bound holds for the prediction.
    pub bound_steps: u32,
    /// Coordinates that the model predicts for the end of its horizon; empty without them.
    pub ahead: Vec<f32, MAX_STATES>,
    /// The longest tick since the frame before (µs).
    pub worst_tick_us: u32,
    /// Frames dropped so far.
    pub dropped: u32,
}

/// A list of a slice, which is not longer than its capacity.
#[inline(never)]
fn list<const C: usize>(numbers: &[f32]) -> Vec<f32, C> {
    numbers.iter().copied().take(C).collect()
}

/// The sending end of the queue between a loop and its transmitter: it never waits.
///
/// ```
/// use firmware_core::control_loop::telemetry::{Frame, Queue, Telemetry};
/// let mut queue = Queue::<3>::new(); // room for two
/// let (producer, mut consumer) = queue.split();
/// let mut telemetry = Telemetry::new(producer);
/// for _ in 0..5 {
///     telemetry.send(Frame::default());
/// }
/// assert_eq!(telemetry.dropped(), 3);
/// assert_eq!([consumer.dequeue().unwrap().sequence, consumer.dequeue().unwrap().sequence], [0, 1]);
/// telemetry.send(Frame::default());
/// let frame = consumer.dequeue().unwrap();
/// assert_eq!((frame.sequence, frame.dropped), (5, 3));
/// ```
pub struct Telemetry<'q> {
    queue: Option<spsc::Producer<'q, Frame>>,
    sequence: u32,
    dropped: u32,
}

/// The queue between a loop and its transmitter, with room for `C` − 1 frames.
pub type Queue<const C: usize> = spsc::Queue<Frame, C>;

/// The end of the queue from which frames are sent.
pub type Frames<'q> = spsc::Consumer<'q, Frame>;

impl<'q> Telemetry<'q> {
    /// The sending end.
    pub fn new(queue: spsc::Producer<'q, Frame>) -> Self {
        Self { queue: Some(queue), sequence: 0, dropped: 0 }
    }

    /// Of a robot that nobody listens to: no frame is made.
    pub fn off() -> Self {
        Self { queue: None, sequence: 0, dropped: 0 }
    }

    /// Whether somebody listens.
    pub fn is_on(&self) -> bool {
        self.queue.is_some()
    }

    /// Numbers a frame, and puts it into the queue; drops it when the queue is full.
    #[inline(never)]
    pub fn send(&mut self, mut frame: Frame) {
        (frame.sequence, frame.dropped) = (self.sequence, self.dropped);
        self.sequence = self.sequence.wrapping_add(1);
        let Some(queue) = &mut self.queue else { return };
        if queue.enqueue(frame).is_err() {
            self.dropped = self.dropped.saturating_add(1);
        }
    }

    /// Sends the frame of a sample.
    // On a stack of its own: that of a tick lies beneath the model's steps.
    #[inline(never)]
    pub(crate) fn tell(&mut self, time_us: u64, report: Report, told: &Told<'_>) {
        self.send(Frame::told(time_us, report, told));
    }

    /// Frames dropped so far.
    pub fn dropped(&self) -> u32 {
        self.dropped
    }
}

impl Frame {
    /// The frame of the last sample of a tracker, which was at `time_us`, and what its loop reported then.
    pub fn of<const N: usize, const M: usize, const H: usize>(
        time_us: u64,
        report: Report,
        tracker: &Tracker<'_, '_, N, M, H>,
    ) -> Self {
        Self::told(time_us, report, &tracker.told())
    }

    /// [`of`](Self::of): a controller has this once, whatever loops it runs.
    #[inline(never)]
    pub(crate) fn told(time_us: u64, report: Report, told: &Told<'_>) -> Self {
        Self {
            time_us,
            mode: report.mode,
            alarms: report.alarms,
            noticed: report.noticed,
            worst_tick_us: report.worst_tick_us,
            applied: list(told.applied),
            measured: list(told.measured),
            predicted: list(told.predicted),
            residual: list(told.residual),
            ahead: list(told.ahead),
            steps: told.steps,
            bound_steps: told.bound_steps,
            ..Self::default()
        }
    }

    /// As postcard writes it.
    pub(crate) fn write(&self, to: &mut Writer<'_>) {
        let to = to.word(self.sequence).long(self.time_us).byte(self.mode as u8);
        let to = to.word(self.alarms.bits().into()).word(self.noticed.bits().into());
        let to = to.numbers(&self.applied).numbers(&self.measured);
        let to = to.numbers(&self.predicted).numbers(&self.residual);
        let to = to.word(self.steps).word(self.bound_steps).numbers(&self.ahead);
        to.word(self.worst_tick_us).word(self.dropped);
    }
}

/// A row of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Its number within its trajectory; 0 begins a new one.
    pub number: u64,
    /// Coordinates as measured.
    pub measured: Vec<f32, MAX_STATES>,
    /// Inputs that act until the next row.
    pub inputs: Vec<f32, MAX_INPUTS>,
}

/// Turns frames into the rows of a log.
///
/// Only the running robot makes rows: one that coasts to a stop after its actuators were switched off
/// moves as no input says. A frame that is missing, is not a sample time after the one before, or has no
/// measurement ends a trajectory.
///
/// ```
/// use firmware_core::control_loop::Mode;
/// use firmware_core::control_loop::telemetry::{Frame, Rows};
/// let frame = |sequence: u32, applied: f32, measured: f32| Frame {
///     sequence,
///     time_us: 100_000 * u64::from(sequence),
///     mode: Mode::Running,
///     applied: [applied].into_iter().collect(),
///     measured: [measured].into_iter().collect(),
///     ..Frame::default()
/// };
/// let mut rows = Rows::new(100_000, u64::MAX);
/// assert_eq!(rows.frame(&frame(7, 0.0, 1.0)), None); // what acts from here on is not known yet
/// let row = rows.frame(&frame(8, 2.0, 1.5)).unwrap();
/// assert_eq!((row.number, row.measured[0], row.inputs[0]), (0, 1.0, 2.0));
/// assert_eq!(rows.frame(&frame(9, 3.0, 1.8)).unwrap().number, 1);
/// assert_eq!(rows.frame(&frame(11, 3.0, 2.0)), None); // frame 10 is missing
/// assert_eq!(rows.frame(&frame(12, 4.0, 2.2)).unwrap().number, 0);
/// ```
#[derive(Clone, Debug)]
pub struct Rows {
    sample_us: u64,
    most: u64,
    /// The frame whose inputs the next one tells, and the number of its row.
    last: Option<(Frame, u64)>,
}

impl Rows {
    /// Rows of samples of `sample_us` (µs); after `most` of them a new trajectory begins.
    pub fn new(sample_us: u32, most: u64) -> Self {
        Self { sample_us: sample_us.into(), most, last: None }
    }

    /// Takes a frame; the row of the one before it.
    pub fn frame(&mut self, frame: &Frame) -> Option<Row> {
        let before = self.last.take().filter(|(last, _)| {
            // A fiftieth of a sample is more than any clock is off.
            let step_us = frame.time_us.checked_sub(last.time_us);
            last.sequence.wrapping_add(1) == frame.sequence
                && step_us.is_some_and(|us| us.abs_diff(self.sample_us) < self.sample_us / 50)
        });
        // Its inputs acted also when the loop has just stopped.
        let row = before.map(|(last, number)| Row {
            number,
            measured: last.measured,
            inputs: frame.applied.clone(),
        });
        if frame.mode == Mode::Running && !frame.measured.is_empty() {
            let next = row.as_ref().map_or(0, |row| row.number.saturating_add(1));
            self.last = Some((frame.clone(), if next < self.most { next } else { 0 }));
        }
        row
    }
}
