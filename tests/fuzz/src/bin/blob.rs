//! Any bytes as a blob: as they are, and with their length and checksum put right.
#![no_main]

use firmware_core::q31::{self, FixedState};
use fuzz::model::read;
use libfuzzer_sys::fuzz_target;

fuzz_target!(
    init: fuzz::seeds([
        include_bytes!("../../../../models/rosbot/model.bin").as_slice(),
        include_bytes!("../../../../models/rosbot/model.q31"),
        include_bytes!("../../../../models/skid-rosbot/model.bin"),
        include_bytes!("../../../../models/soft-leg/model.bin"),
        include_bytes!("../../../../models/two-link-arm/model.bin"),
    ]),
    |bytes: &[u8]| {
        let mut words = vec![0_u32; bytes.len().div_ceil(4)];
        let copy: &mut [u8] = &mut bytemuck::cast_slice_mut(&mut words)[..bytes.len()];
        copy.copy_from_slice(bytes);
        read(copy);
        read_fixed(copy);
        let whole = copy.len() / 4 * 4;
        if repair(&mut copy[..whole]).is_some() {
            read(&copy[..whole]);
            read_fixed(&copy[..whole]);
        }
    }
);

/// Predicts with a model in fixed point from the corners of its range, where a sum that can overflow does.
fn read_fixed(bytes: &[u8]) {
    let Ok(model) = q31::parse(bytes) else { return };
    let mut state = FixedState::new();
    for corner in 0..256_u32 {
        let number = |i: u32| if corner >> (i % 8) & 1 == 0 { i32::MIN } else { i32::MAX };
        let states: Vec<i32> = (0..model.states() as u32).map(number).collect();
        let inputs: Vec<i32> = (3..3 + model.inputs() as u32).map(number).collect();
        assert_eq!(model.observe(&mut state, &states), Ok(()));
        for _ in 0..3 {
            let _ = model.step(&mut state, &inputs);
        }
    }
}

/// Makes the length and the checksum fit, as a reader without tables would compute them.
fn repair(blob: &mut [u8]) -> Option<()> {
    let length = u32::try_from(blob.len()).ok()?;
    blob.get_mut(8..12)?.copy_from_slice(&length.to_le_bytes());
    let mut crc = u32::MAX;
    for byte in blob.get(..12)?.iter().chain(blob.get(16..)?) {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = (crc >> 1) ^ (0xEDB8_8320 & (crc & 1).wrapping_neg());
        }
    }
    blob[12..16].copy_from_slice(&(!crc).to_le_bytes());
    Some(())
}
