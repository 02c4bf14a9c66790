//! Gives the linker the memory of the machine: that of the STM32F405, or with the feature `mps2-an386` that
//! one's.

use std::path::Path;

fn main() -> std::io::Result<()> {
    let an386 = std::env::var_os("CARGO_FEATURE_MPS2_AN386").is_some();
    let memory = if an386 { "mps2-an386.x" } else { "netduinoplus2.x" };
    let out = std::env::var("OUT_DIR").map_err(std::io::Error::other)?;
    std::fs::copy(memory, Path::new(&out).join("memory.x"))?;
    println!("cargo:rustc-link-search={out}");
    println!("cargo:rerun-if-changed={memory}");
    Ok(())
}
