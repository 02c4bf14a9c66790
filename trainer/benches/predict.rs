//! Prediction speed on the host in f32, one thread: one lifted step of the models in models/,
//! beside a step that forms all terms of the lift and multiplies them with the operator.

use std::hint::black_box;
use std::path::Path;

use criterion::{Criterion, criterion_group, criterion_main};
use firmware_core::capacity::MAX_OBSERVABLES;
use firmware_core::{Predictor, PredictorState, blob};

fn predict(c: &mut Criterion) {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    let mut group = c.benchmark_group("one step");
    for robot in ["rosbot", "soft-leg", "two-link-arm"] {
        let bytes = std::fs::read(models.join(robot).join("model.bin")).expect("the blob is there");
        let mut words = vec![0_u32; bytes.len().div_ceil(4)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(&bytes);
        let bytes = &bytemuck::cast_slice(&words)[..bytes.len()];
        let model = firmware_core::parse(bytes).expect("the blob is valid");
        let test = blob::self_test(bytes).expect("the blob is valid");
        let structure = model.structure();
        let (n, m) = (structure.states().len(), structure.inputs().len());

        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        let mut applied: &[f32] = &[];
        for (x, u) in test.states.chunks_exact(n).zip(test.inputs.chunks_exact(m)) {
            predictor.observe(&mut state, applied, x).expect("a valid sample");
            applied = u;
        }
        let start = state.clone();
        group.bench_function(format!("{robot}: lifted step"), |b| {
            b.iter(|| {
                if predictor.step(black_box(&mut state), black_box(applied)).is_err() {
                    state = start.clone();
                }
            });
        });
        let dictionary = structure.dictionary();
        let mut values = [0.0_f32; MAX_OBSERVABLES];
        let mut terms = vec![0.0_f32; dictionary.dense_terms()];
        let mut outputs = vec![0.0_f32; structure.outputs()];
        group.bench_function(format!("{robot}: lift and multiply, without the rest"), |b| {
            b.iter(|| {
                start.history().observe(structure, black_box(applied), &mut values);
                dictionary.lift_dense(&values, &mut terms);
                let rows = model.coefficients().chunks_exact(terms.len());
                for (z, row) in outputs.iter_mut().zip(rows) {
                    *z = row.iter().zip(&terms).map(|(c, t)| c * t).sum();
                }
                black_box(&mut outputs);
            });
        });
    }
    group.finish();
}

criterion_group!(benches, predict);
criterion_main!(benches);
