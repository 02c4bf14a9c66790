//! Whether what is measured is what the model says.
//!
//! A residual is compared with the model's own error bound for as many steps as were predicted: the
//! ratio r = |measured − predicted| / bound. Two cumulative sums (Page 1954, "Continuous inspection
//! schemes", Biometrika 41) add up what is beyond the bounds.
//!
//! **How far**, per state:
//!
//! ```text
//! s ← max(0, s + min(r, CAP) − 1),   alarm while s > FAR
//! ```
//!
//! An error that stays at r times its bound is noticed after FAR / (r − 1) samples, however small the
//! excess, while single samples beyond the bound are forgotten.
//!
//! **How often**, over all states: the logarithm of the ratio of two probabilities of being beyond some
//! bound, p₁ of a robot that has changed and p₀ of one that has not,
//!
//! ```text
//! s ← max(0, s + ln(p₁/p₀))              beyond,
//! s ← max(0, s + ln((1 − p₁)/(1 − p₀)))  within,     alarm while s > OFTEN
//! ```
//!
//! with p₀ = 4 × states × (1 − coverage), generous because errors come in bursts, and p₁ = 10 p₀, at most
//! 0.1. Bounds that are exceeded as a matter of course (p₀ above 0.05) have only the first sum: calibrate
//! with a coverage of 0.999 for a model that shall watch its robot.
//!
//! Neither sum grows far beyond its threshold, so that an alarm ends soon after its reason.

use crate::capacity::MAX_STATES;
use crate::control_loop::limited;
use crate::error_bounds::ErrorBounds;

/// The most that one sample counts, in bounds.
pub const CAP: f32 = 4.0;
/// The first sum's threshold, in bounds: one wild sample is not enough, two are.
pub const FAR: f32 = 5.0;
/// The second sum's threshold: five or six samples beyond the bounds out of some dozens.
pub const OFTEN: f32 = 12.0;
/// An alarm of the second sum ends after this many samples within the bounds, however long it has lasted.
pub const CALM: f32 = 10.0;
/// A single sample this many bounds off is not believed.
pub const GATE: f32 = 8.0;

/// The sums.
///
/// ```
/// use firmware_core::control_loop::monitor::Monitor;
/// use firmware_core::error_bounds::ErrorBounds;
/// let bounds = ErrorBounds::new(1, 0.9, 2000, &[1, 2], &[0.1, 0.15]).unwrap();
/// let mut monitor = Monitor::new(bounds);
/// // An error of 0.15 after one step is 1.5 bounds: beyond 5 in eleven samples.
/// let noticed = (1..100).find(|_| monitor.update(bounds, 1, &[0.15]).alarm);
/// assert_eq!(noticed, Some(11));
/// // After two steps it is within its bound.
/// let mut monitor = Monitor::new(bounds);
/// assert!((1..100).all(|_| !monitor.update(bounds, 2, &[0.15]).alarm));
///
/// // Bounds for 99.9 % are exceeded by a fifth in every tenth sample: noticed at the sixth time.
/// let bounds = ErrorBounds::new(1, 0.999, 2000, &[1], &[0.1]).unwrap();
/// let mut monitor = Monitor::new(bounds);
/// let errors = (1..100).map(|sample| if sample % 10 == 0 { 0.12 } else { 0.05 });
/// let noticed = errors.map(|error| monitor.update(bounds, 1, &[error]).alarm).position(|a| a);
/// assert_eq!(noticed, Some(59));
/// // Beyond them for a minute, it is as the model says again: ten samples later nothing is noticed.
/// (0..600).for_each(|_| _ = monitor.update(bounds, 1, &[0.12]));
/// let calm = (1..1000).find(|_| !monitor.update(bounds, 1, &[0.05]).alarm);
/// assert!(calm <= Some(11), "{calm:?}");
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Monitor {
    far: [f32; MAX_STATES],
    often: f32,
    /// What a sample beyond and one within the bounds adds to `often`.
    beyond: f32,
    within: f32,
}

/// What a residual says.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Verdict {
    /// The largest residual as a multiple of its bound.
    pub ratio: f32,
    /// Errors beyond the bounds have added up.
    pub alarm: bool,
}

/// The logarithm of a / b, 2 artanh((a − b) / (a + b)): libm's is five times as much code. After forty terms it is
/// right to the last bits for ratios up to ten.
#[inline(never)]
fn log_ratio(a: f32, b: f32) -> f32 {
    let z = (a - b) / (a + b);
    let (mut sum, mut power, mut odd) = (0.0, z, 1.0);
    while odd < 80.0 {
        sum += power / odd;
        power *= z * z;
        odd += 2.0;
    }
    2.0 * sum
}

impl Monitor {
    /// A monitor for these bounds.
    pub fn new(bounds: ErrorBounds<'_>) -> Self {
        // A coverage that rounds to 1 must not make a single sample infinitely telling.
        let p0 = 4.0 * bounds.states() as f32 * (1.0 - bounds.coverage());
        let p0 = if p0 > 1e-4 { p0 } else { 1e-4 };
        let p1 = if p0 < 0.01 { 10.0 * p0 } else { 0.1 };
        let [beyond, within] = match p0 <= 0.05 {
            true => [log_ratio(p1, p0), log_ratio(1.0 - p1, 1.0 - p0)],
            false => [0.0; 2],
        };
        Self { far: [0.0; MAX_STATES], often: 0.0, beyond, within }
    }

    /// Takes the residuals of one sample, shape `[states]` in the states' units, `steps` after the last
    /// measurement; beyond the last horizon the bounds of that hold.
    pub fn update(&mut self, bounds: ErrorBounds<'_>, steps: u32, residuals: &[f32]) -> Verdict {
        let last = bounds.horizons().last().copied().unwrap_or(0);
        let row = bounds.row(steps.min(last)).unwrap_or(&[0.0; MAX_STATES]);
        let mut verdict = Verdict::default();
        for ((residual, bound), sum) in residuals.iter().zip(row).zip(&mut self.far) {
            // A bound of 0 is one of a state that never erred; NaN counts as infinitely far off.
            let bound = if *bound > f32::MIN_POSITIVE { *bound } else { f32::MIN_POSITIVE };
            let ratio = residual.abs() / bound;
            let ratio = if ratio.is_nan() { f32::INFINITY } else { ratio };
            let counted = if ratio < CAP { ratio } else { CAP };
            // What has been wrong for long must not take as long to be forgotten.
            *sum = limited(*sum + counted - 1.0, 0.0, 2.0 * FAR);
            if ratio > verdict.ratio {
                verdict.ratio = ratio;
            }
            verdict.alarm |= *sum > FAR;
        }
        let told = if verdict.ratio > 1.0 { self.beyond } else { self.within };
        // `within` is negative, or 0 with a sum that stays there.
        self.often = limited(self.often + told, 0.0, OFTEN - CALM * self.within);
        verdict.alarm |= self.often > OFTEN;
        verdict
    }

    /// Forgets everything.
    pub fn reset(&mut self) {
        (self.far, self.often) = ([0.0; MAX_STATES], 0.0);
    }
}
