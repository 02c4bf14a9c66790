//! Coverage-guided fuzzing of what firmware-core reads from outside: blobs from flash, frames from a line.
//!
//! A target is one file in `src/bin`; `run TARGET SECONDS` in this folder builds and runs it. libFuzzer
//! changes inputs, keeps those that reach new edges or comparisons, and stops at the first one that panics,
//! overflows or hangs. It starts from the [seeds] that a target brings along.

pub mod link;
pub mod model;
pub mod robot;

/// Writes the inputs to start from into the folder that `FUZZ_SEEDS` names; nothing if it names none, as
/// when one input is tried again.
///
/// # Panics
/// When they cannot be written.
pub fn seeds<B: AsRef<[u8]>>(seeds: impl IntoIterator<Item = B>) {
    let Some(folder) = std::env::var_os("FUZZ_SEEDS") else { return };
    for (i, seed) in seeds.into_iter().enumerate() {
        let path = std::path::Path::new(&folder).join(format!("seed-{i}"));
        std::fs::write(&path, seed).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    }
}
