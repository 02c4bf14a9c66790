//! Compiles the baselines in C for the Cortex-M4F, each at its own level of optimisation, whatever that of
//! the image is. `CMSIS_DSP` names a folder with CMSIS-DSP, of which what is needed is compiled too, and
//! `CMSIS_CORE` the folder with `cmsis_compiler.h`.

use std::env;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The language is GNU's by intention: products and sums are fused, as they are without any option.
const FLAGS: [&str; 9] = [
    "-mcpu=cortex-m4",
    "-mthumb",
    "-mfpu=fpv4-sp-d16",
    "-mfloat-abi=hard",
    "-std=gnu11",
    "-Wall",
    "-Wextra",
    "-ffunction-sections",
    "-c",
];
const BASELINES: &str = "src/baselines.c";

fn main() {
    let opt_level = env::var("OPT_LEVEL").expect("cargo sets it");
    println!("cargo:rustc-env=LEVEL=O{opt_level}");
    // The memory map is that of the other images.
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    let memory = concat!(env!("CARGO_MANIFEST_DIR"), "/../netduinoplus2.x");
    std::fs::copy(memory, out.join("memory.x")).expect("the memory map of the other images");
    println!("cargo:rustc-link-search={}", out.display());
    println!("cargo:rerun-if-changed={memory}");
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=CMSIS_DSP");
    println!("cargo:rerun-if-env-changed=CMSIS_CORE");
    println!("cargo:rustc-check-cfg=cfg(cmsis)");

    let mut options = Vec::new();
    if let Some(dsp) = env::var_os("CMSIS_DSP").map(PathBuf::from) {
        println!("cargo:rustc-cfg=cmsis");
        for folder in ["Include", "PrivateInclude"] {
            options.push(format!("-I{}", dsp.join(folder).display()));
        }
        options.push(match env::var("CMSIS_CORE") {
            Ok(folder) => format!("-I{folder}"),
            // The library's own way to do without; its functions in f32 use nothing of CMSIS-Core.
            Err(_) => "-D__GNUC_PYTHON__".into(),
        });
        options.extend(["-DCMSIS", "-DARM_MATH_LOOPUNROLL"].map(String::from));
        for function in ["arm_mat_vec_mult_f32", "arm_mat_mult_f32"] {
            let source = dsp.join("Source/MatrixFunctions").join(function).with_extension("c");
            compile(&source, "O3", &options);
        }
    }
    compile(Path::new(BASELINES), "O2", &[]);
    compile(Path::new(BASELINES), "O3", &options);
}

fn compile(source: &Path, level: &str, options: &[String]) {
    let name = source.file_stem().expect("a file").display();
    let object = format!("{}/{name}-{level}.o", env::var("OUT_DIR").expect("cargo sets it"));
    let status = Command::new("arm-none-eabi-gcc")
        .args(FLAGS)
        .args([format!("-{level}"), format!("-DLEVEL={level}")])
        .args(options)
        .arg(source)
        .args(["-o", &object])
        .status()
        .expect("arm-none-eabi-gcc is there: apt-get install gcc-arm-none-eabi");
    assert!(status.success(), "{} does not compile", source.display());
    println!("cargo:rustc-link-arg={object}");
    println!("cargo:rerun-if-changed={}", source.display());
}
