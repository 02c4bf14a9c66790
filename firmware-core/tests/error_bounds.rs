//! Error bounds: exact bytes, look-up, and what must be refused.

mod bytes;
mod fixtures;

use bytes::{ENTRY, ERROR_BOUNDS, HEADER, assemble, error_with, numbers_of, sections};
use firmware_core::ErrorBounds;
use firmware_core::blob::{self, EmitError, ParseError};
use firmware_core::capacity::MAX_HORIZON;
use firmware_core::error_bounds::ErrorBoundsError;
use firmware_core::model::{Model, ModelError};
use firmware_core::{parse, parse_prefix};
use fixtures::{Slot, structure};

/// 75 % on 12 units; 1, 5 and 25 steps; two coordinates.
#[rustfmt::skip]
const GOLDEN: [u8; 48] = [
    0x00, 0x00, 0x40, 0x3F,         // 0    coverage 0.75
    0x0C, 0x00, 0x00, 0x00,         // 4    12 units
    0x03, 0x00, 0x00, 0x00,         // 8    three horizons
    0x01, 0x00, 0x00, 0x00,         // 12   1 step
    0x05, 0x00, 0x00, 0x00,         //      5 steps
    0x19, 0x00, 0x00, 0x00,         //      25 steps
    0x00, 0x00, 0x00, 0x3E,         // 24   first coordinate after 1 step 0.125
    0x00, 0x00, 0x00, 0x00,         //      second 0
    0x00, 0x00, 0x00, 0x3F,         //      after 5 steps 0.5
    0x00, 0x00, 0x80, 0x3F,         //      1
    0x00, 0x00, 0x00, 0x40,         //      after 25 steps 2
    0x00, 0x00, 0x80, 0x40,         //      4
];
const HORIZONS: [u32; 3] = [1, 5, 25];
const BOUNDS: [f32; 6] = [0.125, 0.0, 0.5, 1.0, 2.0, 4.0];

fn golden() -> ErrorBounds<'static> {
    ErrorBounds::new(2, 0.75, 12, &HORIZONS, &BOUNDS).unwrap()
}

/// Written again from what is read, with these bounds.
fn emit_with(blob: &[u8], bounds: ErrorBounds<'_>) -> Vec<u8> {
    let slot = Slot::new(blob);
    let model = parse(slot.bytes()).unwrap().with_error_bounds(bounds).unwrap();
    let test = blob::self_test(slot.bytes()).unwrap();
    let mut out = vec![0x55; blob.len() + 100];
    let length = blob::emit(&model, test.states, test.inputs, test.tolerance, &mut out).unwrap();
    for room in [0, HEADER, length / 2, length - 1] {
        let short = Err(EmitError::BufferTooShort { found: room });
        let out = &mut vec![0; room];
        assert_eq!(blob::emit(&model, test.states, test.inputs, test.tolerance, out), short);
    }
    out.truncate(length);
    out
}

/// The fixtures with two coordinates: dense ones and the sparse one.
fn blobs() -> Vec<Vec<u8>> {
    [fixtures::soft_leg(), fixtures::lagged(), fixtures::harmonics(), fixtures::sparse()]
        .iter()
        .map(fixtures::emit)
        .collect()
}

// Bytes.

#[test]
fn golden_bytes_are_written_and_read() {
    for blob in blobs() {
        assert_eq!(parse(Slot::new(&blob).bytes()).unwrap().error_bounds(), None);
        let bounded = emit_with(&blob, golden());
        let mut expected = sections(&blob);
        expected.push((ERROR_BOUNDS, 5, GOLDEN.to_vec()));
        assert_eq!(bounded, assemble(&expected));
        assert_eq!(bounded.len(), blob.len() + ENTRY + GOLDEN.len());

        let slot = Slot::new(&bounded);
        let model = parse(slot.bytes()).unwrap();
        assert_eq!(model.error_bounds(), Some(golden()));
        assert_eq!(parse_prefix(slot.bytes()), Ok(model.clone()));
        let found = model.error_bounds().unwrap();
        assert_eq!((found.coverage(), found.units(), found.states()), (0.75, 12, 2));
        assert_eq!((found.horizons(), found.bounds()), (&HORIZONS[..], &BOUNDS[..]));
        // In place, not copied.
        let at = slot.bytes()[bounded.len() - 24..].as_ptr().addr();
        assert_eq!(found.bounds().as_ptr().addr(), at);
        // Nothing else has changed, and the same bytes are written again.
        let before = Slot::new(&blob);
        let before = parse(before.bytes()).unwrap();
        assert_eq!(model, before.with_error_bounds(golden()).unwrap());
        assert_eq!(emit_with(&bounded, found), bounded);
        // Other bounds take their place.
        let other = ErrorBounds::new(2, 0.5, 1, &[2], &[1.0, 2.0]).unwrap();
        let replaced = emit_with(&bounded, other);
        assert_eq!(parse(Slot::new(&replaced).bytes()).unwrap().error_bounds(), Some(other));
        assert_eq!(replaced, emit_with(&blob, other));
    }
}

#[test]
fn every_flipped_bit_and_truncation_is_noticed() {
    for blob in blobs() {
        let blob = emit_with(&blob, golden());
        let mut slot = Slot::new(&blob);
        for bit in 0..8 * blob.len() {
            slot.bytes_mut()[bit / 8] ^= 1 << (bit % 8);
            assert!(parse(slot.bytes()).is_err(), "bit {bit}");
            slot.bytes_mut()[bit / 8] ^= 1 << (bit % 8);
        }
        for found in 0..blob.len() {
            assert!(parse_prefix(&slot.bytes()[..found]).is_err());
        }
        assert!(parse(slot.bytes()).is_ok());
    }
}

/// The length of the blob in a flash slot, whatever follows.
#[test]
fn where_a_blob_ends_in_its_slot() {
    for blob in blobs() {
        for more in [0, 1, 4, 1000] {
            let slot = [&blob[..], &vec![0xFF; more]].concat();
            assert_eq!(blob::length(&slot), Ok(blob.len()));
        }
        for found in 0..blob.len() {
            let expected = if found < HEADER { HEADER } else { blob.len() };
            let truncated = Err(ParseError::Truncated { expected, found });
            assert_eq!(blob::length(&blob[..found]), truncated);
        }
    }
    assert_eq!(blob::length(&[0xFF; 100]), Err(ParseError::Magic));
    let mut other = blobs()[0].clone();
    other[4] = 2;
    assert_eq!(blob::length(&other), Err(ParseError::Version { found: 2 }));
}

/// Unknown to this reader: the model is as good without them.
#[test]
fn another_encoding_is_skipped() {
    let mut sections = sections(&emit_with(&blobs()[0], golden()));
    let last = sections.len() - 1;
    for encoding in [0, 3, 4, 6, 0xFFFF] {
        sections[last].1 = encoding;
        let slot = Slot::new(&assemble(&sections));
        assert_eq!(parse(slot.bytes()).unwrap().error_bounds(), None);
    }
}

// Look-up.

#[test]
fn the_bound_of_the_next_horizon() {
    let bounds = golden();
    let both = |step| [bounds.bound(step, 0), bounds.bound(step, 1)];
    assert_eq!(both(0), [Some(0.0), Some(0.0)]);
    assert_eq!(both(1), [Some(0.125), Some(0.0)]);
    for step in 2..=5 {
        assert_eq!(both(step), [Some(0.5), Some(1.0)]);
    }
    for step in 6..=25 {
        assert_eq!(both(step), [Some(2.0), Some(4.0)]);
    }
    for step in [26, 100, MAX_HORIZON, u32::MAX] {
        assert_eq!(both(step), [None, None]);
    }
    for step in [0, 1, 25, 26] {
        for coordinate in [2, 3, usize::MAX] {
            assert_eq!(bounds.bound(step, coordinate), None);
        }
    }
    // The first horizon need not be one step.
    let late = ErrorBounds::new(1, 0.9, 1, &[10, MAX_HORIZON], &[3.0, 4.0]).unwrap();
    let found = [0, 1, 10, 11, MAX_HORIZON, MAX_HORIZON + 1].map(|step| late.bound(step, 0));
    assert_eq!(found, [Some(0.0), Some(3.0), Some(3.0), Some(4.0), Some(4.0), None]);
}

// Refused.

#[test]
fn numbers_that_are_no_bounds() {
    let refused = |coverage: f32, units: u32, horizons: &[u32], bounds: &[f32]| {
        ErrorBounds::new(2, coverage, units, horizons, bounds).unwrap_err()
    };
    for coverage in [0.0, -0.5, 1.0, 1.5, f32::NAN, f32::INFINITY] {
        assert_eq!(refused(coverage, 12, &HORIZONS, &BOUNDS), ErrorBoundsError::Coverage);
    }
    assert_eq!(refused(0.9, 0, &HORIZONS, &BOUNDS), ErrorBoundsError::Units);
    assert_eq!(refused(0.9, 12, &[], &[]), ErrorBoundsError::NoHorizon);
    for (horizons, horizon) in [
        ([0, 1, 2], 0),
        ([1, 1, 2], 1),
        ([1, 5, 4], 2),
        ([1, 5, MAX_HORIZON + 1], 2),
        ([u32::MAX, 5, 6], 0),
    ] {
        let expected = ErrorBoundsError::Horizon { horizon };
        assert_eq!(refused(0.9, 12, &horizons, &BOUNDS), expected);
    }
    for found in [0, 5, 7] {
        let expected = ErrorBoundsError::DimensionMismatch { expected: 6, found };
        assert_eq!(refused(0.9, 12, &HORIZONS, &vec![1.0; found]), expected);
    }
    for bad in [-1.0, -f32::MIN_POSITIVE, f32::NAN, f32::INFINITY] {
        for bound in 0..6 {
            let mut bounds = BOUNDS;
            bounds[bound] = bad;
            let expected = ErrorBoundsError::Bound { bound };
            assert_eq!(refused(0.9, 12, &HORIZONS, &bounds), expected);
        }
    }
}

#[test]
fn bounds_of_another_model() {
    let structure = structure(&fixtures::one_state());
    let model = Model::new(structure, &fixtures::ONE_STATE, None).unwrap();
    let mismatch = ModelError::DimensionMismatch {
        field: "states of the error bounds",
        expected: 1,
        found: 2,
    };
    assert_eq!(model.with_error_bounds(golden()), Err(mismatch));
}

/// The same in a blob whose checksum is valid.
#[test]
fn sections_that_hold_no_bounds() {
    for blob in blobs() {
        let blob = emit_with(&blob, golden());
        let last = sections(&blob).len() - 1;
        let with = |word: usize, value: [u8; 4]| {
            error_with(&blob, |s| s[last].2[4 * word..4 * word + 4].copy_from_slice(&value))
        };
        let bounds = |error| ParseError::ErrorBounds(error);
        for coverage in [0.0_f32, 1.0, f32::NAN] {
            assert_eq!(with(0, coverage.to_le_bytes()), bounds(ErrorBoundsError::Coverage));
        }
        assert_eq!(with(1, [0; 4]), bounds(ErrorBoundsError::Units));
        for (word, value) in [(3, 0_u32), (3, 5), (4, 1), (4, 25), (5, 5), (5, MAX_HORIZON + 1)] {
            let found = with(word, value.to_le_bytes());
            let horizon = if (word, value) == (3, 5) { 1 } else { word - 3 };
            let horizon = if (word, value) == (4, 25) { 2 } else { horizon };
            assert_eq!(found, bounds(ErrorBoundsError::Horizon { horizon }));
        }
        for bound in 0..6 {
            for bad in [-1.0, f32::NAN, f32::INFINITY] {
                let found = with(6 + bound, bad.to_le_bytes());
                assert_eq!(found, bounds(ErrorBoundsError::Bound { bound }));
            }
        }
        // More or fewer horizons than there are numbers.
        let length =
            |expected, found| ParseError::SectionLength { kind: ERROR_BOUNDS, expected, found };
        assert_eq!(with(2, 0_u32.to_le_bytes()), length(12, 48));
        assert_eq!(with(2, 2_u32.to_le_bytes()), length(36, 48));
        assert_eq!(with(2, 4_u32.to_le_bytes()), length(60, 48));
        assert_eq!(with(2, 1_000_u32.to_le_bytes()), length(12_012, 48));
        let huge = with(2, u32::MAX.to_le_bytes());
        assert!(matches!(huge, ParseError::SectionLength { kind: ERROR_BOUNDS, .. }));
        for found in (0..48).chain([49, 50, 51, 52, 60]) {
            let resized = error_with(&blob, |s| s[last].2.resize(found, 0));
            assert!(
                matches!(resized, ParseError::SectionLength { kind: ERROR_BOUNDS, .. }),
                "{found} bytes: {resized:?}"
            );
        }
        // No horizon at all.
        let none = error_with(&blob, |s| {
            s[last].2.truncate(12);
            s[last].2[8] = 0;
        });
        assert_eq!(none, bounds(ErrorBoundsError::NoHorizon));
    }
    assert_eq!(numbers_of(&GOLDEN[24..]), BOUNDS);
}
