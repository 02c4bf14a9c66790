//! Fitting speed, one thread: the paper's drive dictionary (64 terms, 4 targets) from memory, beside
//! the matrix product that any dense method needs at least, ΨᵀΨ of the materialised lift by faer.

use std::hint::black_box;
use std::path::Path;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use trainer::edmd;
use trainer::robot::Robot;
use trainer::trajectory::{InMemory, Trajectory};

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

criterion_group!(benches, fit);
criterion_main!(benches);
