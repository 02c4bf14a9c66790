//! A digital output.

use crate::mcu::board::Resets;
use crate::mcu::{MisuseLog, Wire};
use embedded_hal::digital::{self, ErrorType, OutputPin, StatefulOutputPin};

/// Why a pin is not switched. This is misuse, and on record.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PinError {
    /// A motor must stand without voltage before it is reversed.
    #[error("{pin}: the direction is switched while the motor is driven")]
    Driven {
        /// Name of the pin.
        pin: String,
    },
    /// The microcontroller was reset since the pin was claimed.
    #[error("{pin} is from before a reset")]
    BeforeReset {
        /// Name of the pin.
        pin: String,
    },
}

impl digital::Error for PinError {
    fn kind(&self) -> digital::ErrorKind {
        digital::ErrorKind::Other
    }
}

/// A pin, from [`Board::pin`](crate::mcu::Board::pin) or
/// [`Board::direction_pin`](crate::mcu::Board::direction_pin).
#[derive(Debug)]
pub struct Pin {
    name: String,
    level: Wire<bool>,
    /// The duty of the motor whose direction this is.
    driven: Option<Wire<f64>>,
    misuse: MisuseLog,
    resets: Resets,
    claimed_at: u32,
}

impl Pin {
    pub(crate) fn new(
        name: String,
        level: Wire<bool>,
        driven: Option<Wire<f64>>,
        misuse: &MisuseLog,
        resets: &Resets,
    ) -> Self {
        let (misuse, resets) = (misuse.clone(), resets.clone());
        Self { name, level, driven, misuse, claimed_at: resets.get(), resets }
    }

    fn switch(&mut self, high: bool) -> Result<(), PinError> {
        if self.resets.get() != self.claimed_at {
            return Err(self.misuse.record(PinError::BeforeReset { pin: self.name.clone() }));
        }
        let is_driven = self.driven.as_ref().is_some_and(|share| share.get() != 0.0);
        if is_driven && high != self.level.get() {
            return Err(self.misuse.record(PinError::Driven { pin: self.name.clone() }));
        }
        self.level.set(high);
        Ok(())
    }
}

impl ErrorType for Pin {
    type Error = PinError;
}

impl OutputPin for Pin {
    fn set_low(&mut self) -> Result<(), PinError> {
        self.switch(false)
    }

    fn set_high(&mut self) -> Result<(), PinError> {
        self.switch(true)
    }
}

impl StatefulOutputPin for Pin {
    fn is_set_high(&mut self) -> Result<bool, PinError> {
        Ok(self.level.get())
    }

    fn is_set_low(&mut self) -> Result<bool, PinError> {
        Ok(!self.level.get())
    }
}
