/*
 * koopman.h: a robot's motion, predicted on its own microcontroller from a learned Koopman model.
 *
 * Load a model once, observe every sample, predict with a copy of the state; errors are to be looked at:
 *
 *     static koopman_model_t model;
 *     static koopman_state_t state;
 *     koopman_load(&model, blob, blob_length, "my-robot");
 *     koopman_state_init(&state);
 *
 *     koopman_observe(&model, &state, applied, 2, measured, 3);        every sample time
 *     koopman_state_t ahead = state;
 *     koopman_rollout_held(&model, &ahead, input, 2, path[0], 30);     ten steps of path[10][3]
 *
 * Units     Coordinates and inputs are in the units that the model names (koopman_state_unit), angles
 *           in rad, the sample time in s. A step is one sample time.
 * Shapes    Arrays of float, rows of steps one after the other: predicted[horizon][n]. Every array
 *           comes with its length, the number of floats in it, which has to be the one that the model
 *           asks for. n is the number of state coordinates, m that of inputs (koopman_info).
 * Memory    All of it is the caller's: nothing is allocated, and the library has no variables. Models
 *           and states are objects of a known size, which may be copied; their fields are private. The
 *           blob is read in place, at an address divisible by 4, and stays the caller's.
 * Threads   The library has no locks and needs none. A model may be shared once it is loaded; a state
 *           belongs to one loop at a time, so give every loop and interrupt its own.
 * Time      No function waits or repeats without a bound. koopman_load reads every byte of the blob a
 *           few times; a step takes what `trainer inspect` and the README say; a rollout takes its
 *           horizon of steps.
 * Stack     koopman_load takes 2.2 KB on a Cortex-M4F with a sparse model and 3.3 KB with a dense one,
 *           everything else 600 B and 1.5 KB; firmware-core/c/run prints it.
 * Checks    Every pointer and length is checked as far as it can be: NULL, alignment, length. That the
 *           memory is there and that no one else writes to it during the call is for the caller. A
 *           model or a state with nothing in it is recognised by a mark that is not there; other memory
 *           is not likely to have it, and memory of zeros, such as static objects, never does.
 * Panics    There are none. Rust wants a handler, so the library has one, which would loop for ever; no
 *           function gets to it, and a linker with --gc-sections leaves it out.
 * Build     The floats are in registers of the floating-point unit: compile for the ABI that the
 *           library is built for (thumbv7em-none-eabihf: -mfloat-abi=hard) and switch the unit on.
 */

#ifndef KOOPMAN_H
#define KOOPMAN_H

/* Made by cbindgen from firmware-core/c/src; see firmware-core/c/tests/header.rs. */

#include <stddef.h>
#include <stdint.h>

/*
 Pointers and sizes in a koopman_model_t.
 */
#define KOOPMAN_MODEL_POINTERS 93

/*
 Further words of 32 bits in it.
 */
#define KOOPMAN_MODEL_WORDS 579

/*
 Pointers and sizes in a koopman_state_t.
 */
#define KOOPMAN_STATE_POINTERS 4

/*
 Further words of 32 bits in it.
 */
#define KOOPMAN_STATE_WORDS 308

/*
 What a function answers: KOOPMAN_OK, which is 0, or why it did nothing. 1 to 31 are about the
 arguments, 32 to 63 about the blob, 64 and above about the prediction. Numbers keep their meaning.
 */
enum koopman_error_t
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     It is done.
     */
    KOOPMAN_OK = 0,
    /*
     A pointer is NULL that must not be.
     */
    KOOPMAN_ERROR_NULL = 1,
    /*
     A pointer does not have the alignment of its type; that of a blob is 4.
     */
    KOOPMAN_ERROR_MISALIGNED = 2,
    /*
     A length is not the one that the model asks for, or no array has it.
     */
    KOOPMAN_ERROR_LENGTH = 3,
    /*
     What is read and what is written overlap.
     */
    KOOPMAN_ERROR_OVERLAP = 4,
    /*
     There is no model in the koopman_model_t: koopman_load was not called or failed.
     */
    KOOPMAN_ERROR_NO_MODEL = 5,
    /*
     There is no state in the koopman_state_t: koopman_state_init was not called.
     */
    KOOPMAN_ERROR_NO_STATE = 6,
    /*
     There is no state coordinate or input with this index.
     */
    KOOPMAN_ERROR_INDEX = 7,
    /*
     The text and its end do not fit into the buffer.
     */
    KOOPMAN_ERROR_BUFFER = 8,
    /*
     Fewer bytes than the blob has.
     */
    KOOPMAN_ERROR_TRUNCATED = 32,
    /*
     More bytes than the blob has.
     */
    KOOPMAN_ERROR_TRAILING = 33,
    /*
     The bytes are no blob.
     */
    KOOPMAN_ERROR_MAGIC = 34,
    /*
     The blob has a format that this library does not read.
     */
    KOOPMAN_ERROR_VERSION = 35,
    /*
     The blob has been damaged.
     */
    KOOPMAN_ERROR_CHECKSUM = 36,
    /*
     The sections of the blob do not hold together, one is missing, unknown, or has a wrong length.
     */
    KOOPMAN_ERROR_SECTIONS = 37,
    /*
     The metadata of the blob cannot be decoded.
     */
    KOOPMAN_ERROR_METADATA = 38,
    /*
     The model is larger than this library has room for, or has something that it does not know.
     */
    KOOPMAN_ERROR_UNSUPPORTED = 39,
    /*
     The parts of the blob do not make a model.
     */
    KOOPMAN_ERROR_MODEL = 40,
    /*
     The error bounds of the blob are none.
     */
    KOOPMAN_ERROR_BOUNDS = 41,
    /*
     The prediction stored in the blob is not reproduced.
     */
    KOOPMAN_ERROR_SELF_TEST = 42,
    /*
     The model belongs to another robot.
     */
    KOOPMAN_ERROR_ANOTHER_ROBOT = 43,
    /*
     The model looks at earlier samples that have not been observed yet.
     */
    KOOPMAN_ERROR_NOT_READY = 64,
    /*
     A measured coordinate is NaN or infinite.
     */
    KOOPMAN_ERROR_NOT_FINITE = 65,
    /*
     An input is NaN or infinite.
     */
    KOOPMAN_ERROR_INPUT_NOT_FINITE = 66,
    /*
     The prediction left the finite numbers, a limit of the model, or the circle.
     */
    KOOPMAN_ERROR_DIVERGED = 67,
    /*
     The model has no error bound for this step.
     */
    KOOPMAN_ERROR_NO_BOUND = 68,
    /*
     Something else; this library has no number for it.
     */
    KOOPMAN_ERROR_OTHER = 127,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum koopman_error_t koopman_error_t;
#else
typedef int32_t koopman_error_t;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 A Koopman model, checked when it was loaded. The memory is the caller's; what is in it is the
 library's. It refers to the blob, and no prediction changes it: any number of states, also
 of several threads, may use it at once. It may be copied and simply forgotten.
 */
typedef struct {
    size_t pointers[KOOPMAN_MODEL_POINTERS];
    uint32_t words[KOOPMAN_MODEL_WORDS];
} koopman_model_t;

/*
 What a model looks like.
 */
typedef struct {
    /*
     State coordinates, n.
     */
    uint32_t states;
    /*
     Inputs, m.
     */
    uint32_t inputs;
    /*
     The oldest sample that a prediction looks at, in samples before the present one: lag + 1
     samples are to be observed before the first step.
     */
    uint32_t lag;
    /*
     The last step that koopman_error_bound has an answer for; 0 if the model has no error bounds.
     */
    uint32_t horizon;
    /*
     The share of measurements within the error bounds, between 0 and 1; 0 if there are none.
     */
    float coverage;
    /*
     Time between samples, in s.
     */
    float sample_time_s;
} koopman_info_t;

/*
 All that moves while a predictor works: the samples that a prediction looks at, measured or
 predicted. The memory is the caller's; what is in it is the library's. A copy (`ahead = state`) is
 a state of its own. It belongs to the model that it has observed with: initialise it anew before
 another one uses it.
 */
typedef struct {
    size_t pointers[KOOPMAN_STATE_POINTERS];
    uint32_t words[KOOPMAN_STATE_WORDS];
} koopman_state_t;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/*
 The name of an error, as it is written in this header; "unknown" for any other number. The text is
 part of the library and ends with NUL.
 */
const char *koopman_error_name(int32_t error);

/*
 Loads the model of a blob: checks its checksum, its dimensions and its numbers, and predicts the
 prediction that is stored in it.

 `blob` points to `length` bytes, exactly the blob, at an address divisible by 4. They are read in
 place, now and by every prediction: they must stay where they are, unchanged, as long as the model
 is used. `robot` is the name of the robot that this is, and a model of another one is refused; NULL
 takes any.

 On an error there is no model in `model`.
 */
koopman_error_t koopman_load(koopman_model_t *model,
                             const void *blob,
                             size_t length,
                             const char *robot);

/*
 The length of the blob at the beginning of `slot`, `length` bytes of flash or anything else, as its
 first bytes say, in `blob_length`: what koopman_load asks for. Only koopman_load says whether it is
 a blob.
 */
koopman_error_t koopman_blob_length(const void *slot, size_t length, size_t *blob_length);

/*
 The shape of the model, its sample time and its error bounds.
 */
koopman_error_t koopman_info(const koopman_model_t *model, koopman_info_t *info);

/*
 The name of the robot that the model belongs to, in UTF-8 and with NUL, in `buffer` of `size`
 bytes. When it does not fit, nothing is written.
 */
koopman_error_t koopman_robot(const koopman_model_t *model, char *buffer, size_t size);

/*
 The name of state coordinate `index`, from 0, such as "phi"; `buffer` as in koopman_robot.
 */
koopman_error_t koopman_state_name(const koopman_model_t *model,
                                   size_t index,
                                   char *buffer,
                                   size_t size);

/*
 The unit of state coordinate `index`, such as "m"; `buffer` as in koopman_robot.
 */
koopman_error_t koopman_state_unit(const koopman_model_t *model,
                                   size_t index,
                                   char *buffer,
                                   size_t size);

/*
 The name of input `index`, from 0, such as "omega_r"; `buffer` as in koopman_robot.
 */
koopman_error_t koopman_input_name(const koopman_model_t *model,
                                   size_t index,
                                   char *buffer,
                                   size_t size);

/*
 The unit of input `index`, such as "rad/s"; `buffer` as in koopman_robot.
 */
koopman_error_t koopman_input_unit(const koopman_model_t *model,
                                   size_t index,
                                   char *buffer,
                                   size_t size);

/*
 What the actuator of input `index` accepts, from `low` to `high`, in the unit of the input.
 */
koopman_error_t koopman_input_range(const koopman_model_t *model,
                                    size_t index,
                                    float *low,
                                    float *high);

/*
 How far the measured coordinate `index` may be from the predicted one after `step` steps without a
 measurement, in its unit, in `bound`: with the probability `coverage` of koopman_info_t it is not
 further. 0 for step 0; KOOPMAN_ERROR_NO_BOUND beyond the horizon of koopman_info_t. The difference
 of angles is to be taken the short way round.
 */
koopman_error_t koopman_error_bound(const koopman_model_t *model,
                                    uint32_t step,
                                    size_t index,
                                    float *bound);

/*
 A state that has observed nothing yet; also to forget everything.
 */
koopman_error_t koopman_state_init(koopman_state_t *state);

/*
 Takes a measurement: `coordinates[n]` in the units of the model (angles in rad, any turn), after
 `applied[m]` acted for one sample time. `coordinates_length` is n and `applied_length` is m. Before
 the first measurement nothing was applied: `applied` may be NULL and its length 0.

 On an error the state is unchanged.
 */
koopman_error_t koopman_observe(const koopman_model_t *model,
                                koopman_state_t *state,
                                const float *applied,
                                size_t applied_length,
                                const float *coordinates,
                                size_t coordinates_length);

/*
 Predicts one sample time ahead under `input[m]` and moves the state there. `input_length` is m.

 On an error the state is unchanged.
 */
koopman_error_t koopman_step(const koopman_model_t *model,
                             koopman_state_t *state,
                             const float *input,
                             size_t input_length);

/*
 The present coordinates in `coordinates[n]`: measured or predicted, whichever came last; predicted
 angles from -pi to pi. `coordinates_length` is n. KOOPMAN_ERROR_NOT_READY before the first measurement.
 */
koopman_error_t koopman_coordinates(const koopman_model_t *model,
                                    const koopman_state_t *state,
                                    float *coordinates,
                                    size_t coordinates_length);

/*
 Predicts over a sequence of inputs, `inputs[horizon][m]`, into `predicted[horizon][n]`, and moves
 the state to the end: copy it first to keep it. `inputs_length` is horizon m, `predicted_length` is
 horizon n; the two arrays do not overlap.

 On an error the state is at the last step that was done, of which koopman_steps says the number, and
 the rows of `predicted` up to it are valid, the others untouched.
 */
koopman_error_t koopman_rollout(const koopman_model_t *model,
                                koopman_state_t *state,
                                const float *inputs,
                                size_t inputs_length,
                                float *predicted,
                                size_t predicted_length);

/*
 The same with one input, `input[m]`, held over the whole horizon. `input_length` is m.
 */
koopman_error_t koopman_rollout_held(const koopman_model_t *model,
                                     koopman_state_t *state,
                                     const float *input,
                                     size_t input_length,
                                     float *predicted,
                                     size_t predicted_length);

/*
 Steps predicted since the last measurement, in `steps`. After KOOPMAN_ERROR_DIVERGED the step that
 failed is the next one.
 */
koopman_error_t koopman_steps(const koopman_state_t *state, uint32_t *steps);

/*
 The first step since the last measurement that used a value outside the range that the model was
 trained in, in `step` (1 is the first step), and the index of the observable that had it, in
 `observable` (`trainer inspect` lists them). Both are 0 when there was none: a step is never 0.
 */
koopman_error_t koopman_out_of_range(const koopman_state_t *state,
                                     uint32_t *step,
                                     uint32_t *observable);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* KOOPMAN_H */
