//! Time that passes only when it is told to.

use firmware_core::device::MonotonicClock;
use std::cell::Cell;
use std::rc::Rc;

/// A clock that starts at 0 and is advanced explicitly. Clones are handles to the same clock.
///
/// ```
/// use firmware_core::device::MonotonicClock;
/// use firmware_sim::mcu::VirtualClock;
///
/// let clock = VirtualClock::new();
/// let seen_by_the_firmware = clock.clone();
/// clock.advance_ns(2_900);
/// assert_eq!(seen_by_the_firmware.now_us(), 2);
/// assert_eq!(seen_by_the_firmware.now_ns(), 2_900);
/// ```
#[derive(Debug, Clone, Default)]
pub struct VirtualClock(Rc<Cell<u64>>);

impl VirtualClock {
    /// A clock at 0.
    pub fn new() -> Self {
        Self::default()
    }

    /// Time since the start (ns).
    pub fn now_ns(&self) -> u64 {
        self.0.get()
    }

    /// Time since the start (s).
    pub fn now_s(&self) -> f64 {
        self.0.get() as f64 * 1e-9
    }

    /// Lets `ns` nanoseconds pass; the clock stops at 2⁶⁴ ns, after 584 years.
    pub fn advance_ns(&self, ns: u64) {
        self.0.set(self.0.get().saturating_add(ns));
    }

    /// Lets `us` microseconds pass.
    pub fn advance_us(&self, us: u64) {
        self.advance_ns(us.saturating_mul(1_000));
    }
}

impl MonotonicClock for VirtualClock {
    fn now_us(&self) -> u64 {
        self.0.get() / 1_000
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn adds_up_without_rounding_and_never_goes_back() {
        let clock = VirtualClock::new();
        (0..3_000).for_each(|_| clock.advance_ns(333));
        assert_eq!((clock.now_ns(), clock.now_us()), (999_000, 999));
        clock.advance_us(1);
        assert_eq!(clock.now_s(), 1e-3);
        clock.advance_us(u64::MAX);
        assert_eq!(clock.now_ns(), u64::MAX);
    }
}
