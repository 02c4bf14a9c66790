//! Which ticks are samples of the model, what acted from one to the next, and what the ticks between them do.
//!
//! | tick | work |
//! |---|---|
//! | sample | the robot is predicted, measured and compared |
//! | those after it | the path ahead, as many steps at each as it takes |
//! | then one | the second prediction |
//! | then one | the frame for the host |
//!
//! So no tick takes much longer than another. With fewer than four ticks per sample all of it is done at the
//! sample.

use crate::control_loop::ControlLoopError;
use crate::control_loop::supervisor::{Report, Supervisor};
use crate::control_loop::telemetry::Telemetry;
use crate::control_loop::tracker::Tracker;

/// What a loop with `M` inputs and several ticks per sample keeps of them.
#[derive(Clone, Debug)]
pub struct Rhythm<const M: usize> {
    ticks_per_sample: u8,
    /// How far a tick goes on with what the last sample has left to do.
    steps: usize,
    /// Ticks since the last sample.
    ticks: u8,
    /// Mean of what acted over them.
    mean: [f32; M],
    /// The last sample has left nothing to do since the tick before.
    is_done: bool,
    /// When the last sample was (µs), and what is to be reported of it, if it is still to be.
    time_us: u64,
    report: Option<Report>,
}

impl<const M: usize> Rhythm<M> {
    /// Of a loop that looks `ahead` so many samples. The first tick is a sample, and every `ticks_per_sample`th
    /// from there on.
    ///
    /// # Errors
    /// [`ControlLoopError::Setting`] for no tick per sample.
    pub fn new(ticks_per_sample: u8, ahead: usize) -> Result<Self, ControlLoopError> {
        if ticks_per_sample == 0 {
            return Err(ControlLoopError::Setting { field: "ticks_per_sample" });
        }
        let steps =
            if ticks_per_sample < FEW { usize::MAX } else { most_steps(ticks_per_sample, ahead) };
        Ok(Self {
            ticks_per_sample,
            steps,
            ticks: 0,
            mean: [0.0; M],
            is_done: true,
            time_us: 0,
            report: None,
        })
    }

    /// A tick begins; `applied` acted since the one before. Whether it is a sample.
    pub fn begin(&mut self, applied: [f32; M]) -> bool {
        let ticks = self.ticks();
        for (mean, u) in self.mean.iter_mut().zip(applied) {
            // The mean of equal inputs is exactly those.
            *mean += (u - *mean) / ticks;
        }
        self.ticks == 0 || self.ticks >= self.ticks_per_sample
    }

    /// Ticks since the last sample, at least 1, as a number to divide by.
    pub fn ticks(&self) -> f32 {
        f32::from(self.ticks.max(1))
    }

    /// A sample at `now_us`: what acted since the one before it, on average.
    pub fn sample(&mut self, now_us: u64) -> [f32; M] {
        (self.ticks, self.time_us) = (0, now_us);
        core::mem::replace(&mut self.mean, [0.0; M])
    }

    /// Goes on with what the last sample has left to do for this tick.
    pub fn go_on<const N: usize, const H: usize>(
        &mut self,
        tracker: &mut Tracker<'_, '_, N, M, H>,
        supervisor: &mut Supervisor,
    ) {
        self.is_done = tracker.is_done();
        let is_sample = self.ticks == 0;
        let at_once = self.steps == usize::MAX;
        if !self.is_done && (!is_sample || at_once) {
            let noticed = tracker.go_on(self.steps);
            let raised = supervisor.judge(noticed, tracker);
            if let Some(report) = &mut self.report {
                // It is the sample that tells.
                report.noticed |= raised;
                report.alarms |= raised;
                supervisor.reported(raised);
            }
            self.is_done = at_once;
        }
    }

    /// The tick ends: the last sample's frame is sent, once it is complete. It says how things were at the end of the
    /// sample's tick, and what the model has noticed since then.
    pub fn end<const N: usize, const H: usize>(
        &mut self,
        tracker: &Tracker<'_, '_, N, M, H>,
        supervisor: &mut Supervisor,
        telemetry: &mut Telemetry<'_>,
    ) {
        if self.ticks == 0 && telemetry.is_on() {
            self.report = Some(supervisor.report());
        }
        self.ticks = self.ticks.saturating_add(1);
        if self.is_done
            && let Some(report) = self.report.take()
        {
            telemetry.tell(self.time_us, report, &tracker.told());
        }
    }
}

/// With fewer ticks per sample nothing is spread over them.
const FEW: u8 = 4;

/// The most steps of the model that a tick makes, of a loop that looks `ahead` so many samples.
///
/// ```
/// use firmware_core::control_loop::rhythm::most_steps;
/// assert_eq!(most_steps(10, 10), 2); // the ROSbot's loop
/// assert_eq!(most_steps(25, 20), 1); // the soft leg's
/// assert_eq!(most_steps(1, 10), 12); // to the sample, ten ahead, and the second prediction's
/// ```
pub const fn most_steps(ticks_per_sample: u8, ahead: usize) -> usize {
    match ticks_per_sample.checked_sub(FEW - 1) {
        None | Some(0) => ahead.saturating_add(2),
        // Ticks but the sample, the second prediction and the frame; the sample's measurement is as a step.
        Some(ticks) => ahead.saturating_add(1).div_ceil(ticks as usize),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_steps_are_made_before_the_next_sample() {
        for ahead in 0..60_usize {
            for ticks in 1..=255 {
                let steps = most_steps(ticks, ahead);
                assert!(steps > 0);
                if ticks >= FEW {
                    let path = (ahead + 1).div_ceil(steps);
                    assert!(1 + path + 2 <= ticks.into(), "{ahead} samples, {ticks} ticks");
                }
            }
        }
    }
}
