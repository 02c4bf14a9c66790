//! The simulated microcontroller: its clock, its peripherals and what they are wired to.
//!
//! Control loops that are generic over embedded-hal, embedded-io, embedded-storage and
//! [`firmware_core::device`] run on these devices unchanged, in virtual time. The devices are
//! stricter than hardware: what a datasheet forbids is [`Misuse`](misuse::Misuse), an error where
//! the trait has one, and always on record.
//!
//! | module | what lives there |
//! |---|---|
//! | [`clock`] | [`VirtualClock`], advanced explicitly |
//! | [`wire`] | [`Wire`]: what a device drives and a bench reads, or the other way round |
//! | [`misuse`] | [`MisuseLog`]: what the firmware did wrong, and first |
//! | [`board`] | [`Board`]: hands out each peripheral once, resets the outputs |
//! | [`pwm`], [`pin`] | the outputs |
//! | [`encoder`], [`position_sensor`], [`adc`] | the inputs |
//! | [`uart`] | a serial line with its times, losses and overruns |
//! | [`flash`] | NOR flash with unequal sectors and failing power |
//! | [`power`] | the supply and its brown-out detector |

pub mod adc;
pub mod board;
pub mod clock;
pub mod encoder;
pub mod flash;
pub mod misuse;
pub mod pin;
pub mod position_sensor;
pub mod power;
pub mod pwm;
pub mod uart;
pub mod wire;

pub use adc::Adc;
pub use board::Board;
pub use clock::VirtualClock;
pub use encoder::Encoder;
pub use flash::Flash;
pub use misuse::MisuseLog;
pub use pin::Pin;
pub use position_sensor::MotionCapture;
pub use power::BrownOutDetector;
pub use pwm::Pwm;
pub use uart::UartEnd;
pub use wire::Wire;
