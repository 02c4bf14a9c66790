//! Blobs taken apart and put together from the format table, sharing no code with the crate.
#![allow(dead_code, reason = "every test file uses a part")]

use firmware_core::blob::ParseError;
use firmware_core::parse;

use crate::fixtures::Slot;

/// A section as the table of `blob` lists it: kind, encoding, bytes without padding.
pub type Section = (u16, u16, Vec<u8>);

pub const HEADER: usize = 16;
pub const ENTRY: usize = 12;
pub const METADATA: u16 = 1;
pub const COEFFICIENTS: u16 = 2;
pub const SELF_TEST: u16 = 3;
pub const TERMS: u16 = 4;
pub const RANGES: u16 = 0x8001;
pub const ERROR_BOUNDS: u16 = 0x8002;

/// CRC-32 bit by bit, from its definition: reflected polynomial 0xEDB88320, all ones before and
/// after.
pub fn crc32(bytes: impl Iterator<Item = u8>) -> u32 {
    !bytes.fold(!0, |crc: u32, byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| {
            if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 }
        })
    })
}

/// Makes the checksum right again.
pub fn seal(blob: &mut [u8]) {
    let crc = crc32(blob[..12].iter().chain(&blob[16..]).copied());
    blob[12..16].copy_from_slice(&crc.to_le_bytes());
}

pub fn u16_at(bytes: &[u8], offset: usize) -> u16 {
    u16::from_le_bytes(bytes[offset..offset + 2].try_into().unwrap())
}

pub fn u32_at(bytes: &[u8], offset: usize) -> usize {
    u32::from_le_bytes(bytes[offset..offset + 4].try_into().unwrap()) as usize
}

/// The sections of a good blob.
pub fn sections(blob: &[u8]) -> Vec<Section> {
    (0..usize::from(u16_at(blob, 6)))
        .map(|i| HEADER + i * ENTRY)
        .map(|e| {
            let (offset, length) = (u32_at(blob, e + 4), u32_at(blob, e + 8));
            (u16_at(blob, e), u16_at(blob, e + 2), blob[offset..offset + length].to_vec())
        })
        .collect()
}

/// A blob of these sections with a valid checksum, as the format table says.
pub fn assemble(sections: &[Section]) -> Vec<u8> {
    let mut blob = b"KOOP".to_vec();
    blob.extend(1_u16.to_le_bytes());
    blob.extend((sections.len() as u16).to_le_bytes());
    blob.extend([0; 8]);
    let mut offset = HEADER + sections.len() * ENTRY;
    for (kind, encoding, bytes) in sections {
        blob.extend(kind.to_le_bytes());
        blob.extend(encoding.to_le_bytes());
        blob.extend((offset as u32).to_le_bytes());
        blob.extend((bytes.len() as u32).to_le_bytes());
        offset += bytes.len().next_multiple_of(4);
    }
    for (_, _, bytes) in sections {
        blob.extend(bytes);
        blob.resize(blob.len().next_multiple_of(4), 0);
    }
    let length = blob.len() as u32;
    blob[8..12].copy_from_slice(&length.to_le_bytes());
    seal(&mut blob);
    blob
}

pub fn error(bytes: &[u8]) -> ParseError {
    parse(Slot::new(bytes).bytes()).unwrap_err()
}

/// The error after changing the blob and making its checksum right.
pub fn error_after(blob: &[u8], change: impl FnOnce(&mut Vec<u8>)) -> ParseError {
    let mut blob = blob.to_vec();
    change(&mut blob);
    seal(&mut blob);
    error(&blob)
}

/// The error after changing the sections.
pub fn error_with(blob: &[u8], change: impl FnOnce(&mut Vec<Section>)) -> ParseError {
    let mut sections = sections(blob);
    change(&mut sections);
    error(&assemble(&sections))
}

pub fn bytes_of(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|v| v.to_le_bytes()).collect()
}

pub fn numbers_of(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}

pub fn set_number(section: &mut Section, index: usize, value: f32) {
    section.2[4 * index..4 * index + 4].copy_from_slice(&value.to_le_bytes());
}
