//! Pointers and lengths from C, checked once.
//!
//! What can be seen of a pointer is checked: that it is there, aligned, and that an array of this
//! length can exist there. That the memory belongs to the caller, and that no one else writes to it
//! meanwhile, is the caller's word.

use core::ffi::c_void;
use core::mem::offset_of;
use core::slice;

use crate::error::koopman_error_t::{self, *};

/// Whether an array may lie there.
pub(crate) fn check<T>(pointer: *const T, length: usize) -> Result<(), koopman_error_t> {
    if pointer.is_null() {
        return Err(KOOPMAN_ERROR_NULL);
    }
    if !pointer.is_aligned() {
        return Err(KOOPMAN_ERROR_MISALIGNED);
    }
    let bytes = length.checked_mul(size_of::<T>()).filter(|bytes| isize::try_from(*bytes).is_ok());
    match bytes.and_then(|bytes| pointer.addr().checked_add(bytes)) {
        Some(_) => Ok(()),
        None => Err(KOOPMAN_ERROR_LENGTH),
    }
}

/// An array to be read; an empty one may be NULL.
///
/// # Safety
/// From `pointer` on there are `length` elements, which no one writes to during `'a`.
pub(crate) unsafe fn array<'a, T>(
    pointer: *const T,
    length: usize,
) -> Result<&'a [T], koopman_error_t> {
    if length == 0 {
        return Ok(&[]);
    }
    check(pointer, length)?;
    // SAFETY: not null, aligned, of a possible length; the elements are there by the caller's word.
    Ok(unsafe { slice::from_raw_parts(pointer, length) })
}

/// An array to be written; an empty one may be NULL.
///
/// # Safety
/// From `pointer` on there are `length` elements, which no one else touches during `'a`.
pub(crate) unsafe fn array_mut<'a, T>(
    pointer: *mut T,
    length: usize,
) -> Result<&'a mut [T], koopman_error_t> {
    if length == 0 {
        return Ok(&mut []);
    }
    check(pointer, length)?;
    // SAFETY: not null, aligned, of a possible length; the elements are the caller's by its word.
    Ok(unsafe { slice::from_raw_parts_mut(pointer, length) })
}

/// The bytes of a blob, to be read; none of them may be NULL.
///
/// # Safety
/// As [`array`].
pub(crate) unsafe fn bytes<'a>(
    pointer: *const c_void,
    length: usize,
) -> Result<&'a [u8], koopman_error_t> {
    let pointer = pointer.cast::<u8>();
    check(pointer, length)?;
    // SAFETY: not null, of a possible length; the bytes are there by the caller's word.
    Ok(unsafe { slice::from_raw_parts(pointer, length) })
}

/// Puts a result there.
///
/// # Safety
/// `pointer` is the caller's, and no one else touches it.
pub(crate) unsafe fn put<T>(pointer: *mut T, value: T) -> Result<(), koopman_error_t> {
    check(pointer, 1)?;
    // SAFETY: not null and aligned; what was there has nothing to be dropped.
    unsafe { pointer.write(value) };
    Ok(())
}

/// Whether two arrays share memory; NULL and empty ones do not.
pub(crate) fn overlap<T, U>(a: (*const T, usize), b: (*const U, usize)) -> bool {
    let end = |from: usize, length: usize, size| from.saturating_add(length.saturating_mul(size));
    let (from_a, to_a) = (a.0.addr(), end(a.0.addr(), a.1, size_of::<T>()));
    let (from_b, to_b) = (b.0.addr(), end(b.0.addr(), b.1, size_of::<U>()));
    let there = |from, to| from != 0 && from != to;
    there(from_a, to_a) && there(from_b, to_b) && from_a < to_b && from_b < to_a
}

/// An object of this library in memory of the caller, behind a mark that says that it is one.
#[repr(C)]
pub(crate) struct Marked<T> {
    mark: u32,
    object: T,
}

impl<T> Marked<T> {
    /// Copies an object there. It is not passed by value, or it would be on the stack once more.
    ///
    /// # Safety
    /// The caller's object `O` has [`room`], is the caller's, and no one else touches it. A `T` owns
    /// nothing, so that its bytes are another one.
    pub(crate) unsafe fn write<O>(
        pointer: *mut O,
        mark: u32,
        object: &T,
    ) -> Result<(), koopman_error_t> {
        check(pointer, 1)?;
        let to = pointer.wrapping_byte_add(offset_of!(Self, object)).cast::<T>();
        // SAFETY: not null, aligned, large enough; what was there has nothing to be dropped.
        unsafe { to.copy_from_nonoverlapping(object, 1) };
        // SAFETY: as above; the mark is the first field.
        unsafe { pointer.cast::<u32>().write(mark) };
        Ok(())
    }

    /// Makes an object there, still without its mark: it is never on the stack.
    ///
    /// # Safety
    /// As [`write`](Self::write), and during `'a`.
    pub(crate) unsafe fn place<'a, O>(
        pointer: *mut O,
        make: impl FnOnce() -> T,
    ) -> Result<&'a mut T, koopman_error_t> {
        // SAFETY: as the caller says.
        unsafe { Self::clear(pointer)? };
        let to = pointer.wrapping_byte_add(offset_of!(Self, object)).cast::<T>();
        // SAFETY: not null, aligned, large enough; what was there has nothing to be dropped.
        unsafe { to.write(make()) };
        // SAFETY: as above; the caller lends it.
        Ok(unsafe { &mut *to })
    }

    /// Says that there is one.
    ///
    /// # Safety
    /// It was made by [`place`](Self::place), and no one else touches it.
    pub(crate) unsafe fn mark<O>(pointer: *mut O, mark: u32) {
        // SAFETY: as above; the mark is the first field.
        unsafe { pointer.cast::<u32>().write(mark) };
    }

    /// Says that there is none.
    ///
    /// # Safety
    /// As [`write`](Self::write).
    pub(crate) unsafe fn clear<O>(pointer: *mut O) -> Result<(), koopman_error_t> {
        check(pointer, 1)?;
        // SAFETY: not null and aligned; the mark is the first field.
        unsafe { pointer.cast::<u32>().write(0) };
        Ok(())
    }

    /// The object, if the mark says that there is one.
    ///
    /// # Safety
    /// No one writes to it during `'a`, and what carries this mark was made by [`write`](Self::write).
    pub(crate) unsafe fn get<'a, O>(
        pointer: *const O,
        mark: u32,
        missing: koopman_error_t,
    ) -> Result<&'a T, koopman_error_t> {
        check(pointer, 1)?;
        // SAFETY: not null and aligned; the mark is the first field, and any bits are a number.
        if unsafe { pointer.cast::<u32>().read() } != mark {
            return Err(missing);
        }
        // SAFETY: there is one.
        Ok(unsafe { &(*pointer.cast::<Self>()).object })
    }

    /// The same, to be changed.
    ///
    /// # Safety
    /// No one else touches it during `'a`, and what carries this mark was made by [`write`](Self::write).
    pub(crate) unsafe fn get_mut<'a, O>(
        pointer: *mut O,
        mark: u32,
        missing: koopman_error_t,
    ) -> Result<&'a mut T, koopman_error_t> {
        check(pointer, 1)?;
        // SAFETY: not null and aligned; the mark is the first field, and any bits are a number.
        if unsafe { pointer.cast::<u32>().read() } != mark {
            return Err(missing);
        }
        // SAFETY: there is one.
        Ok(unsafe { &mut (*pointer.cast::<Self>()).object })
    }
}

/// Whether the header's object `O` has room for a marked `T`.
pub(crate) const fn room<O, T>() -> bool {
    size_of::<Marked<T>>() <= size_of::<O>() && align_of::<Marked<T>>() <= align_of::<O>()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overlapping() {
        let numbers = [0.0_f32; 8];
        let at = |from: usize, length| (numbers.as_ptr().wrapping_add(from), length);
        assert!(overlap(at(0, 4), at(3, 1)) && overlap(at(3, 1), at(0, 4)));
        assert!(!overlap(at(0, 4), at(4, 4)) && !overlap(at(4, 4), at(0, 4)));
        assert!(!overlap(at(0, 4), at(2, 0)) && !overlap((core::ptr::null::<u8>(), 99), at(0, 1)));
        // Nothing wraps round.
        assert!(overlap(at(0, usize::MAX), at(7, 1)));
    }

    #[test]
    fn impossible_arrays() {
        let number = 0.0_f32;
        let at = &raw const number;
        assert_eq!(check(at, 1), Ok(()));
        assert_eq!(check(core::ptr::null::<f32>(), 1), Err(KOOPMAN_ERROR_NULL));
        assert_eq!(check(at.wrapping_byte_add(1), 1), Err(KOOPMAN_ERROR_MISALIGNED));
        assert_eq!(check(at, usize::MAX / 4 + 1), Err(KOOPMAN_ERROR_LENGTH));
        assert_eq!(check(at, isize::MAX as usize / 4 + 1), Err(KOOPMAN_ERROR_LENGTH));
        let last = core::ptr::without_provenance::<f32>(usize::MAX - 3);
        assert_eq!(check(last, 1), Err(KOOPMAN_ERROR_LENGTH));
    }
}
