//! Counts the instructions of a step on the emulated Cortex-M4F for models of all kinds, and holds the
//! cost table against them. `firmware-sim/cortex-m/measure` builds the image and runs it.

use std::io::Write;
use std::process::{Command, ExitCode};

use firmware_core::blob;
use firmware_core::capacity::MAX_OBSERVABLES;
use firmware_core::cost::{self, Cost, Part};
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::model::{
    Input, Model, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};
use firmware_sim::run::store::{BLOB_INSTRUCTIONS, LINE_INSTRUCTIONS, SIGNATURE_INSTRUCTIONS};

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
        let coordinates = (0..n as u8)
            .filter(|i| states[usize::from(*i)].target == Target::Increment && random.chance(60));
        symmetry =
            Symmetry::Translation { coordinates: coordinates.fold(0, |set, i| set | 1 << i) };
    }
    // Half of the dense models look at the present sample alone.
    let now = dense && random.chance(50);
    let largest = if now { 0 } else { random.below(6) as u8 };
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
    for i in (1..sources.len()).rev().filter(|_| !now) {
        sources.swap(i, random.below(i + 1));
    }
    let most = if dense { 5 } else { 16 };
    sources.truncate(1 + random.below(most));
    let standardised = random.chance(30);
    let (mut observables, mut factors) = (Vec::new(), Vec::new());
    for group in &sources {
        let observable = observables.len() as u8;
        let fourier = group.len() == 2 && random.chance(if now { 10 } else { 70 });
        let basis = if fourier { Basis::Fourier } else { Basis::Hermite };
        let order =
            if random.chance(70) { 1 } else { 2 + random.below(if dense { 1 } else { 3 }) as u8 };
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
            let first = if now { factors.len() } else { 1 + random.below(factors.len()) };
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
    let ranges = Some(&ranges[..]);
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

/// A worse deviation of a sparse model than this fails.
const WORST: f64 = 0.02;
/// Models whose counts the numbers are fitted to; the others only check them.
const FITTED: f64 = 0.7;

/// A model that has been measured.
struct Row {
    name: String,
    dense: bool,
    parts: Vec<Part>,
    measured: f64,
    predicted: f64,
    bytes: u32,
}

impl Row {
    fn deviation(&self) -> f64 {
        self.predicted / self.measured - 1.0
    }
}

fn main() -> ExitCode {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let fit = arguments.iter().any(|a| a == "--fit");
    arguments.retain(|a| a != "--fit");
    let [image, rest @ ..] = &arguments[..] else {
        eprintln!("usage: step_cost IMAGE [MODELS] [--fit]");
        return ExitCode::FAILURE;
    };
    let count: usize = rest.first().and_then(|n| n.parse().ok()).unwrap_or(40);
    let mut random = Random(1);
    let mut blobs = Vec::new();
    for robot in ["rosbot", "skid-rosbot", "soft-leg", "two-link-arm"] {
        let path = format!("{}/../models/{robot}/model.bin", env!("CARGO_MANIFEST_DIR"));
        blobs.push((robot.to_owned(), std::fs::read(path).expect("the blob of a model")));
    }
    while blobs.len() < 4 + count {
        let dense = blobs.len() % 4 == 3;
        let name = format!("{} {}", if dense { "dense" } else { "sparse" }, blobs.len());
        blobs.extend(model(&mut random, dense).map(|blob| (name, blob)));
    }
    let mut rows = measure(image, &blobs);
    if fit {
        let constants = fitted(&rows);
        for (constant, part) in constants.iter().zip(&rows[0].parts) {
            println!("{constant:.1} // {}", part.name);
        }
        for row in &mut rows {
            let products = row.parts.iter().zip(&constants).map(|(p, each)| p.count as f64 * each);
            row.predicted = products.sum();
        }
    }
    println!("{:<52} instructions", "part of a step");
    for part in &rows[0].parts {
        println!("{:<52} {:>12.1}", part.name, part.each);
    }
    println!("{:<14} {:>8} {:>9} {:>7} {:>7}", "model", "counted", "predicted", "off", "bytes");
    for row in &rows {
        let Row { name, measured, predicted, bytes, .. } = row;
        let off = 100.0 * row.deviation();
        println!("{name:<14} {measured:>8.0} {predicted:>9.0} {off:>6.2}% {bytes:>7}");
    }
    let worst = |dense: bool, rows: &[Row]| {
        let own = rows.iter().filter(|r| r.dense == dense).map(|r| r.deviation().abs());
        own.fold(0.0, f64::max)
    };
    let (_, checked) = rows.split_at((rows.len() as f64 * FITTED) as usize);
    println!(
        "worst of the sparse models {:.2} % (left out of a fit: {:.2} %), of the dense ones {:.1} %",
        100.0 * worst(false, &rows),
        100.0 * worst(false, checked),
        100.0 * worst(true, &rows)
    );
    if worst(false, &rows) <= WORST { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Counts the instructions of a step of every blob.
fn measure(image: &str, blobs: &[(String, Vec<u8>)]) -> Vec<Row> {
    let mut list = tempfile::NamedTempFile::new().expect("a temporary file");
    for (_, blob) in blobs {
        list.write_all(&(blob.len() as u32).to_le_bytes()).expect("room");
        list.write_all(blob).expect("room");
    }
    let target = format!("enable=on,target=native,arg=list,arg={}", list.path().display());
    let output = Command::new("qemu-system-arm")
        .args(["-M", "netduinoplus2", "-icount", "shift=0", "-nographic"])
        .args(["-semihosting-config", &target, "-kernel", image])
        .output()
        .expect("qemu-system-arm");
    let text = String::from_utf8_lossy(&output.stdout);
    if !output.status.success() {
        panic!("the image failed:\n{text}{}", String::from_utf8_lossy(&output.stderr));
    }
    let mut lines = text.lines();
    println!("{}", lines.next().unwrap_or_default());
    let update = lines.next().unwrap_or_default();
    println!("{update}");
    let number = |name: &str| -> f64 {
        let after = update.split_once(name).map(|(_, rest)| rest.split([',', ' ']).next());
        after.flatten().and_then(|n| n.parse().ok()).expect("a number")
    };
    // What the simulated controller is charged with.
    let signature = number("signature ") / SIGNATURE_INSTRUCTIONS as f64;
    assert!((signature - 1.0).abs() < 0.02, "{signature} of the instructions of a signature");
    let blob = (number("hash ") + number("parse ")) / BLOB_INSTRUCTIONS as f64;
    assert!((blob - 1.0).abs() < 0.02, "{blob} of the instructions per byte of a blob");
    let line = number("line ") / f64::from(LINE_INSTRUCTIONS);
    assert!((line - 1.0).abs() < 0.02, "{line} of the instructions per byte of the line");
    let rows = lines.zip(blobs).map(|(line, (name, blob))| {
        let measured = line.split(' ').nth(2).and_then(|n| n.parse().ok()).expect("a count");
        let mut words = vec![0_u32; blob.len() / 4];
        let aligned: &mut [u8] = bytemuck::cast_slice_mut(&mut words);
        aligned.copy_from_slice(blob);
        let model = firmware_core::parse(aligned).expect("a blob");
        let (structure, terms) = (model.structure(), model.terms());
        let cost = Cost::new(structure, terms);
        // Error bounds come later.
        if model.error_bounds().is_none() {
            assert_eq!(cost.bytes as usize, blob.len(), "{name}: the length is known beforehand");
        }
        Row {
            name: name.clone(),
            dense: terms.is_none(),
            parts: cost::parts(structure, terms).to_vec(),
            measured,
            predicted: cost.instructions.into(),
            bytes: cost.bytes,
        }
    });
    rows.collect()
}

/// Instructions per feature that fit the first models with the least relative squares, sparse and
/// dense apart where they share nothing.
fn fitted(rows: &[Row]) -> Vec<f64> {
    let n = rows[0].parts.len();
    let (rows, _) = rows.split_at((rows.len() as f64 * FITTED) as usize);
    // The table of dense models is coarse: they do not shape the numbers that sparse ones share.
    let weight = |row: &Row| if row.dense { 1e-3 } else { 1.0 } / row.measured;
    let mut sums = vec![vec![0.0; n + 1]; n];
    for row in rows {
        let w = weight(row);
        for (own, part) in sums.iter_mut().zip(&row.parts) {
            let a = part.count as f64 * w;
            for (sum, other) in own.iter_mut().zip(&row.parts) {
                *sum += a * other.count as f64 * w;
            }
            own[n] += a * row.measured * w;
        }
    }
    for (i, row) in sums.iter_mut().enumerate() {
        // Features that do not occur are 0.
        row[i] += 1e-16;
    }
    for i in 0..n {
        let pivot = (i..n).max_by(|a, b| sums[*a][i].abs().total_cmp(&sums[*b][i].abs()));
        sums.swap(i, pivot.unwrap_or(i));
        let pivot = sums[i].clone();
        for (j, row) in sums.iter_mut().enumerate() {
            if j != i {
                let factor = row[i] / pivot[i];
                row.iter_mut().zip(&pivot).for_each(|(to, from)| *to -= factor * from);
            }
        }
    }
    (0..n).map(|i| sums[i][n] / sums[i][i]).collect()
}
