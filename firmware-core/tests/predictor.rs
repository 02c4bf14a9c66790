//! Predictions: exact known operators, then agreement with the definition, then everything that
//! can go wrong on the way.

mod fixtures;
mod naive;

use std::f64::consts::{FRAC_PI_2, PI};

use firmware_core::dictionary::{Source, block_size};
use firmware_core::history::History;
use firmware_core::model::{Model, ModelRepr, Space, State, Structure, Symmetry, Target};
use firmware_core::predictor::OutOfRange;
use firmware_core::{PredictError, Predictor, PredictorState, Scalar};
use fixtures::{Numbers, at, fourier, hermite, input, repr, scaled, state};
use proptest::prelude::*;

/// A few hundred roundings of f64 at numbers around 1.
const ROUNDING: f64 = 1e-12;
/// The same in f32, over a short rollout.
const SINGLE: f64 = 1e-5;

const UNBOUNDED: [f32; 2] = [f32::NEG_INFINITY, f32::INFINITY];

fn model<'a, S: Scalar>(repr: &ModelRepr<'static>, coefficients: &'a [S]) -> Model<'a, S> {
    Model::new(fixtures::structure(repr), coefficients, None).unwrap()
}

/// One block per observable at order 1: dense terms 1, v₀, 1, v₁, …
fn linear(
    states: &[State<'static>],
    inputs: usize,
    symmetry: Symmetry,
    sources: &[(Source, u8)],
) -> ModelRepr<'static> {
    let inputs = &[input("u1"), input("u2")][..inputs];
    let observables: Vec<_> = sources.iter().map(|(source, lag)| at(*source, *lag)).collect();
    let factors: Vec<_> = (0..sources.len()).map(|o| [hermite(o as u8, 1)]).collect();
    let parts: Vec<fixtures::Part<'_>> = factors.iter().map(|own| (&own[..], 0)).collect();
    repr("linear", states, inputs, symmetry, &observables, &parts)
}

/// Rows of a matrix over the observables as coefficients of [`linear`].
fn rows<const N: usize>(matrix: &[[f64; N]]) -> Vec<f64> {
    matrix.iter().flatten().flat_map(|c| [0.0, *c]).collect()
}

fn coordinates<S: Scalar>(predictor: &Predictor<'_, '_, S>, state: &PredictorState<S>) -> Vec<S> {
    let mut x = vec![S::ZERO; predictor.model().structure().states().len()];
    predictor.coordinates(state, &mut x).unwrap();
    x
}

// Exact known operators.

#[test]
fn a_linear_system_is_predicted_exactly() {
    let line = |name| state(name, Space::Line, Target::Absolute);
    let sources = [(Source::State(0), 0), (Source::State(1), 0), (Source::Input(0), 0)];
    let repr = linear(&[line("x1"), line("x2")], 1, Symmetry::None, &sources);
    let (a, b) = ([[0.9, 0.2], [-0.3, 0.8]], [0.1, 0.5]);
    let f = rows(&[[a[0][0], a[0][1], b[0]], [a[1][0], a[1][1], b[1]]]);
    let model = model(&repr, &f);
    let predictor = Predictor::new(&model);
    let mut state = PredictorState::new();
    let mut x = [1.0, -2.0];
    predictor.observe(&mut state, &[], &x).unwrap();
    for u in Numbers(1).take(200) {
        predictor.step(&mut state, &[u]).unwrap();
        x = [0, 1].map(|i| a[i][0] * x[0] + a[i][1] * x[1] + b[i] * u);
        let found = coordinates(&predictor, &state);
        assert!((found[0] - x[0]).abs() < ROUNDING && (found[1] - x[1]).abs() < ROUNDING);
    }
    assert_eq!(state.step(), 200);
}

/// Constant forward and turning speed: in the body frame every step is the same increment, and the
/// robot runs on a circle of radius v / ω.
#[test]
fn a_unicycle_runs_in_circles() {
    let repr = repr("unicycle", &fixtures::POSE, &[], fixtures::SE2, &[], &[(&[], 0)]);
    let (radius, turn) = (2.0_f64, 0.1_f64);
    let f = [radius * turn.sin(), radius * (1.0 - turn.cos()), turn];
    let model = model(&repr, &f);
    let predictor = Predictor::new(&model);
    for (x0, y0, phi0) in [(0.0, 0.0, 0.0), (3.0, -1.0, 2.5), (0.0, 5.0, -7.0)] {
        let mut state = PredictorState::new();
        predictor.observe(&mut state, &[], &[x0, y0, phi0]).unwrap();
        for k in 1..=100 {
            predictor.step(&mut state, &[]).unwrap();
            let phi = phi0 + f64::from(k) * turn;
            let expected = [
                x0 + radius * (phi.sin() - phi0.sin()),
                y0 - radius * (phi.cos() - phi0.cos()),
                naive::wrap(phi),
            ];
            let found = coordinates(&predictor, &state);
            assert!(found[2] > -PI && found[2] <= PI);
            assert!(naive::distance(model.structure(), &found, &expected) < ROUNDING);
        }
    }
}

/// x⁺ = x₍ₖ₋₂₎ + u₍ₖ₋₁₎, by hand.
#[test]
fn lags_count_samples_before_the_present_one() {
    let states = [state("x", Space::Line, Target::Absolute)];
    let sources = [(Source::State(0), 2), (Source::Input(0), 1)];
    let repr = linear(&states, 1, Symmetry::None, &sources);
    let f = rows(&[[1.0, 1.0]]);
    let model = model(&repr, &f);
    assert_eq!(model.structure().lag(), 2);
    let predictor = Predictor::new(&model);
    let mut state = PredictorState::new();
    predictor.observe(&mut state, &[], &[1.0]).unwrap();
    predictor.observe(&mut state, &[10.0], &[2.0]).unwrap();
    predictor.observe(&mut state, &[20.0], &[3.0]).unwrap();
    let mut x = [0.0; 6];
    predictor.rollout(&mut state, &[30.0, 40.0, 50.0, 0.0, 0.0, 0.0], &mut x).unwrap();
    // x₃ = x₀ + u₁, x₄ = x₁ + u₂, x₅ = x₂ + u₃, x₆ = x₃ + u₄, x₇ = x₄ + u₅, x₈ = x₅ + u₆
    assert_eq!(x, [21.0, 32.0, 43.0, 71.0, 32.0, 43.0]);
    // A measurement pushes the same history.
    predictor.observe(&mut state, &[5.0], &[100.0]).unwrap();
    predictor.step(&mut state, &[0.0]).unwrap();
    assert_eq!(coordinates(&predictor, &state), [32.0 + 5.0]);
}

/// A pose that repeats its last increment goes on along its arc; in the world frame it would leave
/// along a straight line.
#[test]
fn earlier_increments_are_in_the_frame_of_the_earlier_sample() {
    let sources = [0, 1, 2].map(|i| (Source::Increment(i), 1));
    let repr = linear(&fixtures::POSE, 0, fixtures::SE2, &sources);
    let f = rows(&[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    let model = model(&repr, &f);
    let predictor = Predictor::new(&model);
    let pose = |phi: f64| [1.0 + 2.0 * phi.sin(), -2.0 * phi.cos(), phi];
    let mut state = PredictorState::new();
    let (start, turn) = (3.0, 0.25);
    predictor.observe(&mut state, &[], &pose(start)).unwrap();
    predictor.observe(&mut state, &[], &pose(start + turn)).unwrap();
    for k in 2..=60 {
        predictor.step(&mut state, &[]).unwrap();
        let expected = pose(start + f64::from(k) * turn);
        let found = coordinates(&predictor, &state);
        assert!(naive::distance(model.structure(), &found, &expected) < 1e-10, "step {k}");
    }
}

#[test]
fn increments_by_hand() {
    let sources = [(0, 1), (1, 1), (2, 1), (0, 2), (1, 2), (2, 2)];
    let sources = sources.map(|(i, lag)| (Source::Increment(i), lag));
    let structure = fixtures::structure(&linear(&fixtures::POSE, 0, fixtures::SE2, &sources));
    let mut history = History::default();
    assert!(history.is_empty());
    // Facing along y, one ahead; then, across the seam, half a unit to the left of where it faces.
    for pose in [[0.0, 0.0, FRAC_PI_2], [0.0, 1.0, PI], [0.0, 0.5, -PI + 0.1]] {
        history.push(&structure, &[], &structure.sample(&pose));
    }
    assert_eq!(history.len(), 3);
    let found: Vec<f64> = history.raw(&structure, &[]).collect();
    let expected = [0.0, 0.5, 0.1, 1.0, 0.0, FRAC_PI_2];
    for (f, e) in found.iter().zip(expected) {
        assert!((f - e).abs() < ROUNDING, "{found:?}");
    }
    history.clear();
    assert!(history.is_empty());
}

// Agreement with the definition.

/// Random Hermite coefficients that keep angles well defined: 0.3 and small terms.
fn hermite_coefficients(structure: &Structure<'_>, numbers: &mut Numbers) -> Vec<f64> {
    let terms = fixtures::width(structure);
    (0..structure.outputs() * terms)
        .map(|i| if i % terms == 0 { 0.3 } else { 0.3 * numbers.next().unwrap() / terms as f64 })
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Every kind of model, over several steps: the monomial kernel, the history and the retraction
    /// against a prediction straight from the definition.
    #[test]
    fn predictions_are_their_definition(seed: u64) {
        for repr in fixtures::all() {
            let mut numbers = Numbers(seed);
            let structure = fixtures::structure(&repr);
            let (n, m) = (structure.states().len(), structure.inputs().len());
            let terms = fixtures::terms(&structure);
            let hermite = hermite_coefficients(&structure, &mut numbers);
            let powers: Vec<f64> = match terms {
                None => hermite
                    .chunks(structure.dictionary().dense_terms())
                    .flat_map(|row| naive::monomials(structure.dictionary(), row))
                    .collect(),
                Some(_) => hermite.clone(),
            };
            let model = fixtures::model(structure.clone(), &powers, None).unwrap();
            let predictor = Predictor::new(&model);
            let mut state = PredictorState::new();
            let mut log = naive::Log { x: vec![], u: vec![] };
            for k in 0..=structure.lag() + 1 {
                let x = numbers.take_f64(n);
                let u = numbers.take_f64(m);
                // The first sample is one more than needed: it must be forgotten.
                predictor.observe(&mut state, &u, &x).unwrap();
                log.x.push(x);
                if k > 0 {
                    log.u.push(u);
                }
            }
            for _ in 0..5 {
                let u = numbers.take_f64(m);
                predictor.step(&mut state, &u).unwrap();
                let expected = naive::step(&structure, terms, &log, &u, &hermite);
                let found = coordinates(&predictor, &state);
                let distance = naive::distance(&structure, &found, &expected);
                prop_assert!(distance < 1e-10, "{}: {}", repr.robot, distance);
                log.x.push(found);
                log.u.push(u);
            }
        }
    }

    /// Any dictionary, blocks beyond one tile of the kernel included: outputs = lift · F.
    #[test]
    fn the_kernel_is_the_lift_times_the_operator(
        parts in fixtures::parts(), angles in prop::array::uniform2(-4.0_f64..4.0),
        line in prop::array::uniform2(-2.0_f64..2.0), u in prop::array::uniform2(-2.0_f64..2.0),
        seed: u64,
    ) {
        let parts: Vec<fixtures::Part<'_>> = parts.iter().map(|(own, cut)| (&own[..], *cut)).collect();
        let mut states = [
            state("x", Space::Line, Target::Absolute),
            state("y", Space::Line, Target::Absolute),
            state("phi", Space::Circle, Target::Increment),
            state("theta", Space::Circle, Target::Increment),
        ];
        states[0].limit = UNBOUNDED;
        states[1].limit = UNBOUNDED;
        let inputs = [input("u1"), input("u2")];
        let repr = repr("r", &states, &inputs, Symmetry::None, &fixtures::OBSERVABLES, &parts);
        let structure = fixtures::structure(&repr);
        let dictionary = structure.dictionary();
        let terms = dictionary.dense_terms();
        let hermite = Numbers(seed).take_f64(4 * terms);
        let powers: Vec<f64> =
            hermite.chunks(terms).flat_map(|row| naive::monomials(dictionary, row)).collect();
        let model = Model::new(structure.clone(), &powers, None).unwrap();
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        let x = [line[0], line[1], angles[0], angles[1]];
        predictor.observe(&mut state, &[], &x).unwrap();
        let mut values = [0.0; 8];
        state.history().observe(&structure, &u, &mut values);
        predictor.step(&mut state, &u).unwrap();

        let mut lifted = vec![0.0; terms];
        dictionary.lift_dense(&values, &mut lifted);
        let outputs: Vec<f64> = hermite
            .chunks(terms)
            .map(|row| row.iter().zip(&lifted).map(|(c, t)| c * t).sum())
            .collect();
        let expected = [outputs[0], outputs[1], x[2] + outputs[2], x[3] + outputs[3]];
        let found = coordinates(&predictor, &state);
        // Powers cancel where Hermite polynomials do not: relative to the sum of magnitudes.
        let magnitudes: f64 = naive::powers(dictionary, &values)
            .iter()
            .enumerate()
            .map(|(i, power)| (0..4).map(|o| powers[o * terms + i].abs()).sum::<f64>() * power.abs())
            .sum();
        let distance = naive::distance(&structure, &found, &expected);
        prop_assert!(distance <= ROUNDING * magnitudes.max(1.0), "{} of {}", distance, magnitudes);
    }

    /// `retract` undoes `targets`, whatever the model.
    #[test]
    fn targets_lead_to_the_next_sample(seed: u64, scale in 0.01_f64..10.0) {
        for repr in fixtures::all() {
            let structure = fixtures::structure(&repr);
            let n = structure.states().len();
            let mut numbers = Numbers(seed);
            let coefficients = fixtures::coefficients(&structure);
            let coefficients: Vec<f64> = coefficients.into_iter().map(f64::from).collect();
            let model = fixtures::model(structure.clone(), &coefficients, None).unwrap();
            let state = fixtures::fill(&Predictor::new(&model), &mut numbers);
            let mut history = state.history().clone();
            let mut next = numbers.take_f64(n);
            next.iter_mut().for_each(|x| *x *= scale);
            next[0] = next[0].clamp(-8.0, 8.0); // the cart's limit
            let mut targets = vec![f64::NAN; structure.outputs()];
            history.targets(&structure, &structure.sample(&next), &mut targets);
            let sample = history.retract(&structure, &targets).unwrap();
            history.push(&structure, &numbers.take_f64(structure.inputs().len()), &sample);
            let mut found = vec![0.0; n];
            history.coordinates(&structure, &mut found);
            let distance = naive::distance(&structure, &found, &next);
            prop_assert!(distance < ROUNDING * (1.0 + scale), "{}: {}", repr.robot, distance);
        }
    }

    /// The controller's precision, on the same operator and the same numbers.
    #[test]
    fn single_and_double_precision_agree(seed: u64) {
        for repr in fixtures::all() {
            let structure = fixtures::structure(&repr);
            let (n, m) = (structure.states().len(), structure.inputs().len());
            let single = fixtures::coefficients(&structure);
            let double: Vec<f64> = single.iter().map(|c| f64::from(*c)).collect();
            let model32 = fixtures::model(structure.clone(), &single, None).unwrap();
            let model64 = fixtures::model(structure.clone(), &double, None).unwrap();
            let (p32, p64) = (Predictor::new(&model32), Predictor::new(&model64));
            let (mut s32, mut s64) = (PredictorState::new(), PredictorState::new());
            let mut numbers = Numbers(seed);
            let wide = |v: &[f32]| v.iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
            for _ in 0..=structure.lag() {
                let (u, x) = (numbers.take_f32(m), numbers.take_f32(n));
                p32.observe(&mut s32, &u, &x).unwrap();
                p64.observe(&mut s64, &wide(&u), &wide(&x)).unwrap();
            }
            for _ in 0..5 {
                let u = numbers.take_f32(m);
                p32.step(&mut s32, &u).unwrap();
                p64.step(&mut s64, &wide(&u)).unwrap();
                let (x32, x64) = (wide(&coordinates(&p32, &s32)), coordinates(&p64, &s64));
                let distance = naive::distance(&structure, &x32, &x64);
                prop_assert!(distance < SINGLE, "{}: {}", repr.robot, distance);
            }
        }
    }

    /// A rollout is the step repeated, to the bit; a held input is the same input repeated.
    #[test]
    fn a_rollout_is_the_step_repeated(seed: u64, horizon in 0_usize..8) {
        for repr in fixtures::all() {
            let structure = fixtures::structure(&repr);
            let (n, m) = (structure.states().len(), structure.inputs().len());
            let coefficients: Vec<f64> =
                fixtures::coefficients(&structure).into_iter().map(f64::from).collect();
            let model = fixtures::model(structure, &coefficients, None).unwrap();
            let predictor = Predictor::new(&model);
            let mut numbers = Numbers(seed);
            let start = fixtures::fill(&predictor, &mut numbers);
            let inputs = numbers.take_f64(horizon * m);

            let (mut rolled, mut stepped) = (start.clone(), start.clone());
            let mut predicted = vec![0.0; horizon * n];
            predictor.rollout(&mut rolled, &inputs, &mut predicted).unwrap();
            for (k, row) in predicted.chunks(n).enumerate() {
                predictor.step(&mut stepped, &inputs[k * m..(k + 1) * m]).unwrap();
                prop_assert_eq!(coordinates(&predictor, &stepped), row);
            }
            prop_assert_eq!(&rolled, &stepped);

            let held = numbers.take_f64(m);
            let (mut one, mut other) = (start.clone(), start.clone());
            let mut repeated = predicted.clone();
            predictor.rollout_held(&mut one, &held, &mut predicted).unwrap();
            predictor.rollout(&mut other, &held.repeat(horizon), &mut repeated).unwrap();
            prop_assert_eq!(predicted, repeated);
            prop_assert_eq!(one, other);
        }
    }
}

/// One block of every number of factors the kernel may meet, at the borders of its tiles.
#[test]
fn blocks_around_the_size_of_a_tile() {
    let observables: Vec<_> = (0..6)
        .map(|i| at(Source::State(i), 0))
        .chain((0..6).map(|i| at(Source::Input(i), 0)))
        .collect();
    let states = ["a", "b", "c", "d", "e", "f"]
        .map(|name| State { limit: UNBOUNDED, ..state(name, Space::Line, Target::Absolute) });
    let inputs = ["u", "v", "w", "p", "q", "r"].map(input);
    let orders: [&[u8]; 14] = [
        &[9],
        &[9, 5],
        &[9, 9],
        &[3, 3, 3],
        &[3, 3, 4],
        &[4, 3, 3],
        &[9, 6, 1],
        &[1, 6, 9],
        &[1; 6],
        &[1; 7],
        &[1; 12],
        &[7, 1, 7, 1],
        &[2, 2, 2, 2, 2, 2, 2],
        &[9, 9, 9],
    ];
    let mut numbers = Numbers(3);
    for orders in orders {
        let factors: Vec<_> =
            orders.iter().enumerate().map(|(o, p)| hermite(o as u8, *p)).collect();
        let repr = repr("r", &states, &inputs, Symmetry::None, &observables, &[(&factors, 0)]);
        let structure = fixtures::structure(&repr);
        let terms = structure.dictionary().dense_terms();
        assert_eq!(terms, block_size(&factors));
        let f = numbers.take_f64(6 * terms);
        let x = numbers.take_f64(6);
        let u = numbers.take_f64(6);
        let model = Model::new(structure, &f, None).unwrap();
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        predictor.observe(&mut state, &[], &x).unwrap();
        predictor.step(&mut state, &u).unwrap();
        let powers = naive::powers(model.structure().dictionary(), &[&x[..], &u].concat());
        for (row, found) in f.chunks(terms).zip(coordinates(&predictor, &state)) {
            let expected: f64 = row.iter().zip(&powers).map(|(c, p)| c * p).sum();
            assert!((found - expected).abs() < ROUNDING * terms as f64, "{orders:?}");
        }
    }
}

// Measurements, history and arguments.

#[test]
fn not_ready_until_the_history_is_full() {
    for repr in fixtures::all() {
        let structure = fixtures::structure(&repr);
        let (n, m, need) =
            (structure.states().len(), structure.inputs().len(), structure.lag() + 1);
        let coefficients = fixtures::coefficients(&structure);
        let model = fixtures::model(structure, &coefficients, None).unwrap();
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        let (u, x) = (vec![0.1; m], vec![0.1; n]);
        for have in 0..need {
            let before = state.clone();
            let not_ready = Err(PredictError::NotReady { have, need });
            assert_eq!(predictor.step(&mut state, &u), not_ready);
            assert_eq!(predictor.rollout_held(&mut state, &u, &mut vec![0.0; 3 * n]), not_ready);
            assert_eq!(state, before);
            assert_eq!(state.history().len(), have);
            predictor.observe(&mut state, &u, &x).unwrap();
        }
        assert_eq!(predictor.step(&mut state, &u), Ok(()));
    }
}

/// A state that moves on to a model with more lags has to be filled again.
#[test]
fn a_history_is_as_long_as_its_model_looks_back() {
    let states = [state("x", Space::Line, Target::Absolute)];
    let short = linear(&states, 0, Symmetry::None, &[(Source::State(0), 1)]);
    let long = linear(&states, 0, Symmetry::None, &[(Source::State(0), 3)]);
    let (short, long) = (model(&short, &[0.0, 1.0]), model(&long, &[0.0, 1.0]));
    let mut state: PredictorState = PredictorState::new();
    for have in 0..5 {
        assert_eq!(state.history().len(), have.min(2));
        Predictor::new(&short).observe(&mut state, &[], &[1.0]).unwrap();
    }
    let not_ready = Err(PredictError::NotReady { have: 2, need: 4 });
    assert_eq!(Predictor::new(&long).step(&mut state, &[]), not_ready);
}

#[test]
fn a_measurement_starts_a_new_prediction() {
    let repr = fixtures::one_state();
    let ranges = [-1.0, 1.0, -1.0, 1.0];
    let structure = fixtures::structure(&repr);
    let model = Model::new(structure, &fixtures::ONE_STATE, Some(&ranges)).unwrap();
    let predictor = Predictor::new(&model);
    let mut state = PredictorState::new();
    predictor.observe(&mut state, &[], &[2.0]).unwrap();
    predictor.rollout_held(&mut state, &[0.0], &mut [0.0; 3]).unwrap();
    assert_eq!(state.step(), 3);
    assert!(state.out_of_range().is_some());
    predictor.observe(&mut state, &[0.0], &[0.5]).unwrap();
    assert_eq!((state.step(), state.out_of_range()), (0, None));
    assert_eq!(coordinates(&predictor, &state), [0.5]);
}

#[test]
fn measured_angles_of_any_turn() {
    for repr in [fixtures::harmonics(), fixtures::se2(), fixtures::direct_sum()] {
        let structure = fixtures::structure(&repr);
        let (n, m) = (structure.states().len(), structure.inputs().len());
        let f: Vec<f64> = fixtures::coefficients(&structure).into_iter().map(f64::from).collect();
        let model = Model::new(structure.clone(), &f, None).unwrap();
        let predictor = Predictor::new(&model);
        let after = |turns: f64| {
            let x: Vec<f64> = structure
                .states()
                .iter()
                .map(|s| if s.space == Space::Circle { 2.0 + turns * 2.0 * PI } else { 0.5 })
                .collect();
            let mut state = PredictorState::new();
            predictor.observe(&mut state, &[], &x).unwrap();
            predictor.step(&mut state, &vec![0.3; m]).unwrap();
            coordinates(&predictor, &state)
        };
        let (here, there) = (after(0.0), after(-3.0));
        assert_eq!(here.len(), n);
        for ((a, b), s) in here.iter().zip(&there).zip(structure.states()) {
            assert!((a - b).abs() < ROUNDING, "{}", repr.robot);
            assert!(s.space == Space::Line || *a > -PI && *a <= PI);
        }
    }
}

#[test]
fn measurements_that_are_refused_leave_no_trace() {
    let model = model(&fixtures::soft_leg(), &[0.0; 32]);
    let predictor = Predictor::new(&model);
    let mut state: PredictorState = PredictorState::new();
    let mismatch =
        |field, expected, found| Err(PredictError::DimensionMismatch { field, expected, found });
    let fresh = state.clone();
    assert_eq!(predictor.observe(&mut state, &[], &[1.0]), mismatch("coordinates", 2, 1));
    assert_eq!(predictor.observe(&mut state, &[], &[1.0; 3]), mismatch("coordinates", 2, 3));
    assert_eq!(predictor.observe(&mut state, &[1.0], &[1.0; 2]), mismatch("inputs", 2, 1));
    for (bad, coordinate) in [([f32::NAN, 0.0], 0), ([0.0, f32::INFINITY], 1)] {
        let refused = Err(PredictError::NotFinite { coordinate });
        assert_eq!(predictor.observe(&mut state, &[], &bad), refused);
    }
    assert_eq!(state, fresh);
    predictor.observe(&mut state, &[], &[1.0, 2.0]).unwrap();
    let ready = state.clone();
    // From the second measurement on there is an input.
    assert_eq!(predictor.observe(&mut state, &[], &[1.0, 2.0]), mismatch("inputs", 2, 0));
    assert_eq!(predictor.step(&mut state, &[1.0]), mismatch("inputs", 2, 1));
    assert_eq!(predictor.step(&mut state, &[1.0; 3]), mismatch("inputs", 2, 3));
    assert_eq!(predictor.coordinates(&state, &mut [0.0; 1]), mismatch("coordinates", 2, 1));
    assert_eq!(predictor.coordinates(&state, &mut [0.0; 3]), mismatch("coordinates", 2, 3));
    let rollout = |state: &mut PredictorState, inputs: usize, predicted: usize| {
        predictor.rollout(state, &vec![0.0; inputs], &mut vec![0.0; predicted])
    };
    assert_eq!(rollout(&mut state, 4, 5), mismatch("predicted", 4, 5));
    assert_eq!(rollout(&mut state, 3, 4), mismatch("inputs", 4, 3));
    assert_eq!(rollout(&mut state, 6, 4), mismatch("inputs", 4, 6));
    assert_eq!(
        predictor.rollout_held(&mut state, &[0.0; 2], &mut [0.0; 5]),
        mismatch("predicted", 4, 5)
    );
    assert_eq!(
        predictor.rollout_held(&mut state, &[0.0; 1], &mut [0.0; 4]),
        mismatch("inputs", 2, 1)
    );
    assert_eq!(state, ready);
    assert_eq!(rollout(&mut state, 0, 0), Ok(()));
}

// The trained range.

#[test]
fn the_first_step_and_observable_out_of_range() {
    // x⁺ = 2 x with [1, x] ⊗ [1, u]; trained for x in [−5, 5], u in [−1, 1].
    let structure = fixtures::structure(&ModelRepr {
        states: [State { limit: UNBOUNDED, ..fixtures::one_state().states[0] }]
            .into_iter()
            .collect(),
        ..fixtures::one_state()
    });
    let ranges = [-5.0, 5.0, -1.0, 1.0];
    let model = Model::new(structure, &[0.0, 0.0, 2.0, 0.0], Some(&ranges)).unwrap();
    let predictor = Predictor::new(&model);
    let start = |x: f64| {
        let mut state = PredictorState::new();
        predictor.observe(&mut state, &[], &[x]).unwrap();
        state
    };
    let mut state = start(1.0);
    // x: 1, 2, 4, 8; the fourth step is predicted from 8.
    predictor.rollout(&mut state, &[0.0; 3], &mut [0.0; 3]).unwrap();
    assert_eq!(state.out_of_range(), None);
    predictor.step(&mut state, &[0.0]).unwrap();
    let first = Some(OutOfRange { step: 4, observable: 0 });
    assert_eq!(state.out_of_range(), first);
    predictor.step(&mut state, &[7.0]).unwrap();
    assert_eq!(state.out_of_range(), first); // the first one stays

    let mut state = start(5.0); // the border belongs to the range
    predictor.step(&mut state, &[1.0]).unwrap();
    assert_eq!(state.out_of_range(), None);
    let mut state = start(5.0);
    predictor.step(&mut state, &[-1.5]).unwrap();
    assert_eq!(state.out_of_range(), Some(OutOfRange { step: 1, observable: 1 }));
}

/// Ranges are compared before centring and scaling.
#[test]
fn ranges_hold_raw_values() {
    let states = [state("x", Space::Line, Target::Absolute)];
    let observables = [scaled(Source::State(0), 0, 10.0, 100.0)];
    let parts: [fixtures::Part<'_>; 1] = [(&[hermite(0, 1)], 0)];
    let repr = repr("r", &states, &[], Symmetry::None, &observables, &parts);
    let ranges = [9.0, 11.0];
    let model = Model::new(fixtures::structure(&repr), &[10.0, 0.01], Some(&ranges)).unwrap();
    let predictor = Predictor::new(&model);
    let mut state = PredictorState::new();
    predictor.observe(&mut state, &[], &[10.5]).unwrap();
    predictor.step(&mut state, &[]).unwrap();
    assert_eq!(coordinates(&predictor, &state), [10.5_f64]);
    assert_eq!(state.out_of_range(), None);
}

// Divergence.

/// The prediction fails at this step and leaves the state as it was.
fn assert_diverges<S: Scalar>(
    predictor: &Predictor<'_, '_, S>,
    state: &mut PredictorState<S>,
    input: &[S],
    step: u32,
) {
    let before = state.clone();
    assert_eq!(predictor.step(state, input), Err(PredictError::Diverged { step }));
    assert_eq!(*state, before);
}

fn one_coordinate(space: Space, target: Target, limit: [f32; 2]) -> ModelRepr<'static> {
    let observables = match space {
        Space::Line => vec![at(Source::State(0), 0)],
        Space::Circle => vec![at(Source::Sin(0), 0), at(Source::Cos(0), 0)],
    };
    let factor = if space == Space::Line { hermite(0, 2) } else { fourier(0, 1) };
    let states = [State { limit, ..state("x", space, target) }];
    repr("r", &states, &[input("u")], Symmetry::None, &observables, &[(&[factor], 0)])
}

#[test]
fn a_hard_limit_ends_a_rollout() {
    let repr = one_coordinate(Space::Line, Target::Absolute, [-100.0, 100.0]);
    let model = model(&repr, &[0.0, 2.0, 0.0]);
    let predictor = Predictor::new(&model);
    let mut state: PredictorState = PredictorState::new();
    predictor.observe(&mut state, &[], &[-1.0]).unwrap();
    let mut x = [7.0; 10];
    let found = predictor.rollout(&mut state, &[0.0; 10], &mut x);
    assert_eq!(found, Err(PredictError::Diverged { step: 7 }));
    assert_eq!(x, [-2.0, -4.0, -8.0, -16.0, -32.0, -64.0, 7.0, 7.0, 7.0, 7.0]);
    assert_eq!(state.step(), 6);
    assert_diverges(&predictor, &mut state, &[0.0], 7);
    // The limit itself is not beyond it.
    predictor.observe(&mut state, &[0.0], &[50.0]).unwrap();
    predictor.step(&mut state, &[0.0]).unwrap();
    assert_eq!(coordinates(&predictor, &state), [100.0]);
}

#[test]
fn numbers_that_are_none() {
    for target in [Target::Absolute, Target::Increment] {
        let states = [State { limit: UNBOUNDED, ..state("x", Space::Line, target) }];
        let repr = one_coordinate(Space::Line, target, UNBOUNDED);
        let squared = model(&repr, &[0.0_f32, 0.0, 1.0]);
        let predictor = Predictor::new(&squared);
        let mut state = PredictorState::new();
        predictor.observe(&mut state, &[], &[1e15]).unwrap();
        predictor.step(&mut state, &[0.0]).unwrap(); // 1e30
        assert_diverges(&predictor, &mut state, &[0.0], 2); // ∞

        let sources = [(Source::State(0), 0), (Source::Input(0), 0)];
        let difference = [0.0, f32::MAX, 0.0, -f32::MAX];
        let difference = model(&linear(&states, 1, Symmetry::None, &sources), &difference);
        let predictor = Predictor::new(&difference);
        predictor.observe(&mut state, &[0.0], &[10.0]).unwrap();
        assert_diverges(&predictor, &mut state, &[10.0], 1); // ∞ − ∞
    }
}

#[test]
fn inputs_that_are_no_numbers() {
    for repr in fixtures::all() {
        let structure = fixtures::structure(&repr);
        let f: Vec<f64> = fixtures::coefficients(&structure).into_iter().map(f64::from).collect();
        let m = structure.inputs().len();
        let model = fixtures::model(structure, &f, None).unwrap();
        let predictor = Predictor::new(&model);
        let mut state = fixtures::fill(&predictor, &mut Numbers(5));
        for bad in [f64::NAN, f64::INFINITY].into_iter().filter(|_| m > 0) {
            let (inputs, before) = (vec![bad; m], state.clone());
            let expected = Err(PredictError::InputNotFinite { input: 0 });
            assert_eq!(predictor.step(&mut state, &inputs), expected);
            let n = model.structure().states().len();
            assert_eq!(predictor.observe(&mut state, &inputs, &vec![0.0; n]), expected);
            assert_eq!(state, before);
        }
    }
}

#[test]
fn an_angle_that_turns_hundreds_of_times_in_a_step() {
    let repr = one_coordinate(Space::Circle, Target::Increment, UNBOUNDED);
    for (turn, diverges) in [(500.0, false), (2e3, true), (-2e3, true), (1e13, true)] {
        let coefficients = [turn, 0.0, 0.0];
        let model = model(&repr, &coefficients);
        let predictor = Predictor::new(&model);
        let mut state: PredictorState = PredictorState::new();
        predictor.observe(&mut state, &[], &[2.0]).unwrap();
        if diverges {
            assert_diverges(&predictor, &mut state, &[0.0], 1);
        } else {
            predictor.step(&mut state, &[0.0]).unwrap();
        }
    }
}

#[test]
fn an_absolute_angle_that_loses_its_direction() {
    let repr = one_coordinate(Space::Circle, Target::Absolute, UNBOUNDED);
    // (sin, cos) ← q · (sin, cos)
    for (q, diverges) in [(1.0, false), (0.01, false), (1e-4, true), (0.0, true), (f32::MAX, true)]
    {
        let f = [0.0, q, 0.0, 0.0, 0.0, q];
        let model = model(&repr, &f);
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        predictor.observe(&mut state, &[], &[2.0]).unwrap();
        if diverges {
            assert_diverges(&predictor, &mut state, &[0.0], 1);
        } else {
            // Put back on the circle at every step, nothing shrinks.
            predictor.rollout_held(&mut state, &[0.0], &mut [0.0; 20]).unwrap();
            assert!((coordinates(&predictor, &state)[0] - 2.0).abs() < 1e-5);
        }
    }
}

#[test]
fn angles_have_limits_too() {
    let limit = [-1.0, 2.0];
    // The angle grows by 0.25 a step, as an increment and as a rotation of (sin, cos).
    let (s, c) = 0.25_f32.sin_cos();
    for (target, f) in
        [(Target::Increment, vec![0.25, 0.0, 0.0]), (Target::Absolute, vec![0.0, c, s, 0.0, -s, c])]
    {
        let repr = one_coordinate(Space::Circle, target, limit);
        let model = model(&repr, &f);
        let predictor = Predictor::new(&model);
        let mut state = PredictorState::new();
        predictor.observe(&mut state, &[], &[1.1]).unwrap();
        let found = predictor.rollout_held(&mut state, &[0.0], &mut [0.0; 20]);
        assert_eq!(found, Err(PredictError::Diverged { step: 4 }), "{target:?}");

        let repr = one_coordinate(Space::Circle, target, [-4.0, 4.0]);
        let free = Model::new(fixtures::structure(&repr), &f, None).unwrap();
        let predictor = Predictor::new(&free);
        assert_eq!(predictor.rollout_held(&mut state, &[0.0], &mut [0.0; 50]), Ok(()));
    }
}

/// A state belongs to what its model keeps: to a model that keeps other things it is empty, instead of
/// showing it numbers that mean something else.
#[test]
fn a_state_of_another_structure_is_empty() {
    let [lagged, se2] = [fixtures::lagged(), fixtures::se2_lagged()];
    let ones = |repr| vec![0.01_f64; 16 * fixtures::width(&fixtures::structure(repr))];
    let of = |repr: &ModelRepr<'static>, f: &[f64]| {
        let structure = fixtures::structure(repr);
        let count = structure.outputs() * fixtures::width(&structure);
        Model::new(structure, &f[..count].to_vec().leak()[..], None).unwrap()
    };
    let (a, b) = (of(&lagged, &ones(&lagged)), of(&se2, &ones(&se2)));
    let (a, b) = (Predictor::new(&a), Predictor::new(&b));
    let mut state = fixtures::fill(&a, &mut Numbers(1));
    let before = state.clone();
    let need = b.model().structure().lag() + 1;
    assert_eq!(b.step(&mut state, &[0.1, 0.2]), Err(PredictError::NotReady { have: 0, need }));
    assert_eq!(state, before);
    // It starts anew, without an applied input.
    b.observe(&mut state, &[], &[1.0, 2.0, 3.0]).unwrap();
    assert_eq!(state.history().len(), 1);
}

/// Every error leaves the state as it was, whatever had been computed by then.
#[test]
fn a_failed_step_changes_nothing() {
    for repr in fixtures::all() {
        let structure = fixtures::structure(&repr);
        let m = structure.inputs().len();
        let count = structure.outputs() * fixtures::width(&structure);
        let coefficients: Vec<f64> =
            (0..count).map(|i| if i % 2 == 0 { 0.3 } else { 0.01 }).collect();
        let good = fixtures::model(structure.clone(), &coefficients, None).unwrap();
        let predictor = Predictor::new(&good);
        let mut state = fixtures::fill(&predictor, &mut Numbers(3));
        let _ = predictor.step(&mut state, &Numbers(4).take_f64(m));
        let before = state.clone();
        let huge = vec![1e300_f64; count];
        let diverging = fixtures::model(structure, &huge, None).unwrap();
        let u = Numbers(5).take_f64(m);
        let found = Predictor::new(&diverging).step(&mut state, &u);
        assert!(matches!(found, Err(PredictError::Diverged { .. })), "{}: {found:?}", repr.robot);
        assert_eq!(state, before, "{}", repr.robot);
        let mut wrong = u.clone();
        if let Some(last) = wrong.last_mut() {
            *last = f64::NAN;
            let found = predictor.step(&mut state, &wrong);
            assert_eq!(found, Err(PredictError::InputNotFinite { input: m - 1 }));
            assert_eq!(state, before, "{}", repr.robot);
        }
        // And the next step is that of the state before.
        let mut other = before.clone();
        assert_eq!(predictor.step(&mut state, &u), predictor.step(&mut other, &u));
        assert_eq!(state, other, "{}", repr.robot);
    }
}
