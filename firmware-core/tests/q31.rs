//! Models in fixed point: exact bytes, a known operator, sums that cannot overflow, and what is refused.

mod bytes;
mod fixtures;

use bytes::{Section, assemble, sections};
use firmware_core::blob::{self, Aligned, ParseError};
use firmware_core::dictionary::{Basis, Block, Factor, Observable, Source};
use firmware_core::model::{
    Input, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};
use firmware_core::q31::{self, FixedModel, FixedState, LoadError, Scale};
use firmware_core::{PredictError, parse};
use proptest::prelude::*;

/// One state, `inputs` inputs. In fixed point the metadata are names and units.
fn structure(inputs: usize) -> Structure<'static> {
    let observable = |source| Observable { source, lag: 0, centre: 0.0, gain: 1.0 };
    let names = ["u", "v", "w", "a", "b"];
    let names = names.iter().take(inputs);
    Structure::try_from(ModelRepr {
        robot: "cart",
        sample_time_s: 0.1,
        states: [State {
            name: "x",
            unit: "m",
            space: Space::Line,
            target: Target::Absolute,
            limit: [-8.0, 8.0],
        }]
        .into_iter()
        .collect(),
        inputs: names.map(|name| Input { name, unit: "V", range: [-1.0, 1.0] }).collect(),
        symmetry: Symmetry::None,
        observables: [observable(Source::State(0))].into_iter().collect(),
        factors: [Factor { observable: 0, basis: Basis::Hermite, order: 1 }].into_iter().collect(),
        blocks: [Block { factors: 1, max_degree: 0 }].into_iter().collect(),
        provenance: Provenance { logs: [0x11; 32], robot: [0x22; 32] },
    })
    .unwrap()
}

/// Room for a blob.
type Slot = Aligned<[u8; 65_536]>;

fn bytes(bytes: [u8; 4]) -> u32 {
    u32::from_le_bytes(bytes)
}

const HALF_MIN: u32 = (i32::MIN >> 1) as u32;
const HALF_MAX: u32 = (i32::MAX >> 1) as u32;

/// A model of one state, register 0, and inputs in the registers behind it: one block, an axis per radix.
fn words(radices: &[u8], shift: u8, coefficients: &[i32]) -> Vec<u32> {
    let inputs = radices.len() - 1;
    let mut words = vec![bytes([1, inputs as u8, 1, radices.len() as u8]), 0];
    words.extend([bytes([0, shift, 0, 0]), bytes([0, 31, 31, 0])]);
    let low = i32::MIN >> shift;
    words.extend([low as u32, (i32::MAX >> shift).wrapping_sub(low) as u32]);
    words.extend([HALF_MIN, HALF_MAX, HALF_MIN, HALF_MAX]);
    words.extend([0.0_f32.to_bits(), 8.0_f32.to_bits()]);
    for i in 0..inputs {
        words.extend([bytes([i as u8 + 1, 0, 0, 0]), HALF_MIN, HALF_MAX]);
        words.extend([0.0_f32.to_bits(), 1.0_f32.to_bits()]);
    }
    words.extend((0..).zip(radices).map(|(i, radix)| bytes([i, *radix, 0, 0])));
    words.push(radices.len() as u32);
    words.extend(coefficients.iter().map(|c| *c as u32));
    words
}

fn emit(inputs: usize, words: &[u32], test: &[i32]) -> Result<Box<Slot>, LoadError> {
    let mut blob = Box::new(Aligned([0xFF; 65_536]));
    q31::emit(&structure(inputs), words, test, &mut blob.0)?;
    Ok(blob)
}

fn step(model: &FixedModel<'_>, x: i32, u: &[i32]) -> Result<i32, PredictError> {
    let mut state = FixedState::new();
    model.observe(&mut state, &[x])?;
    model.step(&mut state, u)?;
    let mut out = [0];
    model.coordinates(&state, &mut out)?;
    Ok(out[0])
}

/// x⁺ = x / 2 + 2 u in [m] and [V]: in full scales of 8 m and 1 V, X / 2 + U / 4. With 2²⁹ for full scale, and
/// twice that for what is multiplied once: terms 1, u, x, x·u.
const CART: [i32; 4] = [0, 1 << 28, 1 << 29, 0];

#[test]
fn a_known_operator_is_exact() {
    let blob = emit(1, &words(&[2, 2], 2, &CART), &[0, 0]).unwrap();
    let model = q31::parse_prefix(&blob.0).unwrap();
    assert_eq!(model.robot(), "cart");
    let (x, u) = (model.coordinate_scale(0).unwrap(), model.input_scale(0).unwrap());
    assert_eq!(
        (x, u),
        (Scale::Line { centre: 0.0, full: 8.0 }, Scale::Line { centre: 0.0, full: 1.0 })
    );
    let mut state = FixedState::new();
    assert_eq!(model.step(&mut state, &[0]), Err(PredictError::NotReady { have: 0, need: 1 }));
    model.observe(&mut state, &[x.to_fixed(4.0)]).unwrap();
    let inputs = [0.5, 0.5, -0.5].map(|volt| u.to_fixed(volt));
    let mut path = [0; 3];
    model.rollout(&mut state, &inputs, &mut path).unwrap();
    assert_eq!(path.map(|position| x.to_unit(position)), [3.0, 2.5, 0.25]);
    assert_eq!(state.step(), 3);
    // Held, from a state that was filled otherwise before; both banks.
    for steps in 0..2 {
        model.observe(&mut state, &[x.to_fixed(4.0)]).unwrap();
        model.rollout_held(&mut state, &inputs[..1], &mut path[..steps]).unwrap();
        let mut ahead = FixedState::new();
        model.observe(&mut ahead, &[x.to_fixed(-1.0)]).unwrap();
        model.step(&mut ahead, &[0]).unwrap();
        ahead.clone_from(&state);
        let mut held = [0; 3];
        model.rollout_held(&mut ahead, &inputs[..1], &mut held).unwrap();
        model.rollout_held(&mut state, &inputs[..1], &mut path).unwrap();
        assert_eq!((held, ahead.step()), (path, state.step()));
    }
    // Beyond full scale there is nothing: 4 + 2 · 2 V would be 8 m.
    let blob = emit(1, &words(&[2, 2], 2, &[0, 1 << 29, 1 << 29, 0]), &[0, 0]).unwrap();
    let model = q31::parse_prefix(&blob.0).unwrap();
    assert_eq!(step(&model, x.to_fixed(7.999_999), &[u.to_fixed(0.99)]).map(|_| ()), Ok(()));
    let blob = emit(1, &words(&[2, 2], 2, &[1 << 28, 1 << 29, 1 << 29, 0]), &[0, 0]).unwrap();
    let model = q31::parse_prefix(&blob.0).unwrap();
    assert_eq!(step(&model, i32::MAX, &[i32::MAX]), Err(PredictError::Diverged { step: 1 }));
}

#[test]
fn the_trained_range_is_flagged() {
    let mut words = words(&[2, 2], 2, &CART);
    // x within half of full scale, u within a quarter; observables 3 and 5.
    words[2] = bytes([0, 2, 0, 3]);
    (words[6], words[7]) = (-(1_i32 << 29) as u32, 1 << 29);
    words[12] = bytes([1, 5, 0, 0]);
    (words[13], words[14]) = (-(1_i32 << 28) as u32, 1 << 28);
    let blob = emit(1, &words, &[0, 0]).unwrap();
    let model = q31::parse_prefix(&blob.0).unwrap();
    let outside = |x: i32, u: i32| {
        let mut state = FixedState::new();
        model.observe(&mut state, &[x]).unwrap();
        model.step(&mut state, &[u]).unwrap();
        state.out_of_range().map(|o| (o.step, o.observable))
    };
    assert_eq!(outside(1 << 30, 1 << 29), None);
    assert_eq!(outside(-(1 << 30), -(1 << 29)), None);
    assert_eq!(outside((1 << 30) + 2, 0), Some((1, 3)));
    assert_eq!(outside(-(1 << 30) - 1, 0), Some((1, 3)));
    assert_eq!(outside(0, (1 << 29) + 2), Some((1, 5)));
    assert_eq!(outside(0, i32::MIN), Some((1, 5)));
    // What was predicted outside is flagged by the step that uses it.
    let mut state = FixedState::new();
    model.observe(&mut state, &[(1 << 30) - 4]).unwrap();
    model.step(&mut state, &[1 << 29]).unwrap();
    assert_eq!(state.out_of_range(), None);
}

/// The cart, written by hand from the table of the section. Changing a byte here breaks every blob in the field.
#[rustfmt::skip]
const SECTION: [u8; 96] = [
    0x01, 0x01, 0x01, 0x02,                         // 1 state, 1 input, 1 block, 2 factors
    0x00, 0x00, 0x00, 0x00,                         // no pose
    0x00, 0x02, 0x00, 0x00,                         // next value, shift 2, output 0, observable 0
    0x00, 0x1F, 0x1F, 0x00,                         // register 0, no sine and cosine
    0x00, 0x00, 0x00, 0xE0,                         // least −2²⁹
    0xFF, 0xFF, 0xFF, 0x3F,                         // span 2³⁰ − 1
    0x00, 0x00, 0x00, 0xC0, 0xFF, 0xFF, 0xFF, 0x3F, // trained range: all
    0x00, 0x00, 0x00, 0xC0, 0xFF, 0xFF, 0xFF, 0x3F, // no cosine
    0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x41, // centre 0, full scale 8
    0x01, 0x00, 0x00, 0x00,                         // input: register 1, observable 0
    0x00, 0x00, 0x00, 0xC0, 0xFF, 0xFF, 0xFF, 0x3F, // trained range: all
    0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x80, 0x3F, // centre 0, full scale 1
    0x00, 0x02, 0x00, 0x00,                         // factor: register 0, radix 2
    0x01, 0x02, 0x00, 0x00,                         // factor: register 1, radix 2
    0x02, 0x00, 0x00, 0x00,                         // a block of two factors
    0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x10, // coefficients of 1, u
    0x00, 0x00, 0x00, 0x20, 0x00, 0x00, 0x00, 0x00, //              of x, x·u
];
#[rustfmt::skip]
const SELF_TEST: [u8; 12] = [
    0x00, 0x00, 0x00, 0x40, 0x00, 0x00, 0x00, 0x20, // from 4 m with 0.25 V
    0x00, 0x00, 0x00, 0x28,                         // to 2.5 m
];

#[test]
fn golden_bytes() {
    let slot = emit(1, &words(&[2, 2], 2, &CART), &[1 << 30, 1 << 29]).unwrap();
    let blob = &slot.0[..blob::length(&slot.0).unwrap()];
    let found = sections(blob);
    assert_eq!(found.len(), 3);
    assert_eq!((found[0].0, found[0].1), (1, 1));
    assert_eq!(found[1], (5, 6, SECTION.to_vec()));
    assert_eq!(found[2], (3, 7, SELF_TEST.to_vec()));
    assert_eq!(assemble(&found), blob);
    assert_eq!(q31::structure(blob).unwrap(), structure(1));
}

/// A slot with a blob of these sections.
fn slot(parts: &[Section]) -> Box<Slot> {
    let mut slot = Box::new(Aligned([0xFF; 65_536]));
    let blob = assemble(parts);
    slot.0[..blob.len()].copy_from_slice(&blob);
    slot
}

#[test]
fn each_kind_of_blob_is_refused_by_the_reader_of_the_other() {
    let fixed = emit(1, &words(&[2, 2], 2, &CART), &[0, 0]).unwrap();
    let length = blob::length(&fixed.0).unwrap();
    assert_eq!(parse(&fixed.0[..length]), Err(ParseError::FixedPoint));
    let float = Aligned(*include_bytes!("../../models/rosbot/model.bin"));
    assert_eq!(q31::parse(&float.0), Err(LoadError::FloatingPoint));
    // As any blob.
    assert_eq!(
        q31::parse(&fixed.0[..length + 4]),
        Err(LoadError::Blob(ParseError::Trailing { expected: length, found: length + 4 }))
    );
    assert_eq!(
        q31::parse_for("another", &fixed.0[..length]),
        Err(LoadError::Blob(ParseError::AnotherRobot))
    );
    for i in 0..length {
        let mut damaged = fixed.clone();
        damaged.0[i] ^= 0x10;
        assert!(q31::parse_prefix(&damaged.0).is_err(), "byte {i}");
    }
}

#[test]
fn words_that_do_not_hold_together_are_refused() {
    let good = emit(1, &words(&[2, 2], 2, &CART), &[1 << 30, 1 << 29]).unwrap();
    let parts = sections(&good.0[..blob::length(&good.0).unwrap()]);
    let with = |word: usize, value: u32| {
        let mut parts = parts.clone();
        parts[1].2[4 * word..4 * word + 4].copy_from_slice(&value.to_le_bytes());
        q31::parse_prefix(&slot(&parts).0).map(|_| ()).unwrap_err()
    };
    let section = |field| LoadError::Section { field };
    assert_eq!(with(0, bytes([0, 1, 1, 2])), section("counts"));
    assert_eq!(
        with(0, bytes([9, 1, 1, 2])),
        LoadError::TooLarge { field: "states", capacity: 8, found: 9 }
    );
    assert!(matches!(with(0, bytes([1, 1, 1, 1])), LoadError::TooLarge { .. }));
    assert_eq!(with(1, bytes([0, 0, 0, 1])), section("pose"));
    assert_eq!(with(2, bytes([6, 2, 0, 0])), section("kind of a coordinate"));
    assert_eq!(with(2, bytes([0, 32, 0, 0])), section("shift of a coordinate"));
    assert_eq!(with(2, bytes([0, 0xFF, 0, 0])), section("shift of a coordinate"));
    assert_eq!(with(2, bytes([0, 2, 1, 0])), section("shift of a coordinate"));
    // Outputs within the range would not fit when they are shifted.
    assert_eq!(with(2, bytes([0, 3, 0, 0])), section("shift of a coordinate"));
    assert_eq!(with(3, bytes([1, 31, 31, 0])), section("registers"));
    assert_eq!(with(3, bytes([31, 31, 31, 0])), section("registers"));
    assert_eq!(with(3, bytes([0, 2, 31, 0])), section("registers"));
    assert_eq!(with(5, u32::MAX), section("range of a coordinate"));
    assert_eq!(with(11, 0), section("scale of a coordinate"));
    assert_eq!(with(16, f32::NAN.to_bits()), section("scale of an input"));
    assert_eq!(with(17, bytes([3, 2, 0, 0])), section("factor"));
    assert_eq!(with(17, bytes([0, 1, 0, 0])), section("factor"));
    assert_eq!(with(17, bytes([0, 11, 0, 0])), section("factor"));
    assert_eq!(with(17, bytes([0, 3, 0, 0])), section("length"));
    assert_eq!(with(19, 1), section("blocks"));
    assert_eq!(
        with(19, 13),
        LoadError::TooLarge { field: "factors of a block", capacity: 12, found: 13 }
    );
    assert_eq!(with(20, i32::MAX as u32), LoadError::Overflow { output: 0 });
    // Another operator.
    assert_eq!(with(22, 1 << 28), LoadError::SelfTest);
}

#[test]
fn a_sum_that_could_overflow_is_refused() {
    // 2³¹ − 2 is the most that a sum may be, a coefficient that is multiplied once counting half.
    let most = i32::MAX - 1;
    let fits = |c: [i32; 2]| emit(0, &words(&[2], 0, &c), &[0]).map(|_| ());
    assert_eq!(fits([most, 0]), Ok(()));
    assert_eq!(fits([most - 100, 200]), Ok(()));
    assert_eq!(fits([most, 1]), Err(LoadError::Overflow { output: 0 }));
    assert_eq!(fits([-most, -2]), Err(LoadError::Overflow { output: 0 }));
    assert_eq!(fits([i32::MIN, 0]), Err(LoadError::Overflow { output: 0 }));
}

/// Powers of all axes: the operator in f64, in output integers.
fn in_f64(radices: &[u8], coefficients: &[i32], v: &[i32]) -> f64 {
    let Some((radix, faster)) = radices.split_first() else { return f64::from(coefficients[0]) };
    let w = f64::from(v[0]) / 4_294_967_296.0;
    coefficients
        .chunks_exact(coefficients.len() / usize::from(*radix))
        .rev()
        .fold(0.0, |sum, row| sum * w + in_f64(faster, row, &v[1..]))
}

/// The largest coefficients in these proportions that are accepted.
fn largest(radices: &[u8], proportions: &[i32]) -> Option<(Vec<i32>, Box<Slot>)> {
    let test = vec![0; radices.len()];
    (0..31).find_map(|shift| {
        let coefficients: Vec<i32> = proportions.iter().map(|c| c >> shift).collect();
        let blob = emit(radices.len() - 1, &words(radices, 0, &coefficients), &test).ok()?;
        Some((coefficients, blob))
    })
}

/// Shapes that every tile of the kernel, and what is around the tiles, takes part in.
const SHAPES: [&[u8]; 12] = [
    &[2],
    &[2, 2, 2],
    &[2, 2, 2, 2],
    &[2, 2, 2, 2, 2],
    &[2, 2, 2, 2, 2, 2],
    &[4, 4],
    &[2, 2, 4, 4],
    &[3, 4, 4],
    &[6, 6],
    &[2, 3, 4, 5],
    &[10, 2],
    &[5, 2, 2, 2, 2],
];

fn number() -> impl Strategy<Value = i32> {
    prop_oneof![
        Just(i32::MIN),
        Just(i32::MAX),
        Just(0),
        any::<i32>(),
        any::<i32>().prop_map(|x| x >> 8)
    ]
}

proptest! {
    /// Overflow would panic here. The bar is a millionth of full scale, 2,147 of the last place; every fold
    /// loses less than one, of a scale that is at least its own.
    #[test]
    fn no_overflow_and_as_in_f64(
        shape in 0..SHAPES.len(),
        proportions in prop::collection::vec(number(), 512),
        v in prop::collection::vec(number(), 6),
    ) {
        let radices = SHAPES[shape];
        let size = radices.iter().map(|radix| usize::from(*radix)).product();
        if let Some((coefficients, blob)) = largest(radices, &proportions[..size]) {
            let model = q31::parse_prefix(&blob.0).unwrap();
            let found = step(&model, v[0], &v[1..radices.len()]).unwrap();
            let folds: u8 = radices.iter().map(|radix| radix - 1).sum();
            let off = in_f64(radices, &coefficients, &v) - f64::from(found);
            prop_assert!(off.abs() <= 2.0 * f64::from(folds), "{off}");
        }
    }

    /// All of one magnitude, with signs that add up, at the corners of the range.
    #[test]
    fn the_largest_sums_at_the_corners(shape in 0..SHAPES.len(), corner in 0..64_u32, sign: bool) {
        let radices = SHAPES[shape];
        let size: usize = radices.iter().map(|radix| usize::from(*radix)).product();
        let v: Vec<i32> =
            (0..6).map(|i| if corner >> i & 1 == 0 { i32::MAX } else { i32::MIN }).collect();
        let proportions: Vec<i32> = (0..size)
            .map(|index| {
                let mut rest = index;
                let mut negative = sign;
                for (radix, v) in radices.iter().zip(&v).rev() {
                    let digit = rest % usize::from(*radix);
                    rest /= usize::from(*radix);
                    negative ^= *v < 0 && digit % 2 == 1;
                }
                if negative { -(1 << 30) } else { 1 << 30 }
            })
            .collect();
        let (coefficients, blob) = largest(radices, &proportions).unwrap();
        let model = q31::parse_prefix(&blob.0).unwrap();
        let found = step(&model, v[0], &v[1..radices.len()]).unwrap();
        let off = in_f64(radices, &coefficients, &v) - f64::from(found);
        prop_assert!(off.abs() < 40.0, "{off}");
    }

    /// Conversions there and back are off by less than the last place.
    #[test]
    fn scales_there_and_back(x: i32, centre in -100.0_f32..100.0, full in 0.001_f32..1e4) {
        let line = Scale::Line { centre, full };
        let back = line.to_fixed(line.to_unit(x));
        // f64 has 53 bits: a centre that is large beside the scale takes some of them.
        prop_assert!((i64::from(back) - i64::from(x)).abs() <= 1);
        prop_assert_eq!(Scale::Turn.to_fixed(Scale::Turn.to_unit(x)), x);
    }

    /// Whatever the words are, nothing panics.
    #[test]
    fn any_words(
        at in prop::collection::vec((0..24_usize, any::<u32>()), 1..4),
        x: i32,
        u: i32,
    ) {
        let mut words = words(&[2, 2], 2, &CART);
        for (word, value) in at {
            words[word] = value;
        }
        if let Ok(blob) = emit(1, &words, &[0, 0]) {
            let model = q31::parse_prefix(&blob.0).unwrap();
            let _ = step(&model, x, &[u]);
        }
    }
}
