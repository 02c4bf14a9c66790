//! An analogue input.

use crate::log::stream;
use crate::mcu::Wire;
use crate::normal::standard_normal;
use rand_chacha::ChaCha8Rng;

/// Why an [`Adc`] cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum AdcError {
    /// A code must fit into 16 bits.
    #[error("an ADC has 1 to 16 bits, not {bits}")]
    Bits {
        /// What was given.
        bits: u8,
    },
    /// The full scale must be a positive voltage.
    #[error("the full scale must be above 0 V, not {volt} V")]
    FullScale {
        /// What was given.
        volt: f64,
    },
}

/// Measures the voltage on a wire, with seeded normal noise, in steps of full scale / 2^bits; what
/// lies outside the scale saturates.
///
/// ```
/// use firmware_sim::mcu::{Adc, Wire};
///
/// let volt = Wire::new(1.65);
/// let mut adc = Adc::new(&volt, 12, 3.3, 0.0, 1)?;
/// assert_eq!(adc.read(), 2048);
/// volt.set(5.0);
/// assert_eq!(adc.read(), 4095);
/// # Ok::<(), firmware_sim::mcu::adc::AdcError>(())
/// ```
#[derive(Debug)]
pub struct Adc {
    volt: Wire<f64>,
    step_volt: f64,
    max_code: u16,
    noise_volt: f64,
    noise: ChaCha8Rng,
}

impl Adc {
    /// An input of 2^`bits` codes from 0 V to `full_scale_volt`, with noise of standard deviation
    /// `noise_volt` (V).
    ///
    /// # Errors
    ///
    /// [`AdcError`] for a number of bits or a scale that no ADC has.
    pub fn new(
        volt: &Wire<f64>,
        bits: u8,
        full_scale_volt: f64,
        noise_volt: f64,
        seed: u64,
    ) -> Result<Self, AdcError> {
        if !(1..=16).contains(&bits) {
            return Err(AdcError::Bits { bits });
        }
        if !(full_scale_volt > 0.0 && full_scale_volt.is_finite()) {
            return Err(AdcError::FullScale { volt: full_scale_volt });
        }
        Ok(Self {
            volt: volt.clone(),
            step_volt: full_scale_volt / f64::from(1_u32 << bits),
            max_code: ((1_u32 << bits) - 1) as u16,
            noise_volt,
            noise: stream(seed, 0),
        })
    }

    /// The code nearest to the voltage now.
    pub fn read(&mut self) -> u16 {
        let volt = self.volt.get() + self.noise_volt * standard_normal(&mut self.noise);
        let code = libm::round(volt / self.step_volt);
        code.clamp(0.0, f64::from(self.max_code)) as u16
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn noise_has_its_size_and_belongs_to_its_seed() {
        let volt = Wire::new(1.65);
        let codes = |seed| -> Vec<f64> {
            let mut adc = Adc::new(&volt, 16, 3.3, 0.01, seed).unwrap();
            (0..10_000).map(|_| f64::from(adc.read()) * 3.3 / 65_536.0 - 1.65).collect()
        };
        let errors = codes(1);
        assert_eq!(errors, codes(1));
        assert_ne!(errors, codes(2));
        let variance = errors.iter().map(|error| error * error).sum::<f64>() / 10_000.0;
        // Five standard errors.
        assert!((variance.sqrt() / 0.01 - 1.0).abs() < 0.036, "{variance}");
    }

    #[test]
    fn impossible_converters_are_refused() {
        let new = |bits, volt| Adc::new(&Wire::new(0.0), bits, volt, 0.0, 1).map(|_| ());
        assert_eq!(new(0, 1.0), Err(AdcError::Bits { bits: 0 }));
        assert_eq!(new(17, 1.0), Err(AdcError::Bits { bits: 17 }));
        assert_eq!(new(12, 0.0), Err(AdcError::FullScale { volt: 0.0 }));
    }

    proptest! {
        #[test]
        fn quantisation_is_off_by_half_a_step_at_most(bits in 1..=16_u8, share in 0.0..1.0_f64) {
            let volt = Wire::new(3.3 * share);
            let code = Adc::new(&volt, bits, 3.3, 0.0, 1).unwrap().read();
            let steps = f64::from(1_u32 << bits);
            // The last half step saturates.
            let ideal = (share * steps).min(steps - 1.0);
            prop_assert!((f64::from(code) - ideal).abs() <= 0.5 + 1e-9);
        }

        #[test]
        fn any_voltage_gives_a_code(volt in prop::num::f64::ANY) {
            let code = Adc::new(&Wire::new(volt), 12, 3.3, 0.0, 1).unwrap().read();
            prop_assert!(code <= 4095);
        }
    }
}
