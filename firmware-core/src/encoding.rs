//! Postcard on a controller: reading what it has written, one field after the other, straight to where it
//! belongs, and writing the same bytes.
//!
//! serde makes a value and moves it, and what a model is made of is kilobytes: on a controller that is
//! stack and time, and code of its own for every field of every message. The bytes are postcard's all the same (its specification: integers of one byte as they
//! are; lengths and variants as varints; `f32` as four bytes, little-endian; text and lists behind their
//! length), and whatever serde refuses is refused here, for the same reason: the tests hold both against each other.

use heapless::Vec;

/// Why bytes are not what was to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ReadError {
    /// They end too early or too late, or hold a length or a text that is none.
    Malformed,
    /// A list is longer than there is room for, or a variant is not known.
    Unsupported,
}

/// Bytes to be read from the front.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    /// Nothing may be left.
    pub(crate) fn end(self) -> Result<(), ReadError> {
        if self.rest.is_empty() { Ok(()) } else { Err(ReadError::Malformed) }
    }

    #[inline(always)]
    pub(crate) fn byte(&mut self) -> Result<u8, ReadError> {
        let (byte, rest) = self.rest.split_first().ok_or(ReadError::Malformed)?;
        self.rest = rest;
        Ok(*byte)
    }

    #[inline(always)]
    pub(crate) fn array<const N: usize>(&mut self) -> Result<[u8; N], ReadError> {
        let (array, rest) = self.rest.split_first_chunk().ok_or(ReadError::Malformed)?;
        self.rest = rest;
        Ok(*array)
    }

    #[inline(always)]
    pub(crate) fn number(&mut self) -> Result<f32, ReadError> {
        self.array().map(f32::from_le_bytes)
    }

    #[inline(always)]
    pub(crate) fn numbers<const N: usize>(&mut self) -> Result<[f32; N], ReadError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.number()?;
        }
        Ok(numbers)
    }

    /// An integer of so many bits.
    #[inline(never)]
    fn varint(&mut self, bits: u32) -> Result<usize, ReadError> {
        // A byte, as a rule.
        if let Some((byte, rest)) = self.rest.split_first()
            && *byte < 0x80
        {
            self.rest = rest;
            return Ok((*byte).into());
        }
        let (mut value, mut shift) = (0_usize, 0_u32);
        while shift < bits {
            let byte = self.byte()?;
            let digit = usize::from(byte & 0x7F);
            // The last byte has bits of its own only as far as the integer has.
            let left = bits.saturating_sub(shift);
            if left < 7 && digit.checked_shr(left).unwrap_or(0) != 0 {
                return Err(ReadError::Malformed);
            }
            value |= digit.checked_shl(shift).unwrap_or(0);
            if byte < 0x80 {
                return Ok(value);
            }
            shift = shift.saturating_add(7);
        }
        Err(ReadError::Malformed)
    }

    #[inline(always)]
    pub(crate) fn word(&mut self) -> Result<u32, ReadError> {
        Ok(self.varint(u32::BITS)? as u32)
    }

    #[inline(always)]
    fn length(&mut self) -> Result<usize, ReadError> {
        self.varint(usize::BITS)
    }

    /// Bytes behind their length, in place.
    pub(crate) fn bytes(&mut self) -> Result<&'a [u8], ReadError> {
        let length = self.length()?;
        let (bytes, rest) = self.rest.split_at_checked(length).ok_or(ReadError::Malformed)?;
        self.rest = rest;
        Ok(bytes)
    }

    /// A text, in place.
    pub(crate) fn text(&mut self) -> Result<&'a str, ReadError> {
        core::str::from_utf8(self.bytes()?).map_err(|_| ReadError::Malformed)
    }

    /// A list, over the one that is there. No element is empty, so that the bytes bound the work.
    #[inline(always)]
    pub(crate) fn list<T, const N: usize>(
        &mut self,
        to: &mut Vec<T, N>,
        element: impl Fn(&mut Self) -> Result<T, ReadError>,
    ) -> Result<(), ReadError> {
        to.clear();
        for _ in 0..self.length()? {
            to.push(element(self)?).map_err(|_| ReadError::Unsupported)?;
        }
        Ok(())
    }
}

/// Bytes that are written one after the other. What has no room is missing, and [`written`](Self::written)
/// says so in the end: no field has to be checked.
pub(crate) struct Writer<const N: usize> {
    bytes: [u8; N],
    length: usize,
}

impl<const N: usize> Writer<N> {
    pub(crate) fn new() -> Self {
        Self { bytes: [0; N], length: 0 }
    }

    /// All bytes, unless some had no room.
    pub(crate) fn written(&self) -> Option<&[u8]> {
        self.bytes.get(..self.length)
    }

    /// The whole room; zeros where nothing was written.
    pub(crate) fn all(&self) -> [u8; N] {
        self.bytes
    }

    #[inline(never)]
    pub(crate) fn byte(&mut self, byte: u8) {
        if let Some(place) = self.bytes.get_mut(self.length) {
            *place = byte;
        }
        self.length = self.length.saturating_add(1);
    }

    /// Bytes as they are.
    #[inline(never)]
    pub(crate) fn array(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.byte(*byte);
        }
    }

    /// A varint.
    #[inline(never)]
    pub(crate) fn word(&mut self, value: u32) {
        self.long(value.into());
    }

    #[inline(never)]
    pub(crate) fn long(&mut self, value: u64) {
        let mut rest = value;
        while rest >= 0x80 {
            self.byte(rest as u8 | 0x80);
            rest >>= 7;
        }
        self.byte(rest as u8);
    }

    /// Bytes, or a text, behind their length.
    #[inline(never)]
    pub(crate) fn bytes(&mut self, bytes: &[u8]) {
        self.long(bytes.len() as u64);
        self.array(bytes);
    }

    #[inline(never)]
    pub(crate) fn numbers(&mut self, numbers: &[f32]) {
        self.long(numbers.len() as u64);
        for number in numbers {
            self.array(&number.to_le_bytes());
        }
    }
}
