//! The whole path: a simulated robot is recorded, a model fitted to the log, written as a blob,
//! read back and asked, with the numbers of every stage compared; and what it costs in memory.

use std::path::Path;

use firmware_core::blob::Aligned;
use firmware_core::model::Space;
use firmware_core::{Predictor, PredictorState, Scalar, parse_prefix};
use firmware_sim::record::{self, Settings};
use trainer::edmd;
use trainer::export::{coordinate, export};
use trainer::recording::{Recording, Visitor};
use trainer::robot::{Robot, ScoreOptions};
use trainer::score::{self, Lifted};
use trainer::trajectory::Logs;

/// The ROSbot with its motion in the robot's own frame: exact in the heading, nearly exact in the
/// position.
const ROSBOT: &str = r#"
name = "rosbot"
sample_time_s = 0.1
states = [
    { name = "x", space = "R", unit = "m" },
    { name = "y", space = "R", unit = "m" },
    { name = "phi", space = "S1", unit = "rad" },
]
inputs = [
    { name = "omega_r", unit = "rad/s", range = [-32, 32] },
    { name = "omega_l", unit = "rad/s", range = [-32, 32] },
]
symmetry = { kind = "se2", coordinates = ["x", "y", "phi"] }
[dictionary]
order = 5
"#;

/// Largest error of a noise-free rollout over 50 steps, in metres and radians: what the motion in
/// the body frame, an entire function of the inputs, keeps beyond order 5 at up to four standard
/// deviations, and 50 roundings of f32 at a few metres.
const ROLLOUT_BOUND: f64 = 1e-4;

fn rosbot() -> Robot {
    Robot::parse(ROSBOT, Path::new("robot.toml")).unwrap()
}

fn record_rosbot(trials: u32, seed: u64, folder: &Path) {
    let settings = Settings {
        robot: record::Robot::Rosbot,
        trials,
        seconds: 30.0,
        seed,
        noise: 0.0,
        integrator: None,
        digits: None,
    };
    record::Recording::new(settings).unwrap().write(folder, false).unwrap();
}

/// States and inputs of one sample.
type Sample = (Vec<f64>, Vec<f64>);

/// All trajectories of a log with their names.
#[derive(Default)]
struct All {
    trajectories: Vec<(String, Vec<Sample>)>,
}

impl All {
    fn read(logs: &Path, robot: &Robot) -> Self {
        let mut all = Self::default();
        Recording::open(logs).unwrap().read(&robot.schema, &mut all).unwrap();
        all
    }
}

impl Visitor for All {
    fn begin(&mut self, name: &str) {
        self.trajectories.push((name.to_owned(), Vec::new()));
    }

    fn row(&mut self, states: &[f64], inputs: &[f64]) {
        self.trajectories.last_mut().unwrap().1.push((states.to_vec(), inputs.to_vec()));
    }
}

/// More bytes than any of the blobs.
const ROOM: usize = 1 << 17;

/// The blob of a fit, at an address that the core accepts.
fn blob(robot: &Robot, logs: &Path) -> Box<Aligned<[u8; ROOM]>> {
    let recording = Recording::open(logs).unwrap();
    let source = Logs { recording: &recording, schema: &robot.schema };
    let bytes = export(&edmd::fit(robot, &source, &|_| ()).unwrap()).unwrap();
    let mut slot = Box::new(Aligned([0xff; ROOM]));
    slot.0[..bytes.len()].copy_from_slice(&bytes);
    slot
}

/// What the controller predicts from sample `start` on for `horizon` steps.
fn controller(
    predictor: &Predictor<'_, '_>,
    rows: &[Sample],
    start: usize,
    horizon: usize,
) -> Vec<f32> {
    let structure = predictor.model().structure();
    let narrow = |inputs: &[f64]| inputs.iter().map(|u| *u as f32).collect::<Vec<_>>();
    let mut state = PredictorState::new();
    for row in start - structure.lag()..=start {
        let applied =
            if row + structure.lag() == start { vec![] } else { narrow(&rows[row - 1].1) };
        let states = rows[row].0.iter().zip(structure.states());
        let sample: Vec<f32> = states.map(|(x, s)| coordinate(*x, s.space)).collect();
        predictor.observe(&mut state, &applied, &sample).unwrap();
    }
    let inputs: Vec<f32> = rows[start..start + horizon].iter().flat_map(|r| narrow(&r.1)).collect();
    let mut predicted = vec![0.0; horizon * structure.states().len()];
    predictor.rollout(&mut state, &inputs, &mut predicted).unwrap();
    predicted
}

#[test]
fn a_recorded_robot_is_predicted() {
    let folder = tempfile::tempdir().unwrap();
    record_rosbot(10, 1, &folder.path().join("seen"));
    record_rosbot(2, 2, &folder.path().join("unseen"));
    let robot = rosbot();
    let slot = blob(&robot, &folder.path().join("seen"));
    let model = parse_prefix(&slot.0).unwrap();
    let predictor = Predictor::new(&model);
    let mut worst = 0.0_f64;
    for (_, rows) in &All::read(&folder.path().join("unseen"), &robot).trajectories {
        for start in (0..rows.len() - 51).step_by(10) {
            // Far from the origin f32 has fewer digits: start where the robot stands.
            let origin = [rows[start].0[0], rows[start].0[1], 0.0];
            let local: Vec<Sample> = rows[start..=start + 50]
                .iter()
                .map(|(x, u)| (x.iter().zip(origin).map(|(x, o)| x - o).collect(), u.clone()))
                .collect();
            let predicted = controller(&predictor, &local, 0, 50);
            for (predicted, (measured, _)) in predicted.chunks_exact(3).zip(&local[1..]) {
                let error = |i: usize| f64::from(predicted[i]) - measured[i];
                worst = worst.max(error(0).abs()).max(error(1).abs()).max(error(2).wrap().abs());
            }
        }
    }
    println!("largest error over 50 steps: {worst:.2e}");
    assert!(worst < ROLLOUT_BOUND, "{worst}");
}

#[test]
fn evaluate_shows_the_controllers_numbers_bit_for_bit() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let horizon = 20;
    let options = ScoreOptions { horizon, stride: 40, ..ScoreOptions::default() };
    let mut lags = Vec::new();
    for name in ["rosbot", "soft-leg", "two-link-arm"] {
        let robot = Robot::load(&models.join(name)).unwrap();
        let logs = models.join(name).join("logs");
        let slot = blob(&robot, &logs);
        let model = parse_prefix(&slot.0).unwrap();
        let predictor = Predictor::new(&model);
        lags.push(model.structure().lag());

        let recording = Recording::open(&logs).unwrap();
        let source = Logs { recording: &recording, schema: &robot.schema };
        let counts = score::count(&source, &[]).unwrap();
        let mut csv = Vec::new();
        let lifted = Lifted::Given(&model);
        let scored =
            score::score(&source, counts, lifted, &options, Some(&mut csv), &|_| ()).unwrap();
        let all = All::read(&logs, &robot);
        let csv = String::from_utf8(csv).unwrap();
        let mut lines = csv.lines().skip(1);
        let mut windows = 0;
        while let Some(first) = lines.next() {
            let mut window = vec![first];
            window.extend(lines.by_ref().take(horizon - 1));
            let start: usize = first.split(',').nth(1).unwrap().parse().unwrap();
            let trajectory = first.split(',').next().unwrap();
            let (_, rows) = all.trajectories.iter().find(|(name, _)| name == trajectory).unwrap();
            let predicted = controller(&predictor, rows, start, horizon);
            let n = robot.states.len();
            for (line, row) in window.iter().zip(predicted.chunks_exact(n)) {
                let numbers: Vec<f64> =
                    line.split(',').skip(3).map(|field| field.parse().unwrap()).collect();
                for (i, p) in row.iter().enumerate() {
                    let (measured, shown) = (numbers[2 * i], numbers[2 * i + 1]);
                    // An angle is shown on the turn of the measured one, by this very formula.
                    let expected = match robot.states[i].space {
                        Space::Line => f64::from(*p),
                        Space::Circle => measured + (f64::from(*p) - measured).wrap(),
                    };
                    assert_eq!(shown.to_bits(), expected.to_bits(), "{name}: {line}");
                }
            }
            windows += 1;
        }
        assert_eq!(windows, scored.windows);
        assert!(windows >= 10, "{name}: {windows}");
    }
    assert!(lags.iter().any(|lag| *lag > 0), "one of them looks back");
}

/// Memory is measured from outside the allocator, as the largest resident set of a process that
/// does nothing else: it counts every page touched, and needs no unsafe code.
#[cfg(target_os = "linux")]
mod memory {
    use std::io::Write;
    use std::process::Command;

    use trainer::trajectory::{InMemory, Trajectory};

    use super::*;

    /// Uniform in ±1, without a generator's crate.
    fn uniform(seed: &mut u64) -> f64 {
        *seed =
            seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        2.0 * (*seed >> 11) as f64 / (1_u64 << 53) as f64 - 1.0
    }

    /// One sample of the paper's drive and the inputs that act next.
    fn drive(pose: &mut [f64; 3], seed: &mut u64) -> ([f64; 3], [f64; 2]) {
        let (before, u) = (*pose, [15.0 * uniform(seed), 15.0 * uniform(seed)]);
        let ahead = 0.1 * 0.031 * (u[0] + u[1]);
        pose[0] += ahead * pose[2].cos();
        pose[1] += ahead * pose[2].sin();
        pose[2] += 0.1 * 0.062 / 0.228 * (u[0] - u[1]);
        (before, u)
    }

    /// Writes a log of one trajectory, row by row.
    fn write_log(path: &Path, rows: u64) {
        let mut file = std::io::BufWriter::new(std::fs::File::create(path).unwrap());
        let (mut pose, mut seed) = ([0.0; 3], 1);
        writeln!(file, "time_s,x_m,y_m,phi_rad,omega_r_radps,omega_l_radps").unwrap();
        for k in 0..rows {
            let ([x, y, phi], [r, l]) = drive(&mut pose, &mut seed);
            writeln!(file, "{}.{},{x:.6},{y:.6},{phi:.6},{r:.4},{l:.4}", k / 10, k % 10).unwrap();
        }
        file.flush().unwrap();
    }

    /// The paper's dictionary: 64 terms, 4 targets.
    const PAPER: &str = r#"
name = "rosbot"
    sample_time_s = 0.1
    states = [
        { name = "x", space = "R", unit = "m" },
        { name = "y", space = "R", unit = "m" },
        { name = "phi", space = "S1", unit = "rad" },
    ]
    inputs = [
        { name = "omega_r", unit = "rad/s", range = [-32, 32] },
        { name = "omega_l", unit = "rad/s", range = [-32, 32] },
    ]
    "#;

    fn paper() -> Robot {
        Robot::parse(PAPER, Path::new("robot.toml")).unwrap()
    }

    const LOG: &str = "PIPELINE_FIT_THIS_LOG";
    const KIB_PER_MIB: i64 = 1024;
    /// Between two runs of one and the same fit: pages of the program that happen to be mapped.
    const NOISE_KIB: i64 = 256;

    fn largest_resident_kib() -> i64 {
        let status = std::fs::read_to_string("/proc/self/status").unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
        line.trim().trim_end_matches("kB").trim().parse().unwrap()
    }

    /// Runs one of the tests below in a process of its own and takes the number that it prints.
    fn measured(test: &str, log: &Path) -> i64 {
        let output = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "--ignored", "--nocapture", "--test-threads=1", test])
            .env(LOG, log)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
        let number = said.split("peak_kib=").nth(1).and_then(|rest| rest.split_whitespace().next());
        number.expect("the process prints its peak").parse().unwrap()
    }

    #[test]
    #[ignore = "runs in a process of its own, started by the tests of memory"]
    fn process_that_fits_a_log() {
        let Some(log) = std::env::var_os(LOG) else { return };
        let robot = paper();
        let recording = Recording::open(Path::new(&log)).unwrap();
        let source = Logs { recording: &recording, schema: &robot.schema };
        let fitted = edmd::fit(&robot, &source, &|_| ()).unwrap();
        assert_eq!(fitted.operator.terms, 64);
        println!("\npeak_kib={}", largest_resident_kib());
    }

    #[test]
    #[ignore = "runs in a process of its own, started by the tests of memory"]
    fn process_that_fits_trajectories_in_memory() {
        if std::env::var_os(LOG).is_none() {
            return;
        }
        let robot = paper();
        let mut seed = 1;
        let trajectories: Vec<Trajectory> = (0..100)
            .map(|_| {
                let mut pose = [0.0; 3];
                let mut trajectory = Trajectory {
                    states: Vec::with_capacity(3 * 501),
                    inputs: Vec::with_capacity(2 * 501),
                };
                for _ in 0..=500 {
                    let (x, u) = drive(&mut pose, &mut seed);
                    trajectory.states.extend(x);
                    trajectory.inputs.extend(u);
                }
                trajectory
            })
            .collect();
        let source = InMemory { trajectories: &trajectories, states: 3, inputs: 2 };
        let before = largest_resident_kib();
        let fitted = edmd::fit(&robot, &source, &|_| ()).unwrap();
        assert_eq!((fitted.operator.pairs, fitted.operator.terms), (50_000, 64));
        println!("\npeak_kib={}", largest_resident_kib() - before);
    }

    /// Difference of the peaks of a short and a long log.
    fn growth(short: u64, long: u64) -> i64 {
        let folder = tempfile::tempdir().unwrap();
        let [a, b] = [short, long].map(|rows| {
            let log = folder.path().join(format!("{rows}.csv"));
            write_log(&log, rows);
            measured("memory::process_that_fits_a_log", &log)
        });
        println!("peak of a fit from CSV: {a} KiB at {short} rows, {b} KiB at {long} rows");
        b - a
    }

    #[test]
    fn a_fit_from_csv_takes_no_more_memory_for_a_longer_log() {
        // 95,000 more rows are 4.5 MB of text and 3.6 MB of numbers.
        assert!(growth(5_000, 100_000) < NOISE_KIB);
    }

    #[test]
    #[ignore = "writes and reads 260 MB; run with --release --ignored"]
    fn five_million_rows_take_as_much_memory_as_fifty_thousand() {
        assert!(growth(50_000, 5_000_000) < KIB_PER_MIB);
    }

    #[test]
    fn a_fit_from_memory_takes_four_megabytes_at_most() {
        let taken = measured("memory::process_that_fits_trajectories_in_memory", Path::new("."));
        println!("peak of a fit of 50,000 pairs beyond the caller's data: {taken} KiB");
        assert!(taken <= 4 * KIB_PER_MIB, "{taken} KiB");
    }
}
