//! What a call answers.

use core::ffi::{CStr, c_char};

use firmware_core::PredictError;
use firmware_core::blob::ParseError;

/// What a function answers: KOOPMAN_OK, which is 0, or why it did nothing. 1 to 31 are about the
/// arguments, 32 to 63 about the blob, 64 and above about the prediction. Numbers keep their meaning.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum koopman_error_t {
    /// It is done.
    KOOPMAN_OK = 0,
    /// A pointer is NULL that must not be.
    KOOPMAN_ERROR_NULL = 1,
    /// A pointer does not have the alignment of its type; that of a blob is 4.
    KOOPMAN_ERROR_MISALIGNED = 2,
    /// A length is not the one that the model asks for, or no array has it.
    KOOPMAN_ERROR_LENGTH = 3,
    /// What is read and what is written overlap.
    KOOPMAN_ERROR_OVERLAP = 4,
    /// There is no model in the koopman_model_t: koopman_load was not called or failed.
    KOOPMAN_ERROR_NO_MODEL = 5,
    /// There is no state in the koopman_state_t: koopman_state_init was not called.
    KOOPMAN_ERROR_NO_STATE = 6,
    /// There is no state coordinate or input with this index.
    KOOPMAN_ERROR_INDEX = 7,
    /// The text and its end do not fit into the buffer.
    KOOPMAN_ERROR_BUFFER = 8,

    /// Fewer bytes than the blob has.
    KOOPMAN_ERROR_TRUNCATED = 32,
    /// More bytes than the blob has.
    KOOPMAN_ERROR_TRAILING = 33,
    /// The bytes are no blob.
    KOOPMAN_ERROR_MAGIC = 34,
    /// The blob has a format that this library does not read.
    KOOPMAN_ERROR_VERSION = 35,
    /// The blob has been damaged.
    KOOPMAN_ERROR_CHECKSUM = 36,
    /// The sections of the blob do not hold together, one is missing, unknown, or has a wrong length.
    KOOPMAN_ERROR_SECTIONS = 37,
    /// The metadata of the blob cannot be decoded.
    KOOPMAN_ERROR_METADATA = 38,
    /// The model is larger than this library has room for, or has something that it does not know.
    KOOPMAN_ERROR_UNSUPPORTED = 39,
    /// The parts of the blob do not make a model.
    KOOPMAN_ERROR_MODEL = 40,
    /// The error bounds of the blob are none.
    KOOPMAN_ERROR_BOUNDS = 41,
    /// The prediction stored in the blob is not reproduced.
    KOOPMAN_ERROR_SELF_TEST = 42,
    /// The model belongs to another robot.
    KOOPMAN_ERROR_ANOTHER_ROBOT = 43,

    /// The model looks at earlier samples that have not been observed yet.
    KOOPMAN_ERROR_NOT_READY = 64,
    /// A measured coordinate is NaN or infinite.
    KOOPMAN_ERROR_NOT_FINITE = 65,
    /// An input is NaN or infinite.
    KOOPMAN_ERROR_INPUT_NOT_FINITE = 66,
    /// The prediction left the finite numbers, a limit of the model, or the circle.
    KOOPMAN_ERROR_DIVERGED = 67,
    /// The model has no error bound for this step.
    KOOPMAN_ERROR_NO_BOUND = 68,

    /// Something else; this library has no number for it.
    KOOPMAN_ERROR_OTHER = 127,
}

use koopman_error_t::*;

const NAMES: [(koopman_error_t, &CStr); 27] = [
    (KOOPMAN_OK, c"KOOPMAN_OK"),
    (KOOPMAN_ERROR_NULL, c"KOOPMAN_ERROR_NULL"),
    (KOOPMAN_ERROR_MISALIGNED, c"KOOPMAN_ERROR_MISALIGNED"),
    (KOOPMAN_ERROR_LENGTH, c"KOOPMAN_ERROR_LENGTH"),
    (KOOPMAN_ERROR_OVERLAP, c"KOOPMAN_ERROR_OVERLAP"),
    (KOOPMAN_ERROR_NO_MODEL, c"KOOPMAN_ERROR_NO_MODEL"),
    (KOOPMAN_ERROR_NO_STATE, c"KOOPMAN_ERROR_NO_STATE"),
    (KOOPMAN_ERROR_INDEX, c"KOOPMAN_ERROR_INDEX"),
    (KOOPMAN_ERROR_BUFFER, c"KOOPMAN_ERROR_BUFFER"),
    (KOOPMAN_ERROR_TRUNCATED, c"KOOPMAN_ERROR_TRUNCATED"),
    (KOOPMAN_ERROR_TRAILING, c"KOOPMAN_ERROR_TRAILING"),
    (KOOPMAN_ERROR_MAGIC, c"KOOPMAN_ERROR_MAGIC"),
    (KOOPMAN_ERROR_VERSION, c"KOOPMAN_ERROR_VERSION"),
    (KOOPMAN_ERROR_CHECKSUM, c"KOOPMAN_ERROR_CHECKSUM"),
    (KOOPMAN_ERROR_SECTIONS, c"KOOPMAN_ERROR_SECTIONS"),
    (KOOPMAN_ERROR_METADATA, c"KOOPMAN_ERROR_METADATA"),
    (KOOPMAN_ERROR_UNSUPPORTED, c"KOOPMAN_ERROR_UNSUPPORTED"),
    (KOOPMAN_ERROR_MODEL, c"KOOPMAN_ERROR_MODEL"),
    (KOOPMAN_ERROR_BOUNDS, c"KOOPMAN_ERROR_BOUNDS"),
    (KOOPMAN_ERROR_SELF_TEST, c"KOOPMAN_ERROR_SELF_TEST"),
    (KOOPMAN_ERROR_ANOTHER_ROBOT, c"KOOPMAN_ERROR_ANOTHER_ROBOT"),
    (KOOPMAN_ERROR_NOT_READY, c"KOOPMAN_ERROR_NOT_READY"),
    (KOOPMAN_ERROR_NOT_FINITE, c"KOOPMAN_ERROR_NOT_FINITE"),
    (KOOPMAN_ERROR_INPUT_NOT_FINITE, c"KOOPMAN_ERROR_INPUT_NOT_FINITE"),
    (KOOPMAN_ERROR_DIVERGED, c"KOOPMAN_ERROR_DIVERGED"),
    (KOOPMAN_ERROR_NO_BOUND, c"KOOPMAN_ERROR_NO_BOUND"),
    (KOOPMAN_ERROR_OTHER, c"KOOPMAN_ERROR_OTHER"),
];

/// The name of an error, as it is written in this header; "unknown" for any other number. The text is
/// part of the library and ends with NUL.
#[unsafe(no_mangle)]
pub extern "C" fn koopman_error_name(error: i32) -> *const c_char {
    let found = NAMES.iter().find(|(known, _)| *known as i32 == error);
    found.map_or(c"unknown", |(_, name)| *name).as_ptr()
}

/// Runs what a function of the header does.
#[inline(always)]
pub(crate) fn answer(work: impl FnOnce() -> Result<(), koopman_error_t>) -> koopman_error_t {
    work().err().unwrap_or(KOOPMAN_OK)
}

impl From<ParseError> for koopman_error_t {
    fn from(error: ParseError) -> Self {
        match error {
            ParseError::Misaligned => KOOPMAN_ERROR_MISALIGNED,
            ParseError::Truncated { .. } => KOOPMAN_ERROR_TRUNCATED,
            ParseError::Trailing { .. } => KOOPMAN_ERROR_TRAILING,
            ParseError::Magic => KOOPMAN_ERROR_MAGIC,
            ParseError::Version { .. } => KOOPMAN_ERROR_VERSION,
            ParseError::Checksum { .. } => KOOPMAN_ERROR_CHECKSUM,
            ParseError::SectionTable
            | ParseError::UnknownSection { .. }
            | ParseError::MissingSection { .. }
            | ParseError::SectionLength { .. } => KOOPMAN_ERROR_SECTIONS,
            ParseError::Metadata => KOOPMAN_ERROR_METADATA,
            ParseError::Unsupported => KOOPMAN_ERROR_UNSUPPORTED,
            ParseError::Model(_) => KOOPMAN_ERROR_MODEL,
            ParseError::ErrorBounds(_) => KOOPMAN_ERROR_BOUNDS,
            ParseError::SelfTest { .. } => KOOPMAN_ERROR_SELF_TEST,
            ParseError::AnotherRobot => KOOPMAN_ERROR_ANOTHER_ROBOT,
            _ => KOOPMAN_ERROR_OTHER,
        }
    }
}

impl From<PredictError> for koopman_error_t {
    fn from(error: PredictError) -> Self {
        match error {
            PredictError::NotReady { .. } => KOOPMAN_ERROR_NOT_READY,
            PredictError::DimensionMismatch { .. } => KOOPMAN_ERROR_LENGTH,
            PredictError::NotFinite { .. } => KOOPMAN_ERROR_NOT_FINITE,
            PredictError::InputNotFinite { .. } => KOOPMAN_ERROR_INPUT_NOT_FINITE,
            PredictError::Diverged { .. } => KOOPMAN_ERROR_DIVERGED,
            _ => KOOPMAN_ERROR_OTHER,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every error of the header has its name.
    #[test]
    fn names() {
        let header = include_str!("../include/koopman.h");
        let mut count = 0;
        for line in header.lines() {
            let Some((name, number)) = line.trim().trim_end_matches(',').split_once(" = ") else {
                continue;
            };
            if name.starts_with("KOOPMAN_") {
                // SAFETY: the texts end with NUL and live as long as the program.
                let found = unsafe { CStr::from_ptr(koopman_error_name(number.parse().unwrap())) };
                assert_eq!(found.to_str(), Ok(name));
                count += 1;
            }
        }
        assert_eq!(count, NAMES.len());
        // SAFETY: as above.
        assert_eq!(unsafe { CStr::from_ptr(koopman_error_name(-1)) }, c"unknown");
    }
}
