//! What models in fixed point predict from random samples, to be compared with emulated controllers, and
//! their blobs in one file for these: firmware-sim/cortex-m/fixed runs both.

use std::process::ExitCode;

use firmware_core::q31;

#[path = "../../firmware-sim/cortex-m/src/q31_bits.rs"]
mod bits;

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let steps = arguments.next().and_then(|steps| steps.parse().ok());
    let (Some(steps), Some(list)) = (steps, arguments.next()) else {
        eprintln!("expected the number of steps, a file to write, and blobs");
        return ExitCode::FAILURE;
    };
    let mut all = Vec::new();
    for (i, path) in arguments.enumerate() {
        let bytes = std::fs::read(&path).expect("a blob");
        all.extend((bytes.len() as u32).to_le_bytes());
        all.extend(&bytes);
        let mut words = vec![0_u32; bytes.len().div_ceil(4)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(&bytes);
        let model = q31::parse(bytemuck::cast_slice(&words)).expect("a blob in fixed point");
        let Some((predicted, hash)) = bits::bits(&model, steps) else { return ExitCode::FAILURE };
        println!("{i} {} {predicted} of {steps} {hash:016x}", model.robot());
    }
    std::fs::write(list, all).expect("a file to write");
    ExitCode::SUCCESS
}
