//! Seeded input signals that make a robot show its dynamics.

use crate::normal::standard_normal;
use rand::{Rng, RngExt};
use std::ops::RangeInclusive;

/// The random signal on every input of a robot, independent from input to input.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Signal {
    /// A new level from N(0, `std`²) for every sample, clipped to ±`limit`.
    Gaussian {
        /// Standard deviation, in the unit of the input.
        std: f64,
        /// Largest size, in the unit of the input, above 0; infinite for no limit.
        limit: f64,
    },
    /// Levels held for a random number of samples.
    Steps {
        /// Largest size: levels are uniform in ±`limit`, in the unit of the input.
        limit: f64,
        /// Share of the levels that are exactly 0 instead.
        zero_share: f64,
        /// Samples for which a level is held, uniform; not empty.
        hold: RangeInclusive<u32>,
    },
}

/// A signal on `INPUTS` inputs, as it unfolds.
///
/// Levels are rounded to a fixed number of decimals, as a command on a serial line is: what a log
/// shows is then exactly what acted.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Excitation<const INPUTS: usize> {
    signal: Signal,
    decimals: u8,
    level: [f64; INPUTS],
    samples_left: [u32; INPUTS],
}

impl<const INPUTS: usize> Excitation<INPUTS> {
    /// The signal from its beginning, rounded to `decimals` decimals.
    pub(crate) fn new(signal: Signal, decimals: u8) -> Self {
        Self { signal, decimals, level: [0.0; INPUTS], samples_left: [0; INPUTS] }
    }

    /// The input over the next sample.
    pub(crate) fn next(&mut self, rng: &mut impl Rng) -> [f64; INPUTS] {
        for (level, samples_left) in self.level.iter_mut().zip(&mut self.samples_left) {
            if *samples_left == 0 {
                let (drawn, hold) = match &self.signal {
                    Signal::Gaussian { std, limit } => {
                        ((std * standard_normal(rng)).clamp(-limit, *limit), 1)
                    }
                    Signal::Steps { limit, zero_share, hold } => {
                        let is_zero = rng.random::<f64>() < *zero_share;
                        let drawn = limit * (2.0 * rng.random::<f64>() - 1.0);
                        let samples = rng.random_range(hold.clone());
                        (if is_zero { 0.0 } else { drawn }, samples)
                    }
                };
                *level = round_to(drawn, self.decimals);
                *samples_left = hold;
            }
            *samples_left = samples_left.saturating_sub(1);
        }
        self.level
    }
}

/// The number with at most `decimals` decimals nearest to `value`, never −0.
///
/// Numbers too large to have that many decimals in an f64 come back as they are.
pub(crate) fn round_to(value: f64, decimals: u8) -> f64 {
    /// 2⁵³, from where on every f64 is a whole number.
    const WHOLE: f64 = 9_007_199_254_740_992.0;
    let scale = (0..decimals).fold(1.0, |power, _| power * 10.0);
    let scaled = value * scale;
    if scaled.abs() < WHOLE { scaled.round() / scale + 0.0 } else { value }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn rounding_gives_the_nearest_short_decimal() {
        assert_eq!(round_to(1.234_567_8, 6), 1.234_568);
        assert_eq!(round_to(-0.000_000_4, 6).to_string(), "0");
        assert_eq!(round_to(0.1 + 0.2, 15).to_string(), "0.3");
        assert_eq!(round_to(1e300, 6), 1e300);
        assert_eq!(round_to(2.5, 0), 3.0);
        assert!(round_to(f64::NAN, 3).is_nan());
    }

    #[test]
    fn gaussian_levels_are_clipped_and_change_every_sample() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let signal = Signal::Gaussian { std: 9.0, limit: 10.0 };
        let mut excitation = Excitation::<2>::new(signal, 3);
        let samples: Vec<_> = (0..1000).map(|_| excitation.next(&mut rng)).collect();
        assert!(samples.iter().flatten().all(|u| u.abs() <= 10.0));
        // P(|u| > 10 | σ = 9) = 0.27 per input.
        let clipped = samples.iter().flatten().filter(|u| u.abs() == 10.0).count();
        assert!((440..640).contains(&clipped), "{clipped}");
        let free = |u: f64| u.abs() < 10.0;
        assert!(samples.windows(2).all(|w| !free(w[0][0]) || w[0][0] != w[1][0]));
    }

    #[test]
    fn steps_keep_their_hold_times_and_their_share_of_zeros() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let signal = Signal::Steps { limit: 12.0, zero_share: 0.2, hold: 4..=20 };
        let mut excitation = Excitation::<1>::new(signal, 2);
        let levels: Vec<f64> = (0..24_000).map(|_| excitation.next(&mut rng)[0]).collect();
        let runs: Vec<&[f64]> = levels.chunk_by(|a, b| a == b).collect();
        let runs = &runs[..runs.len() - 1];
        // Two zeros in a row merge into one longer run.
        assert!(runs.iter().all(|run| run.len() >= 4));
        assert!(runs.iter().all(|run| run[0] == 0.0 || run.len() <= 20));
        assert!(levels.iter().all(|u| u.abs() <= 12.0));
        let zeros = levels.iter().filter(|u| **u == 0.0).count() as f64 / levels.len() as f64;
        assert!((zeros - 0.2).abs() < 0.05, "{zeros}");
        let negative = levels.iter().filter(|u| **u < 0.0).count() as f64 / levels.len() as f64;
        assert!((negative - 0.4).abs() < 0.05, "{negative}");
    }
}
