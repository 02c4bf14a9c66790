//! A sensor like motion capture.

use crate::log::{Sensor, stream};
use crate::mcu::{VirtualClock, Wire};
use firmware_core::device::{MonotonicClock, PositionSensor};
use rand_chacha::ChaCha8Rng;
use std::convert::Infallible;
use std::num::NonZeroU64;

/// How a [`MotionCapture`] measures `N` coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionCaptureSettings<const N: usize> {
    /// Time between two measurements (µs).
    pub period_us: NonZeroU64,
    /// Standard deviations of independent normal noise, in the units of the coordinates.
    pub noise_std: [f64; N],
    /// Decimals that are kept; `None` for all that an [`f32`] holds.
    pub decimals: Option<u8>,
}

impl<const N: usize> MotionCaptureSettings<N> {
    /// What is there, to the last digit.
    pub const fn exact(period_us: NonZeroU64) -> Self {
        Self { period_us, noise_std: [0.0; N], decimals: None }
    }
}

impl MotionCaptureSettings<3> {
    /// A planar pose (m, m, rad) every 100 ms, as noisy as the recorded logs: 1 mm, 1 mm, 2 mrad.
    pub const POSE: Self = Self {
        period_us: NonZeroU64::new(100_000).unwrap(),
        noise_std: Sensor::POSE.std,
        decimals: Sensor::POSE.decimals,
    };
}

impl MotionCaptureSettings<2> {
    /// A leg's tip (mm) every 50 ms, as noisy as the recorded logs: 0.1 mm.
    pub const TIP: Self = Self {
        period_us: NonZeroU64::new(50_000).unwrap(),
        noise_std: Sensor::TIP.std,
        decimals: Sensor::TIP.decimals,
    };
}

/// Measures the coordinates on a wire at the first call at or after each multiple of its period,
/// and has nothing new in between.
///
/// ```
/// use firmware_core::device::PositionSensor;
/// use firmware_sim::mcu::{MotionCapture, VirtualClock, Wire};
/// use firmware_sim::mcu::position_sensor::MotionCaptureSettings;
///
/// let (clock, tip) = (VirtualClock::new(), Wire::new([1.5, -2.0]));
/// let settings = MotionCaptureSettings::exact(50_000.try_into()?);
/// let mut sensor = MotionCapture::new(&tip, &clock, settings, 1);
/// assert_eq!(sensor.measure()?, Some([1.5, -2.0]));
/// clock.advance_us(49_999);
/// assert_eq!(sensor.measure()?, None);
/// clock.advance_us(1);
/// assert_eq!(sensor.measure()?, Some([1.5, -2.0]));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct MotionCapture<const N: usize> {
    coordinates: Wire<[f64; N]>,
    clock: VirtualClock,
    period_us: NonZeroU64,
    sensor: Sensor<N>,
    noise: ChaCha8Rng,
    due_us: u64,
}

impl<const N: usize> MotionCapture<N> {
    /// A sensor of the coordinates on the wire, with the noise of `seed`.
    pub fn new(
        coordinates: &Wire<[f64; N]>,
        clock: &VirtualClock,
        settings: MotionCaptureSettings<N>,
        seed: u64,
    ) -> Self {
        let MotionCaptureSettings { period_us, noise_std, decimals } = settings;
        Self {
            coordinates: coordinates.clone(),
            clock: clock.clone(),
            period_us,
            sensor: Sensor { std: noise_std, decimals },
            noise: stream(seed, 0),
            due_us: 0,
        }
    }
}

impl<const N: usize> PositionSensor<N> for MotionCapture<N> {
    type Error = Infallible;

    fn measure(&mut self) -> Result<Option<[f32; N]>, Infallible> {
        let now_us = self.clock.now_us();
        if now_us < self.due_us {
            return Ok(None);
        }
        self.due_us = (now_us / self.period_us + 1).saturating_mul(self.period_us.get());
        let measured = self.sensor.measure(self.coordinates.get(), &mut self.noise);
        Ok(Some(measured.map(|value| value as f32)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_its_rate_whenever_it_is_asked() {
        let (clock, wire) = (VirtualClock::new(), Wire::new([0.0]));
        let settings = MotionCaptureSettings::exact(NonZeroU64::new(100).unwrap());
        let mut sensor = MotionCapture::new(&wire, &clock, settings, 1);
        // Asked late once, it is back on its grid afterwards.
        let mut times = Vec::new();
        for step in [0, 60, 60, 60, 20, 50, 50, 250, 50] {
            clock.advance_us(step);
            if sensor.measure().unwrap().is_some() {
                times.push(clock.now_us());
            }
        }
        assert_eq!(times, [0, 120, 200, 300, 550, 600]);
    }

    #[test]
    fn noise_is_that_of_the_seed_and_rounded() {
        let (clock, wire) = (VirtualClock::new(), Wire::new([1.0, -1.0]));
        let measure = |seed| {
            let mut sensor = MotionCapture::new(&wire, &clock, MotionCaptureSettings::TIP, seed);
            sensor.measure().unwrap().unwrap()
        };
        assert_eq!(measure(7), measure(7));
        assert_ne!(measure(7), measure(8));
        let [y, z] = measure(7).map(f64::from);
        // Five standard deviations.
        assert!((y - 1.0).abs() < 0.5 && (z + 1.0).abs() < 0.5);
        assert!((y * 1e4 - (y * 1e4).round()).abs() < 0.01, "four decimals: {y}");
    }
}
