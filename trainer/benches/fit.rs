//! Fitting speed, one thread: the paper's drive dictionary (64 terms, 4 targets) from memory, beside
//! the matrix product that any dense method needs at least, ΨᵀΨ of the materialised lift by faer.

use std::hint::black_box;
use std::path::Path;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use trainer::edmd;
use trainer::export::{export, write_whole};
use trainer::recording::Recording;
use trainer::robot::Robot;
use trainer::trajectory::{InMemory, Logs, Trajectory};

const ROBOT: &str = r#"
name = "rosbot"
sample_time_s = 0.1
states = [
    { name = "x", space = "R", unit = "m" },
    { name = "y", space = "R", unit = "m" },
    { name = "phi", space = "S1", unit = "rad" },
]
inputs = [
    { name = "omega_r", unit = "rad/s", range = [-40, 40] },
    { name = "omega_l", unit = "rad/s", range = [-40, 40] },
]
[dictionary]
standardise = false
"#;

/// The paper's plant (r = 0.062 m, L = 0.228 m, Euler, T = 0.1 s) under inputs of variance 9².
fn drive(trajectories: usize, pairs: usize) -> Vec<Trajectory> {
    let mut seed = 1_u64;
    let mut uniform = move || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
    };
    (0..trajectories)
        .map(|_| {
            let (mut x, mut t) = ([0.0_f64; 3], Trajectory::default());
            for _ in 0..=pairs {
                let u = [18.0 * 3.0_f64.sqrt() * uniform(), 18.0 * 3.0_f64.sqrt() * uniform()];
                t.states.extend(x);
                t.inputs.extend(u);
                let ahead = 0.1 * 0.031 * (u[0] + u[1]);
                x[0] += ahead * x[2].cos();
                x[1] += ahead * x[2].sin();
                x[2] += 0.1 * 0.062 / 0.228 * (u[0] - u[1]);
            }
            t
        })
        .collect()
}

fn fit(c: &mut Criterion) {
    let robot = Robot::parse(ROBOT, Path::new("robot.toml")).expect("the description is valid");
    let mut group = c.benchmark_group("fit 64 terms x 4 targets");
    group.sample_size(20);
    for trajectories in [100, 1000] {
        let data = drive(trajectories, 500);
        let source = InMemory { trajectories: &data, states: 3, inputs: 2 };
        let pairs = trajectories * 500;
        group.bench_function(BenchmarkId::new("from memory", pairs), |b| {
            b.iter(|| black_box(edmd::fit(&robot, &source, &|_| ())));
        });
        if trajectories == 100 {
            let lifted = faer::Mat::from_fn(pairs, 64, |i, j| ((i * 64 + j) % 97) as f64 / 97.0);
            group.bench_function(BenchmarkId::new("faer product of the lift alone", pairs), |b| {
                b.iter(|| {
                    let mut gram = faer::Mat::zeros(64, 64);
                    faer::linalg::matmul::matmul(
                        gram.as_mut(),
                        faer::Accum::Replace,
                        black_box(&lifted).transpose(),
                        &lifted,
                        1.0,
                        faer::Par::Seq,
                    );
                    black_box(gram)
                });
            });
        }
    }
    group.finish();
}

/// 50,000 rows of CSV in one file to a blob on disk, without the scoring.
fn from_csv(c: &mut Criterion) {
    let robot = Robot::parse(ROBOT, Path::new("robot.toml")).expect("the description is valid");
    let folder = tempfile::tempdir().expect("a folder");
    let mut text = String::from("time_s,x_m,y_m,phi_rad,omega_r_radps,omega_l_radps\n");
    for trajectory in drive(1, 49_999) {
        let rows = trajectory.states.chunks_exact(3).zip(trajectory.inputs.chunks_exact(2));
        for (k, (x, u)) in rows.enumerate() {
            let time = k as f64 / 10.0;
            text += &format!("{time},{},{},{},{},{}\n", x[0], x[1], x[2], u[0], u[1]);
        }
    }
    let log = folder.path().join("log.csv");
    std::fs::write(&log, &text).expect("a file");
    let mut group = c.benchmark_group(format!("50000 rows of CSV, {} bytes", text.len()));
    group.sample_size(20);
    group.bench_function("read, fit and write the blob", |b| {
        b.iter(|| {
            let recording = Recording::open(&log).expect("the log is there");
            let source = Logs { recording: &recording, schema: &robot.schema };
            let fitted = edmd::fit(&robot, &source, &|_| ()).expect("the log is good");
            let bytes = export(&fitted).expect("the model is good");
            write_whole(&folder.path().join("model.bin"), |f| f.write_all(&bytes)).expect("room");
        });
    });
    group.bench_function("read and split the lines alone", |b| {
        b.iter(|| {
            let bytes = std::fs::read(&log).expect("the log is there");
            black_box(bytes.split(|byte| [b',', b'\n'].contains(byte)).count())
        });
    });
    group.finish();
}

criterion_group!(benches, fit, from_csv);
criterion_main!(benches);
