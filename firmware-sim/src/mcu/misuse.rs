//! What the firmware did that no hardware would forgive.

use crate::mcu::VirtualClock;
use firmware_core::device::MonotonicClock;
use std::cell::{Cell, RefCell};
use std::fmt;
use std::rc::Rc;

/// All misuse so far: the first in full, the others counted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Misuse {
    /// What was done first.
    pub first: String,
    /// Virtual time of the first (µs).
    pub first_at_us: u64,
    /// How many there were, the first included.
    pub count: u64,
}

impl fmt::Display for Misuse {
    /// Such as `2 misuses, the first at 1000 µs: pin PC6 is claimed already`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let s = if self.count == 1 { "" } else { "s" };
        write!(f, "{} misuse{s}, the first at {} µs: {}", self.count, self.first_at_us, self.first)
    }
}

/// Where the devices of a board write down how they were misused. Clones share the record.
#[derive(Debug, Clone)]
pub struct MisuseLog {
    clock: VirtualClock,
    record: Rc<Record>,
}

#[derive(Debug, Default)]
struct Record {
    misuse: RefCell<Option<Misuse>>,
    unseen: Cell<bool>,
}

impl MisuseLog {
    /// An empty record that takes its times from `clock`.
    pub fn new(clock: &VirtualClock) -> Self {
        Self { clock: clock.clone(), record: Rc::default() }
    }

    /// Writes down that something was misused, and gives it back as the error that it also is.
    pub fn record<E: fmt::Display>(&self, error: E) -> E {
        self.record.unseen.set(true);
        self.record
            .misuse
            .borrow_mut()
            .get_or_insert_with(|| Misuse {
                first: error.to_string(),
                first_at_us: self.clock.now_us(),
                count: 0,
            })
            .count += 1;
        error
    }

    /// All misuse so far; with this it has been seen.
    pub fn look(&self) -> Option<Misuse> {
        self.record.unseen.set(false);
        self.record.misuse.borrow().clone()
    }

    /// Misuse that nobody has looked at.
    pub(crate) fn unseen(&self) -> Option<Misuse> {
        self.record.misuse.borrow().clone().filter(|_| self.record.unseen.get())
    }
}
