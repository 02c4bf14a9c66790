//! What the host predicts from random samples, to be compared with the emulated controller:
//! firmware-sim/cortex-m/bits runs both.

use std::path::Path;
use std::process::ExitCode;

use firmware_sim::run::Blob;
use trainer::recording::{Recording, Visitor};
use trainer::robot::Robot;

#[path = "../../firmware-sim/cortex-m/src/bits.rs"]
mod bits;
#[path = "../../firmware-sim/cortex-m/src/shapes.rs"]
mod shapes;

/// In the order of the image.
const MODELS: [&str; 4] = ["rosbot", "skid-rosbot", "soft-leg", "two-link-arm"];

/// The samples of a robot's logs, states and then inputs; NaN where a trajectory begins.
#[derive(Default)]
struct Samples {
    numbers: Vec<f32>,
    width: usize,
}

impl Visitor for Samples {
    fn begin(&mut self, _: &str) {
        self.numbers.extend(std::iter::repeat_n(f32::NAN, self.width));
    }

    fn row(&mut self, states: &[f64], inputs: &[f64]) {
        self.numbers.extend(states.iter().chain(inputs).map(|x| *x as f32));
    }
}

/// Predicts along the logs of models/, and puts their samples into a file for the target.
fn recorded(file: &Path) {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let mut bytes = Vec::new();
    for robot in MODELS {
        let folder = models.join(robot);
        let blob = Blob::read(&folder.join("model.bin")).expect("a model of models/");
        let model = blob.model().expect("a blob");
        let structure = model.structure();
        let width = structure.states().len() + structure.inputs().len();
        let mut samples = Samples { numbers: Vec::new(), width };
        let robot = Robot::load(&folder).expect("a description");
        let logs = Recording::open(&folder.join("logs")).expect("logs");
        logs.read(&robot.schema, &mut samples).expect("logs");
        bytes.extend(((samples.numbers.len() / width) as u32).to_le_bytes());
        bytes.extend(samples.numbers.iter().flat_map(|x| x.to_le_bytes()));
        let mut rows = samples.numbers.chunks_exact(width);
        let replay = bits::replay(&model, |sample| {
            rows.next().map(|row| sample.copy_from_slice(row)).is_some()
        });
        let replay = replay.expect("finite samples");
        println!("{} {} rollouts {:016x}", structure.robot(), replay.rollouts, replay.hash);
        for (error, state) in replay.error.iter().zip(structure.states()) {
            println!("  {}: mean square {:e} ({})2", state.name, error, state.unit);
        }
    }
    std::fs::write(file, bytes).expect("a file");
}

fn main() -> ExitCode {
    if let [_, command, file] = &std::env::args().collect::<Vec<_>>()[..]
        && command == "recorded"
    {
        recorded(Path::new(file));
        return ExitCode::SUCCESS;
    }
    let steps = std::env::args().nth(1).and_then(|steps| steps.parse().ok());
    let Some(steps) = steps else {
        eprintln!("expected the number of steps");
        return ExitCode::FAILURE;
    };
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    for robot in MODELS {
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
