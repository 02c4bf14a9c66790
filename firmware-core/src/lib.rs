//! Predicts a robot's motion on its own microcontroller from a Koopman model learned from its logs.
//!
//! `no_std`, no allocation, no panic, no unbounded loop. The trainer on the laptop uses this very
//! code in `f64`, so that there is one lift and one prediction.
#![doc = ""]
//! | module | what lives there |
//! |---|---|
//! | [`dictionary`] | observables, Hermite and Fourier bases, Kronecker blocks, the lift |
//! | [`model`] | `ModelRepr` (what the bytes say), `Structure` and `Model` (checked once) |
//! | [`history`] | samples: from coordinates to observables, from outputs back to coordinates |
//! | [`blob`] | the bytes of a model: layout, parse, emit |
//! | [`predictor`] | `Predictor` (immutable) and `PredictorState`: step, rollout, held inputs |
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

#[cfg(target_endian = "big")]
compile_error!("blobs are little-endian and are read in place");

pub mod blob;
pub mod capacity;
pub mod dictionary;
pub mod history;
mod kernel;
pub mod model;
pub mod predictor;
mod scalar;

pub use blob::{parse, parse_for, parse_prefix};
pub use model::{Model, ModelRepr, Structure};
pub use predictor::{PredictError, Predictor, PredictorState};
pub use scalar::{Lanes, Number, Scalar};
