//! What the host predicts from random samples, to be compared with the emulated controller:
//! firmware-sim/cortex-m/bits runs both.

use std::path::Path;
use std::process::ExitCode;

use firmware_sim::run::Blob;

#[path = "../../firmware-sim/cortex-m/src/bits.rs"]
mod bits;
#[path = "../../firmware-sim/cortex-m/src/shapes.rs"]
mod shapes;

fn main() -> ExitCode {
    let steps = std::env::args().nth(1).and_then(|steps| steps.parse().ok());
    let Some(steps) = steps else {
        eprintln!("expected the number of steps");
        return ExitCode::FAILURE;
    };
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    for robot in ["rosbot", "skid-rosbot", "soft-leg", "two-link-arm"] {
        let blob = Blob::read(&models.join(robot).join("model.bin")).expect("a model of models/");
        let model = blob.model().expect("a blob");
        match bits::bits(&model, steps) {
            Some((predicted, hash)) => println!("{robot} {predicted} of {steps} {hash:016x}"),
            None => return ExitCode::FAILURE,
        }
    }
    for shape in shapes::SHAPES {
        let mut room = [0.0; shapes::COEFFICIENTS];
        let model = shape.model(&mut room).expect("a model");
        match bits::bits(&model, steps) {
            Some((predicted, hash)) => {
                println!("{} {predicted} of {steps} {hash:016x}", shape.name);
            }
            None => return ExitCode::FAILURE,
        }
    }
    ExitCode::SUCCESS
}
