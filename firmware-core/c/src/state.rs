//! A predictor's state in memory of the caller, and predicting.

use firmware_core::{Predictor, PredictorState};

use crate::error::answer;
use crate::error::koopman_error_t::{self, *};
use crate::model::{koopman_model_t, loaded};
use crate::pointer::{Marked, array, array_mut, check, overlap, put, room};

/// Pointers and sizes in a koopman_state_t.
pub const KOOPMAN_STATE_POINTERS: usize = 4;
/// Further words of 32 bits in it.
pub const KOOPMAN_STATE_WORDS: usize = 308;

/// All that moves while a predictor works: the samples that a prediction looks at, measured or
/// predicted. The memory is the caller's; what is in it is the library's. A copy (`ahead = state`) is
/// a state of its own. It belongs to the model that it has observed with: initialise it anew before
/// another one uses it.
#[repr(C)]
pub struct koopman_state_t {
    pointers: [usize; KOOPMAN_STATE_POINTERS],
    words: [u32; KOOPMAN_STATE_WORDS],
}

const _: () =
    assert!(room::<koopman_state_t, PredictorState>(), "KOOPMAN_STATE_WORDS is too small");
/// "KSTA".
const MARK: u32 = u32::from_le_bytes(*b"KSTA");

/// The state that was initialised there.
///
/// # Safety
/// As the head of the header says of `state`.
unsafe fn initialised<'a>(
    state: *mut koopman_state_t,
) -> Result<&'a mut PredictorState, koopman_error_t> {
    // SAFETY: what carries the mark was initialised; the rest is the caller's word.
    unsafe { Marked::get_mut(state, MARK, KOOPMAN_ERROR_NO_STATE) }
}

/// The same, only to be read.
///
/// # Safety
/// As the head of the header says of `state`.
unsafe fn read<'a>(state: *const koopman_state_t) -> Result<&'a PredictorState, koopman_error_t> {
    // SAFETY: what carries the mark was initialised; the rest is the caller's word.
    unsafe { Marked::get(state, MARK, KOOPMAN_ERROR_NO_STATE) }
}

/// A state that has observed nothing yet; also to forget everything.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_state_init(state: *mut koopman_state_t) -> koopman_error_t {
    answer(|| {
        // SAFETY: `room` was asked, and a state owns nothing; the rest is the caller's word.
        unsafe { Marked::write(state, MARK, &PredictorState::<f32>::new()) }
    })
}

/// Takes a measurement: `coordinates[n]` in the units of the model (angles in rad, any turn), after
/// `applied[m]` acted for one sample time. `coordinates_length` is n and `applied_length` is m. Before
/// the first measurement nothing was applied: `applied` may be NULL and its length 0.
///
/// On an error the state is unchanged.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_observe(
    model: *const koopman_model_t,
    state: *mut koopman_state_t,
    applied: *const f32,
    applied_length: usize,
    coordinates: *const f32,
    coordinates_length: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let model = unsafe { loaded(model)? };
        // SAFETY: the caller's word.
        let state = unsafe { initialised(state)? };
        // SAFETY: the caller's word.
        let applied = unsafe { array(applied, applied_length)? };
        // SAFETY: the caller's word.
        let coordinates = unsafe { array(coordinates, coordinates_length)? };
        Ok(Predictor::new(model).observe(state, applied, coordinates)?)
    })
}

/// Predicts one sample time ahead under `input[m]` and moves the state there. `input_length` is m.
///
/// On an error the state is unchanged.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_step(
    model: *const koopman_model_t,
    state: *mut koopman_state_t,
    input: *const f32,
    input_length: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let model = unsafe { loaded(model)? };
        // SAFETY: the caller's word.
        let state = unsafe { initialised(state)? };
        // SAFETY: the caller's word.
        let input = unsafe { array(input, input_length)? };
        Ok(Predictor::new(model).step(state, input)?)
    })
}

/// The present coordinates in `coordinates[n]`: measured or predicted, whichever came last; predicted
/// angles from -pi to pi. `coordinates_length` is n. KOOPMAN_ERROR_NOT_READY before the first measurement.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_coordinates(
    model: *const koopman_model_t,
    state: *const koopman_state_t,
    coordinates: *mut f32,
    coordinates_length: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let model = unsafe { loaded(model)? };
        // SAFETY: the caller's word.
        let state = unsafe { read(state)? };
        // SAFETY: the caller's word.
        let coordinates = unsafe { array_mut(coordinates, coordinates_length)? };
        if state.history().is_empty() {
            return Err(KOOPMAN_ERROR_NOT_READY);
        }
        Ok(Predictor::new(model).coordinates(state, coordinates)?)
    })
}

/// Predicts over a sequence of inputs, `inputs[horizon][m]`, into `predicted[horizon][n]`, and moves
/// the state to the end: copy it first to keep it. `inputs_length` is horizon m, `predicted_length` is
/// horizon n; the two arrays do not overlap.
///
/// On an error the state is at the last step that was done, of which koopman_steps says the number, and
/// the rows of `predicted` up to it are valid, the others untouched.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_rollout(
    model: *const koopman_model_t,
    state: *mut koopman_state_t,
    inputs: *const f32,
    inputs_length: usize,
    predicted: *mut f32,
    predicted_length: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let model = unsafe { loaded(model)? };
        // SAFETY: the caller's word.
        let state = unsafe { initialised(state)? };
        if overlap((inputs, inputs_length), (predicted.cast_const(), predicted_length)) {
            return Err(KOOPMAN_ERROR_OVERLAP);
        }
        // SAFETY: the caller's word.
        let inputs = unsafe { array(inputs, inputs_length)? };
        // SAFETY: the caller's word; no input is among them.
        let predicted = unsafe { array_mut(predicted, predicted_length)? };
        Ok(Predictor::new(model).rollout(state, inputs, predicted)?)
    })
}

/// The same with one input, `input[m]`, held over the whole horizon. `input_length` is m.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_rollout_held(
    model: *const koopman_model_t,
    state: *mut koopman_state_t,
    input: *const f32,
    input_length: usize,
    predicted: *mut f32,
    predicted_length: usize,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let model = unsafe { loaded(model)? };
        // SAFETY: the caller's word.
        let state = unsafe { initialised(state)? };
        if overlap((input, input_length), (predicted.cast_const(), predicted_length)) {
            return Err(KOOPMAN_ERROR_OVERLAP);
        }
        // SAFETY: the caller's word.
        let input = unsafe { array(input, input_length)? };
        // SAFETY: the caller's word; the input is not among them.
        let predicted = unsafe { array_mut(predicted, predicted_length)? };
        Ok(Predictor::new(model).rollout_held(state, input, predicted)?)
    })
}

/// Steps predicted since the last measurement, in `steps`. After KOOPMAN_ERROR_DIVERGED the step that
/// failed is the next one.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_steps(
    state: *const koopman_state_t,
    steps: *mut u32,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let state = unsafe { read(state)? };
        // SAFETY: the caller's word.
        unsafe { put(steps, state.step()) }
    })
}

/// The first step since the last measurement that used a value outside the range that the model was
/// trained in, in `step` (1 is the first step), and the index of the observable that had it, in
/// `observable` (`trainer inspect` lists them). Both are 0 when there was none: a step is never 0.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn koopman_out_of_range(
    state: *const koopman_state_t,
    step: *mut u32,
    observable: *mut u32,
) -> koopman_error_t {
    answer(|| {
        // SAFETY: the caller's word.
        let state = unsafe { read(state)? };
        let (at, which) = state.out_of_range().map_or((0, 0), |out| (out.step, out.observable));
        check(observable, 1)?;
        // SAFETY: the caller's word.
        unsafe { put(step, at)? };
        // An index below 64.
        let which = which as u32;
        // SAFETY: the caller's word.
        unsafe { put(observable, which) }
    })
}
