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

/// Bytes to be read from the front. Where nothing can be read there is nothing, a zero, say, from there on, and
/// [`end`](Self::end) says so: no field has to be checked.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reader<'a> {
    rest: &'a [u8],
    /// The first thing that was wrong.
    so_far: Result<(), ReadError>,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes, so_far: Ok(()) }
    }

    /// What was wrong with what has been read.
    pub(crate) fn so_far(&self) -> Result<(), ReadError> {
        self.so_far
    }

    /// The same, and nothing may be left.
    pub(crate) fn end(self) -> Result<(), ReadError> {
        self.so_far?;
        if self.rest.is_empty() { Ok(()) } else { Err(ReadError::Malformed) }
    }

    /// Nothing can be read any more; what is read instead.
    #[cold]
    #[inline(never)]
    fn fail(&mut self, error: ReadError) -> u8 {
        self.so_far = self.so_far.and(Err(error));
        self.rest = &[];
        0
    }

    #[inline(never)]
    pub(crate) fn byte(&mut self) -> u8 {
        self.next()
    }

    #[inline(always)]
    fn next(&mut self) -> u8 {
        let Some((byte, rest)) = self.rest.split_first() else {
            return self.fail(ReadError::Malformed);
        };
        self.rest = rest;
        *byte
    }

    #[inline(always)]
    pub(crate) fn array<const N: usize>(&mut self) -> [u8; N] {
        let Some((array, rest)) = self.rest.split_first_chunk() else {
            self.fail(ReadError::Malformed);
            return [0; N];
        };
        self.rest = rest;
        *array
    }

    /// As many bytes as there are places.
    #[inline(never)]
    pub(crate) fn copy(&mut self, to: &mut [u8]) {
        match self.rest.split_at_checked(to.len()) {
            Some((bytes, rest)) => {
                to.copy_from_slice(bytes);
                self.rest = rest;
            }
            None => _ = self.fail(ReadError::Malformed),
        }
    }

    #[inline(never)]
    pub(crate) fn number(&mut self) -> f32 {
        f32::from_le_bytes(self.array())
    }

    /// An integer of so many bits.
    #[inline(never)]
    fn varint(&mut self, bits: u32) -> usize {
        match self.next() {
            byte @ 0x80.. => self.longer(byte, bits),
            byte => byte.into(),
        }
    }

    /// One of more than a byte, after the first.
    #[cold]
    #[inline(never)]
    fn longer(&mut self, first: u8, bits: u32) -> usize {
        let (mut value, mut shift) = (usize::from(first & 0x7F), 7);
        while shift < bits {
            let byte = self.byte();
            let digit = usize::from(byte & 0x7F);
            // The last byte has bits of its own only as far as the integer has.
            let left = bits.wrapping_sub(shift);
            if left < 7 && digit.checked_shr(left).unwrap_or(0) != 0 {
                break;
            }
            value |= digit.checked_shl(shift).unwrap_or(0);
            if byte < 0x80 {
                return value;
            }
            shift = shift.wrapping_add(7);
        }
        self.fail(ReadError::Malformed).into()
    }

    #[inline(always)]
    pub(crate) fn word(&mut self) -> u32 {
        self.varint(u32::BITS) as u32
    }

    /// One of so many variants.
    #[inline(never)]
    pub(crate) fn variant(&mut self, count: u32) -> u32 {
        let variant = self.word();
        if variant < count { variant } else { self.fail(ReadError::Unsupported).into() }
    }

    #[inline(always)]
    fn length(&mut self) -> usize {
        self.varint(usize::BITS)
    }

    /// Bytes behind their length, in place.
    pub(crate) fn bytes(&mut self) -> &'a [u8] {
        let length = self.length();
        let Some((bytes, rest)) = self.rest.split_at_checked(length) else {
            self.fail(ReadError::Malformed);
            return &[];
        };
        self.rest = rest;
        bytes
    }

    /// A text, in place.
    #[inline(never)]
    pub(crate) fn text(&mut self) -> &'a str {
        core::str::from_utf8(self.bytes()).unwrap_or_else(|_| {
            self.fail(ReadError::Malformed);
            ""
        })
    }

    /// A list, over the one that is there. No element is empty, so that the bytes bound the work.
    #[inline(always)]
    pub(crate) fn list<T, const N: usize>(
        &mut self,
        to: &mut Vec<T, N>,
        element: impl Fn(&mut Self) -> T,
    ) {
        to.clear();
        for _ in 0..self.length() {
            let element = element(self);
            if self.so_far.is_err() {
                return;
            }
            if to.push(element).is_err() {
                self.fail(ReadError::Unsupported);
            }
        }
    }
}

/// Bytes that are written one after the other to where they are to lie. What has no room is missing, and
/// [`end`](Self::end) says so: no field has to be checked.
pub(crate) struct Writer<'w> {
    bytes: &'w mut [u8],
    length: usize,
}

impl<'w> Writer<'w> {
    /// Behind the first `length` bytes, which stay.
    pub(crate) fn behind(bytes: &'w mut [u8], length: usize) -> Self {
        Self { bytes, length }
    }

    /// The end of what was written, unless some had no room.
    pub(crate) fn end(self) -> Option<usize> {
        Some(self.length).filter(|length| *length <= self.bytes.len())
    }

    // Each gives the writer back: the next one finds it where it is.

    #[inline(never)]
    pub(crate) fn byte(&mut self, byte: u8) -> &mut Self {
        if let Some(place) = self.bytes.get_mut(self.length) {
            *place = byte;
        }
        self.length = self.length.wrapping_add(1);
        self
    }

    /// Bytes as they are.
    #[inline(never)]
    pub(crate) fn array(&mut self, bytes: &[u8]) -> &mut Self {
        bytes.iter().fold(self, |to, byte| to.byte(*byte))
    }

    /// A varint.
    #[inline(never)]
    pub(crate) fn word(&mut self, value: u32) -> &mut Self {
        self.long(value.into())
    }

    #[inline(never)]
    pub(crate) fn long(&mut self, value: u64) -> &mut Self {
        let (mut to, mut rest) = (self, value);
        while rest >= 0x80 {
            to = to.byte(rest as u8 | 0x80);
            rest >>= 7;
        }
        to.byte(rest as u8)
    }

    /// Bytes, or a text, behind their length.
    #[inline(never)]
    pub(crate) fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.long(bytes.len() as u64).array(bytes)
    }

    #[inline(never)]
    pub(crate) fn numbers(&mut self, numbers: &[f32]) -> &mut Self {
        let to = self.long(numbers.len() as u64);
        numbers.iter().fold(to, |to, number| to.array(&number.to_le_bytes()))
    }
}
