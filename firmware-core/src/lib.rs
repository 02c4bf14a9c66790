//! Predicts a robot's motion on its own microcontroller from a Koopman model learned from its logs.
//!
//! `no_std`, no allocation, no panic, no unbounded loop. The trainer on the laptop uses this very
//! code in `f64`, so that there is one lift and one prediction.
//!
//! ```
//! use firmware_core::blob::Aligned;
//! use firmware_core::{Predictor, PredictorState};
//!
//! static BLOB: &Aligned<[u8]> =
//!     &Aligned(*include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/rosbot/model.bin")));
//!
//! let model = firmware_core::parse_for("rosbot", &BLOB.0).unwrap();
//! let predictor = Predictor::new(&model);
//! let mut state = PredictorState::new();
//! // Measured: x, y [m], heading [rad]. Before the first sample nothing was applied.
//! predictor.observe(&mut state, &[], &[1.0, 2.0, 0.5]).unwrap();
//!
//! // Where will it be in one second, ten samples, with wheel speeds of 12 and 7 rad/s held?
//! let mut path = [0.0_f32; 30];
//! predictor.rollout_held(&mut state.clone(), &[12.0, 7.0], &mut path).unwrap();
//! let [.., x, y, phi] = path;
//! // A wheel radius of 0.062 m and a track of 0.228 m give an arc of 0.589 m that turns by 1.360 rad.
//! assert!((x - 1.208).abs() < 0.01 && (y - 2.507).abs() < 0.01 && (phi - 1.860).abs() < 0.01);
//! assert_eq!(state.out_of_range(), None);
//! ```
#![doc = ""]
//! | module | what lives there |
//! |---|---|
//! | [`dictionary`] | observables, Hermite and Fourier bases, Kronecker blocks, the lift |
//! | [`sparse`] | single products of basis functions instead of whole blocks |
//! | [`error_bounds`] | how far off a prediction may be |
//! | [`model`] | `ModelRepr` (what the bytes say), `Structure` and `Model` (checked once) |
//! | [`history`] | samples: from coordinates to observables, from outputs back to coordinates |
//! | [`blob`] | the bytes of a model: layout, parse, emit |
//! | `encoding` (private) | what postcard has written, read in place |
//! | [`predictor`] | `Predictor` (immutable) and `PredictorState`: step, rollout, held inputs |
//! | [`kernel`] | how a step evaluates the operator: portable, and on a Cortex-M4F |
//! | [`q31`] | models in fixed point, for controllers without a floating-point unit |
//! | `registers` (private) | where the numbers of a step lie |
//! | [`control_loop`] | sense, predict, act: the soft leg and the ROSbot |
//! | [`slots`] | two flash slots for models: write, trial, confirm, revert |
//! | [`link`] | messages between host and controller over a serial line |
//! | [`update`] | installing a new model over that line: sessions, signatures, trial |
//! | [`device`] | encoders, position sensors and the clock, as traits |
//! | [`cost`] | instructions and bytes of a model, before it is flashed |
//! | [`capacity`] | what there is room for |
#![no_std]
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::panic,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::unreachable
    )
)]
// Only assembly needs it, which no other machine has.
#![cfg_attr(not(any(cortex_m4f, q31_kernel)), forbid(unsafe_code))]

#[cfg(target_endian = "big")]
compile_error!("blobs are little-endian and are read in place");

pub mod blob;
pub mod capacity;
pub mod control_loop;
pub mod cost;
pub mod device;
pub mod dictionary;
mod encoding;
pub mod error_bounds;
pub mod history;
pub mod kernel;
pub mod link;
pub mod model;
pub mod predictor;
pub mod q31;
mod registers;
mod scalar;
pub mod slots;
pub mod sparse;
pub mod update;

pub use blob::{parse, parse_for, parse_prefix};
pub use error_bounds::ErrorBounds;
pub use model::{Model, ModelRepr, Structure};
pub use predictor::{PredictError, Predictor, PredictorState};
pub use scalar::{Lanes, Number, Scalar};
pub use sparse::SparseTerms;
