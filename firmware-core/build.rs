//! Which kernels the target has: stable Rust does not tell a Cortex-M4, which has the DSP extension, from a
//! Cortex-M3.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-check-cfg=cfg(q31_kernel, values(none(), \"smmla\", \"smull\"))");
    let target = std::env::var("TARGET").unwrap_or_default();
    let kernels = [("thumbv7em-", "smmla"), ("thumbv7m-", "smull"), ("thumbv8m.main-", "smull")];
    println!("cargo::rustc-check-cfg=cfg(cortex_m4f)");
    if target.starts_with("thumbv7em-") && target.ends_with("eabihf") {
        println!("cargo::rustc-cfg=cortex_m4f");
    }
    for (prefix, kernel) in kernels {
        if target.starts_with(prefix) {
            println!("cargo::rustc-cfg=q31_kernel");
            println!("cargo::rustc-cfg=q31_kernel=\"{kernel}\"");
        }
    }
}
