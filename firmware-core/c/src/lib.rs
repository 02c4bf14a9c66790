//! `firmware-core` for firmware in C and C++: a static library, `libkoopman.a`, and its header,
//! `include/koopman.h`, which cbindgen makes from the files listed below.
//!
//! A model and a state of a predictor are objects of the caller, of a size that the header knows: the
//! library allocates nothing and has no variables of its own. Every function checks what it is given
//! and returns a [`koopman_error_t`](error::koopman_error_t).
//!
//! | module | what lives there |
//! |---|---|
//! | [`error`] | `koopman_error_t` and the names of errors |
//! | [`model`] | `koopman_model_t`: load, shape, names, error bounds |
//! | [`state`] | `koopman_state_t`: observe, step, rollout |
//! | `pointer` (private) | pointers and lengths from C, checked once, and the marks of objects |
//!
//! `run` in this folder builds the library for a Cortex-M4F, links [the example](../example/main.c)
//! with it, runs that in QEMU, and compares with what `firmware-core` predicts on the host.
#![cfg_attr(target_os = "none", no_std)]
// The names are those of the header.
#![allow(non_camel_case_types)]
#![allow(
    clippy::missing_safety_doc,
    reason = "the head of the header says it once for all functions"
)]
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

pub mod error;
pub mod model;
mod pointer;
pub mod state;

/// Rust wants one; nothing gets here. `run` checks that the linker has left it out, as no function of
/// the library refers to it.
#[cfg(target_os = "none")]
#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {
        core::hint::spin_loop();
    }
}
