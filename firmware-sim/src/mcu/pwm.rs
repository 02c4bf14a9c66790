//! A PWM output.

use crate::mcu::board::Resets;
use crate::mcu::{MisuseLog, Wire};
use embedded_hal::pwm::{self, ErrorType, SetDutyCycle};

/// Why a duty is not set. This is misuse, and on record.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PwmError {
    /// The timer cannot count that far.
    #[error("{channel}: duty {duty} is above the maximum {max}")]
    AboveMax {
        /// Name of the channel.
        channel: String,
        /// What was asked for.
        duty: u16,
        /// The largest duty.
        max: u16,
    },
    /// The microcontroller was reset since the channel was claimed.
    #[error("{channel} is from before a reset")]
    BeforeReset {
        /// Name of the channel.
        channel: String,
    },
}

impl pwm::Error for PwmError {
    fn kind(&self) -> pwm::ErrorKind {
        pwm::ErrorKind::Other
    }
}

/// One channel of a timer, from [`Board::pwm`](crate::mcu::Board::pwm).
#[derive(Debug)]
pub struct Pwm {
    name: String,
    max_duty: u16,
    /// Share of full duty, from 0 to 1.
    share: Wire<f64>,
    misuse: MisuseLog,
    resets: Resets,
    claimed_at: u32,
}

impl Pwm {
    pub(crate) fn new(
        name: String,
        max_duty: u16,
        share: Wire<f64>,
        misuse: &MisuseLog,
        resets: &Resets,
    ) -> Self {
        let (misuse, resets) = (misuse.clone(), resets.clone());
        Self { name, max_duty, share, misuse, claimed_at: resets.get(), resets }
    }

    /// The wire that carries the share of full duty.
    pub(crate) fn share(&self) -> &Wire<f64> {
        &self.share
    }
}

impl ErrorType for Pwm {
    type Error = PwmError;
}

impl SetDutyCycle for Pwm {
    fn max_duty_cycle(&self) -> u16 {
        self.max_duty
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), PwmError> {
        let max = self.max_duty;
        if self.resets.get() != self.claimed_at {
            Err(self.misuse.record(PwmError::BeforeReset { channel: self.name.clone() }))
        } else if duty > max {
            Err(self.misuse.record(PwmError::AboveMax { channel: self.name.clone(), duty, max }))
        } else {
            self.share.set(f64::from(duty) / f64::from(max));
            Ok(())
        }
    }
}
