//! Counts the instructions of a step on the emulated Cortex-M4F for models of all kinds, and holds the
//! trainer's cost table against them. `firmware-sim/cortex-m/measure` builds the image and runs it.

use std::io::Write;
use std::process::{Command, ExitCode};

use firmware_core::blob;
use firmware_core::capacity::MAX_OBSERVABLES;
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::model::{
    Input, Model, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};

/// Random numbers: xorshift64*.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 33
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n.max(1) as u64) as usize
    }

    fn chance(&mut self, percent: usize) -> bool {
        self.below(100) < percent
    }

    /// Between −1 and 1.
    fn number(&mut self) -> f32 {
        self.next() as f32 / (1_u64 << 30) as f32 - 1.0
    }
}

const NAMES: [&str; 8] = ["a", "b", "c", "d", "e", "f", "g", "h"];

/// A random model as a blob: sparse, or of Kronecker blocks.
fn model(random: &mut Random, dense: bool) -> Option<Vec<u8>> {
    let se2 = random.chance(30);
    let n = if se2 { 3 + random.below(4) } else { 1 + random.below(6) };
    let m = random.below(5);
    let states = (0..n).map(|i| {
        let circle = if se2 && i < 3 { i == 2 } else { random.chance(30) };
        let space = if circle { Space::Circle } else { Space::Line };
        let increment = se2 && i < 3 || random.chance(50);
        let target = if increment { Target::Increment } else { Target::Absolute };
        let limit = if circle { [f32::NEG_INFINITY, f32::INFINITY] } else { [-100.0, 100.0] };
        State { name: NAMES[i], unit: "", space, target, limit }
    });
    let states: Vec<State<'_>> = states.collect();
    let mut symmetry = Symmetry::None;
    if se2 {
        symmetry = Symmetry::Se2 { x: 0, y: 1, heading: 2 };
    } else if random.chance(30) {
        let coordinates = (0..n as u8).filter(|i| {
            states[usize::from(*i)].target == Target::Increment && random.chance(60)
        });
        symmetry = Symmetry::Translation { coordinates: coordinates.fold(0, |set, i| set | 1 << i) };
    }
    let largest = random.below(6) as u8;
    let mut sources = Vec::new();
    for (i, state) in states.iter().enumerate() {
        let i = i as u8;
        for lag in 0..=largest {
            if !symmetry.excludes(i) && (lag == 0 || random.chance(15)) {
                match state.space {
                    Space::Line => sources.push(vec![(Source::State(i), lag)]),
                    Space::Circle => {
                        sources.push(vec![(Source::Sin(i), lag), (Source::Cos(i), lag)]);
                    }
                }
            }
            if lag > 0 && random.chance(25) {
                sources.push(vec![(Source::Increment(i), lag)]);
            }
        }
    }
    for i in 0..m {
        for lag in 0..=largest {
            if lag == 0 || random.chance(30) {
                sources.push(vec![(Source::Input(i as u8), lag)]);
            }
        }
    }
    for i in (1..sources.len()).rev() {
        sources.swap(i, random.below(i + 1));
    }
    let most = if dense { 5 } else { 16 };
    sources.truncate(1 + random.below(most));
    let standardised = random.chance(30);
    let (mut observables, mut factors) = (Vec::new(), Vec::new());
    for group in &sources {
        let observable = observables.len() as u8;
        let fourier = group.len() == 2 && random.chance(70);
        let basis = if fourier { Basis::Fourier } else { Basis::Hermite };
        let order = if random.chance(70) { 1 } else { 2 + random.below(if dense { 1 } else { 3 }) as u8 };
        factors.push(Factor { observable, basis, order });
        for (source, lag) in group.iter().take(1 + usize::from(fourier)) {
            let scaled = standardised
                && matches!(source, Source::State(_) | Source::Increment(_) | Source::Input(_));
            let (centre, gain) = if scaled { (0.1, 1.5) } else { (0.0, 1.0) };
            observables.push(Observable { source: *source, lag: *lag, centre, gain });
        }
    }
    if observables.len() > MAX_OBSERVABLES {
        return None;
    }
    let block = Block { factors: 1, max_degree: 0 };
    let blocks = match dense {
        false => factors.iter().map(|_| block).collect(),
        true => {
            let first = 1 + random.below(factors.len());
            let mut blocks = vec![Block { factors: first as u8, max_degree: 0 }];
            blocks.extend((first..factors.len()).map(|_| block));
            blocks.into_iter().collect()
        }
    };
    let structure = Structure::try_from(ModelRepr {
        robot: if dense { "dense" } else { "sparse" },
        sample_time_s: 0.1,
        states: states.iter().copied().collect(),
        inputs: (0..m).map(|i| Input { name: NAMES[i], unit: "", range: [-1.0, 1.0] }).collect(),
        symmetry,
        observables: observables.iter().copied().collect(),
        factors: factors.iter().copied().collect(),
        blocks,
        provenance: Provenance { logs: [0; 32], robot: [0; 32] },
    })
    .ok()?;
    let functions = structure.dictionary().functions();
    let terms: Vec<[u8; 2]> = (0..random.below(25))
        .map(|k| {
            let parent = if random.chance(50) { 0 } else { random.below(k + 1) };
            [parent as u8, random.below(functions) as u8]
        })
        .collect();
    let width = if dense { structure.dictionary().dense_terms() } else { terms.len() + 1 };
    let coefficients: Vec<f32> = (0..structure.outputs() * width)
        .map(|i| if i % width == 0 { 0.3 } else { 0.1 * random.number() / width as f32 })
        .collect();
    let ranges = [-50.0, 50.0].repeat(observables.len());
    let ranges = random.chance(90).then_some(&ranges[..]);
    let model = match dense {
        true => Model::new(structure, &coefficients, ranges),
        false => Model::new_sparse(structure, &terms, &coefficients, ranges),
    }
    .ok()?;
    let samples = model.structure().lag() + 1;
    let mut numbers = |count: usize| (0..count).map(|_| random.number()).collect::<Vec<f32>>();
    let (x, u) = (numbers(samples * n), numbers(samples * m));
    let mut bytes = vec![0; 1 << 16];
    let length = blob::emit(&model, &x, &u, &vec![1e-3; n], &mut bytes).ok()?;
    bytes.truncate(length);
    Some(bytes)
}

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let image = arguments.next().unwrap_or_default();
    let count: usize = arguments.next().and_then(|n| n.parse().ok()).unwrap_or(40);
    let mut random = Random(1);
    let mut blobs = Vec::new();
    for robot in ["rosbot", "soft-leg", "two-link-arm"] {
        let path = format!("{}/../models/{robot}/model.bin", env!("CARGO_MANIFEST_DIR"));
        blobs.push(std::fs::read(path).expect("the blob of a model"));
    }
    while blobs.len() < 3 + count {
        let dense = blobs.len() % 4 == 3;
        blobs.extend(model(&mut random, dense));
    }
    let mut list = tempfile::NamedTempFile::new().expect("a temporary file");
    for blob in &blobs {
        list.write_all(&(blob.len() as u32).to_le_bytes()).expect("room");
        list.write_all(blob).expect("room");
    }
    let target = format!("enable=on,target=native,arg=list,arg={}", list.path().display());
    let output = Command::new("qemu-system-arm")
        .args(["-M", "netduinoplus2", "-icount", "shift=0", "-nographic"])
        .args(["-semihosting-config", &target, "-kernel", &image])
        .output()
        .expect("qemu-system-arm");
    let text = String::from_utf8_lossy(&output.stdout);
    print!("{text}");
    ExitCode::SUCCESS
}
