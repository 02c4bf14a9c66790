//! Blobs: exact bytes, round trips, and everything that must be refused.

mod bytes;
mod fixtures;

use bytes::{
    COEFFICIENTS, ENTRY, ERROR_BOUNDS, HEADER, METADATA, RANGES, SELF_TEST, Section, TERMS,
    assemble, bytes_of, error, error_after, error_with, numbers_of, seal, sections, set_number,
    u32_at,
};
use firmware_core::blob::{self, EmitError, ParseError, parse_into};
use firmware_core::capacity::{
    MAX_BLOCKS, MAX_FACTORS, MAX_INPUTS, MAX_LAG, MAX_OBSERVABLES, MAX_OUTPUTS, MAX_STATES,
    MAX_TERMS,
};
use firmware_core::dictionary::{Basis, Block, DictionaryError, Factor, Observable, Source};
use firmware_core::model::{
    Input, Model, ModelError, ModelRepr, Provenance, Space, State, Structure, Symmetry, Target,
};
use firmware_core::{Predictor, PredictorState, parse, parse_for, parse_prefix};
use fixtures::{Numbers, Slot, at, hermite};
use proptest::prelude::*;
use serde::Serialize;

fn blobs() -> Vec<(ModelRepr<'static>, Vec<u8>)> {
    fixtures::all().into_iter().map(|repr| (repr.clone(), fixtures::emit(&repr))).collect()
}

// The specification.

/// The one-state model, written by hand from the format table. Changing a byte here breaks every
/// blob in the field.
#[rustfmt::skip]
const GOLDEN: [u8; 248] = [
    // Header.
    b'K', b'O', b'O', b'P',         // 0    magic
    0x01, 0x00,                     // 4    format version 1
    0x04, 0x00,                     // 6    four sections
    0xF8, 0x00, 0x00, 0x00,         // 8    total length 248
    0x8F, 0x91, 0xA1, 0x57,         // 12   CRC-32 of the rest, by zlib
    // Section table: kind, encoding, offset, length.
    0x01, 0x00, 0x01, 0x00, 0x40, 0x00, 0x00, 0x00, 0x87, 0x00, 0x00, 0x00, // 16  metadata, 64, 135
    0x02, 0x00, 0x02, 0x00, 0xC8, 0x00, 0x00, 0x00, 0x10, 0x00, 0x00, 0x00, // 28  coefficients, 200, 16
    0x03, 0x00, 0x03, 0x00, 0xD8, 0x00, 0x00, 0x00, 0x10, 0x00, 0x00, 0x00, // 40  self-test, 216, 16
    0x01, 0x80, 0x03, 0x00, 0xE8, 0x00, 0x00, 0x00, 0x10, 0x00, 0x00, 0x00, // 52  ranges, 232, 16
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
    0x00, 0x00, 0x01,               //        observable 0, Hermite, order 1
    0x01, 0x00, 0x01,               //        observable 1, Hermite, order 1
    0x01,                           //      one block
    0x02, 0x00,                     //        two factors, not cut
    0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11,
    0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11, 0x11,
    0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22,
    0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22, 0x22,
                                    //      SHA-256 of the logs, of the robot description
    0x00,                           // 199  padding
    // Coefficients of 1, u, x, x·u.
    0x00, 0x00, 0x00, 0x00,         // 200  0
    0x00, 0x00, 0x00, 0x40,         //      2
    0x00, 0x00, 0x00, 0x3F,         //      0.5
    0x00, 0x00, 0x00, 0x00,         //      0
    // Self-test: from 4 m under 1 V to 4 m, within 2⁻¹⁰ m.
    0x00, 0x00, 0x80, 0x40,         // 216  x at k
    0x00, 0x00, 0x80, 0x3F,         //      u at k
    0x00, 0x00, 0x80, 0x40,         //      x at k + 1
    0x00, 0x00, 0x80, 0x3A,         //      tolerance
    // Trained ranges.
    0x00, 0x00, 0xA0, 0xC0,         // 232  x from −5
    0x00, 0x00, 0xA0, 0x40,         //      to 5
    0x00, 0x00, 0x80, 0xBF,         //      u from −1
    0x00, 0x00, 0x80, 0x3F,         //      to 1
];

/// The model that [`GOLDEN`] holds.
fn golden_repr() -> ModelRepr<'static> {
    let mut repr = fixtures::one_state();
    repr.states[0].unit = "m";
    repr.inputs[0].unit = "V";
    repr
}

const GOLDEN_RANGES: [f32; 4] = [-5.0, 5.0, -1.0, 1.0];

#[test]
fn golden_bytes_are_written() {
    let structure = Structure::try_from(golden_repr()).unwrap();
    let model = Model::new(structure, &fixtures::ONE_STATE, Some(&GOLDEN_RANGES)).unwrap();
    let mut out = [0xAA; 300];
    let length = blob::emit(&model, &[4.0], &[1.0], &[1.0 / 1024.0], &mut out).unwrap();
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
    assert_eq!(model.structure().to_repr(), golden_repr());
    assert_eq!(model.coefficients(), fixtures::ONE_STATE);
    assert_eq!(model.ranges(), Some(&GOLDEN_RANGES[..]));
    // In place, not copied.
    assert_eq!(model.coefficients().as_ptr().addr(), slot.bytes()[200..].as_ptr().addr());
    let test = blob::self_test(slot.bytes()).unwrap();
    assert_eq!((test.states, test.inputs), (&[4.0][..], &[1.0][..]));
    assert_eq!((test.expected, test.tolerance), (&[4.0][..], &[1.0 / 1024.0][..]));
}

/// The variants that the golden model does not use, in the order of the declaration.
#[test]
fn numbers_of_the_variants() {
    fn encoded<T: Serialize>(value: &T) -> Vec<u8> {
        postcard::to_slice(value, &mut [0; 64]).unwrap().to_vec()
    }
    assert_eq!(encoded(&[Space::Line, Space::Circle]), [0, 1]);
    assert_eq!(encoded(&[Target::Absolute, Target::Increment]), [0, 1]);
    assert_eq!(encoded(&[Basis::Hermite, Basis::Fourier]), [0, 1]);
    let sources =
        [Source::State(7), Source::Sin(7), Source::Cos(7), Source::Increment(7), Source::Input(7)];
    assert_eq!(encoded(&sources), [0, 7, 1, 7, 2, 7, 3, 7, 4, 7]);
    assert_eq!(encoded(&Symmetry::None), [0]);
    assert_eq!(encoded(&Symmetry::Translation { coordinates: 0b011 }), [1, 3]);
    assert_eq!(encoded(&Symmetry::Se2 { x: 4, y: 5, heading: 255 }), [2, 4, 5, 255]);
    assert_eq!(encoded(&hermite(200, 9)), [200, 0, 9]);
    assert_eq!(encoded(&Block { factors: 12, max_degree: 200 }), [12, 200]);
}

// Round trips.

#[test]
fn what_is_written_is_read() {
    for (repr, blob) in blobs() {
        let slot = Slot::new(&blob);
        let model = parse(slot.bytes()).unwrap();
        let structure = fixtures::structure(&repr);
        assert_eq!(model.structure(), &structure);
        assert_eq!(model.structure().to_repr(), repr);
        if repr.robot != "cart" {
            assert_eq!(model.coefficients(), fixtures::coefficients(&structure));
        }
        assert_eq!(model.ranges(), Some(&fixtures::ranges(&structure)[..]));
        assert_eq!(parse_prefix(slot.bytes()).as_ref(), Ok(&model));
        assert_eq!(parse_for(repr.robot, slot.bytes()).as_ref(), Ok(&model));
        assert_eq!(assemble(&sections(&blob)), blob);
        // Written again from what was read: the same bytes.
        let test = blob::self_test(slot.bytes()).unwrap();
        let mut again = vec![0x55; blob.len()];
        let length =
            blob::emit(&model, test.states, test.inputs, test.tolerance, &mut again).unwrap();
        assert_eq!((length, again), (blob.len(), blob));
    }
}

#[test]
fn ranges_are_optional() {
    for (repr, blob) in blobs() {
        let mut sections = sections(&blob);
        sections.retain(|(kind, ..)| *kind != RANGES);
        let slot = Slot::new(&assemble(&sections));
        assert_eq!(parse(slot.bytes()).unwrap().ranges(), None, "{}", repr.robot);
    }
}

#[test]
fn sections_come_in_any_order() {
    let mut sections = sections(&GOLDEN);
    sections.reverse();
    let slot = Slot::new(&assemble(&sections));
    assert_eq!(parse(slot.bytes()).unwrap().coefficients(), fixtures::ONE_STATE);
}

#[test]
fn what_cannot_be_written() {
    let structure = Structure::try_from(golden_repr()).unwrap();
    let model = Model::new(structure, &fixtures::ONE_STATE, Some(&GOLDEN_RANGES)).unwrap();
    let emit = |states: &[f32], inputs: &[f32], tolerance: &[f32], room: usize| {
        blob::emit(&model, states, inputs, tolerance, &mut vec![0; room])
    };
    for room in 0..GOLDEN.len() {
        let short = Err(EmitError::BufferTooShort { found: room });
        assert_eq!(emit(&[4.0], &[1.0], &[0.1], room), short);
    }
    assert_eq!(emit(&[4.0], &[1.0], &[0.1], GOLDEN.len()), Ok(GOLDEN.len()));
    for (states, inputs, tolerance) in [
        (&[][..], &[1.0][..], &[0.1][..]),
        (&[4.0], &[], &[0.1]),
        (&[4.0], &[1.0], &[]),
        (&[4.0, 4.0], &[1.0], &[0.1]),
        (&[4.0], &[1.0, 1.0], &[0.1]),
        (&[4.0], &[1.0], &[0.1, 0.1]),
        // The right number of numbers, in the wrong places.
        (&[4.0], &[1.0, 1.0], &[]),
        (&[4.0, 4.0], &[1.0], &[]),
        // No prediction.
        (&[f32::NAN], &[1.0], &[0.1]),
        (&[4.0], &[f32::INFINITY], &[0.1]),
        (&[8.0], &[3.0], &[0.1]),
    ] {
        assert_eq!(emit(states, inputs, tolerance, 300), Err(EmitError::SelfTest));
    }
    // What was written would not be read.
    for tolerance in [f32::NAN, -1.0, f32::INFINITY] {
        assert_eq!(emit(&[4.0], &[1.0], &[tolerance], 300), Err(EmitError::SelfTest));
    }
}

// Damage.

#[test]
fn every_flipped_bit_is_noticed() {
    for (repr, blob) in blobs() {
        let mut slot = Slot::new(&blob);
        for bit in 0..8 * blob.len() {
            slot.bytes_mut()[bit / 8] ^= 1 << (bit % 8);
            assert!(parse(slot.bytes()).is_err(), "bit {bit} of {}", repr.robot);
            slot.bytes_mut()[bit / 8] ^= 1 << (bit % 8);
        }
        assert!(parse(slot.bytes()).is_ok());
    }
}

#[test]
fn every_truncation_is_noticed() {
    for (_, blob) in blobs() {
        let slot = Slot::new(&blob);
        for found in 0..blob.len() {
            let expected = if found < HEADER { HEADER } else { blob.len() };
            let truncated = Err(ParseError::Truncated { expected, found });
            assert_eq!(parse(&slot.bytes()[..found]), truncated);
            assert_eq!(parse_prefix(&slot.bytes()[..found]), truncated);
        }
    }
}

#[test]
fn trailing_bytes_belong_to_a_slot_only() {
    for (_, blob) in blobs() {
        let expected = blob.len();
        for more in [1, 2, 3, 4, 100, 4096] {
            for byte in [0x00, 0xFF, 0x4B] {
                let long = [&blob[..], &vec![byte; more]].concat();
                let slot = Slot::new(&long);
                let trailing = Err(ParseError::Trailing { expected, found: long.len() });
                assert_eq!(parse(slot.bytes()), trailing);
                assert_eq!(parse_for("cart", slot.bytes()), trailing);
                assert!(parse_prefix(slot.bytes()).is_ok());
            }
        }
    }
}

#[test]
fn an_address_that_is_not_aligned() {
    for shift in 1..4 {
        let slot = Slot::new(&[&vec![0; shift][..], &GOLDEN].concat());
        assert_eq!(parse(&slot.bytes()[shift..]), Err(ParseError::Misaligned));
        assert_eq!(parse_prefix(&slot.bytes()[shift..]), Err(ParseError::Misaligned));
    }
}

#[test]
fn an_empty_flash_slot() {
    for byte in [0x00, 0xFF] {
        assert_eq!(error(&[byte; 4096]), ParseError::Magic);
    }
    assert_eq!(error(&[]), ParseError::Truncated { expected: HEADER, found: 0 });
}

#[test]
fn another_robot() {
    let slot = Slot::new(&GOLDEN);
    assert!(parse_for("cart", slot.bytes()).is_ok());
    for robot in ["", "car", "carts", "Cart", "rosbot"] {
        assert_eq!(parse_for(robot, slot.bytes()), Err(ParseError::AnotherRobot));
    }
}

// Well-formed bytes that are no model. The checksum is valid in all of these.

#[test]
fn another_format() {
    for found in [0, 2, 0x0100, 0xFFFF_u16] {
        let version = |blob: &mut Vec<u8>| blob[4..6].copy_from_slice(&found.to_le_bytes());
        assert_eq!(error_after(&GOLDEN, version), ParseError::Version { found });
    }
    assert_eq!(error_after(&GOLDEN, |blob| blob[0] = b'k'), ParseError::Magic);
}

#[test]
fn total_lengths_that_cannot_be() {
    for length in [0, 4, 12, 246, 247] {
        let short = |blob: &mut Vec<u8>| blob[8] = length;
        assert_eq!(error_after(&GOLDEN, short), ParseError::SectionTable);
    }
    for length in [249_u32, u32::MAX] {
        let odd = |blob: &mut Vec<u8>| blob[8..12].copy_from_slice(&length.to_le_bytes());
        assert_eq!(error_after(&GOLDEN, odd), ParseError::SectionTable);
    }
    let huge = |blob: &mut Vec<u8>| blob[8..12].copy_from_slice(&0xFFFF_FFFC_u32.to_le_bytes());
    let truncated = ParseError::Truncated { expected: 0xFFFF_FFFC, found: GOLDEN.len() };
    assert_eq!(error_after(&GOLDEN, huge), truncated);
    // A header alone.
    assert_eq!(error(&assemble(&[])), ParseError::MissingSection { kind: METADATA });
    // Shorter by a section that the table still lists.
    let cut = |blob: &mut Vec<u8>| {
        blob.truncate(232);
        blob[8] = 232;
    };
    assert_eq!(error_after(&GOLDEN, cut), ParseError::SectionTable);
    // Longer by four bytes that belong to no section.
    let gap = |blob: &mut Vec<u8>| {
        blob.extend([0; 4]);
        blob[8] = 252;
    };
    assert_eq!(error_after(&GOLDEN, gap), ParseError::SectionTable);
}

#[test]
fn section_tables_that_do_not_hold_together() {
    let bad = ParseError::SectionTable;
    let with = |offset: usize, value: u32| {
        error_after(&GOLDEN, |blob| blob[offset..offset + 4].copy_from_slice(&value.to_le_bytes()))
    };
    let entry = |section: usize| HEADER + section * ENTRY;
    for section in 0..4 {
        let (offset, length) = (entry(section) + 4, entry(section) + 8);
        let (start, size) = (u32_at(&GOLDEN, offset) as u32, u32_at(&GOLDEN, length) as u32);
        // Overlaps, gaps, misaligned, outside.
        for moved in [0, start - 4, start + 4, start + 1, 248, u32::MAX, u32::MAX - 3] {
            assert_eq!(with(offset, moved), bad, "section {section} at {moved}");
        }
        for resized in [size + 5, size.saturating_sub(4), 0, 248, u32::MAX, u32::MAX - 3] {
            assert_eq!(with(length, resized), bad, "section {section} of {resized}");
        }
    }
    // More sections than there are, or fewer.
    for count in [0_u16, 1, 3, 5, 17, 0xFFFF] {
        let found = error_after(&GOLDEN, |blob| blob[6..8].copy_from_slice(&count.to_le_bytes()));
        assert_eq!(found, bad, "{count} sections");
    }
    // Bytes between sections that are not zero.
    assert_eq!(error_after(&GOLDEN, |blob| blob[199] = 1), bad);
    // The same kind twice.
    for section in 0..4 {
        let twice = |sections: &mut Vec<Section>| sections.push(sections[section].clone());
        assert_eq!(error_with(&GOLDEN, twice), bad);
    }
    let optional: Section = (0x9000, 7, vec![1, 2, 3]);
    assert_eq!(error_with(&GOLDEN, |s| s.extend([optional.clone(), optional.clone()])), bad);
    // Sixteen sections are allowed, seventeen are not.
    let mut sections = sections(&GOLDEN);
    sections.extend((0..12).map(|i| (0x9000 + i, 0, vec![0xFF; usize::from(i)])));
    assert!(parse(Slot::new(&assemble(&sections)).bytes()).is_ok());
    sections.push((0xA000, 0, vec![]));
    assert_eq!(error(&assemble(&sections)), bad);
}

#[test]
fn sections_that_are_not_known() {
    for kind in [0_u16, 4, 5, 6, 0x7FFF] {
        for at in 0..5 {
            let found = error_with(&GOLDEN, |s| s.insert(at, (kind, 9, vec![1])));
            assert_eq!(found, ParseError::UnknownSection { kind, encoding: 9 });
        }
    }
    let slot = Slot::new(&GOLDEN);
    let expected = parse(slot.bytes()).unwrap().structure().clone();
    for kind in [0x8000_u16, 0x8002, 0x8003, 0xFFFF] {
        for at in 0..5 {
            let mut sections = sections(&GOLDEN);
            sections.insert(at, (kind, 9, vec![1, 2, 3, 4, 5]));
            let slot = Slot::new(&assemble(&sections));
            assert_eq!(parse(slot.bytes()).unwrap().structure(), &expected);
            assert!(blob::self_test(slot.bytes()).is_ok());
        }
    }
}

#[test]
fn another_encoding() {
    for section in 0..3 {
        let kind = [METADATA, COEFFICIENTS, SELF_TEST][section];
        for encoding in [0, 4, 0xFFFF] {
            let found = error_with(&GOLDEN, |s| s[section].1 = encoding);
            assert_eq!(found, ParseError::UnknownSection { kind, encoding });
        }
    }
    // Optional: as if it were not there.
    let mut sections = sections(&GOLDEN);
    sections[3].1 = 9;
    assert_eq!(parse(Slot::new(&assemble(&sections)).bytes()).unwrap().ranges(), None);
}

#[test]
fn sections_that_are_missing() {
    for (section, kind) in [METADATA, COEFFICIENTS, SELF_TEST].into_iter().enumerate() {
        let found = error_with(&GOLDEN, |s| drop(s.remove(section)));
        assert_eq!(found, ParseError::MissingSection { kind });
    }
}

#[test]
fn lengths_that_the_metadata_do_not_ask_for() {
    let mismatch = |field, expected, found| {
        ParseError::Model(ModelError::DimensionMismatch { field, expected, found })
    };
    let resized =
        |section: usize, length: usize| error_with(&GOLDEN, |s| s[section].2.resize(length, 0));
    assert_eq!(resized(1, 12), mismatch("coefficients", 4, 3));
    assert_eq!(resized(1, 20), mismatch("coefficients", 4, 5));
    assert_eq!(resized(1, 0), mismatch("coefficients", 4, 0));
    assert_eq!(resized(3, 8), mismatch("ranges", 4, 2));
    assert_eq!(resized(3, 0), mismatch("ranges", 4, 0));
    for length in [0, 12, 20] {
        let expected = ParseError::SectionLength { kind: SELF_TEST, expected: 16, found: length };
        assert_eq!(resized(2, length), expected);
    }
    for (section, kind) in [(1, COEFFICIENTS), (2, SELF_TEST), (3, RANGES)] {
        for found in [13, 14, 15] {
            let expected = ParseError::SectionLength { kind, expected: 16, found };
            assert_eq!(resized(section, found), expected);
        }
    }
    // Metadata that end early or go on.
    for length in 0..135 {
        assert_eq!(resized(0, length), ParseError::Metadata, "{length} bytes");
    }
    for length in [136, 137, 200] {
        assert_eq!(resized(0, length), ParseError::Metadata, "{length} bytes");
    }
}

#[test]
fn coefficients_that_are_no_numbers() {
    let nans = [f32::from_bits(0x7F80_0001), f32::from_bits(0xFFFF_FFFF)];
    let infinities = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    for (_, blob) in blobs() {
        let count = sections(&blob)[1].2.len() / 4;
        for coefficient in [0, count / 2, count - 1] {
            for value in nans.into_iter().chain(infinities) {
                let found = error_with(&blob, |s| set_number(&mut s[1], coefficient, value));
                assert_eq!(found, ParseError::Model(ModelError::NotFinite { coefficient }));
            }
        }
    }
}

#[test]
fn ranges_that_are_none() {
    let number = ModelError::Number { field: "trained range of an observable", index: 1 };
    for value in [f32::NAN, 2.0] {
        let found = error_with(&GOLDEN, |s| set_number(&mut s[3], 2, value));
        assert_eq!(found, ParseError::Model(number));
    }
}

#[test]
fn a_prediction_that_is_not_reproduced() {
    for (repr, blob) in blobs() {
        let good = sections(&blob);
        let structure = fixtures::structure(&repr);
        let n = structure.states().len();
        let count = good[2].2.len() / 4;
        let expected = numbers_of(&good[2].2);
        for coordinate in 0..n {
            let at = count - 2 * n + coordinate;
            let failed = ParseError::SelfTest { coordinate };
            for off in [1e-3, -1e-3, f32::NAN, f32::INFINITY] {
                let value = expected[at] + off;
                assert_eq!(error_with(&blob, |s| set_number(&mut s[2], at, value)), failed);
            }
            for tolerance in [f32::NAN, -1.0] {
                let found = error_with(&blob, |s| set_number(&mut s[2], at + n, tolerance));
                assert_eq!(found, failed);
            }
            // A turn more is the same angle.
            if structure.states()[coordinate].space == Space::Circle {
                let mut sections = good.clone();
                set_number(&mut sections[2], at, expected[at] + std::f32::consts::TAU);
                assert!(parse(Slot::new(&assemble(&sections)).bytes()).is_ok());
            }
        }
        // Numbers that cannot be observed: no prediction at all.
        let found = error_with(&blob, |s| set_number(&mut s[2], 0, f32::NAN));
        assert_eq!(found, ParseError::SelfTest { coordinate: n });
        // Another operator.
        let found = error_with(&blob, |s| {
            let constant = numbers_of(&s[1].2)[0];
            set_number(&mut s[1], 0, constant + 0.1);
        });
        assert!(matches!(found, ParseError::SelfTest { .. }));
    }
}

/// A tolerance without an end would accept any prediction.
#[test]
fn a_tolerance_is_finite() {
    let found = error_with(&GOLDEN, |s| set_number(&mut s[2], 3, f32::INFINITY));
    assert_eq!(found, ParseError::SelfTest { coordinate: 0 });
}

// Capacities.

/// [`ModelRepr`] with lists of any length.
#[derive(Serialize)]
struct Metadata<'a> {
    robot: &'a str,
    sample_time_s: f32,
    states: &'a [State<'a>],
    inputs: &'a [Input<'a>],
    symmetry: Symmetry,
    observables: &'a [Observable],
    factors: &'a [Factor],
    blocks: &'a [Block],
    provenance: Provenance,
}

impl Metadata<'_> {
    fn encoded(&self) -> Vec<u8> {
        postcard::to_slice(self, &mut vec![0; 1 << 16]).unwrap().to_vec()
    }
}

/// As many of everything as there is room for, with a constant term in every block.
struct Full {
    states: Vec<State<'static>>,
    inputs: Vec<Input<'static>>,
    observables: Vec<Observable>,
    factors: Vec<Factor>,
    blocks: Vec<Block>,
}

impl Full {
    fn new() -> Self {
        let states = vec![fixtures::state("a", Space::Circle, Target::Absolute); MAX_STATES];
        let inputs = vec![fixtures::input("u"); MAX_INPUTS];
        let observables: Vec<_> = (0..=MAX_LAG as u8)
            .flat_map(|lag| {
                let angles = (0..MAX_STATES as u8).flat_map(|i| [Source::Sin(i), Source::Cos(i)]);
                angles.chain((0..MAX_INPUTS as u8).map(Source::Input)).map(move |s| at(s, lag))
            })
            .rev()
            .take(MAX_OBSERVABLES)
            .collect();
        // The first block has 12 factors (2,048 terms and the fastest at order 1); 63 blocks follow.
        let mut factors: Vec<_> = (0..11).map(|o| hermite(o, 1)).collect();
        let mut blocks = vec![Block { factors: 11, max_degree: 0 }];
        for i in 0..MAX_BLOCKS - 1 {
            let own = if i < MAX_FACTORS - 11 - (MAX_BLOCKS - 1) { 2 } else { 1 };
            blocks.push(Block { factors: own, max_degree: 0 });
            factors.extend((0..own).map(|o| hermite((i as u8 % 60) + o, 1)));
        }
        Self { states, inputs, observables, factors, blocks }
    }

    fn metadata(&self) -> Vec<u8> {
        Metadata {
            robot: "full",
            sample_time_s: 0.01,
            states: &self.states,
            inputs: &self.inputs,
            symmetry: Symmetry::None,
            observables: &self.observables,
            factors: &self.factors,
            blocks: &self.blocks,
            provenance: Provenance { logs: [0; 32], robot: [0; 32] },
        }
        .encoded()
    }

    /// A blob whose outputs are 0.5 in all circumstances.
    fn blob(&self) -> Vec<u8> {
        let (n, m) = (self.states.len(), self.inputs.len());
        let samples = 1 + self.observables.iter().map(|o| usize::from(o.lag)).max().unwrap_or(0);
        let mut factors = self.factors.iter();
        let terms: usize = self
            .blocks
            .iter()
            .map(|b| factors.by_ref().take(b.factors.into()).map(|f| f.radix()).product::<usize>())
            .sum();
        let coefficients: Vec<f32> =
            (0..2 * n * terms).map(|i| if i % terms == 0 { 0.5 } else { 0.0 }).collect();
        let angle = std::f32::consts::FRAC_PI_4;
        let self_test = [vec![0.0; samples * (n + m)], vec![angle; n], vec![1e-6; n]].concat();
        assemble(&[
            (METADATA, 1, self.metadata()),
            (COEFFICIENTS, 2, bytes_of(&coefficients)),
            (SELF_TEST, 3, bytes_of(&self_test)),
        ])
    }
}

#[test]
fn a_model_that_fills_every_capacity() {
    let full = Full::new();
    assert_eq!((full.states.len(), full.inputs.len()), (MAX_STATES, MAX_INPUTS));
    assert_eq!(full.observables.len(), MAX_OBSERVABLES);
    assert_eq!((full.factors.len(), full.blocks.len()), (MAX_FACTORS, MAX_BLOCKS));
    let slot = Slot::new(&full.blob());
    let model = parse(slot.bytes()).unwrap();
    assert_eq!(model.structure().outputs(), MAX_OUTPUTS);
    assert_eq!(model.structure().lag(), MAX_LAG);
    assert!(model.structure().dictionary().dense_terms() <= MAX_TERMS);
    exercise(&model, 1);
}

#[test]
fn dimensions_beyond_capacity() {
    type Change = fn(&mut Full);
    let changes: [Change; 5] = [
        |full| full.states.push(full.states[0]),
        |full| full.inputs.push(full.inputs[0]),
        |full| full.observables.push(at(Source::Sin(7), 0)),
        |full| full.blocks.push(Block { factors: 0, max_degree: 0 }),
        |full| {
            full.blocks[MAX_BLOCKS - 1].factors += 1;
            full.factors.push(hermite(60, 1));
        },
    ];
    for change in changes {
        let mut full = Full::new();
        change(&mut full);
        assert_eq!(error(&full.blob()), ParseError::Unsupported);
    }
    let dictionary = |change: Change| {
        let mut full = Full::new();
        change(&mut full);
        match error(&full.blob()) {
            ParseError::Model(ModelError::Dictionary(error)) => error,
            other => panic!("{other:?}"),
        }
    };
    let field = |error| match error {
        DictionaryError::TooLarge { field, .. } => field,
        other => panic!("{other:?}"),
    };
    assert_eq!(field(dictionary(|full| full.factors[0].order = 3)), "terms");
    assert_eq!(field(dictionary(|full| full.factors[0].order = 10)), "order of a factor");
    let thirteen: Change = |full| full.blocks[0].factors = 13;
    assert_eq!(field(dictionary(thirteen)), "factors of a block");
    let mut late = Full::new();
    late.observables[0].lag = MAX_LAG as u8 + 1;
    let observable = ParseError::Model(ModelError::Observable { observable: 0 });
    assert_eq!(error(&late.blob()), observable);
}

// Arbitrary bytes.

/// Predicts with whatever was accepted: lift, targets, steps, rollouts.
fn exercise(model: &Model<'_>, seed: u64) {
    let structure = model.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let predictor = Predictor::new(model);
    let mut numbers = Numbers(seed);
    let mut state = PredictorState::new();
    for _ in 0..=structure.lag() + 1 {
        let (u, x) = (numbers.take_f32(m), numbers.take_f32(n));
        predictor.observe(&mut state, &u, &x).unwrap();
    }
    let next = structure.sample(&numbers.take_f32(n));
    state.history().targets(structure, &next, &mut vec![0.0; structure.outputs()]);
    let mut values = vec![0.0; structure.dictionary().observables().len()];
    state.history().observe(structure, &numbers.take_f32(m), &mut values);
    if let Some(chain) = model.terms() {
        let mut lifted = vec![0.0; chain.count() + 1];
        assert_eq!(chain.lift(structure.dictionary(), &values, &mut lifted), chain.count());
        for term in [0, 1, chain.count() / 2, chain.count() - 1] {
            assert_eq!(chain.term(structure.dictionary(), term).is_some(), term < chain.count());
        }
    }
    if let Some(bounds) = model.error_bounds() {
        for step in [0, 1, 7, 65_535, u32::MAX] {
            assert!(bounds.bound(step, n - 1).is_none_or(|b| b >= 0.0 && b.is_finite()));
            assert_eq!(bounds.bound(step, n), None);
        }
    }
    let terms = structure.dictionary().dense_terms();
    structure.dictionary().lift_dense(&values, &mut vec![0.0; terms]);
    for dense in [0, 1, terms / 2, terms - 1, terms] {
        structure.dictionary().is_distinct(dense);
    }
    let mut predicted = vec![0.0; 4 * n];
    let inputs = numbers.take_f32(4 * m);
    let outcome = predictor.rollout(&mut state, &inputs, &mut predicted);
    assert!(outcome.is_err() || predicted.iter().all(|x| x.is_finite()));
    let _ = predictor.rollout_held(&mut state, &vec![f32::MAX; m], &mut predicted);
}

/// A blob around metadata that may be anything, with as many numbers as they ask for and a
/// self-test that accepts any prediction that stays finite; a sparse one if `terms` are given.
fn around(metadata: &[u8], terms: Option<&[[u8; 2]]>, seed: u64) -> Option<Vec<u8>> {
    let repr: ModelRepr<'_> = postcard::from_bytes(metadata).ok()?;
    let structure = Structure::try_from(repr).ok()?;
    let mut numbers = Numbers(seed);
    let width = terms.map_or(structure.dictionary().dense_terms(), |terms| terms.len() + 1);
    let coefficients = numbers.take_f32(structure.outputs() * width);
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let samples = structure.lag() + 1;
    let self_test = [numbers.take_f32(samples * (n + m)), vec![0.0; n], vec![f32::MAX; n]].concat();
    let mut sections = vec![
        (METADATA, 1, metadata.to_vec()),
        (COEFFICIENTS, 2, bytes_of(&coefficients)),
        (SELF_TEST, 3, bytes_of(&self_test)),
    ];
    sections.extend(terms.map(|terms| (TERMS, 4, terms.concat())));
    Some(assemble(&sections))
}

fn source() -> impl Strategy<Value = Source> {
    prop_oneof![
        (0_u8..4).prop_map(Source::State),
        (0_u8..4).prop_map(Source::Sin),
        (0_u8..4).prop_map(Source::Cos),
        (0_u8..4).prop_map(Source::Increment),
        (0_u8..4).prop_map(Source::Input),
    ]
}

fn factor() -> impl Strategy<Value = Factor> {
    let basis = prop_oneof![5 => Just(Basis::Hermite), 1 => Just(Basis::Fourier)];
    (0_u8..7, basis, 0_u8..11).prop_map(|(observable, basis, order)| Factor {
        observable,
        basis,
        order: if order > 3 { 1 } else { order },
    })
}

fn symmetry() -> impl Strategy<Value = Symmetry> {
    prop_oneof![
        3 => Just(Symmetry::None),
        1 => (0_u8..16).prop_map(|coordinates| Symmetry::Translation { coordinates }),
        1 => (0_u8..4, 0_u8..4, 0_u8..4).prop_map(|(x, y, heading)| Symmetry::Se2 { x, y, heading }),
    ]
}

/// Metadata of the right shape that may or may not hold together.
fn metadata() -> impl Strategy<Value = Vec<u8>> {
    let space = prop_oneof![Just(Space::Line), Just(Space::Circle)];
    let target = prop_oneof![Just(Target::Absolute), Just(Target::Increment)];
    let state = (space, target, prop::bool::weighted(0.9)).prop_map(|(space, target, bounded)| {
        let mut state = fixtures::state("x", space, target);
        if !bounded {
            state.limit = [f32::NEG_INFINITY, f32::INFINITY];
        }
        state
    });
    let observable = (source(), prop_oneof![3 => Just(0_u8), 2 => 1_u8..8])
        .prop_map(|(source, lag)| at(source, lag));
    let blocks = prop::collection::vec((prop::collection::vec(factor(), 0..4), 0_u8..4), 1..4);
    (
        prop::collection::vec(state, 1..5),
        0_usize..5,
        symmetry(),
        prop::collection::vec(observable, 0..7),
        blocks,
    )
        .prop_map(|(states, inputs, symmetry, observables, blocks)| {
            let factors: Vec<Factor> = blocks.iter().flat_map(|(own, _)| own.clone()).collect();
            let blocks: Vec<Block> = blocks
                .iter()
                .map(|(own, cut)| Block { factors: own.len() as u8, max_degree: *cut })
                .collect();
            Metadata {
                robot: "r",
                sample_time_s: 0.1,
                states: &states,
                inputs: &vec![fixtures::input("u"); inputs],
                symmetry,
                observables: &observables,
                factors: &factors,
                blocks: &blocks,
                provenance: Provenance { logs: [0; 32], robot: [0; 32] },
            }
            .encoded()
        })
}

fn accept(bytes: &[u8], seed: u64) {
    let slot = Slot::new(bytes);
    let parsed = parse(slot.bytes());
    if let Ok(model) = &parsed {
        exercise(model, seed);
    }
    let _ = parse_prefix(slot.bytes());
    let _ = blob::self_test(slot.bytes());
    // Where another model was, and with a state that has seen something of it.
    let golden = Slot::new(&GOLDEN);
    let (mut model, mut state) = (parse(golden.bytes()).unwrap(), PredictorState::new());
    let n = model.structure().states().len();
    Predictor::new(&model).observe(&mut state, &[], &vec![0.5; n]).unwrap();
    let loaded = parse_into(slot.bytes(), &mut model, &mut state);
    assert_eq!(loaded.err(), parsed.as_ref().err().copied());
    assert_eq!(state, PredictorState::new());
    as_serde_reads(slot.bytes(), &parsed);
    assert_eq!(model, parsed.unwrap_or(Model::empty()));
}

/// Metadata, once it is their turn, are what serde makes of them, or refused for the reason that it has.
fn as_serde_reads(blob: &[u8], parsed: &Result<Model<'_>, ParseError>) {
    use ParseError::*;
    let earlier = matches!(
        parsed,
        Err(Misaligned
            | Truncated { .. }
            | Trailing { .. }
            | Magic
            | Version { .. }
            | Checksum { .. }
            | SectionTable
            | UnknownSection { .. }
            | MissingSection { kind: METADATA })
    );
    if earlier {
        return;
    }
    let sections = sections(blob);
    let (_, _, metadata) = sections.iter().find(|section| section.0 == METADATA).unwrap();
    match postcard::take_from_bytes::<ModelRepr<'_>>(metadata) {
        Ok((repr, [])) => match Structure::try_from(repr) {
            Ok(structure) => match parsed {
                Ok(model) => assert_eq!(*model.structure(), structure),
                Err(error) => assert!(!matches!(error, Metadata | Unsupported), "{error:?}"),
            },
            Err(error) => assert_eq!(parsed.as_ref().err(), Some(&Model(error))),
        },
        Err(postcard::Error::SerdeDeCustom) => {
            assert_eq!(parsed.as_ref().err(), Some(&Unsupported))
        }
        _ => assert_eq!(parsed.as_ref().err(), Some(&Metadata)),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(20_000))]

    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        accept(&bytes, 1);
    }

    /// Arbitrary bytes behind a header with a valid length and checksum.
    #[test]
    fn any_bytes_with_a_valid_checksum(
        count in 0_u16..18, bytes in prop::collection::vec(any::<u8>(), 0..600),
    ) {
        let length = (HEADER + bytes.len()).next_multiple_of(4);
        let mut blob = GOLDEN[..HEADER].to_vec();
        blob[6..8].copy_from_slice(&count.to_le_bytes());
        blob[8..12].copy_from_slice(&(length as u32).to_le_bytes());
        blob.extend(bytes);
        blob.resize(length, 0);
        seal(&mut blob);
        accept(&blob, 1);
    }

    /// Arbitrary sections in a table that holds together.
    #[test]
    fn any_sections(
        metadata in prop::collection::vec(any::<u8>(), 0..300),
        coefficients in prop::collection::vec(any::<u8>(), 0..300),
        self_test in prop::collection::vec(any::<u8>(), 0..100),
    ) {
        let sections =
            [(METADATA, 1, metadata), (COEFFICIENTS, 2, coefficients), (SELF_TEST, 3, self_test)];
        accept(&assemble(&sections), 1);
    }

    /// A few bytes of a good blob overwritten, the checksum made right.
    #[test]
    fn overwritten_bytes(
        which in 0..fixtures::all().len(), seed: u64,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let mut blob = fixtures::emit(&fixtures::all()[which]);
        // The header and the metadata; numbers are met above.
        let end = (u32_at(&blob, HEADER + 4) + u32_at(&blob, HEADER + 8)).min(blob.len());
        for (at, byte) in changes {
            blob[at.index(end)] = byte;
        }
        seal(&mut blob);
        accept(&blob, seed);
    }

    /// Overwritten metadata with numbers that fit whatever they have become.
    #[test]
    fn overwritten_metadata(
        which in 0..fixtures::all().len(), seed: u64,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
    ) {
        let repr = &fixtures::all()[which];
        let mut metadata = sections(&fixtures::emit(repr))[0].2.clone();
        for (at, byte) in changes {
            let at = at.index(metadata.len() - 64); // not the hashes
            metadata[at] = byte;
        }
        let terms = fixtures::terms(&fixtures::structure(repr));
        if let Some(blob) = around(&metadata, terms, seed) {
            accept(&blob, seed);
        }
    }

    /// Metadata with bytes that are another, that are too many, or missing; lengths and variants of more
    /// than a byte among them.
    #[test]
    fn damaged_metadata(
        which in 0..fixtures::all().len(),
        changes in prop::collection::vec(
            (any::<prop::sample::Index>(), 0_usize..3, prop::sample::select(
                vec![vec![], vec![0], vec![1], vec![5], vec![0x80], vec![0x80, 0], vec![0x81, 1],
                    vec![0xFF; 4], vec![0xFF, 0xFF, 0xFF, 0xFF, 0x0F], vec![0x80, 0x80, 0x80, 0x80, 0x10],
                    [vec![0xFF; 9], vec![1]].concat(), [vec![0x80; 9], vec![2]].concat()],
            )),
            1..4,
        ),
    ) {
        let mut sections = sections(&fixtures::emit(&fixtures::all()[which]));
        for (at, removed, inserted) in changes {
            let metadata = &mut sections[0].2;
            let at = at.index(metadata.len());
            let end = (at + removed).min(metadata.len());
            metadata.splice(at..end, inserted);
        }
        accept(&assemble(&sections), 1);
    }

    /// Error bounds with a few bytes overwritten or missing, on every kind of model.
    #[test]
    fn overwritten_error_bounds(
        which in 0..fixtures::all().len(), horizons in 1_u32..4, length in 0_usize..200,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..3),
        cut: bool, seed: u64,
    ) {
        let repr = &fixtures::all()[which];
        let mut bounds = bytes_of(&[0.9]);
        bounds.extend([40, horizons].into_iter().chain(1..=horizons).flat_map(u32::to_le_bytes));
        let count = horizons as usize * repr.states.len();
        bounds.extend(bytes_of(&Numbers(seed).map(|v| v.abs() as f32).take(count).collect::<Vec<_>>()));
        for (at, byte) in &changes {
            bounds[at.index(12 + 4 * horizons as usize)] = *byte;
        }
        if cut {
            bounds.truncate(length);
        }
        let mut sections = sections(&fixtures::emit(repr));
        sections.push((ERROR_BOUNDS, 5, bounds));
        let blob = assemble(&sections);
        if changes.is_empty() && !cut {
            prop_assert!(parse(Slot::new(&blob).bytes()).unwrap().error_bounds().is_some());
        }
        accept(&blob, seed);
    }

    /// Models of every shape.
    #[test]
    fn any_metadata(metadata in metadata(), seed: u64) {
        if let Some(blob) = around(&metadata, None, seed) {
            accept(&blob, seed);
        }
    }

    /// Chains of every shape, good and bad, over dictionaries that can carry one.
    #[test]
    fn any_chain(
        orders in prop::collection::vec(1_u8..4, 1..7),
        terms in prop::collection::vec(any::<[u8; 2]>(), 0..12),
        tame: bool, seed: u64,
    ) {
        let functions: u8 = orders.iter().sum();
        let tamed = |(k, [p, g]): (usize, [u8; 2])| [p % (k as u8 + 1), g % functions];
        let terms: Vec<[u8; 2]> = match tame {
            true => terms.into_iter().enumerate().map(tamed).collect(),
            false => terms,
        };
        let states = [fixtures::state("x", Space::Line, Target::Increment); 4];
        let inputs = [fixtures::input("u"); 2];
        let observables: Vec<_> = (0..4).map(Source::State).chain((0..2).map(Source::Input)).collect();
        let factors: Vec<_> =
            orders.iter().enumerate().map(|(o, p)| hermite(o as u8, *p)).collect();
        let metadata = Metadata {
            robot: "r",
            sample_time_s: 0.1,
            states: &states,
            inputs: &inputs,
            symmetry: Symmetry::None,
            observables: &observables.iter().map(|s| at(*s, 0)).collect::<Vec<_>>(),
            factors: &factors,
            blocks: &vec![Block { factors: 1, max_degree: 0 }; factors.len()],
            provenance: Provenance { logs: [0; 32], robot: [0; 32] },
        };
        let blob = around(&metadata.encoded(), Some(&terms), seed).unwrap();
        let good = |(k, [p, g]): (usize, &[u8; 2])| usize::from(*p) <= k && *g < functions;
        let outcome = parse(Slot::new(&blob).bytes()).map(drop);
        let sparse = matches!(outcome, Err(ParseError::Model(ModelError::Sparse(_))));
        prop_assert_eq!(sparse, !terms.iter().enumerate().all(good), "{:?}", outcome);
        accept(&blob, seed);
    }
}
