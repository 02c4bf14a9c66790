//! Folding, and steps that take no look at each part of a model: exact sums first, then against the step that
//! does, to the bit.

#[path = "../../firmware-sim/cortex-m/src/shapes.rs"]
mod shapes;

use firmware_core::kernel::{Run, fold, fold_portable};
use firmware_core::{Model, PredictError, Predictor, PredictorState, Structure};
use proptest::prelude::*;
use shapes::{COEFFICIENTS, DRIVE, DRIVE_SE2, LEG, SHAPES, Shape};

/// Numbers by xorshift (Marsaglia 2003).
fn numbers(seed: u64) -> impl FnMut() -> u64 {
    let mut state = seed | 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state >> 8
    }
}

#[test]
fn runs_are_polynomials() {
    let shapes = [(2, 6), (3, 2), (4, 2), (5, 1), (6, 1), (7, 1), (9, 1)];
    for (radix, most) in shapes {
        for count in 1..=most {
            let run = Run::new(radix, count).unwrap();
            let size = usize::from(radix).pow(count.into());
            assert_eq!((run.size(), run.count()), (size, count.into()));
            let mut next = numbers(u64::from(radix) * 100 + u64::from(count));
            let mut small = |most: u64| (next() % (2 * most + 1)) as i64 - most as i64;
            for tiles in [1, 2, 7, 8, 9, 20] {
                // Small integers: every sum is exact in f32.
                let c: Vec<i64> = (0..tiles * size).map(|_| small(9)).collect();
                let v: Vec<i64> = (0..count).map(|_| small(2)).collect();
                let expected = c.chunks(size).map(|tile| {
                    let terms = tile.iter().enumerate().map(|(i, c)| {
                        let powers = v.iter().rev().scan(i, |rest, v| {
                            let digit = *rest % usize::from(radix);
                            *rest /= usize::from(radix);
                            Some(v.pow(digit as u32))
                        });
                        c * powers.product::<i64>()
                    });
                    terms.sum::<i64>() as f32
                });
                let expected: Vec<f32> = expected.collect();
                let [c, v] = [c, v].map(|all| all.iter().map(|x| *x as f32).collect::<Vec<_>>());
                let (mut folded, mut again) = (vec![0.0; tiles], vec![0.0; tiles]);
                fold_portable(run, &c, &mut folded, &v);
                fold(run, &c, &mut again, &v);
                assert_eq!(folded, expected, "{radix} {count} {tiles}");
                assert_eq!(again, expected, "{radix} {count} {tiles}");
            }
        }
    }
    // What does not fit together: as far as it goes.
    let c: Vec<f32> = (0_u8..7).map(f32::from).collect();
    for (run, v, expected) in [
        (Run::default(), &[][..], [9.0; 3]),
        (Run::new(2, 1).unwrap(), &[], [9.0; 3]),
        (Run::new(2, 1).unwrap(), &[10.0], [10.0, 32.0, 54.0]),
        (Run::new(2, 2).unwrap(), &[100.0, 10.0], [3210.0, 9.0, 9.0]),
        (Run::new(9, 1).unwrap(), &[1.0], [9.0; 3]),
    ] {
        let (mut folded, mut again) = ([9.0; 3], [9.0; 3]);
        fold_portable(run, &c, &mut folded, v);
        fold(run, &c, &mut again, v);
        assert_eq!((folded, again), (expected, expected), "{run:?}");
    }
    for (radix, count) in [(0, 1), (2, 0), (2, 7), (3, 3), (4, 3), (5, 2), (255, 255)] {
        assert_eq!(Run::new(radix, count), None, "{radix} {count}");
    }
}

/// The same model without trained ranges, whose steps look at every part.
fn at_length<'a>(model: &Model<'a>) -> Model<'a> {
    Model::new(model.structure().clone(), model.coefficients(), None).unwrap()
}

fn coordinates(predictor: &Predictor<'_, '_>, state: &PredictorState) -> Vec<u32> {
    let mut x = vec![0.0; predictor.model().structure().states().len()];
    predictor.coordinates(state, &mut x).unwrap();
    x.iter().map(|x| x.to_bits()).collect()
}

/// Steps of a shape from random samples with random inputs, some out of range, some not finite: the short step
/// finds what the long one does.
fn compare(shape: &Shape, seed: u64) {
    let mut room = [0.0; COEFFICIENTS];
    let model = shape.model(&mut room).unwrap();
    let long = at_length(&model);
    let (short, long) = (Predictor::new(&model), Predictor::new(&long));
    let n = model.structure().states().len();
    let mut next = numbers(seed);
    let mut number = |most: f32| most * ((next() % 20_001) as f32 / 10_000.0 - 1.0);
    let (mut a, mut b) = (PredictorState::new(), PredictorState::new());
    for step in 0..200 {
        if step % 10 == 0 {
            let measured: Vec<f32> = (0..n).map(|_| number(3.5)).collect();
            short.observe(&mut a, &[0.0; 2], &measured).unwrap();
            long.observe(&mut b, &[0.0; 2], &measured).unwrap();
        }
        let mut input = [number(70.0), number(70.0)];
        if step % 37 == 0 {
            input[step % 2] = [f32::NAN, f32::INFINITY, -f32::NAN][step % 3];
        }
        let before = a.clone();
        let made = short.step(&mut a, &input);
        assert_eq!(made, long.step(&mut b, &input), "{} {step}", shape.name);
        if made.is_err() {
            assert_eq!(a, before);
        }
        assert_eq!(coordinates(&short, &a), coordinates(&long, &b), "{} {step}", shape.name);
        assert_eq!(a.step(), b.step());
        let outside = input.iter().position(|u| u.abs() > 60.0);
        if let (Ok(()), Some(_), None) = (made, outside, before.out_of_range()) {
            assert_eq!(a.out_of_range().map(|found| found.step), Some(a.step()));
        }
    }
}

/// Holding an input is as many steps with it, also where they end early.
fn hold(shape: &Shape, seed: u64, most: f32) {
    let mut room = [0.0; COEFFICIENTS];
    let model = shape.model(&mut room).unwrap();
    let predictor = Predictor::new(&model);
    let n = model.structure().states().len();
    let mut next = numbers(seed);
    let mut number = |most: f32| most * ((next() % 20_001) as f32 / 10_000.0 - 1.0);
    let mut start = PredictorState::new();
    let measured: Vec<f32> = (0..n).map(|_| number(3.5)).collect();
    predictor.observe(&mut start, &[], &measured).unwrap();
    let input = [number(most), number(most)];
    for steps in [0, 1, 2, 10, 50] {
        let (mut held, mut rolled, mut stepped) = (start.clone(), start.clone(), start.clone());
        let mut path = vec![f32::NAN; steps * n];
        let mut expected = vec![f32::NAN; steps * n];
        let mut ended = Ok(());
        for row in expected.chunks_mut(n) {
            ended = predictor.step(&mut stepped, &input);
            if ended.is_err() {
                break;
            }
            predictor.coordinates(&stepped, row).unwrap();
        }
        assert_eq!(predictor.hold(&mut held, &input, steps), ended, "{}", shape.name);
        assert_eq!(predictor.rollout_held(&mut rolled, &input, &mut path), ended);
        assert_eq!(held, stepped, "{} {steps}", shape.name);
        assert_eq!(rolled, stepped);
        let bits = |path: &[f32]| path.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&path), bits(&expected));
    }
}

proptest! {
    #[test]
    fn short_steps_are_long_ones(seed in any::<u64>()) {
        for shape in &SHAPES {
            compare(shape, seed);
        }
    }

    #[test]
    fn held_inputs_are_steps(seed in any::<u64>()) {
        for shape in &SHAPES {
            hold(shape, seed, 10.0);
            // Beyond the trained ranges, and until it diverges.
            hold(shape, seed, 200.0);
        }
    }
}

/// A further input that nothing observes has to be given, too.
#[test]
fn all_inputs_are_asked_for() {
    let mut room = [0.0; COEFFICIENTS];
    let model = DRIVE.model(&mut room).unwrap();
    let mut repr = model.structure().to_repr();
    let third = *repr.inputs.last().unwrap();
    repr.inputs.push(third).unwrap();
    let structure = Structure::try_from(repr).unwrap();
    let wider = Model::new(structure, model.coefficients(), model.ranges()).unwrap();
    let predictor = Predictor::new(&wider);
    let mut state = PredictorState::new();
    predictor.observe(&mut state, &[], &[0.5; 3]).unwrap();
    let expected = Err(PredictError::DimensionMismatch { field: "inputs", expected: 3, found: 2 });
    assert_eq!(predictor.step(&mut state, &[1.0, 2.0]), expected);
    assert_eq!(predictor.hold(&mut state, &[1.0, 2.0], 2), expected);
    assert_eq!(predictor.step(&mut state, &[1.0, 2.0, 3.0]), Ok(()));
}

#[test]
fn what_is_wrong_is_told() {
    for shape in [DRIVE, LEG, DRIVE_SE2] {
        let mut room = [0.0; COEFFICIENTS];
        let model = shape.model(&mut room).unwrap();
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        let not_ready = Err(PredictError::NotReady { have: 0, need: 1 });
        assert_eq!(predictor.step(&mut state, &[1.0, 2.0]), not_ready);
        assert_eq!(predictor.hold(&mut state, &[1.0, 2.0], 3), not_ready);
        assert_eq!(predictor.hold(&mut state, &[], 0), Ok(()));
        let n = model.structure().states().len();
        predictor.observe(&mut state, &[], &vec![0.5; n]).unwrap();
        let expected =
            Err(PredictError::DimensionMismatch { field: "inputs", expected: 2, found: 1 });
        assert_eq!(predictor.step(&mut state, &[1.0]), expected);
        assert_eq!(predictor.hold(&mut state, &[1.0], 1), expected);
        let infinite = [0.0, f32::NEG_INFINITY];
        let expected = Err(PredictError::InputNotFinite { input: 1 });
        assert_eq!(predictor.step(&mut state, &infinite), expected);
        assert_eq!(predictor.hold(&mut state, &infinite, 2), expected);
        // Another model's state is no state of this one.
        let others = if shape.name == LEG.name { DRIVE } else { LEG };
        let mut room = [0.0; COEFFICIENTS];
        let other = others.model(&mut room).unwrap();
        let found = Predictor::new(&other).step(&mut state, &[1.0, 2.0]);
        assert_eq!(found, not_ready, "{} {}", shape.name, others.name);
    }
}
