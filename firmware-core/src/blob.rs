//! The bytes of a model.
//!
//! Format version 1. All numbers are little-endian; offsets count from the first byte of the blob,
//! which has to lie at an address divisible by four.
//!
//! | offset | size | field |
//! |---|---|---|
//! | 0 | 4 | magic, the bytes `KOOP` |
//! | 4 | 2 | format version, 1 |
//! | 6 | 2 | number of sections n, at most 16 |
//! | 8 | 4 | total length in bytes, divisible by 4 |
//! | 12 | 4 | CRC-32 (ISO-HDLC: polynomial 0x04C11DB7 reflected) of bytes 0 to 11 and 16 to the end |
//! | 16 | 12 n | section table |
//! | 16 + 12 n | | the sections, in the order of the table, each padded with zeros to a multiple of 4; no kind twice |
//!
//! | offset in an entry | size | field |
//! |---|---|---|
//! | 0 | 2 | kind; 0x8000 and above may be skipped by a reader that does not know it |
//! | 2 | 2 | encoding |
//! | 4 | 4 | offset, where the section before it ends |
//! | 8 | 4 | length without padding |
//!
//! | kind | section | encoding | status |
//! |---|---|---|---|
//! | 0x0001 | metadata: [`ModelRepr`](crate::ModelRepr) | 1: postcard 1 | required |
//! | 0x0002 | coefficients `[outputs, dense_terms]`, of a sparse model `[outputs, T + 1]` | 2: f32, powers of the observables | required |
//! | 0x0003 | self-test, below; of a model in fixed point as [`q31`](crate::q31) says | 3: f32; 7: i32 | required |
//! | 0x0004 | terms of a sparse model, below: `[T, 2]` | 4: u8 | makes the model sparse |
//! | 0x0005 | scales, ranges and coefficients of a model in fixed point: [`q31`](crate::q31) | 6: 32-bit words | instead of 0x0002 |
//! | 0x8001 | trained ranges `[observables, 2]`: smallest, largest raw value | 3: f32 | optional |
//! | 0x8002 | error bounds, below | 5: u32 and f32 | optional |
//! | 0x8003 | signature | | reserved |
//!
//! The self-test is one prediction: with L the largest lag, the states at samples k − L … k, shape
//! `[L + 1, states]`; the inputs at the same samples, shape `[L + 1, inputs]`; the expected
//! coordinates at k + 1 and the tolerance of each, shape `[states]` both. The model is refused
//! unless it predicts within the tolerance, a finite one (angles compared on the circle).
//!
//! A blob in fixed point has the sections 0x0001, 0x0003 and 0x0005 and is read by
//! [`q31::parse`](crate::q31::parse); [`parse`] refuses it as [`ParseError::FixedPoint`].
//!
//! A blob without terms is a dense model: every term of every block of the metadata has its
//! coefficients. In one with terms ([`sparse`](crate::sparse)) every block is a single factor, not
//! cut, and only provides functions: v, v², …, vᵖ or sin φ, cos φ, …, sin pφ, cos pφ, numbered from 0
//! over all factors in order. Entry k = 1 … T of the terms is a parent p < k and a function g:
//! term k is term p times function g, and term 0 the constant 1, which has the first coefficient of
//! every output. T is at most 255, and the model has to get by with the
//! [registers](crate::capacity::REGISTERS).
//!
//! | offset in the error bounds | size | field |
//! |---|---|---|
//! | 0 | 4 | coverage, f32, between 0 and 1, both excluded |
//! | 4 | 4 | calibration units, u32, at least 1 |
//! | 8 | 4 | number of horizons H, u32, at least 1 |
//! | 12 | 4 H | horizons \[steps\], u32, ascending from 1 or more to at most 65,535 |
//! | 12 + 4 H | 4 H n | bounds `[H, states]`, f32, finite, from 0 on, in the unit of the coordinate |
//!
//! With the probability of the coverage a measured coordinate is within its bound of the predicted
//! one ([`ErrorBounds`]).
//!
//! Metadata in postcard, field by field: integers of one byte as they are, lengths as varints,
//! enumerations as a varint of the variant in the order of the declaration, `f32` as four bytes,
//! text and lists with their length first.

use crate::Scalar;
use crate::capacity::MAX_STATES;
use crate::dictionary::DictionaryError;
use crate::encoding::ReadError;
use crate::error_bounds::{ErrorBounds, ErrorBoundsError};
use crate::model::{Model, ModelError, Structure};
use crate::predictor::{PredictError, Predictor, PredictorState};
use crate::sparse::SparseTerms;

/// First bytes of a blob.
pub const MAGIC: [u8; 4] = *b"KOOP";
/// The version of the format that this code reads and writes.
pub const VERSION: u16 = 1;
/// Sections a blob may have.
pub const MAX_SECTIONS: usize = 16;

const HEADER: usize = 16;
const ENTRY: usize = 12;
/// Kinds from here on may be skipped.
const OPTIONAL: u16 = 0x8000;
pub(crate) const METADATA: (u16, u16) = (0x0001, 1);
const COEFFICIENTS: (u16, u16) = (0x0002, 2);
pub(crate) const COEFFICIENTS_KIND: u16 = COEFFICIENTS.0;
const SELF_TEST: (u16, u16) = (0x0003, 3);
const TERMS: (u16, u16) = (0x0004, 4);
pub(crate) const Q31: (u16, u16) = (0x0005, 6);
pub(crate) const Q31_SELF_TEST: (u16, u16) = (0x0003, 7);
const RANGES: (u16, u16) = (0x8001, 3);
const ERROR_BOUNDS: (u16, u16) = (0x8002, 5);

/// Bits that are looked up at once in a checksum, and what they do to the CRC-32 (ISO-HDLC: polynomial
/// 0x04C11DB7, reflected).
const BITS: u32 = 6;
static TABLE: [u32; 1 << BITS] = {
    let mut table = [0; 1 << BITS];
    let mut rest: &mut [u32] = &mut table;
    let mut index = 0;
    while let Some((first, others)) = rest.split_first_mut() {
        let (mut crc, mut bit) = (index, 0);
        while bit < BITS {
            crc = (crc >> 1) ^ if crc & 1 == 1 { 0xEDB8_8320 } else { 0 };
            bit += 1;
        }
        *first = crc;
        index += 1;
        rest = others;
    }
    table
};

/// A checksum when so many of its bits, at most [`BITS`], have been worked off.
#[inline(always)]
fn shift(crc: u32, bits: u32) -> u32 {
    // Zeros in front of fewer bits change nothing. Never out of bounds: an index has BITS.
    let index = (crc << BITS.wrapping_sub(bits)) as usize % TABLE.len();
    (crc >> bits) ^ TABLE.get(index).copied().unwrap_or(0)
}

/// CRC-32 (ISO-HDLC) of bytes that follow others with the checksum `before`; that of nothing is 0.
///
/// A word at a time: six instructions a byte on a Cortex-M. A table of all bytes would save two of them and be
/// a kilobyte of flash.
pub(crate) fn crc32(before: u32, bytes: &[u8]) -> u32 {
    let (words, rest) = bytes.as_chunks::<4>();
    let whole = words.iter().fold(!before, |crc, word| {
        let next = |crc| shift(crc, BITS);
        shift(next(next(next(next(next(crc ^ u32::from_le_bytes(*word)))))), 2)
    });
    !rest.iter().fold(whole, |crc, byte| shift(shift(crc ^ u32::from(*byte), BITS), 2))
}

/// Puts bytes at an address divisible by four, as a blob needs them.
///
/// ```
/// use firmware_core::blob::Aligned;
/// static BLOB: &Aligned<[u8]> = &Aligned(*b"KOOP...."); // or Aligned(*include_bytes!("model.bin"))
/// assert_eq!(BLOB.0.as_ptr() as usize % 4, 0);
/// ```
#[derive(Clone, Copy, Debug)]
#[repr(C, align(4))]
pub struct Aligned<T: ?Sized>(pub T);

/// Why bytes are not a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ParseError {
    /// The bytes do not begin at an address divisible by four.
    Misaligned,
    /// Fewer bytes than the header or its total length asks for.
    Truncated {
        /// Bytes asked for.
        expected: usize,
        /// Bytes there.
        found: usize,
    },
    /// More bytes than the blob's total length.
    Trailing {
        /// Total length of the blob.
        expected: usize,
        /// Bytes there.
        found: usize,
    },
    /// Not a blob at all.
    Magic,
    /// A format that this code does not read.
    Version {
        /// The version found.
        found: u16,
    },
    /// The bytes have been damaged.
    Checksum {
        /// As stored.
        expected: u32,
        /// As computed.
        found: u32,
    },
    /// The section table does not hold together.
    SectionTable,
    /// It is a model in fixed point: [`q31::parse`](crate::q31::parse) reads it.
    FixedPoint,
    /// A section that has to be understood is not known to this code.
    UnknownSection {
        /// Its kind.
        kind: u16,
        /// Its encoding.
        encoding: u16,
    },
    /// A required section is missing.
    MissingSection {
        /// Its kind.
        kind: u16,
    },
    /// The metadata cannot be decoded.
    Metadata,
    /// The metadata have a longer list than this build has [room](crate::capacity) for, or name a
    /// variant that it does not know.
    Unsupported,
    /// The parts do not make a model.
    Model(ModelError),
    /// The error bounds are none.
    ErrorBounds(ErrorBoundsError),
    /// A section does not have the length that the metadata, or its own first numbers, ask for.
    SectionLength {
        /// Its kind.
        kind: u16,
        /// Length in bytes that is asked for.
        expected: usize,
        /// Length found.
        found: usize,
    },
    /// The stored prediction is not reproduced.
    SelfTest {
        /// The coordinate that is off; the number of states when there was no prediction at all.
        coordinate: usize,
    },
    /// The model belongs to another robot.
    AnotherRobot,
}

impl From<ReadError> for ParseError {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Malformed => Self::Metadata,
            ReadError::Unsupported => Self::Unsupported,
        }
    }
}

impl From<ModelError> for ParseError {
    fn from(error: ModelError) -> Self {
        Self::Model(error)
    }
}

impl From<DictionaryError> for ParseError {
    fn from(error: DictionaryError) -> Self {
        Self::Model(ModelError::Dictionary(error))
    }
}

/// Why a model cannot be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum EmitError {
    /// The buffer is too short.
    BufferTooShort {
        /// Its length.
        found: usize,
    },
    /// The self-test has another shape than the model, a tolerance is not a finite number from 0 on,
    /// or the model does not predict at all.
    SelfTest,
}

/// One prediction that a blob carries to be checked with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SelfTest<'a> {
    /// Coordinates at samples k − L … k, shape `[L + 1, states]`.
    pub states: &'a [f32],
    /// Inputs at the same samples, shape `[L + 1, inputs]`.
    pub inputs: &'a [f32],
    /// Coordinates at k + 1, shape `[states]`.
    pub expected: &'a [f32],
    /// Largest accepted difference of each, finite, shape `[states]`.
    pub tolerance: &'a [f32],
}

impl<'a> SelfTest<'a> {
    /// Cuts the section's numbers into the parts that the model's shape asks for.
    fn split(structure: &Structure<'_>, numbers: &'a [f32]) -> Option<Self> {
        let (n, m) = (structure.states().len(), structure.inputs().len());
        let samples = structure.lag().wrapping_add(1);
        let (states, rest) = numbers.split_at_checked(samples.wrapping_mul(n))?;
        let (inputs, rest) = rest.split_at_checked(samples.wrapping_mul(m))?;
        let (expected, tolerance) = rest.split_at_checked(n)?;
        (tolerance.len() == n).then_some(Self { states, inputs, expected, tolerance })
    }

    fn len(structure: &Structure<'_>) -> usize {
        let (n, m) = (structure.states().len(), structure.inputs().len());
        // Of a checked structure they are small numbers: nothing wraps.
        let samples = structure.lag().wrapping_add(1);
        samples.wrapping_mul(n.wrapping_add(m)).wrapping_add(n.wrapping_mul(2))
    }

    /// What the model predicts from the stored samples, in `out`, shape `[states]`.
    ///
    /// # Errors
    /// As [`Predictor::step`].
    pub fn predict(&self, model: &Model<'_>, out: &mut [f32]) -> Result<(), PredictError> {
        self.predict_in(model, &mut PredictorState::new(), out)
    }

    /// The same in a state that has seen nothing of this model.
    fn predict_in(
        &self,
        model: &Model<'_>,
        state: &mut PredictorState,
        out: &mut [f32],
    ) -> Result<(), PredictError> {
        let structure = model.structure();
        let m = structure.inputs().len();
        let predictor = Predictor::new(model);
        state.clear();
        let mut inputs = self.inputs.chunks_exact(m.max(1));
        let mut applied: &[f32] = &[];
        for states in self.states.chunks_exact(structure.states().len().max(1)) {
            predictor.observe(state, applied, states)?;
            applied = inputs.next().unwrap_or(&[]);
        }
        predictor.step(state, applied)?;
        predictor.coordinates(state, out)
    }

    /// The first coordinate that the model does not predict within the tolerance.
    #[inline(never)]
    fn failure(&self, model: &Model<'_>, state: &mut PredictorState) -> Option<usize> {
        let states = model.structure().states();
        let mut predicted = [0.0; MAX_STATES];
        let predicted = predicted.get_mut(..states.len())?;
        if self.predict_in(model, state, predicted).is_err() {
            return Some(states.len());
        }
        let expected = self.expected.iter().zip(self.tolerance);
        predicted.iter().zip(states).zip(expected).position(|((p, state), (e, tolerance))| {
            let difference = state.space.difference(*p, *e);
            !(Scalar::abs(difference) <= *tolerance && tolerance.is_finite())
        })
    }
}

/// Reads exactly one blob and checks everything: checksum, section table, dimensions against each
/// other and the [capacities](crate::capacity), finite coefficients, and the stored prediction.
///
/// # Errors
/// [`ParseError`] names the first thing that is wrong.
pub fn parse(bytes: &[u8]) -> Result<Model<'_>, ParseError> {
    returned(bytes, Extent::Exact)
}

/// [`parse`], refusing the model of another robot.
///
/// # Errors
/// As [`parse`], and [`ParseError::AnotherRobot`].
pub fn parse_for<'a>(robot: &str, bytes: &'a [u8]) -> Result<Model<'a>, ParseError> {
    match parse(bytes) {
        Ok(model) if model.structure().robot() != robot => Err(ParseError::AnotherRobot),
        parsed => parsed,
    }
}

/// Reads the blob at the beginning of a flash slot, whatever follows it; [`length`] says where it
/// ends.
///
/// # Errors
/// As [`parse`].
pub fn parse_prefix(slot: &[u8]) -> Result<Model<'_>, ParseError> {
    returned(slot, Extent::Prefix)
}

/// Which of the bytes are the blob.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Extent {
    /// All.
    Exact,
    /// Those at the beginning.
    Prefix,
}

#[inline(never)]
fn returned(bytes: &[u8], extent: Extent) -> Result<Model<'_>, ParseError> {
    // The model is made where the result is returned, and not moved there.
    let mut parsed = Ok(Model::empty());
    if let Ok(model) = &mut parsed
        && let Err(error) = load_alone(bytes, extent, model)
    {
        parsed = Err(error);
    }
    parsed
}

/// [`parse`] into a model that is there already, with a state to try the stored prediction in: what
/// takes the least stack. The state is a new one afterwards, and of bytes that are refused the model is
/// [empty](Model::empty).
///
/// # Errors
/// As [`parse`].
pub fn parse_into<'a>(
    bytes: &'a [u8],
    model: &mut Model<'a>,
    state: &mut PredictorState,
) -> Result<(), ParseError> {
    load(bytes, Extent::Exact, model, state)
}

/// The same with a state of its own.
#[inline(never)]
fn load_alone<'a>(
    bytes: &'a [u8],
    extent: Extent,
    model: &mut Model<'a>,
) -> Result<(), ParseError> {
    load(bytes, extent, model, &mut PredictorState::new())
}

// What is made below is made where it belongs, and nothing that is large is passed by value: a model is
// kilobytes. Every part has a frame of its own, which is off the stack when the next one begins.

/// Loads a blob. (`?` would copy every error on its way.)
#[inline(always)]
fn load<'a>(
    bytes: &'a [u8],
    extent: Extent,
    model: &mut Model<'a>,
    state: &mut PredictorState,
) -> Result<(), ParseError> {
    let mut sections = Sections { blob: &[], table: &[] };
    let mut loaded = whole(bytes, extent, &mut sections);
    if loaded.is_ok() {
        loaded = match sections.bytes(METADATA) {
            Some(bytes) => model.structure_mut().read(bytes).map_err(ParseError::from),
            None => Err(ParseError::MissingSection { kind: METADATA.0 }),
        };
    }
    if loaded.is_ok() {
        loaded = model.structure_mut().check_spaces();
    }
    if loaded.is_ok() {
        loaded = model.structure_mut().check_dictionary();
    }
    if loaded.is_ok() {
        loaded = model.structure_mut().check_observables();
    }
    if loaded.is_ok() {
        model.structure_mut().lay_out();
        loaded = take_terms(&sections, model);
    }
    if loaded.is_ok() {
        loaded = model.lay_out();
    }
    if loaded.is_ok() {
        model.complete();
        loaded = take_numbers(&sections, model);
    }
    if loaded.is_ok() {
        loaded = take_error_bounds(&sections, model);
    }
    if loaded.is_ok() {
        loaded = try_prediction(&sections, model, state);
    }
    if loaded.is_err() {
        model.clear();
    }
    state.clear();
    loaded
}

/// Terms, once it is clear that the sections of all numbers can be read.
#[inline(never)]
fn take_terms<'a>(sections: &Sections<'a>, model: &mut Model<'a>) -> Result<(), ParseError> {
    sections.check(COEFFICIENTS, size_of::<f32>(), true)?;
    sections.check(RANGES, size_of::<f32>(), false)?;
    sections.check(TERMS, size_of::<[u8; 2]>(), false)?;
    let terms = sections.bytes(TERMS).map(|bytes| bytes.as_chunks().0);
    model.take_terms(terms).map_err(|error| ModelError::Sparse(error).into())
}

#[inline(never)]
fn take_numbers<'a>(sections: &Sections<'a>, model: &mut Model<'a>) -> Result<(), ParseError> {
    // They have been looked at with the terms.
    let coefficients = sections.numbers(COEFFICIENTS).unwrap_or(&[]);
    model.take_numbers(coefficients, sections.numbers(RANGES))
}

/// Error bounds, if there are any.
#[inline(never)]
fn take_error_bounds<'a>(sections: &Sections<'a>, model: &mut Model<'a>) -> Result<(), ParseError> {
    sections.check(ERROR_BOUNDS, size_of::<u32>(), false)?;
    let Some(words) = sections.words(ERROR_BOUNDS) else { return Ok(()) };
    let bounds = error_bounds(model.structure().states().len(), words)?;
    model.set_error_bounds(bounds)
}

/// Tries the stored prediction.
#[inline(never)]
fn try_prediction(
    sections: &Sections<'_>,
    model: &Model<'_>,
    state: &mut PredictorState,
) -> Result<(), ParseError> {
    sections.check(SELF_TEST, size_of::<f32>(), true)?;
    let numbers = sections.numbers(SELF_TEST).unwrap_or(&[]);
    let wrong = ParseError::SectionLength {
        kind: SELF_TEST.0,
        expected: SelfTest::len(model.structure()).wrapping_mul(4),
        found: size_of_val(numbers),
    };
    let self_test = SelfTest::split(model.structure(), numbers).ok_or(wrong)?;
    match self_test.failure(model, state) {
        None => Ok(()),
        Some(coordinate) => Err(ParseError::SelfTest { coordinate }),
    }
}

/// The sections of a blob whose checksum and section table hold.
#[inline(never)]
fn whole<'a>(
    slot: &'a [u8],
    extent: Extent,
    sections: &mut Sections<'a>,
) -> Result<(), ParseError> {
    *sections = Sections::new(checked(slot, extent)?.0)?;
    Ok(())
}

/// The blob, and its checksum, which holds.
#[inline]
pub(crate) fn checked(slot: &[u8], extent: Extent) -> Result<(&[u8], u32), ParseError> {
    let is_aligned = slot.as_ptr().addr().is_multiple_of(4);
    if extent == Extent::Prefix && !is_aligned {
        return Err(ParseError::Misaligned);
    }
    let total = length(slot)?;
    if extent == Extent::Exact && slot.len() > total {
        return Err(ParseError::Trailing { expected: total, found: slot.len() });
    }
    if !is_aligned {
        return Err(ParseError::Misaligned);
    }
    let truncated = ParseError::Truncated { expected: total, found: slot.len() };
    let blob = slot.get(..total).ok_or(truncated)?;
    let (expected, found) = (read_u32(blob, 12), checksum(blob));
    if expected != found {
        return Err(ParseError::Checksum { expected, found });
    }
    Ok((blob, found))
}

/// The metadata of a blob whose sections are there, checked.
pub(crate) fn read_structure<'a>(sections: &Sections<'a>) -> Result<Structure<'a>, ParseError> {
    let missing = ParseError::MissingSection { kind: METADATA.0 };
    let mut structure = Structure::empty();
    structure.read(sections.bytes(METADATA).ok_or(missing)?)?;
    structure.check::<ParseError>()?;
    structure.lay_out();
    Ok(structure)
}

/// The prediction stored in a blob that [`parse`] accepts.
///
/// # Errors
/// As [`parse`].
pub fn self_test(bytes: &[u8]) -> Result<SelfTest<'_>, ParseError> {
    let model = parse(bytes)?;
    let numbers = Sections::new(bytes)?.numbers(SELF_TEST).unwrap_or(&[]);
    SelfTest::split(model.structure(), numbers)
        .ok_or(ParseError::MissingSection { kind: SELF_TEST.0 })
}

/// The total length in bytes of the blob at the beginning of a flash slot, as its header says: what
/// follows is no part of it. Only the header is looked at; whether it is a blob [`parse_prefix`]
/// decides.
///
/// # Errors
/// [`ParseError::Truncated`] if the slot is shorter than the header or the length,
/// [`ParseError::Magic`], [`ParseError::Version`], and [`ParseError::SectionTable`] for a length that
/// no blob has.
///
/// ```
/// use firmware_core::blob;
/// let blob = include_bytes!(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/rosbot/model.bin"));
/// let mut slot = [0xFF; 16_384];
/// slot[..blob.len()].copy_from_slice(blob);
/// assert_eq!(blob::length(&slot), Ok(blob.len()));
/// ```
pub fn length(bytes: &[u8]) -> Result<usize, ParseError> {
    let header = bytes
        .get(..HEADER)
        .ok_or(ParseError::Truncated { expected: HEADER, found: bytes.len() })?;
    if !header.starts_with(&MAGIC) {
        return Err(ParseError::Magic);
    }
    let found = read_u16(header, 4);
    if found != VERSION {
        return Err(ParseError::Version { found });
    }
    let length = usize::try_from(read_u32(header, 8)).unwrap_or(usize::MAX);
    if length < HEADER || !length.is_multiple_of(4) {
        return Err(ParseError::SectionTable);
    }
    if length > bytes.len() {
        return Err(ParseError::Truncated { expected: length, found: bytes.len() });
    }
    Ok(length)
}

fn checksum(blob: &[u8]) -> u32 {
    let head = crc32(0, blob.get(..12).unwrap_or(&[]));
    crc32(head, blob.get(HEADER..).unwrap_or(&[]))
}

fn read_u16(bytes: &[u8], offset: usize) -> u16 {
    let field = bytes.get(offset..).and_then(|rest| rest.first_chunk());
    field.copied().map_or(0, u16::from_le_bytes)
}

fn read_u32(bytes: &[u8], offset: usize) -> u32 {
    let field = bytes.get(offset..).and_then(|rest| rest.first_chunk());
    field.copied().map_or(0, u32::from_le_bytes)
}

/// The section table of a blob whose checksum holds, checked.
pub(crate) struct Sections<'a> {
    blob: &'a [u8],
    table: &'a [[u8; ENTRY]],
}

impl<'a> Sections<'a> {
    fn new(blob: &'a [u8]) -> Result<Self, ParseError> {
        Self::of(blob, &[METADATA, COEFFICIENTS, SELF_TEST, TERMS])
    }

    /// Of a reader that understands these kinds in these encodings.
    pub(crate) fn of(blob: &'a [u8], known: &[(u16, u16)]) -> Result<Self, ParseError> {
        let bad = ParseError::SectionTable;
        let count = usize::from(read_u16(blob, 6));
        if count > MAX_SECTIONS {
            return Err(bad);
        }
        let end = HEADER.wrapping_add(count.wrapping_mul(ENTRY));
        let (head, mut rest) = blob.split_at_checked(end).ok_or(bad)?;
        let (table, _) = head.get(HEADER..).ok_or(bad)?.as_chunks::<ENTRY>();
        for (i, entry) in table.iter().enumerate() {
            let (kind, encoding) = (read_u16(entry, 0), read_u16(entry, 2));
            let earlier = table.get(..i).unwrap_or(&[]);
            if earlier.iter().any(|entry| read_u16(entry, 0) == kind) {
                return Err(bad);
            }
            if kind < OPTIONAL && !known.contains(&(kind, encoding)) {
                let q31 = |e: &[u8; ENTRY]| (read_u16(e, 0), read_u16(e, 2)) == Q31;
                let fixed_point = known.contains(&COEFFICIENTS) && table.iter().any(q31);
                return Err(match fixed_point {
                    true => ParseError::FixedPoint,
                    false => ParseError::UnknownSection { kind, encoding },
                });
            }
            // Every byte of a blob belongs to one section or is padding of zeros.
            let (offset, length) = (read_u32(entry, 4), read_u32(entry, 8));
            let length = usize::try_from(length).unwrap_or(usize::MAX);
            let end = blob.len().wrapping_sub(rest.len());
            let (_, behind) = rest.split_at_checked(length).ok_or(bad)?;
            let padding = length.wrapping_neg() % 4;
            let (padding, behind) = behind.split_at_checked(padding).ok_or(bad)?;
            if usize::try_from(offset) != Ok(end) || padding.iter().any(|byte| *byte != 0) {
                return Err(bad);
            }
            rest = behind;
        }
        if rest.is_empty() { Ok(Self { blob, table }) } else { Err(bad) }
    }

    /// The bytes of a section; one of another encoding counts as missing.
    #[inline(never)]
    pub(crate) fn bytes(&self, (kind, encoding): (u16, u16)) -> Option<&'a [u8]> {
        // Both at once, as they lie there.
        let beginning = u32::from(kind) | u32::from(encoding) << 16;
        let entry = self.table.iter().find(|entry| read_u32(*entry, 0) == beginning)?;
        let offset = usize::try_from(read_u32(entry, 4)).unwrap_or(usize::MAX);
        let length = usize::try_from(read_u32(entry, 8)).unwrap_or(usize::MAX);
        self.blob.get(offset..)?.get(..length)
    }

    /// Whether a section is there, or need not be, and has whole elements of so many bytes.
    #[inline(never)]
    fn check(&self, section: (u16, u16), size: usize, required: bool) -> Result<(), ParseError> {
        let (kind, _) = section;
        match self.bytes(section).map(<[u8]>::len) {
            Some(found) if !found.is_multiple_of(size) => {
                let expected = found.next_multiple_of(size);
                Err(ParseError::SectionLength { kind, expected, found })
            }
            None if required => Err(ParseError::MissingSection { kind }),
            _ => Ok(()),
        }
    }

    /// A section of whole words, in place, if there is one.
    #[inline(never)]
    fn words(&self, section: (u16, u16)) -> Option<&'a [u32]> {
        bytemuck::try_cast_slice(self.bytes(section)?).ok()
    }

    /// The same as numbers.
    #[inline(always)]
    fn numbers(&self, section: (u16, u16)) -> Option<&'a [f32]> {
        bytemuck::try_cast_slice(self.words(section)?).ok()
    }

    /// A section of words that has to be there.
    #[inline]
    pub(crate) fn required(&self, section: (u16, u16)) -> Result<&'a [u32], ParseError> {
        self.check(section, size_of::<u32>(), true)?;
        Ok(self.words(section).unwrap_or(&[]))
    }
}

/// Cuts the section of the error bounds into its parts.
fn error_bounds(states: usize, words: &[u32]) -> Result<ErrorBounds<'_>, ParseError> {
    let found = size_of_val(words);
    // Where this wraps, there are more horizons than words: there is nothing to split then.
    let count = words.get(2).map_or(0, |h| *h as usize);
    let per_horizon = states.wrapping_add(1);
    let expected = count.wrapping_mul(per_horizon).wrapping_add(3).wrapping_mul(4);
    let length = ParseError::SectionLength { kind: ERROR_BOUNDS.0, expected, found };
    if expected != found {
        return Err(length);
    }
    let ([coverage, units, _], rest) = words.split_first_chunk().ok_or(length)?;
    let (horizons, bounds) = rest.split_at_checked(count).ok_or(length)?;
    let bounds = bytemuck::try_cast_slice(bounds).map_err(|_| length)?;
    ErrorBounds::new(states, f32::from_bits(*coverage), *units, horizons, bounds)
        .map_err(ParseError::ErrorBounds)
}

/// Writes a model, dense or sparse and with its error bounds if it has any, into `out`, with a
/// prediction from `states` and `inputs` (shapes as in
/// [`SelfTest`]) that may differ by `tolerance` per coordinate, and returns the number of bytes.
///
/// # Errors
/// [`EmitError`].
pub fn emit(
    model: &Model<'_>,
    states: &[f32],
    inputs: &[f32],
    tolerance: &[f32],
    out: &mut [u8],
) -> Result<usize, EmitError> {
    let structure = model.structure();
    let (n, m) = (structure.states().len(), structure.inputs().len());
    let samples = structure.lag().saturating_add(1);
    let found = (states.len(), inputs.len(), tolerance.len());
    let shape = (samples.saturating_mul(n), samples.saturating_mul(m), n);
    if found != shape || !tolerance.iter().all(|t| t.is_finite() && *t >= 0.0) {
        return Err(EmitError::SelfTest);
    }
    let mut predicted = [0.0; MAX_STATES];
    let expected = predicted.get_mut(..n).unwrap_or_default();
    let test = SelfTest { states, inputs, expected: &[], tolerance };
    test.predict(model, expected).map_err(|_| EmitError::SelfTest)?;
    let self_test = [states, inputs, expected, tolerance];

    let short = EmitError::BufferTooShort { found: out.len() };
    let optional =
        [model.terms().is_some(), model.ranges().is_some(), model.error_bounds().is_some()];
    let count = optional.into_iter().fold(3_usize, |n, there| n.saturating_add(there.into()));
    let mut writer = Writer::new(out, count, structure)?;
    writer.numbers(COEFFICIENTS, &[model.coefficients()]).ok_or(short)?;
    writer.numbers(SELF_TEST, &self_test).ok_or(short)?;
    if let Some(terms) = model.terms() {
        writer.words(TERMS, terms.entries().iter().copied()).ok_or(short)?;
    }
    if let Some(ranges) = model.ranges() {
        writer.numbers(RANGES, &[ranges]).ok_or(short)?;
    }
    if let Some(bounds) = model.error_bounds() {
        // At most MAX_HORIZON of them.
        let horizons = bounds.horizons().len() as u32;
        let head = [bounds.coverage().to_bits(), bounds.units(), horizons];
        let words = head.iter().chain(bounds.horizons()).copied();
        let words = words.chain(bounds.bounds().iter().map(|bound| bound.to_bits()));
        writer.words(ERROR_BOUNDS, words.map(u32::to_le_bytes)).ok_or(short)?;
    }
    writer.seal()
}

/// The length in bytes of the blob that [`emit`] writes for a model of this structure, dense or with
/// these terms, with trained ranges or without, and without error bounds.
pub fn size(structure: &Structure<'_>, terms: Option<SparseTerms<'_>>, ranges: bool) -> usize {
    let counter = postcard::ser_flavors::Size::default();
    // Counting cannot fail.
    let metadata = postcard::serialize_with_flavor(&structure.to_repr(), counter).unwrap_or(0);
    let dictionary = structure.dictionary();
    let row = terms.map_or(dictionary.dense_terms(), |terms| terms.count());
    let numbers = [
        structure.outputs().saturating_mul(row),
        SelfTest::len(structure),
        if ranges { dictionary.observables().len().saturating_mul(2) } else { 0 },
    ];
    let chain = terms.map_or(0, |terms| terms.entries().len().saturating_mul(2));
    let sections = 3_usize.saturating_add(terms.is_some().into()).saturating_add(ranges.into());
    let parts = [
        HEADER,
        sections.saturating_mul(ENTRY),
        metadata.next_multiple_of(4),
        chain.next_multiple_of(4),
        numbers.into_iter().fold(0, usize::saturating_add).saturating_mul(4),
    ];
    parts.into_iter().fold(0, usize::saturating_add)
}

/// Lays sections one after the other and fills in the table.
pub(crate) struct Writer<'a> {
    out: &'a mut [u8],
    entry: usize,
    end: usize,
}

impl<'a> Writer<'a> {
    /// Begins a blob of so many sections with the metadata.
    pub(crate) fn new(
        out: &'a mut [u8],
        sections: usize,
        structure: &Structure<'_>,
    ) -> Result<Self, EmitError> {
        let short = EmitError::BufferTooShort { found: out.len() };
        let table = HEADER.saturating_add(sections.saturating_mul(ENTRY));
        let mut writer = Self { out, entry: HEADER, end: table };
        let metadata = writer.out.get_mut(table..).ok_or(short)?;
        let length = postcard::to_slice(&structure.to_repr(), metadata).map_err(|_| short)?.len();
        writer.close(METADATA, length).ok_or(short)?;
        Ok(writer)
    }

    /// A section of words.
    pub(crate) fn put(
        &mut self,
        section: (u16, u16),
        words: impl Iterator<Item = [u8; 4]>,
    ) -> Result<(), EmitError> {
        let short = EmitError::BufferTooShort { found: self.out.len() };
        self.words(section, words).ok_or(short)
    }

    /// Ends the blob, whose sections are all there: its length.
    pub(crate) fn seal(self) -> Result<usize, EmitError> {
        let short = EmitError::BufferTooShort { found: self.out.len() };
        let blob = self.out.get_mut(..self.end).ok_or(short)?;
        let length = u32::try_from(self.end).map_err(|_| short)?;
        // At most MAX_SECTIONS.
        let count = self.entry.saturating_sub(HEADER).checked_div(ENTRY).unwrap_or(0) as u16;
        write(blob, 0, &MAGIC);
        write(blob, 4, &VERSION.to_le_bytes());
        write(blob, 6, &count.to_le_bytes());
        write(blob, 8, &length.to_le_bytes());
        let checksum = checksum(blob);
        write(blob, 12, &checksum.to_le_bytes());
        Ok(self.end)
    }

    /// Ends the section of `length` bytes that was written at `end`: table entry and padding.
    fn close(&mut self, (kind, encoding): (u16, u16), length: usize) -> Option<()> {
        let padded = self.end.checked_add(length)?.checked_next_multiple_of(4)?;
        self.out.get_mut(self.end.checked_add(length)?..padded)?.fill(0);
        let entry = self.out.get_mut(self.entry..self.entry.checked_add(ENTRY)?)?;
        write(entry, 0, &kind.to_le_bytes());
        write(entry, 2, &encoding.to_le_bytes());
        write(entry, 4, &u32::try_from(self.end).ok()?.to_le_bytes());
        write(entry, 8, &u32::try_from(length).ok()?.to_le_bytes());
        self.entry = self.entry.checked_add(ENTRY)?;
        self.end = padded;
        Some(())
    }

    fn numbers(&mut self, section: (u16, u16), parts: &[&[f32]]) -> Option<()> {
        self.words(section, parts.iter().copied().flatten().map(|number| number.to_le_bytes()))
    }

    fn words<const N: usize>(
        &mut self,
        section: (u16, u16),
        words: impl Iterator<Item = [u8; N]>,
    ) -> Option<()> {
        let mut length = 0_usize;
        for word in words {
            let at = self.end.checked_add(length)?;
            self.out.get_mut(at..at.checked_add(N)?)?.copy_from_slice(&word);
            length = length.checked_add(N)?;
        }
        self.close(section, length)
    }
}

/// Overwrites the bytes at `offset` as far as there is room.
fn write(out: &mut [u8], offset: usize, bytes: &[u8]) {
    for (to, byte) in out.iter_mut().skip(offset).zip(bytes) {
        *to = *byte;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crc::{CRC_32_ISO_HDLC, Crc};
    use proptest::prelude::*;

    #[test]
    fn checksum_of_the_catalogue() {
        assert_eq!(crc32(0, b"123456789"), 0xCBF4_3926);
        assert_eq!(crc32(0, &[]), 0);
    }

    proptest! {
        #[test]
        fn checksums(bytes in prop::collection::vec(any::<u8>(), 0..70), at: prop::sample::Index) {
            let (head, tail) = bytes.split_at(at.index(bytes.len() + 1));
            let expected = Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&bytes);
            prop_assert_eq!(crc32(crc32(0, head), tail), expected);
        }
    }
}
