//! What connects a device to what it drives or measures.

use std::cell::Cell;
use std::rc::Rc;

/// A value with one writer and any number of readers. Clones are ends of the same wire.
///
/// ```
/// use firmware_sim::mcu::Wire;
/// let volt = Wire::new(0.0);
/// let other_end = volt.clone();
/// volt.set(3.3);
/// assert_eq!(other_end.get(), 3.3);
/// ```
#[derive(Debug, Clone, Default)]
pub struct Wire<T: Copy>(Rc<Cell<T>>);

impl<T: Copy> Wire<T> {
    /// A wire that carries `value`.
    pub fn new(value: T) -> Self {
        Self(Rc::new(Cell::new(value)))
    }

    /// What the wire carries.
    pub fn get(&self) -> T {
        self.0.get()
    }

    /// Drives the wire.
    pub fn set(&self, value: T) {
        self.0.set(value);
    }
}
