//! Whether what is measured is what the model says.
//!
//! A residual is compared with the model's own error bound for as many steps as were predicted: the
//! ratio r = |measured − predicted| / bound. Per state a cumulative sum (Page 1954, "Continuous
//! inspection schemes", Biometrika 41) adds up what is beyond the bound,
//!
//! ```text
//! s ← max(0, s + min(r, CAP) − 1),   alarm while s > THRESHOLD
//! ```
//!
//! so that an error that stays at r times its bound is noticed after THRESHOLD / (r − 1) samples, however
//! small the excess, while single samples beyond the bound are forgotten.

use crate::capacity::MAX_STATES;
use crate::error_bounds::ErrorBounds;

/// The most that one sample counts, in bounds.
pub const CAP: f32 = 4.0;
/// The sum from which on there is an alarm, in bounds: one wild sample is not enough, two are.
pub const THRESHOLD: f32 = 5.0;
/// A single sample this many bounds off is not believed.
pub const GATE: f32 = 8.0;

/// The sums.
///
/// ```
/// use firmware_core::control_loop::monitor::Monitor;
/// use firmware_core::error_bounds::ErrorBounds;
/// let bounds = ErrorBounds::new(1, 0.999, 2000, &[1, 2], &[0.1, 0.15]).unwrap();
/// let mut monitor = Monitor::default();
/// // An error of 0.15 after one step is 1.5 bounds: beyond 5 in eleven samples.
/// let noticed = (1..100).find(|_| monitor.update(bounds, 1, &[0.15]).alarm);
/// assert_eq!(noticed, Some(11));
/// // After two steps it is within its bound.
/// let mut monitor = Monitor::default();
/// assert!((1..100).all(|_| !monitor.update(bounds, 2, &[0.15]).alarm));
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Monitor {
    sums: [f32; MAX_STATES],
}

/// What a residual says.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Verdict {
    /// The largest residual as a multiple of its bound.
    pub ratio: f32,
    /// Errors beyond the bounds have added up.
    pub alarm: bool,
}

impl Monitor {
    /// Takes the residuals of one sample, shape `[states]` in the states' units, `steps` after the last
    /// measurement; beyond the last horizon the bounds of that hold.
    pub fn update(&mut self, bounds: ErrorBounds<'_>, steps: u32, residuals: &[f32]) -> Verdict {
        let last = bounds.horizons().last().copied().unwrap_or(0);
        let mut verdict = Verdict::default();
        for ((i, residual), sum) in residuals.iter().enumerate().zip(&mut self.sums) {
            let bound = bounds.bound(steps.min(last), i).unwrap_or(0.0);
            // A bound of 0 is one of a state that never erred; NaN counts as infinitely far off.
            let ratio = residual.abs() / bound.max(f32::MIN_POSITIVE);
            let ratio = if ratio.is_nan() { f32::INFINITY } else { ratio };
            *sum = (*sum + ratio.min(CAP) - 1.0).max(0.0);
            // What has been wrong for long must not take as long to be forgotten.
            *sum = sum.min(2.0 * THRESHOLD);
            verdict.ratio = verdict.ratio.max(ratio);
            verdict.alarm |= *sum > THRESHOLD;
        }
        verdict
    }

    /// Forgets everything.
    pub fn reset(&mut self) {
        *self = Self::default();
    }
}
