//! Prints what the example in C should have printed, from what firmware-core predicts on the host.
//!
//!     replay BLOB <OUTPUT
//!
//! What is measured, applied and asked is taken from the lines of the output; everything that a model
//! says or predicts is computed here.

use std::fmt::Write as _;
use std::io::Read;

use firmware_core::blob::Aligned;
use firmware_core::{Model, Predictor, PredictorState};

/// Steps that the example looks ahead.
const HORIZON: usize = 10;

fn main() {
    let path = std::env::args().nth(1).expect("replay BLOB <OUTPUT");
    let bytes = std::fs::read(path).expect("the blob cannot be read");
    let mut room = Aligned([0; 65_536]);
    let blob = &mut room.0[..bytes.len()];
    blob.copy_from_slice(&bytes);
    let model = firmware_core::parse(blob).expect("not a blob");
    let mut output = String::new();
    std::io::stdin().read_to_string(&mut output).expect("the output cannot be read");
    print!("{}", replay(&model, &output));
}

fn replay(model: &Model<'_>, output: &str) -> String {
    let (predictor, mut state) = (Predictor::new(model), PredictorState::new());
    let mut said = describe(model);
    let mut applied = Vec::new();
    for line in output.lines() {
        let (what, numbers) = line.split_once(' ').unwrap_or((line, ""));
        let asked =
            || -> Vec<f32> { numbers.split(' ').filter(|n| !n.is_empty()).map(parse).collect() };
        let mut ahead = state.clone();
        let mut path = vec![0.0; HORIZON * model.structure().states().len()];
        match what {
            "applied" => applied = asked(),
            "measured" => predictor.observe(&mut state, &applied, &asked()).expect("observe"),
            "held" => predictor.rollout_held(&mut ahead, &asked(), &mut path).expect("held"),
            "inputs" => predictor.rollout(&mut ahead, &asked(), &mut path).expect("inputs"),
            _ => continue,
        }
        print(&mut said, what, &asked());
        if matches!(what, "held" | "inputs") {
            for row in path.chunks_exact(model.structure().states().len()) {
                print(&mut said, "predicted", row);
            }
        }
        if what == "inputs" {
            let (step, observable) =
                ahead.out_of_range().map_or((0, 0), |out| (out.step, out.observable));
            writeln!(said, "out_of_range {step} {observable}").unwrap();
        }
    }
    said
}

fn describe(model: &Model<'_>) -> String {
    let (structure, bounds) = (model.structure(), model.error_bounds());
    let horizon = bounds.map_or(0, |b| *b.horizons().last().unwrap());
    let mut said =
        format!("robot {} lag {} horizon {horizon}\n", structure.robot(), structure.lag());
    print(&mut said, "sample_time_s", &[structure.sample_time_s()]);
    print(&mut said, "coverage", &[bounds.map_or(0.0, |b| b.coverage())]);
    for state in structure.states() {
        writeln!(said, "state {} {}", state.name, state.unit).unwrap();
    }
    for input in structure.inputs() {
        writeln!(said, "input {} {}", input.name, input.unit).unwrap();
        print(&mut said, "range", &input.range);
    }
    for step in 0..=horizon {
        let row: Vec<f32> = (0..structure.states().len())
            .map(|i| bounds.and_then(|b| b.bound(step, i)).unwrap_or(0.0))
            .collect();
        print(&mut said, "bound", &row);
    }
    said
}

fn parse(bits: &str) -> f32 {
    f32::from_bits(u32::from_str_radix(bits, 16).expect("eight hexadecimal digits"))
}

fn print(said: &mut String, what: &str, numbers: &[f32]) {
    said.push_str(what);
    for number in numbers {
        write!(said, " {:08x}", number.to_bits()).unwrap();
    }
    said.push('\n');
}
