//! Which kernel of the fixed-point models the target has: stable Rust does not tell a Cortex-M4, which
//! has the DSP extension, from a Cortex-M3.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-check-cfg=cfg(q31_kernel, values(none(), \"smmla\", \"smull\"))");
    let target = std::env::var("TARGET").unwrap_or_default();
    let kernels = [("thumbv7em-", "smmla"), ("thumbv7m-", "smull"), ("thumbv8m.main-", "smull")];
    for (prefix, kernel) in kernels {
        if target.starts_with(prefix) {
            println!("cargo::rustc-cfg=q31_kernel");
            println!("cargo::rustc-cfg=q31_kernel=\"{kernel}\"");
        }
    }
}
