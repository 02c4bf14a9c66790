//! What a control loop needs of the hardware where embedded-hal has no trait for it.
//!
//! PWM is [`embedded_hal::pwm::SetDutyCycle`], a digital output
//! [`embedded_hal::digital::OutputPin`], the serial line [`embedded_io`].

/// A counter that follows a wheel, such as a timer in encoder mode.
///
/// ```
/// // Between two reads the wheel turned back by three counts, across zero.
/// let (before, now) = (1_u16, 65_534_u16);
/// assert_eq!(now.wrapping_sub(before) as i16, -3);
/// ```
pub trait EncoderCount {
    /// Why there is no count.
    type Error;

    /// The count now. It wraps at 2¹⁶ in both directions, and grows when the wheel turns forwards.
    ///
    /// # Errors
    /// When the counter cannot be read.
    fn count(&mut self) -> Result<u16, Self::Error>;
}

/// A sensor of `N` coordinates of the robot: a camera, motion capture, a strain sensor.
pub trait PositionSensor<const N: usize> {
    /// Why there is no measurement.
    type Error;

    /// The coordinates measured since the last call, in the units of the model; `None` if there is
    /// no new measurement. They may be NaN: the loop checks.
    ///
    /// # Errors
    /// When the sensor cannot be read.
    fn measure(&mut self) -> Result<Option<[f32; N]>, Self::Error>;

    /// How old the last measurement was when it was handed out (µs), of a sensor that stamps its
    /// measurements with the time; a loop does not use one that belongs to an earlier sample.
    fn age_us(&self) -> u32 {
        0
    }
}

/// A clock that never goes back.
pub trait MonotonicClock {
    /// Time since some moment in the past (µs).
    fn now_us(&self) -> u64;
}
