//! Predictions from random samples, as many as the semihosting argument `bits N` says, with each model of
//! models/, or along the samples of the file of `bits recorded FILE`: `bits` in the folder above compares them with
//! the host's. It is an image of its own, because what else
//! an image holds changes how the compiler makes the step that `measure` counts.
#![no_std]
#![no_main]

use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use firmware_core::blob::parse;

#[path = "../bits.rs"]
mod bits;
// A file of the host is nothing that is needed here.
#[allow(dead_code)]
#[path = "../host.rs"]
mod host;
// Nor is the counter.
#[allow(dead_code)]
#[path = "../machine.rs"]
mod machine;
#[path = "../models.rs"]
mod models;
#[path = "../shapes.rs"]
mod shapes;
#[path = "../vectors.rs"]
mod vectors;

use models::MODELS;

#[entry]
fn main() -> ! {
    machine::end(predict().is_some())
}

fn predict() -> Option<()> {
    let mut line = [0; 256];
    if let Some(name) = host::argument(&mut line, b"bits recorded ") {
        return recorded(&mut host::File::open(name)?);
    }
    let mut line = [0; 256];
    let (_, digits) = host::argument(&mut line, b"bits ")?.split_last()?;
    let steps = core::str::from_utf8(digits).ok()?.parse().ok()?;
    for blob in MODELS {
        let model = parse(&blob.0).ok()?;
        let (predicted, hash) = bits::bits(&model, steps)?;
        let robot = model.structure().robot();
        hprintln!("{} {} of {} {:016x}", robot, predicted, steps, hash);
    }
    for shape in shapes::SHAPES {
        let mut room = [0.0; shapes::COEFFICIENTS];
        let (predicted, hash) = bits::bits(&shape.model(&mut room)?, steps)?;
        hprintln!("{} {} of {} {:016x}", shape.name, predicted, steps, hash);
    }
    Some(())
}

/// Predicts along the samples of a file: for each model of models/ their number (u32), then the samples.
fn recorded(file: &mut host::File) -> Option<()> {
    for blob in MODELS {
        let model = parse(&blob.0).ok()?;
        let mut left = [0; 4];
        file.read(&mut left);
        let mut left = u32::from_le_bytes(left);
        let replay = bits::replay(&model, |sample| {
            if left == 0 {
                return false;
            }
            left -= 1;
            sample.iter_mut().all(|x| {
                let mut bytes = [0; 4];
                let whole = file.read(&mut bytes) == bytes.len();
                *x = f32::from_le_bytes(bytes);
                whole
            })
        })?;
        let structure = model.structure();
        hprintln!("{} {} rollouts {:016x}", structure.robot(), replay.rollouts, replay.hash);
        for (error, state) in replay.error.iter().zip(structure.states()) {
            hprintln!("  {}: mean square {:e} ({})2", state.name, error, state.unit);
        }
    }
    Some(())
}
