//! A timer in encoder mode.

use crate::mcu::Wire;
use firmware_core::device::EncoderCount;
use std::convert::Infallible;
use std::f64::consts::TAU;
use std::num::NonZeroU32;

/// Counts the turns of a shaft, modulo 2¹⁶.
///
/// ```
/// use firmware_core::device::EncoderCount;
/// use firmware_sim::mcu::{Encoder, Wire};
///
/// let angle_rad = Wire::new(0.0);
/// let mut encoder = Encoder::new(&angle_rad, 1632.try_into()?);
/// angle_rad.set(-std::f64::consts::PI);
/// assert_eq!(encoder.count()?, 65_536_u32.wrapping_sub(816) as u16);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Encoder {
    angle_rad: Wire<f64>,
    counts_per_rad: f64,
}

impl Encoder {
    /// The encoder of the shaft whose angle (rad) is on the wire; it counts 0 at angle 0.
    pub fn new(angle_rad: &Wire<f64>, counts_per_turn: NonZeroU32) -> Self {
        let counts_per_rad = f64::from(counts_per_turn.get()) / TAU;
        Self { angle_rad: angle_rad.clone(), counts_per_rad }
    }
}

impl EncoderCount for Encoder {
    type Error = Infallible;

    fn count(&mut self) -> Result<u16, Infallible> {
        // Rounded, not floored, so that forwards and backwards are alike.
        Ok(libm::round(self.angle_rad.get() * self.counts_per_rad) as i64 as u16)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn differences_survive_the_wrap(start in -1e4..1e4_f64, turned in -60.0..60.0_f64) {
            let angle = Wire::new(start);
            let mut encoder = Encoder::new(&angle, NonZeroU32::new(1632).unwrap());
            let before = encoder.count().unwrap();
            angle.set(start + turned);
            let counts = encoder.count().unwrap().wrapping_sub(before) as i16;
            // Both counts are rounded.
            prop_assert!((f64::from(counts) - turned / TAU * 1632.0).abs() <= 1.0 + 1e-6);
        }
    }
}
