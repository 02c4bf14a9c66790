//! Gives the linker the memory of the machine: that of the STM32F405, or with the feature `mps2-an386` that
//! one's; and says how many interrupts it has, which `src/vectors.rs` has to know.

use std::path::Path;

fn main() -> std::io::Result<()> {
    let an386 = std::env::var_os("CARGO_FEATURE_MPS2_AN386").is_some();
    let memory = if an386 { "mps2-an386.x" } else { "netduinoplus2.x" };
    let out = std::env::var("OUT_DIR").map_err(std::io::Error::other)?;
    std::fs::copy(memory, Path::new(&out).join("memory.x"))?;
    // It would name the handlers of single interrupts; there are none.
    std::fs::write(Path::new(&out).join("device.x"), "")?;
    println!("cargo:rustc-link-search={out}");
    // 82 on an STM32F405, and no more on the other machines; 32 at most on a Cortex-M0+.
    let is_m0 = std::env::var("TARGET").is_ok_and(|target| target.starts_with("thumbv6m"));
    println!("cargo:rustc-env=INTERRUPTS={}", if is_m0 { 32 } else { 82 });
    println!("cargo:rerun-if-changed={memory}");
    Ok(())
}
