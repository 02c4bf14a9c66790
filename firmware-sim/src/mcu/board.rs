//! The board: every peripheral once, and its resets.

use crate::mcu::misuse::Misuse;
use crate::mcu::{MisuseLog, Pin, Pwm, VirtualClock, Wire};
use std::cell::Cell;
use std::collections::BTreeMap;
use std::rc::Rc;

/// Why a peripheral is not handed out. This is misuse, and on record.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ClaimError {
    /// Two owners would drive the same PWM channel.
    #[error("channel {channel} of timer {timer} is claimed already")]
    ChannelClaimed {
        /// Timer number.
        timer: u8,
        /// Channel of the timer.
        channel: u8,
    },
    /// Two owners would drive the same pin.
    #[error("pin {pin} is claimed already")]
    PinClaimed {
        /// Name of the pin.
        pin: String,
    },
    /// All channels of a timer share its frequency.
    #[error("timer {timer} runs at {running_hz} Hz and cannot run at {asked_hz} Hz too")]
    TimerFrequency {
        /// Timer number.
        timer: u8,
        /// Frequency of the channels claimed before (Hz).
        running_hz: u32,
        /// Frequency asked for (Hz).
        asked_hz: u32,
    },
    /// The 16-bit counter cannot divide the timer's clock down to this.
    #[error("timer {timer} counts to 1 … 65535 at {clock_hz} Hz and cannot give {asked_hz} Hz")]
    Frequency {
        /// Timer number.
        timer: u8,
        /// Clock of the timers (Hz).
        clock_hz: u32,
        /// Frequency asked for (Hz).
        asked_hz: u32,
    },
}

/// Why the microcontroller was reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ResetCause {
    /// The supply fell below the threshold of the brown-out detector.
    BrownOut,
    /// The watchdog was not fed in time.
    Watchdog,
    /// The firmware asked for it.
    Software,
}

/// A microcontroller on its board.
///
/// A PWM channel or pin has one owner until the next reset; a second claim is misuse. Wires are
/// known by the same names, whoever owns the peripheral: a bench connects once.
///
/// Dropping a board with misuse that nobody looked at ([`misuse`](Self::misuse)) panics in builds
/// with debug assertions, as a mock with an unfinished expectation does.
///
/// ```
/// use embedded_hal::pwm::SetDutyCycle;
/// use firmware_sim::mcu::{Board, VirtualClock};
///
/// let mut board = Board::new(&VirtualClock::new());
/// let share = board.pwm_wire(3, 2);
/// let mut pwm = board.pwm(3, 2, 18_000)?;
/// assert_eq!(pwm.max_duty_cycle(), 4666); // 84 MHz / 18 kHz
/// pwm.set_duty_cycle(2333)?;
/// assert_eq!(share.get(), 0.5);
///
/// let error = board.pwm(3, 3, 20_000).unwrap_err();
/// assert_eq!(error.to_string(), "timer 3 runs at 18000 Hz and cannot run at 20000 Hz too");
/// assert_eq!(board.misuse().unwrap().count, 1);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Board {
    clock: VirtualClock,
    misuse: MisuseLog,
    resets: Resets,
    last_reset: Option<ResetCause>,
    channels: BTreeMap<(u8, u8), Output<f64>>,
    pins: BTreeMap<String, Output<bool>>,
    /// Frequencies of the timers in use (Hz).
    timers: BTreeMap<u8, u32>,
}

/// A wire that a peripheral drives, and whether that peripheral has an owner.
#[derive(Debug, Default)]
struct Output<T: Copy> {
    wire: Wire<T>,
    claimed: bool,
}

/// Counts the resets of a board, for peripherals that must not outlive one.
pub(crate) type Resets = Rc<Cell<u32>>;

impl Board {
    /// Clock of timers 2 to 7 and 12 to 14 of an STM32F407 (Hz); here it is that of all timers.
    pub const TIMER_CLOCK_HZ: u32 = 84_000_000;

    /// A board with all outputs low.
    pub fn new(clock: &VirtualClock) -> Self {
        Self {
            clock: clock.clone(),
            misuse: MisuseLog::new(clock),
            resets: Resets::default(),
            last_reset: None,
            channels: BTreeMap::new(),
            pins: BTreeMap::new(),
            timers: BTreeMap::new(),
        }
    }

    /// The clock of the board.
    pub fn clock(&self) -> &VirtualClock {
        &self.clock
    }

    /// What was misused so far. A run or a test must ask this before the board is dropped.
    pub fn misuse(&self) -> Option<Misuse> {
        self.misuse.look()
    }

    /// The record that devices of this board write to.
    pub fn misuse_log(&self) -> &MisuseLog {
        &self.misuse
    }

    /// What a PWM channel puts out: its share of full duty, from 0 to 1.
    pub fn pwm_wire(&mut self, timer: u8, channel: u8) -> Wire<f64> {
        self.channels.entry((timer, channel)).or_default().wire.clone()
    }

    /// What a pin puts out: whether it is high.
    pub fn pin_wire(&mut self, name: &str) -> Wire<bool> {
        self.pins.entry(name.to_owned()).or_default().wire.clone()
    }

    /// Claims a PWM channel at 0 duty.
    ///
    /// # Errors
    ///
    /// [`ClaimError`] if the channel has an owner or the timer cannot run at this frequency.
    pub fn pwm(&mut self, timer: u8, channel: u8, frequency_hz: u32) -> Result<Pwm, ClaimError> {
        let clock_hz = Self::TIMER_CLOCK_HZ;
        let max_duty = clock_hz
            .checked_div(frequency_hz)
            .and_then(|counts| u16::try_from(counts).ok())
            .filter(|&counts| counts > 0);
        let Some(max_duty) = max_duty else {
            let error = ClaimError::Frequency { timer, clock_hz, asked_hz: frequency_hz };
            return Err(self.misuse.record(error));
        };
        let running_hz = *self.timers.entry(timer).or_insert(frequency_hz);
        if running_hz != frequency_hz {
            let error = ClaimError::TimerFrequency { timer, running_hz, asked_hz: frequency_hz };
            return Err(self.misuse.record(error));
        }
        let output = self.channels.entry((timer, channel)).or_default();
        if output.claimed {
            return Err(self.misuse.record(ClaimError::ChannelClaimed { timer, channel }));
        }
        output.claimed = true;
        let wire = output.wire.clone();
        Ok(Pwm::new(format!("TIM{timer}_CH{channel}"), max_duty, wire, &self.misuse, &self.resets))
    }

    /// Claims a digital output that is low.
    ///
    /// # Errors
    ///
    /// [`ClaimError::PinClaimed`] if it has an owner.
    pub fn pin(&mut self, name: &str) -> Result<Pin, ClaimError> {
        self.claim_pin(name, None)
    }

    /// Claims the direction pin of a motor that `pwm` drives: switching it before the duty is at 0
    /// is misuse.
    ///
    /// # Errors
    ///
    /// [`ClaimError::PinClaimed`] if it has an owner.
    pub fn direction_pin(&mut self, name: &str, pwm: &Pwm) -> Result<Pin, ClaimError> {
        self.claim_pin(name, Some(pwm.share().clone()))
    }

    fn claim_pin(&mut self, name: &str, driven: Option<Wire<f64>>) -> Result<Pin, ClaimError> {
        let output = self.pins.entry(name.to_owned()).or_default();
        if output.claimed {
            return Err(self.misuse.record(ClaimError::PinClaimed { pin: name.to_owned() }));
        }
        output.claimed = true;
        let wire = output.wire.clone();
        Ok(Pin::new(name.to_owned(), wire, driven, &self.misuse, &self.resets))
    }

    /// Resets the microcontroller: every PWM at 0, every pin low, and all peripherals free. Who
    /// still holds one from before commits misuse by using it.
    pub fn reset(&mut self, cause: ResetCause) {
        self.resets.set(self.resets.get() + 1);
        self.last_reset = Some(cause);
        self.timers.clear();
        for output in self.channels.values_mut() {
            output.wire.set(0.0);
            output.claimed = false;
        }
        for output in self.pins.values_mut() {
            output.wire.set(false);
            output.claimed = false;
        }
    }

    /// Resets since the start.
    pub fn resets(&self) -> u32 {
        self.resets.get()
    }

    /// The cause of the latest reset; `None` before the first one.
    pub fn last_reset(&self) -> Option<ResetCause> {
        self.last_reset
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        if cfg!(debug_assertions)
            && !std::thread::panicking()
            && let Some(misuse) = self.misuse.unseen()
        {
            panic!("nobody looked at {misuse}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use embedded_hal::digital::{OutputPin, StatefulOutputPin};
    use embedded_hal::pwm::SetDutyCycle;

    fn board() -> Board {
        Board::new(&VirtualClock::new())
    }

    #[test]
    fn a_second_claim_is_refused_and_recorded_with_its_time() {
        let mut board = board();
        let _pwm = board.pwm(3, 1, 18_000).unwrap();
        let _pin = board.pin("PC6").unwrap();
        board.clock().advance_us(1_000);
        assert_eq!(board.pin("PC6").unwrap_err().to_string(), "pin PC6 is claimed already");
        board.clock().advance_us(1_000);
        let error = board.pwm(3, 1, 18_000).unwrap_err();
        assert_eq!(error, ClaimError::ChannelClaimed { timer: 3, channel: 1 });
        assert_eq!(
            board.misuse().unwrap().to_string(),
            "2 misuses, the first at 1000 µs: pin PC6 is claimed already"
        );
    }

    #[test]
    fn impossible_frequencies_are_refused() {
        let mut board = board();
        assert!(board.pwm(1, 1, 0).is_err());
        // 84 MHz / 65535 = 1281.8 Hz.
        assert!(board.pwm(1, 1, 1281).is_err());
        assert_eq!(board.pwm(1, 1, 1282).unwrap().max_duty_cycle(), 65_522);
        assert_eq!(board.misuse().unwrap().count, 2);
    }

    #[test]
    fn more_than_full_duty_is_refused_and_changes_nothing() {
        let mut board = board();
        let mut pwm = board.pwm(1, 1, 18_000).unwrap();
        pwm.set_duty_cycle(100).unwrap();
        assert!(pwm.set_duty_cycle(4667).is_err());
        assert_eq!(board.pwm_wire(1, 1).get(), 100.0 / 4666.0);
        assert_eq!(board.misuse().unwrap().first, "TIM1_CH1: duty 4667 is above the maximum 4666");
    }

    #[test]
    fn a_motor_is_reversed_only_at_rest() {
        let mut board = board();
        let mut pwm = board.pwm(1, 1, 18_000).unwrap();
        let mut direction = board.direction_pin("PA1", &pwm).unwrap();
        direction.set_high().unwrap();
        pwm.set_duty_cycle(1).unwrap();
        // The level that it has already switches nothing.
        direction.set_high().unwrap();
        assert!(direction.set_low().is_err());
        assert!(direction.is_set_high().unwrap());
        pwm.set_duty_cycle_fully_off().unwrap();
        direction.set_low().unwrap();
        assert_eq!(
            board.misuse().unwrap().first,
            "PA1: the direction is switched while the motor is driven"
        );
    }

    #[test]
    fn a_reset_lets_go_of_everything() {
        let mut board = board();
        let mut pwm = board.pwm(1, 1, 18_000).unwrap();
        let mut pin = board.pin("PA1").unwrap();
        pwm.set_duty_cycle_fully_on().unwrap();
        pin.set_high().unwrap();
        let (share, level) = (board.pwm_wire(1, 1), board.pin_wire("PA1"));
        board.reset(ResetCause::Watchdog);
        assert_eq!((share.get(), level.get()), (0.0, false));
        assert_eq!((board.resets(), board.last_reset()), (1, Some(ResetCause::Watchdog)));
        assert_eq!(board.misuse(), None);
        // What the firmware had before the reset is gone.
        assert!(pwm.set_duty_cycle(1).is_err() && pin.set_high().is_err());
        assert!(board.misuse().unwrap().first.contains("from before a reset"));
        // After it, the firmware starts anew, at other frequencies if it likes.
        board.pwm(1, 1, 20_000).unwrap().set_duty_cycle(2100).unwrap();
        assert_eq!(share.get(), 0.5);
    }

    #[test]
    #[should_panic(expected = "nobody looked at 1 misuse, the first at 0 µs: pin PA1")]
    fn unseen_misuse_fails_the_test() {
        let mut board = board();
        let _pin = board.pin("PA1");
        let _again = board.pin("PA1");
    }
}
