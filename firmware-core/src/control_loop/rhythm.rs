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
use crate::control_loop::supervisor::Supervisor;
use crate::control_loop::telemetry::{Frame, Telemetry};
use crate::control_loop::tracker::Tracker;

/// What a loop with several ticks per sample keeps of them, and its `M` inputs' sums.
#[derive(Clone, Debug)]
pub struct Rhythm<const M: usize> {
    ticks_per_sample: u8,
    /// How far a tick goes on with what the last sample has left to do.
    steps: usize,
    /// Ticks since the last sample.
    ticks: u8,
    /// Sum of what acted over them.
    sum: [f32; M],
    /// The last sample has left nothing to do since the tick before.
    is_done: bool,
    /// When the sample was whose frame is still to be sent (µs).
    unsent_us: Option<u64>,
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
        let steps = steps_per_tick(ticks_per_sample, ahead);
        Ok(Self {
            ticks_per_sample,
            steps,
            ticks: 0,
            sum: [0.0; M],
            is_done: true,
            unsent_us: None,
        })
    }

    /// Whether this tick is a sample.
    pub fn is_sample(&self) -> bool {
        self.ticks == 0 || self.ticks >= self.ticks_per_sample
    }

    /// Ticks since the last sample, at least 1, as a number to divide by.
    pub fn ticks(&self) -> f32 {
        f32::from(self.ticks.max(1))
    }

    /// A sample at `now_us`: what acted since the one before it, on average.
    pub fn sample(&mut self, now_us: u64) -> [f32; M] {
        let ticks = self.ticks();
        let mean = self.sum.map(|sum| sum / ticks);
        (self.sum, self.ticks) = ([0.0; M], 0);
        self.unsent_us = Some(now_us);
        mean
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
            supervisor.judge(noticed, tracker);
            self.is_done = at_once;
        }
    }

    /// The tick ends: what `acts` from here on; and the last sample's frame, once it is complete.
    pub fn end<const N: usize, const H: usize>(
        &mut self,
        acts: [f32; M],
        tracker: &Tracker<'_, '_, N, M, H>,
        supervisor: &mut Supervisor,
        telemetry: &mut Telemetry<'_>,
    ) {
        for (sum, u) in self.sum.iter_mut().zip(acts) {
            *sum += u;
        }
        self.ticks = self.ticks.saturating_add(1);
        if self.is_done
            && telemetry.is_on()
            && let Some(time_us) = self.unsent_us.take()
        {
            telemetry.send(supervisor.report(Frame::of(time_us, tracker)));
        }
    }
}

/// How far each tick goes on, so that all is done before the next sample; as far as it goes where ticks are few.
const fn steps_per_tick(ticks_per_sample: u8, ahead: usize) -> usize {
    match ticks_per_sample {
        0..=3 => usize::MAX,
        // Those but the sample, the second prediction and the frame. The sample itself is to be taken, too.
        ticks => ahead.saturating_add(1).div_ceil(ticks as usize - 3),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_steps_are_made_before_the_next_sample() {
        for ahead in 0..60_usize {
            for ticks in 1..=255 {
                let steps = steps_per_tick(ticks, ahead);
                assert!(steps > 0);
                if steps < usize::MAX {
                    let path = (ahead + 1).div_ceil(steps);
                    assert!(1 + path + 2 <= ticks.into(), "{ahead} samples, {ticks} ticks");
                }
            }
        }
        assert_eq!(steps_per_tick(10, 10), 2);
        assert_eq!(steps_per_tick(25, 20), 1);
        assert_eq!(steps_per_tick(1, 20), usize::MAX);
    }
}
