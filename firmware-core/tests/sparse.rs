//! Sparse models: agreement with the definition and with dense models, exact bytes, and chains that
//! must be refused.

mod bytes;
mod fixtures;
mod naive;

use bytes::{
    COEFFICIENTS, METADATA, SELF_TEST, Section, TERMS, assemble, bytes_of, error_with, seal,
    sections,
};
use firmware_core::blob::{self, EmitError, ParseError};
use firmware_core::capacity::{MAX_FUNCTIONS, MAX_SPARSE_TERMS, REGISTERS};
use firmware_core::dictionary::{Basis, Block, Dictionary, Factor, Source};
use firmware_core::model::{
    Model, ModelError, ModelRepr, Space, State, Structure, Symmetry, Target,
};
use firmware_core::sparse::{Power, SparseError, SparseTerms};
use firmware_core::{Predictor, PredictorState, Scalar, parse};
use fixtures::{Numbers, OBSERVABLES, Slot, at, fourier, hermite, input, repr, state};
use proptest::prelude::*;

/// A few hundred roundings of f64 at numbers up to 1, per coefficient.
const ROUNDING: f64 = 1e-12;
/// The same in f32.
const SINGLE: f64 = 1e-5;

const UNBOUNDED: [f32; 2] = [f32::NEG_INFINITY, f32::INFINITY];

/// Two lines, two angles, two inputs, one block per part over [`OBSERVABLES`].
fn plane(parts: &[Vec<Factor>]) -> Structure<'static> {
    let line = |name| State { limit: UNBOUNDED, ..state(name, Space::Line, Target::Absolute) };
    let angle = |name| state(name, Space::Circle, Target::Increment);
    let states = [line("x"), line("y"), angle("phi"), angle("theta")];
    let inputs = [input("u1"), input("u2")];
    let parts: Vec<fixtures::Part<'_>> = parts.iter().map(|own| (&own[..], 0)).collect();
    fixtures::structure(&repr("r", &states, &inputs, Symmetry::None, &OBSERVABLES, &parts))
}

fn single_factors(factors: &[Factor]) -> Vec<Vec<Factor>> {
    factors.iter().map(|f| vec![*f]).collect()
}

/// One step of a model from coordinates under an input.
fn step<S: Scalar>(model: &Model<'_, S>, x: &[S], u: &[S]) -> Vec<S> {
    let predictor = Predictor::new(model);
    let mut state = PredictorState::new();
    predictor.observe(&mut state, &[], x).unwrap();
    predictor.step(&mut state, u).unwrap();
    let mut next = vec![S::ZERO; x.len()];
    predictor.coordinates(&state, &mut next).unwrap();
    next
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}

/// Factors over [`OBSERVABLES`], the same observable in several of them if it so happens.
fn factors() -> impl Strategy<Value = Vec<Factor>> {
    let factor = prop_oneof![
        3 => (0_u8..8, 1_u8..=5).prop_map(|(o, p)| hermite(o, p)),
        1 => (prop_oneof![Just(2_u8), Just(6)], 1_u8..=4).prop_map(|(o, p)| fourier(o, p)),
    ];
    prop::collection::vec(factor, 1..12)
}

/// A chain over these factors from arbitrary numbers.
fn chain(factors: &[Factor], numbers: &[[u8; 2]]) -> Vec<[u8; 2]> {
    let functions: usize = factors.iter().map(|f| f.radix() - 1).sum();
    let entry = |(k, [p, g]): (usize, &[u8; 2])| {
        [(usize::from(*p) % (k + 1)) as u8, (usize::from(*g) % functions) as u8]
    };
    numbers.iter().enumerate().map(entry).collect()
}

fn coordinates() -> impl Strategy<Value = (Vec<f64>, Vec<f64>)> {
    (
        prop::array::uniform2(-1.0_f32..1.0),
        prop::array::uniform2(-3.0_f32..3.0),
        prop::array::uniform2(-1.0_f32..1.0),
    )
        .prop_map(|(line, angles, u)| (wide(&[line, angles].concat()), wide(&u)))
}

/// The observables of [`plane`].
fn observables(x: &[f64], u: &[f64]) -> Vec<f64> {
    vec![x[0], x[1], x[2].sin(), x[2].cos(), u[0], u[1], x[3].sin(), x[3].cos()]
}

// The definition.

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// Any chain: the terms and the prediction, in both precisions, against products of functions in
    /// closed form.
    #[test]
    fn a_sparse_model_is_its_definition(
        factors in factors(), numbers in prop::collection::vec(any::<[u8; 2]>(), 0..70),
        (x, u) in coordinates(), seed: u64,
    ) {
        let entries = chain(&factors, &numbers);
        let structure = plane(&single_factors(&factors));
        let dictionary = structure.dictionary();
        let expected_terms = naive::sparse(dictionary, &entries, &observables(&x, &u));
        let terms = SparseTerms::new(dictionary, &entries).unwrap();
        prop_assert_eq!(terms.count(), expected_terms.len());
        let mut lifted = vec![f64::NAN; terms.count()];
        prop_assert_eq!(terms.lift(dictionary, &observables(&x, &u), &mut lifted), terms.count());
        for (found, expected) in lifted.iter().zip(&expected_terms) {
            prop_assert!((found - expected).abs() < ROUNDING, "{} {}", found, expected);
        }

        let single = Numbers(seed).take_f32(4 * terms.count());
        let coefficients = wide(&single);
        let outputs: Vec<f64> = coefficients
            .chunks(terms.count())
            .map(|row| row.iter().zip(&expected_terms).map(|(c, t)| c * t).sum())
            .collect();
        let expected = [outputs[0], outputs[1], x[2] + outputs[2], x[3] + outputs[3]];
        let bound = terms.count() as f64;
        let model = Model::new_sparse(structure.clone(), &entries, &coefficients, None).unwrap();
        let distance = naive::distance(&structure, &step(&model, &x, &u), &expected);
        prop_assert!(distance < ROUNDING * bound, "{}", distance);
        let narrow = |values: &[f64]| values.iter().map(|v| *v as f32).collect::<Vec<f32>>();
        let model = Model::new_sparse(structure.clone(), &entries, &single, None).unwrap();
        let found = wide(&step(&model, &narrow(&x), &narrow(&u)));
        let distance = naive::distance(&structure, &found, &expected);
        prop_assert!(distance < SINGLE * bound, "{}", distance);
    }

    /// A Kronecker block term by term: the same model.
    #[test]
    fn a_dense_model_as_a_sparse_one(
        parts in fixtures::parts(), (x, u) in coordinates(), seed: u64,
    ) {
        let mut own = parts.into_iter().next().unwrap().0;
        // Room for the history and the powers is left.
        while own.iter().map(|f| f.radix()).product::<usize>() > REGISTERS - 64 {
            own.pop();
        }
        prop_assume!(!own.is_empty());
        let dense = plane(std::slice::from_ref(&own));
        let sparse = plane(&single_factors(&own));
        // Every term but the constant is an earlier one times the function of its last factor. The
        // function of a factor comes after all functions of the factors before it.
        let count = dense.dictionary().dense_terms();
        let digits = |term: usize| -> Vec<usize> {
            let mut after = count;
            let axes = own.iter().map(|f| { after /= f.radix(); (after, f.radix()) });
            axes.map(|(after, radix)| term / after % radix).collect()
        };
        let entries: Vec<[u8; 2]> = (1..count).map(|term| {
            let digits = digits(term);
            let last = digits.iter().rposition(|d| *d > 0).unwrap();
            let after: usize = own[last + 1..].iter().map(|f| f.radix()).product();
            let before: usize = own[..last].iter().map(|f| f.radix() - 1).sum();
            [(term - digits[last] * after) as u8, (before + digits[last] - 1) as u8]
        }).collect();

        let single = Numbers(seed).take_f32(4 * count);
        let coefficients = wide(&single);
        let dense32 = Model::new(dense.clone(), &single, None).unwrap();
        let dense64 = Model::new(dense.clone(), &coefficients, None).unwrap();
        let sparse32 = Model::new_sparse(sparse.clone(), &entries, &single, None).unwrap();
        let sparse64 = Model::new_sparse(sparse.clone(), &entries, &coefficients, None).unwrap();
        prop_assert_eq!(sparse64.coefficients_per_output(), dense64.coefficients_per_output());
        let distance = naive::distance(&dense, &step(&sparse64, &x, &u), &step(&dense64, &x, &u));
        prop_assert!(distance < ROUNDING * count as f64, "{}", distance);
        let [x32, u32] = [&x, &u].map(|v| v.iter().map(|v| *v as f32).collect::<Vec<f32>>());
        let found = [&sparse32, &dense32].map(|model| wide(&step(model, &x32, &u32)));
        let distance = naive::distance(&dense, &found[0], &found[1]);
        prop_assert!(distance < SINGLE * count as f64, "{}", distance);
    }

    /// The order that the kernel documents, to the bit, for even and odd numbers of outputs.
    #[test]
    fn the_order_of_the_operations(
        numbers in prop::collection::vec(any::<[u8; 2]>(), 0..70), outputs in 1_usize..6, seed: u64,
    ) {
        let factors = [fourier(5, 3), hermite(0, 4), hermite(7, 1), hermite(6, 2)];
        // An angle, and as many lines whose next values are the outputs themselves.
        let free = |state| State { limit: UNBOUNDED, ..state };
        let mut states = vec![free(state("phi", Space::Circle, Target::Increment))];
        states.resize(1 + outputs, free(state("x", Space::Line, Target::Absolute)));
        let observed: Vec<_> = (0..5)
            .map(Source::Input)
            .chain([Source::Sin(0), Source::Cos(0), Source::State(1)])
            .map(|source| at(source, 0))
            .collect();
        let parts = single_factors(&factors);
        let parts: Vec<fixtures::Part<'_>> = parts.iter().map(|own| (&own[..], 0)).collect();
        let inputs = ["a", "b", "c", "d", "e"].map(input);
        let repr = repr("r", &states, &inputs, Symmetry::None, &observed, &parts);
        let entries = chain(&factors, &numbers);
        let width = entries.len() + 1;
        let mut numbers = Numbers(seed);
        let coefficients = numbers.take_f32((outputs + 1) * width);
        let (x, u) = (numbers.take_f32(outputs + 1), numbers.take_f32(5));
        let model =
            Model::new_sparse(fixtures::structure(&repr), &entries, &coefficients, None).unwrap();
        let found = step(&model, &x, &u);

        let (s, c) = Scalar::sin_cos(x[0]); // not std's
        let (s2, c2) = (s * c + c * s, c * c - s * s);
        let (s3, c3) = (s2 * c + c2 * s, c2 * c - s2 * s);
        let v = u[0];
        let v2 = v * v;
        let v3 = v2 * v;
        let functions = [s, c, s2, c2, s3, c3, v, v2, v3, v3 * v, x[1], c, c * c];
        let mut terms = vec![1.0_f32];
        for [p, g] in &entries {
            terms.push(terms[usize::from(*p)] * functions[usize::from(*g)]);
        }
        for (found, row) in found.iter().zip(coefficients.chunks(width)).skip(1) {
            let mut sum = row[0];
            for (c, t) in row.iter().zip(&terms).skip(1) {
                let product = c * t;
                sum += product;
            }
            prop_assert_eq!(found.to_bits(), sum.to_bits());
        }
    }
}

/// x⁺ = 2 exactly, whatever x and u are.
#[test]
fn the_constant_alone() {
    let structure = plane(&[vec![hermite(0, 1)]]);
    let model = Model::new_sparse(structure, &[], &[2.0_f32, -3.0, 0.0, 0.5], None).unwrap();
    assert_eq!(model.coefficients_per_output(), 1);
    let found = step(&model, &[0.3, 0.7, 1.0, 1.0], &[0.0, 1.0]);
    assert_eq!(found, [2.0, -3.0, 1.0, 1.5]);
}

/// What a chain does not use may be beyond the finite numbers.
#[test]
fn functions_that_no_term_uses() {
    let structure = plane(&single_factors(&[hermite(0, 9), hermite(1, 1)]));
    // Functions: x, …, x⁹, y.
    let terms = [[0, 9]];
    let model =
        Model::new_sparse(structure, &terms, &[0.0_f32, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0], None)
            .unwrap();
    assert_eq!(step(&model, &[1e30, 3.0, 0.0, 0.0], &[0.0, 0.0]), [6.0, 1.0, 0.0, 0.0]);
}

// What a term is.

#[test]
fn functions_count_over_all_factors() {
    let structure = fixtures::structure(&fixtures::sparse());
    let dictionary = structure.dictionary();
    assert_eq!(dictionary.functions(), 14);
    let of = |index| dictionary.function(index);
    for (index, digit) in (0..6).zip(1..) {
        assert_eq!(of(index), Some((fourier(0, 3), digit)));
    }
    for (index, digit) in (6..9).zip(1..) {
        assert_eq!(of(index), Some((hermite(2, 3), digit)));
    }
    assert_eq!([of(9), of(10)], [Some((hermite(3, 2), 1)), Some((hermite(3, 2), 2))]);
    assert_eq!(of(11), Some((hermite(4, 1), 1)));
    assert_eq!(of(12), Some((hermite(0, 1), 1)));
    assert_eq!(of(13), Some((hermite(5, 1), 1)));
    assert_eq!([of(14), of(usize::MAX)], [None, None]);
}

#[test]
fn what_a_term_is() {
    let structure = fixtures::structure(&fixtures::sparse());
    let terms = SparseTerms::new(structure.dictionary(), &fixtures::SPARSE).unwrap();
    let v = |observable, exponent| Power { factor: hermite(observable, 1), digit: 1, exponent };
    let harmonic = |digit, exponent| Power { factor: fourier(0, 3), digit, exponent };
    let expected: [&[Power]; 17] = [
        &[],
        &[v(0, 1)],
        &[v(1, 1)],
        &[v(2, 1)],
        &[v(2, 3)],
        &[v(2, 1), v(3, 1)],
        &[v(2, 1), v(3, 2)],
        &[v(2, 1), v(3, 3)],
        &[v(0, 2)],
        // The sine of the harmonics and the one that is an observable of its own.
        &[v(0, 3)],
        &[harmonic(4, 1)],
        &[harmonic(4, 1), harmonic(5, 1)],
        &[harmonic(4, 1), harmonic(5, 2)],
        &[harmonic(4, 1), harmonic(5, 2), v(4, 1)],
        &[v(5, 1)],
        &[v(5, 1), harmonic(6, 1)],
        &[v(5, 1), harmonic(6, 1), v(2, 2)],
    ];
    assert_eq!(terms.count(), expected.len());
    for (i, expected) in expected.iter().enumerate() {
        assert_eq!(terms.term(structure.dictionary(), i).unwrap(), *expected, "term {i}");
    }
    assert_eq!(terms.term(structure.dictionary(), 17), None);
    assert_eq!(terms.functions(13).collect::<Vec<_>>(), [11, 4, 4, 3]);
    assert_eq!(terms.functions(0).count() + terms.functions(17).count(), 0);
}

#[test]
fn a_lift_that_is_too_short() {
    let structure = fixtures::structure(&fixtures::sparse());
    let terms = SparseTerms::new(structure.dictionary(), &fixtures::SPARSE).unwrap();
    let values = [0.6, 0.8, 2.0, -0.5, 3.0, 4.0];
    let mut whole = [9.0; 19];
    assert_eq!(terms.lift(structure.dictionary(), &values, &mut whole), 17);
    assert_eq!((whole[0], whole[4], whole[7], whole[17]), (1.0, 8.0, -0.25, 9.0));
    for length in 0..17 {
        let mut part = vec![9.0; length];
        assert_eq!(terms.lift(structure.dictionary(), &values, &mut part), length);
        assert_eq!(part, whole[..length]);
    }
}

// The specification.

/// x⁺ = x + 0.5 x² u with the terms 1, x, x², x²·u, written by hand from the format table. Changing
/// a byte here breaks every sparse blob in the field.
#[rustfmt::skip]
const GOLDEN: [u8; 244] = [
    // Header.
    b'K', b'O', b'O', b'P',         // 0    magic
    0x01, 0x00,                     // 4    format version 1
    0x04, 0x00,                     // 6    four sections
    0xF4, 0x00, 0x00, 0x00,         // 8    total length 244
    0x34, 0x62, 0x3D, 0xAC,         // 12   CRC-32 of the rest, by zlib
    // Section table: kind, encoding, offset, length.
    0x01, 0x00, 0x01, 0x00, 0x40, 0x00, 0x00, 0x00, 0x89, 0x00, 0x00, 0x00, // 16  metadata, 64, 137
    0x02, 0x00, 0x02, 0x00, 0xCC, 0x00, 0x00, 0x00, 0x10, 0x00, 0x00, 0x00, // 28  coefficients, 204, 16
    0x03, 0x00, 0x03, 0x00, 0xDC, 0x00, 0x00, 0x00, 0x10, 0x00, 0x00, 0x00, // 40  self-test, 220, 16
    0x04, 0x00, 0x04, 0x00, 0xEC, 0x00, 0x00, 0x00, 0x06, 0x00, 0x00, 0x00, // 52  terms, 236, 6
    // Metadata, postcard.
    0x04, b'c', b'a', b'r', b't',   // 64   robot
    0xCD, 0xCC, 0xCC, 0x3D,         //      sample time 0.1 s
    0x01,                           //      one state
    0x01, b'x', 0x01, b'm',         //        name, unit
    0x00, 0x00,                     //        ℝ, absolute
    0x00, 0x00, 0x10, 0xC1,         //        limit −9
    0x00, 0x00, 0x10, 0x41,         //              9
    0x01,                           //      one input
    0x01, b'u', 0x01, b'V',         //        name, unit
    0x00, 0x00, 0x80, 0xBF,         //        range −1
    0x00, 0x00, 0x80, 0x3F,         //              1
    0x00,                           //      no symmetry
    0x02,                           //      two observables
    0x00, 0x00,                     //        state 0
    0x00,                           //        lag 0
    0x00, 0x00, 0x00, 0x00,         //        centre 0
    0x00, 0x00, 0x80, 0x3F,         //        gain 1
    0x04, 0x00,                     //        input 0
    0x00,                           //        lag 0
    0x00, 0x00, 0x00, 0x00,         //        centre 0
    0x00, 0x00, 0x80, 0x3F,         //        gain 1
    0x02,                           //      two factors
    0x00, 0x00, 0x02,               //        observable 0, Hermite, order 2: functions 0 and 1
    0x01, 0x00, 0x01,               //        observable 1, Hermite, order 1: function 2
    0x02,                           //      two blocks
    0x01, 0x00,                     //        one factor, not cut
    0x01, 0x00,                     //        one factor, not cut
    0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11,
    0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11,
    0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22,
    0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22,
                                    //      SHA-256 of the logs, of the robot description
    0x00, 0x00, 0x00,               // 201  padding
    // Coefficients of 1, x, x², x²·u.
    0x00, 0x00, 0x00, 0x00,         // 204  0
    0x00, 0x00, 0x80, 0x3F,         //      1
    0x00, 0x00, 0x00, 0x00,         //      0
    0x00, 0x00, 0x00, 0x3F,         //      0.5
    // Self-test: from 2 m under 1 V to 4 m, within 2⁻¹⁰ m.
    0x00, 0x00, 0x00, 0x40,         // 220  x at k
    0x00, 0x00, 0x80, 0x3F,         //      u at k
    0x00, 0x00, 0x80, 0x40,         //      x at k + 1
    0x00, 0x00, 0x80, 0x3A,         //      tolerance
    // Terms: parent, function.
    0x00, 0x00,                     // 236  1: 1 · x
    0x00, 0x01,                     //      2: 1 · x²
    0x02, 0x02,                     //      3: x² · u
    0x00, 0x00,                     // 242  padding
];

const GOLDEN_TERMS: [[u8; 2]; 3] = [[0, 0], [0, 1], [2, 2]];
const GOLDEN_COEFFICIENTS: [f32; 4] = [0.0, 1.0, 0.0, 0.5];

/// The metadata of [`GOLDEN`].
fn golden_repr() -> ModelRepr<'static> {
    let mut repr = fixtures::one_state();
    repr.factors[0].order = 2;
    repr.blocks = [Block { factors: 1, max_degree: 0 }; 2].into_iter().collect();
    repr
}

fn golden_model() -> Model<'static> {
    let structure = fixtures::structure(&golden_repr());
    Model::new_sparse(structure, &GOLDEN_TERMS, &GOLDEN_COEFFICIENTS, None).unwrap()
}

#[test]
fn golden_bytes_are_written() {
    let mut out = [0xAA; 300];
    let length = blob::emit(&golden_model(), &[2.0], &[1.0], &[1.0 / 1024.0], &mut out).unwrap();
    assert_eq!(out[..length], GOLDEN);
    assert!(out[length..].iter().all(|byte| *byte == 0xAA));
}

#[test]
fn golden_bytes_are_read() {
    let mut sealed = GOLDEN;
    seal(&mut sealed);
    assert_eq!(sealed, GOLDEN);
    let slot = Slot::new(&GOLDEN);
    let model = parse(slot.bytes()).unwrap();
    assert_eq!(model, golden_model());
    assert_eq!(model.structure().to_repr(), golden_repr());
    assert_eq!(model.terms().map(|terms| terms.entries()), Some(&GOLDEN_TERMS[..]));
    assert_eq!(model.coefficients(), GOLDEN_COEFFICIENTS);
    assert_eq!((model.coefficients_per_output(), model.ranges()), (4, None));
    // In place, not copied.
    let at = |offset: usize| slot.bytes()[offset..].as_ptr().addr();
    assert_eq!(model.terms().unwrap().entries().as_ptr().addr(), at(236));
    assert_eq!(model.coefficients().as_ptr().addr(), at(204));
    let test = blob::self_test(slot.bytes()).unwrap();
    assert_eq!((test.states, test.inputs, test.expected), (&[2.0][..], &[1.0][..], &[4.0][..]));
    assert_eq!(step(&model, &[4.0], &[-0.25]), [2.0]);
}

#[test]
fn a_buffer_that_is_too_short() {
    for room in 0..GOLDEN.len() {
        let found = blob::emit(&golden_model(), &[2.0], &[1.0], &[0.1], &mut vec![0; room]);
        assert_eq!(found, Err(EmitError::BufferTooShort { found: room }));
    }
}

#[test]
fn a_dense_model_has_no_terms() {
    let structure = fixtures::structure(&fixtures::one_state());
    let model = Model::new(structure, &fixtures::ONE_STATE, None).unwrap();
    assert_eq!((model.terms(), model.coefficients_per_output()), (None, 4));
}

/// The constant alone: a section of no bytes is still there.
#[test]
fn a_section_without_terms() {
    let constant = |value: f32| {
        let mut sections = sections(&GOLDEN);
        sections[1].2 = bytes_of(&[value]);
        sections[3].2.clear();
        Slot::new(&assemble(&sections))
    };
    let slot = constant(4.0);
    let model = parse(slot.bytes()).unwrap();
    assert_eq!(model.terms().map(|terms| terms.count()), Some(1));
    assert_eq!(step(&model, &[1.0], &[1.0]), [4.0]);
    assert_eq!(parse(constant(5.0).bytes()), Err(ParseError::SelfTest { coordinate: 0 }));
}

// Refused. The checksum is valid in all of these.

fn sparse_error(change: impl FnOnce(&mut Vec<Section>)) -> SparseError {
    match error_with(&GOLDEN, change) {
        ParseError::Model(ModelError::Sparse(error)) => error,
        other => panic!("{other:?}"),
    }
}

#[test]
fn terms_that_are_no_products() {
    let with = |at: usize, byte: u8| sparse_error(|s| s[3].2[at] = byte);
    for (at, first) in [(0, 1), (2, 2), (4, 3)] {
        for parent in [first, first + 1, 255] {
            assert_eq!(with(at, parent), SparseError::Parent { term: at / 2 + 1 });
        }
        for function in [3, 4, 128, 255] {
            assert_eq!(with(at + 1, function), SparseError::Function { term: at / 2 + 1 });
        }
    }
    // The first one that is wrong.
    let both = sparse_error(|s| s[3].2.copy_from_slice(&[0, 0, 0, 3, 9, 9]));
    assert_eq!(both, SparseError::Function { term: 2 });
}

#[test]
fn blocks_that_do_not_only_provide_functions() {
    // The last bytes of the metadata before the hashes: number of blocks, then each of them.
    let blocks = |bytes: &'static [u8]| {
        sparse_error(|s| {
            let end = s[0].2.len() - 64;
            s[0].2.splice(end - 5..end, bytes.iter().copied());
        })
    };
    assert_eq!(blocks(&[1, 2, 0]), SparseError::Block { block: 0 });
    assert_eq!(blocks(&[2, 2, 0, 0, 0]), SparseError::Block { block: 0 });
    assert_eq!(blocks(&[3, 1, 0, 1, 0, 0, 0]), SparseError::Block { block: 2 });
    assert_eq!(blocks(&[2, 1, 0, 1, 1]), SparseError::Block { block: 1 });
    assert_eq!(blocks(&[2, 1, 5, 1, 0]), SparseError::Block { block: 0 });
}

#[test]
fn terms_of_another_length() {
    let resized = |length: usize| error_with(&GOLDEN, |s| s[3].2.resize(length, 0));
    for found in [1, 3, 5, 7] {
        let expected = found + 1;
        let length = ParseError::SectionLength { kind: TERMS, expected, found };
        assert_eq!(resized(found), length);
    }
    // Coefficients for three terms and the constant.
    for (length, expected) in [(0, 1), (2, 2), (4, 3), (8, 5)] {
        let mismatch = ModelError::DimensionMismatch { field: "coefficients", expected, found: 4 };
        assert_eq!(resized(length), ParseError::Model(mismatch));
    }
    for found in [0, 1, 3, 5] {
        let mismatch = ModelError::DimensionMismatch { field: "coefficients", expected: 4, found };
        let few = error_with(&GOLDEN, |s| s[1].2.resize(4 * found, 0));
        assert_eq!(few, ParseError::Model(mismatch));
    }
    // Of a dense model with the same blocks.
    let dense = ModelError::DimensionMismatch { field: "coefficients", expected: 5, found: 4 };
    assert_eq!(error_with(&GOLDEN, |s| drop(s.remove(3))), ParseError::Model(dense));
    for (section, kind) in [METADATA, COEFFICIENTS, SELF_TEST].into_iter().enumerate() {
        let found = error_with(&GOLDEN, |s| drop(s.remove(section)));
        assert_eq!(found, ParseError::MissingSection { kind });
    }
}

/// A reader that does not know the terms must not take the model for a dense one.
#[test]
fn another_encoding_of_the_terms() {
    for encoding in [0, 1, 3, 5, 0xFFFF] {
        let found = error_with(&GOLDEN, |s| s[3].1 = encoding);
        assert_eq!(found, ParseError::UnknownSection { kind: TERMS, encoding });
    }
    let twice = error_with(&GOLDEN, |s| s.push(s[3].clone()));
    assert_eq!(twice, ParseError::SectionTable);
}

/// Another product is another prediction.
#[test]
fn the_self_test_covers_the_terms() {
    let found = error_with(&GOLDEN, |s| s[3].2[4] = 1);
    assert_eq!(found, ParseError::SelfTest { coordinate: 0 });
}

#[test]
fn coefficients_and_ranges_are_checked() {
    let structure = || fixtures::structure(&golden_repr());
    let with = |coefficients: &[f32], ranges: Option<&[f32]>| {
        Model::new_sparse(structure(), &GOLDEN_TERMS, coefficients, ranges).map(drop)
    };
    let infinite = [0.0, 1.0, f32::INFINITY, 0.5];
    assert_eq!(with(&infinite, None), Err(ModelError::NotFinite { coefficient: 2 }));
    let mismatch = ModelError::DimensionMismatch { field: "ranges", expected: 4, found: 2 };
    assert_eq!(with(&GOLDEN_COEFFICIENTS, Some(&[0.0, 1.0])), Err(mismatch));
    assert_eq!(with(&GOLDEN_COEFFICIENTS, Some(&[0.0, 1.0, 0.0, 1.0])), Ok(()));
}

// Capacities.

/// As many functions and terms as there is room for, and one too many.
#[test]
fn sparse_capacities() {
    let names = ["a", "b", "c", "d", "e", "f", "g", "h"];
    let states =
        names.map(|name| State { limit: UNBOUNDED, ..state(name, Space::Line, Target::Absolute) });
    let observables: Vec<_> = (0..7_u8)
        .flat_map(|lag| (0..8).map(move |i| at(Source::State(i), lag)))
        .chain((0..6).map(|i| at(Source::Input(i), 0)))
        .collect();
    let build = |orders: &[u8]| {
        let factors: Vec<_> =
            orders.iter().enumerate().map(|(o, p)| hermite(o as u8, *p)).collect();
        let parts = single_factors(&factors);
        let parts: Vec<fixtures::Part<'_>> = parts.iter().map(|own| (&own[..], 0)).collect();
        let inputs = ["u", "v", "w", "p", "q", "r"].map(input);
        fixtures::structure(&repr("r", &states, &inputs, Symmetry::None, &observables, &parts))
    };
    // 62 observables, one of them to the sixth power.
    let mut orders = vec![2; observables.len()];
    orders[0] = 6;
    let structure = build(&orders);
    assert_eq!(structure.dictionary().functions(), MAX_FUNCTIONS);
    // Every function, then every one times the first.
    let functions = (0..MAX_FUNCTIONS).map(|g| [0, g as u8]);
    let products = (0..MAX_FUNCTIONS).map(|g| [1, g as u8]);
    let entries: Vec<[u8; 2]> = functions.chain(products).take(MAX_SPARSE_TERMS).collect();
    assert_eq!(entries.len(), MAX_SPARSE_TERMS);
    // There are not registers enough for all of it; with one term fewer than refused, it predicts.
    let taken = |terms: usize| {
        let terms = SparseTerms::new(structure.dictionary(), &entries[..terms]).unwrap();
        structure.fits(Some(terms))
    };
    let Err(ModelError::Sparse(SparseError::TooLarge { field, capacity, found })) =
        taken(MAX_SPARSE_TERMS)
    else {
        panic!()
    };
    assert_eq!((field, capacity), ("registers", REGISTERS));
    let room = MAX_SPARSE_TERMS - (found - REGISTERS);
    assert!(room > 64 && taken(room).is_ok() && taken(room + 1).is_err());
    let (all, entries) = (entries.clone(), entries[..room].to_vec());
    let coefficients = Numbers(1).take_f64(8 * (room + 1));
    let model = Model::new_sparse(structure.clone(), &entries, &coefficients, None).unwrap();
    let predictor = Predictor::new(&model);
    let mut state = fixtures::fill(&predictor, &mut Numbers(2));
    let u = Numbers(3).take_f64(6);
    let mut values = vec![0.0; observables.len()];
    state.history().observe(&structure, &u, &mut values);
    predictor.step(&mut state, &u).unwrap();
    let mut found = [0.0; 8];
    predictor.coordinates(&state, &mut found).unwrap();
    let terms = naive::sparse(structure.dictionary(), &entries, &values);
    for (found, row) in found.iter().zip(coefficients.chunks(terms.len())) {
        let expected: f64 = row.iter().zip(&terms).map(|(c, t)| c * t).sum();
        assert!((found - expected).abs() < ROUNDING * terms.len() as f64);
    }

    let refused = |dictionary: &Dictionary, entries: &[[u8; 2]]| {
        SparseTerms::new(dictionary, entries).unwrap_err()
    };
    let too_large =
        |field, capacity| SparseError::TooLarge { field, capacity, found: capacity + 1 };
    let found = refused(structure.dictionary(), &[&all[..], &[[0, 0]]].concat());
    assert_eq!(found, too_large("sparse terms", MAX_SPARSE_TERMS));
    orders[0] = 7;
    let found = refused(build(&orders).dictionary(), &[[0, 0]]);
    assert_eq!(found, too_large("functions", MAX_FUNCTIONS));

    // The same on parsing.
    let found = error_with(&GOLDEN, |s| {
        s[1].2 = bytes_of(&[0.0; 257]);
        s[3].2 = vec![0; 2 * 256];
    });
    let expected = too_large("sparse terms", MAX_SPARSE_TERMS);
    assert_eq!(found, ParseError::Model(ModelError::Sparse(expected)));
    // x⁺ = x + 0.5 x² u, then terms that do not matter.
    let mut sections = sections(&GOLDEN);
    sections[1].2.resize(4 * 241, 0);
    sections[3].2.resize(2 * 240, 0);
    assert!(parse(Slot::new(&assemble(&sections)).bytes()).is_ok());
}

/// The basis is the same in every factor that holds it.
#[test]
fn an_observable_in_several_factors() {
    let structure = plane(&single_factors(&[hermite(2, 1), fourier(2, 2), hermite(2, 3)]));
    let terms = [[0, 0], [0, 1], [0, 5], [3, 6]];
    let terms = SparseTerms::new(structure.dictionary(), &terms).unwrap();
    let mut lifted = [0.0; 5];
    terms.lift(structure.dictionary(), &[0.0, 0.0, 0.6, 0.8], &mut lifted);
    assert_eq!(lifted[..4], [1.0, 0.6, 0.6, 0.6]);
    let last = terms.term(structure.dictionary(), 4).unwrap();
    assert_eq!((last.len(), last[0].factor.basis, last[0].exponent), (1, Basis::Hermite, 3));
}
