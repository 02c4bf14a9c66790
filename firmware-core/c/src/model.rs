//! A model in memory of the caller.

use core::ffi::{c_char, c_void};

use firmware_core::{Model, PredictorState, blob};

use crate::error::answer;
use crate::error::koopman_error_t::{self, *};
use crate::pointer::{Marked, array_mut, bytes, check, overlap, put, room};

/// Pointers and sizes in a koopman_model_t.
pub const KOOPMAN_MODEL_POINTERS: usize = 93;
/// Further words of 32 bits in it.
pub const KOOPMAN_MODEL_WORDS: usize = 579;

/// A Koopman model, checked when it was loaded. The memory is the caller's; what is in it is the
/// library's. It refers to the blob, and no prediction changes it: any number of states, also
/// of several threads, may use it at once. It may be copied and simply forgotten.
#[repr(C)]
pub struct koopman_model_t {
    pointers: [usize; KOOPMAN_MODEL_POINTERS],
    words: [u32; KOOPMAN_MODEL_WORDS],
}

type Loaded = Model<'static>;
const _: () = assert!(room::<koopman_model_t, Loaded>(), "KOOPMAN_MODEL_WORDS is too small");
/// "KMOD".
const MARK: u32 = u32::from_le_bytes(*b"KMOD");

/// What a model looks like.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct koopman_info_t {
    /// State coordinates, n.
    pub states: u32,
    /// Inputs, m.
    pub inputs: u32,
    /// The oldest sample that a prediction looks at, in samples before the present one: lag + 1
    /// samples are to be observed before the first step.
    pub lag: u32,
    /// The last step that koopman_error_bound has an answer for; 0 if the model has no error bounds.
    pub horizon: u32,
    /// The share of measurements within the error bounds, between 0 and 1; 0 if there are none.
    pub coverage: f32,
    /// Time between samples, in s.
    pub sample_time_s: f32,
}

/// The model that was loaded there.
///
/// # Safety
/// As the head of the header says of `model`.
pub(crate) unsafe fn loaded<'a>(
    model: *const koopman_model_t,
) -> Result<&'a Loaded, koopman_error_t> {
    // SAFETY: what carries the mark was loaded; the rest is the caller's word.
    unsafe { Marked::get(model, MARK, KOOPMAN_ERROR_NO_MODEL) }
}

/// Loads the model of a blob: checks its checksum, its dimensions and its numbers, and predicts the
/// prediction that is stored in it.
///
/// `blob` points to `length` bytes, exactly the blob, at an address divisible by 4. They are read in
/// place, now and by every prediction: they must stay where they are, unchanged, as long as the model
/// is used. `robot` is the name of the robot that this is, and a model of another one is refused; NULL
/// takes any.
///
/// On an error there is no model in `model`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_load(
    model: *mut koopman_model_t,
    blob: *const c_void,
    length: usize,
    robot: *const c_char,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word, for as long as the model is used.
        let bytes = unsafe { bytes(blob, length) };
        if bytes.is_ok() && overlap((blob.cast::<u8>(), length), (model.cast_const(), 1)) {
            return Err(KOOPMAN_ERROR_OVERLAP);
        }
        // SAFETY: `room` was asked; the rest is the caller's word.
        unsafe { Marked::<Loaded>::clear(model)? };
        let bytes = bytes?;
        // SAFETY: as above.
        let loaded = unsafe { Marked::<Loaded>::place(model, Model::empty)? };
        blob::parse_into(bytes, loaded, &mut PredictorState::new())?;
        // SAFETY: the caller's word.
        if !(robot.is_null() || unsafe { is_text(robot, loaded.structure().robot()) }) {
            return Err(KOOPMAN_ERROR_ANOTHER_ROBOT);
        }
        // SAFETY: it was placed there.
        unsafe { Marked::<Loaded>::mark(model, MARK) };
        Ok(())
    })
}

/// Whether a text of C is this one. Of the text no more is read than up to the first difference.
///
/// # Safety
/// `c` points to a text that ends with NUL.
unsafe fn is_text(c: *const c_char, text: &str) -> bool {
    let mut at = c.cast::<u8>();
    for byte in text.bytes() {
        // SAFETY: no NUL came before.
        if byte == 0 || unsafe { at.read() } != byte {
            return false;
        }
        at = at.wrapping_add(1);
    }
    // SAFETY: as above.
    unsafe { at.read() == 0 }
}

/// The length of the blob at the beginning of `slot`, `length` bytes of flash or anything else, as its
/// first bytes say, in `blob_length`: what koopman_load asks for. Only koopman_load says whether it is
/// a blob.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_blob_length(
    slot: *const c_void,
    length: usize,
    blob_length: *mut usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let length = blob::length(unsafe { bytes(slot, length)? })?;
        // SAFETY: the caller's word.
        unsafe { put(blob_length, length) }
    })
}

/// The shape of the model, its sample time and its error bounds.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_info(
    model: *const koopman_model_t,
    info: *mut koopman_info_t,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let model = unsafe { loaded(model)? };
        let structure = model.structure();
        let bounds = model.error_bounds();
        let shape = koopman_info_t {
            // All of them are small.
            states: structure.states().len() as u32,
            inputs: structure.inputs().len() as u32,
            lag: structure.lag() as u32,
            horizon: bounds.and_then(|b| b.horizons().last().copied()).unwrap_or(0),
            coverage: bounds.map_or(0.0, |b| b.coverage()),
            sample_time_s: structure.sample_time_s(),
        };
        // SAFETY: the caller's word.
        unsafe { put(info, shape) }
    })
}

/// Puts a text and NUL there.
///
/// # Safety
/// `buffer` points to `size` bytes of the caller.
unsafe fn put_text(text: &str, buffer: *mut c_char, size: usize) -> Result<(), koopman_error_t> {
    if buffer.is_null() {
        return Err(KOOPMAN_ERROR_NULL);
    }
    // SAFETY: the caller's word.
    let buffer: &mut [u8] = unsafe { array_mut(buffer.cast(), size)? };
    if buffer.len() <= text.len() {
        return Err(KOOPMAN_ERROR_BUFFER);
    }
    for (to, byte) in buffer.iter_mut().zip(text.bytes().chain([0])) {
        *to = byte;
    }
    Ok(())
}

/// The name of the robot that the model belongs to, in UTF-8 and with NUL, in `buffer` of `size`
/// bytes. When it does not fit, nothing is written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_robot(
    model: *const koopman_model_t,
    buffer: *mut c_char,
    size: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let model = unsafe { loaded(model)? };
        // SAFETY: the caller's word.
        unsafe { put_text(model.structure().robot(), buffer, size) }
    })
}

/// The name of state coordinate `index`, from 0, such as "phi"; `buffer` as in koopman_robot.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_state_name(
    model: *const koopman_model_t,
    index: usize,
    buffer: *mut c_char,
    size: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let state = unsafe { loaded(model)? }.structure().states().get(index);
        // SAFETY: the caller's word.
        unsafe { put_text(state.ok_or(KOOPMAN_ERROR_INDEX)?.name, buffer, size) }
    })
}

/// The unit of state coordinate `index`, such as "m"; `buffer` as in koopman_robot.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_state_unit(
    model: *const koopman_model_t,
    index: usize,
    buffer: *mut c_char,
    size: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let state = unsafe { loaded(model)? }.structure().states().get(index);
        // SAFETY: the caller's word.
        unsafe { put_text(state.ok_or(KOOPMAN_ERROR_INDEX)?.unit, buffer, size) }
    })
}

/// The name of input `index`, from 0, such as "omega_r"; `buffer` as in koopman_robot.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_input_name(
    model: *const koopman_model_t,
    index: usize,
    buffer: *mut c_char,
    size: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let input = unsafe { loaded(model)? }.structure().inputs().get(index);
        // SAFETY: the caller's word.
        unsafe { put_text(input.ok_or(KOOPMAN_ERROR_INDEX)?.name, buffer, size) }
    })
}

/// The unit of input `index`, such as "rad/s"; `buffer` as in koopman_robot.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_input_unit(
    model: *const koopman_model_t,
    index: usize,
    buffer: *mut c_char,
    size: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let input = unsafe { loaded(model)? }.structure().inputs().get(index);
        // SAFETY: the caller's word.
        unsafe { put_text(input.ok_or(KOOPMAN_ERROR_INDEX)?.unit, buffer, size) }
    })
}

/// What the actuator of input `index` accepts, from `low` to `high`, in the unit of the input.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_input_range(
    model: *const koopman_model_t,
    index: usize,
    low: *mut f32,
    high: *mut f32,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let input = unsafe { loaded(model)? }.structure().inputs().get(index);
        let [lowest, highest] = input.ok_or(KOOPMAN_ERROR_INDEX)?.range;
        check(high, 1)?;
        // SAFETY: the caller's word.
        unsafe { put(low, lowest)? };
        // SAFETY: the caller's word.
        unsafe { put(high, highest) }
    })
}

/// How far the measured coordinate `index` may be from the predicted one after `step` steps without a
/// measurement, in its unit, in `bound`: with the probability `coverage` of koopman_info_t it is not
/// further. 0 for step 0; KOOPMAN_ERROR_NO_BOUND beyond the horizon of koopman_info_t. The difference
/// of angles is to be taken the short way round.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_error_bound(
    model: *const koopman_model_t,
    step: u32,
    index: usize,
    bound: *mut f32,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let model = unsafe { loaded(model)? };
        if index >= model.structure().states().len() {
            return Err(KOOPMAN_ERROR_INDEX);
        }
        let found = model.error_bounds().and_then(|bounds| bounds.bound(step, index));
        // SAFETY: the caller's word.
        unsafe { put(bound, found.ok_or(KOOPMAN_ERROR_NO_BOUND)?) }
    })
}
