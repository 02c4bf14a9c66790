//! A robot wired to a simulated microcontroller.
//!
//! A bench owns a plant and a [`Board`](crate::mcu::Board), hands out the devices that the firmware
//! drives the plant with, and lets time pass:
//!
//! ```text
//! firmware ──> Pwm, Pin ──wires──> plant ──wires──> Encoder, MotionCapture ──> firmware
//! ```
//!
//! A tick of the firmware takes no time; between ticks the bench advances, with the outputs held.
//! Whoever lets the clock run on his own, as erasing flash does, advances the bench by 0 before that, if he
//! has touched an output, and before he touches an output or a sensor again: the plant then catches up.

pub mod rosbot;
pub mod soft_leg;

pub use rosbot::RosbotBench;
pub use soft_leg::SoftLegBench;
