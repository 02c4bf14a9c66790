//! The robots that the project practises on, as simulated plants, and the logs recorded from them.
//!
//! ```text
//! excitation ──> Plant::step(input, dt) ──> Plant::observe ──> + noise ──> trial-000.csv …
//! ```
//!
//! | module | what lives there |
//! |---|---|
//! | [`plant`] | the trait [`Plant`]: outputs and inputs with units, reset, step, observe |
//! | [`integrate`] | [`Integrator`]: exact, RK4 or Euler, and the two methods themselves |
//! | [`drive`] | differential drive (ROSbot), the paper's system (drive) |
//! | [`rosbot`] | skid-steered ROSbot with motors, encoders and slip, an invented but plausible plant |
//! | [`skid_steer`] | the same without the controllers: wheels and body under motor voltages |
//! | [`arm`] | two-revolute-joint arm, the paper's system (arm) |
//! | [`soft_leg`] | soft pneumatic leg, an invented but plausible plant |
//! | [`bench`](mod@bench) | ROSbot and soft leg, wired to a simulated microcontroller |
//! | [`mcu`] | the simulated microcontroller: clock, peripherals, flash, misuse |
//! | [`plant_line`] | what a controller and a simulated robot tell each other when they are apart |
//! | [`fault`], [`faulty`] | what goes wrong and when; devices that show it |
//! | [`run`] | the firmware on a simulated controller: scenarios, verdicts, plots |
//! | [`record`] | logs as CSV, one file per trajectory |
//! | [`paper`] | the logs that repeat the paper's experiments |
//!
//! "The paper" is L. Shi and K. Karydis, "ACD-EDMD: Analytical Construction for Dictionaries of
//! Lifting Functions in Koopman Operator-Based Nonlinear Robotic Systems", IEEE Robotics and
//! Automation Letters, 2021.
//!
//! # Conventions
//!
//! - SI units and radians; the soft leg uses mm, kPa and V. Angles are continuous, never wrapped.
//! - Time and randomness are arguments: nothing here reads a clock or an unseeded generator.
//! - Transcendental functions come from `libm` by name, so that the same settings give the same
//!   bytes on every machine and whatever features other crates of the build turn on.
//!
//! # Example
//!
//! ```
//! use firmware_sim::{drive::Drive, integrate::Integrator, plant::Plant};
//!
//! // Half a turn on the spot: 1 rad/s of wheel difference turns the robot by r/L rad/s.
//! let mut drive = Drive::new(Default::default(), Integrator::Exact)?;
//! drive.step(&[0.5, -0.5], std::f64::consts::PI * 0.228 / 0.062);
//! let [x, y, phi] = drive.observe();
//! assert_eq!([x, y], [0.0, 0.0]);
//! assert!((phi - std::f64::consts::PI).abs() < 1e-15);
//! # Ok::<(), firmware_sim::drive::DriveError>(())
//! ```

#![forbid(unsafe_code)]

pub mod arm;
pub mod bench;
pub mod drive;
mod excitation;
pub mod fault;
pub mod faulty;
pub mod integrate;
mod log;
pub mod mcu;
mod normal;
pub mod paper;
pub mod plant;
pub mod plant_line;
pub mod record;
pub mod rosbot;
pub mod run;
mod sinc;
pub mod skid_steer;
pub mod soft_leg;

pub use integrate::Integrator;
pub use plant::{Plant, Variable};
