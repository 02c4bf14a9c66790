//! The supply of the microcontroller and its brown-out detector.

use crate::mcu::board::ResetCause;
use crate::mcu::{Board, Wire};

/// Resets a board while its supply is too low.
///
/// ```
/// use firmware_sim::mcu::{Board, BrownOutDetector, VirtualClock, Wire, board::ResetCause};
///
/// let mut board = Board::new(&VirtualClock::new());
/// let supply_volt = Wire::new(3.3);
/// let mut detector = BrownOutDetector::new(&supply_volt, 2.7, 0.1);
/// assert!(detector.runs(&mut board));
/// supply_volt.set(2.6);
/// assert!(!detector.runs(&mut board));
/// supply_volt.set(2.75); // within the hysteresis
/// assert!(!detector.runs(&mut board));
/// supply_volt.set(3.3);
/// assert!(detector.runs(&mut board));
/// assert_eq!((board.resets(), board.last_reset()), (1, Some(ResetCause::BrownOut)));
/// ```
#[derive(Debug)]
pub struct BrownOutDetector {
    supply_volt: Wire<f64>,
    threshold_volt: f64,
    hysteresis_volt: f64,
    in_reset: bool,
}

impl BrownOutDetector {
    /// Resets below the threshold (V), and lets go at the threshold plus the hysteresis (V).
    pub fn new(supply_volt: &Wire<f64>, threshold_volt: f64, hysteresis_volt: f64) -> Self {
        let supply_volt = supply_volt.clone();
        Self { supply_volt, threshold_volt, hysteresis_volt, in_reset: false }
    }

    /// Looks at the supply, resets the board if it has just become too low, and says whether the
    /// microcontroller runs. While it does not, its outputs stay low and no firmware may tick; when
    /// it does again, the firmware starts anew.
    pub fn runs(&mut self, board: &mut Board) -> bool {
        let hysteresis_volt = if self.in_reset { self.hysteresis_volt } else { 0.0 };
        let runs = self.supply_volt.get() >= self.threshold_volt + hysteresis_volt;
        if !runs && !self.in_reset {
            board.reset(ResetCause::BrownOut);
        }
        self.in_reset = !runs;
        runs
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mcu::VirtualClock;
    use embedded_hal::pwm::SetDutyCycle;

    #[test]
    fn a_noisy_supply_at_the_threshold_resets_once() {
        let mut board = Board::new(&VirtualClock::new());
        let share = board.pwm_wire(1, 1);
        board.pwm(1, 1, 18_000).unwrap().set_duty_cycle_fully_on().unwrap();
        let supply = Wire::new(3.3);
        let mut detector = BrownOutDetector::new(&supply, 2.7, 0.1);
        for (volt, runs) in [
            (2.7, true),
            (2.69, false),
            (2.71, false),
            (2.69, false),
            (2.79, false),
            (2.81, true),
            (2.71, true),
        ] {
            supply.set(volt);
            assert_eq!(detector.runs(&mut board), runs, "{volt} V");
        }
        assert_eq!((board.resets(), share.get()), (1, 0.0));
        supply.set(f64::NAN);
        assert!(!detector.runs(&mut board));
        assert_eq!(board.resets(), 2);
    }
}
