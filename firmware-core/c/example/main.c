/* Predicts the skid-steered ROSbot in C, and tries everything that a caller may get wrong.
 *
 * Every line printed that does not begin with # is what firmware-core predicts on the host, too: `run`
 * compares them. Numbers are printed as the bits of the float. The exit code is 0 if every call
 * answered what it should.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "board.h"
#include "koopman.h"

/* blob.S */
extern const uint8_t blob[], blob_end[];

#define STATES 3
#define INPUTS 2
#define HORIZON 10

/* A drive of models/skid-rosbot/logs: x and y in m, heading in rad; wheel speeds, right and left, in
   rad/s, that act from then on. */
static const float drive[][STATES + INPUTS] = {
    {0.615334f, 0.874481f, -2.53236f, 0.0f, -9.920999f},
    {0.639258f, 0.892788f, -2.2880077f, 0.0f, -9.920999f},
    {0.657451f, 0.9152f, -2.0319824f, 0.0f, -9.920999f},
    {0.670397f, 0.944002f, -1.7697048f, 6.3824f, -9.920999f},
    {0.672083f, 0.972908f, -1.494237f, 15.955999f, -9.920999f},
    {0.675581f, 0.973767f, -0.9758911f, 15.955999f, -9.920999f},
    {0.684091f, 0.963588f, -0.32828522f, 15.955999f, -9.920999f},
    {0.703685f, 0.960581f, 0.34188843f, 15.955999f, -9.920999f},
};
#define SAMPLES (sizeof drive / sizeof *drive)

static koopman_model_t model;
static koopman_state_t state;

/* Once: checksum, dimensions, finiteness, self-test. The blob is read in place from then on. */
static koopman_error_t start(void) {
    koopman_error_t error = koopman_load(&model, blob, (size_t)(blob_end - blob), "skid-rosbot");
    return error != KOOPMAN_OK ? error : koopman_state_init(&state);
}

/* Every sample time: what was measured, after what was applied. Where will the robot be in ten
   samples with these wheel speeds? */
static koopman_error_t predict(const float applied[INPUTS], const float measured[STATES],
                               const float input[INPUTS], float path[HORIZON][STATES]) {
    koopman_error_t error = koopman_observe(&model, &state, applied, INPUTS, measured, STATES);
    if (error != KOOPMAN_OK) {
        return error;
    }
    koopman_state_t ahead = state;
    return koopman_rollout_held(&model, &ahead, input, INPUTS, path[0], HORIZON * STATES);
}

static int failures;

/* A call that answers something else is printed, and fails the example. */
#define EXPECT(expected, call) expect(expected, call, #call, __LINE__)
static void expect(koopman_error_t expected, koopman_error_t found, const char *call, int line) {
    if (found != expected) {
        printf("# line %d: %s is %s instead of %s\n", line, call, koopman_error_name(found),
               koopman_error_name(expected));
        failures++;
    }
}

#define CHECK(condition) check(condition, #condition, __LINE__)
static void check(bool condition, const char *text, int line) {
    if (!condition) {
        printf("# line %d: not %s\n", line, text);
        failures++;
    }
}

static void print(const char *what, const float *numbers, size_t count) {
    printf("%s", what);
    for (size_t i = 0; i < count; i++) {
        uint32_t bits;
        memcpy(&bits, &numbers[i], sizeof bits);
        printf(" %08lx", (unsigned long)bits);
    }
    printf("\n");
}

static void print_path(float path[HORIZON][STATES]) {
    for (int k = 0; k < HORIZON; k++) {
        printf("# %2d: %7.3f m %7.3f m %7.3f rad\n", k + 1, (double)path[k][0], (double)path[k][1],
               (double)path[k][2]);
        print("predicted", path[k], STATES);
    }
}

/* What the model says of itself. */
static void describe(void) {
    koopman_info_t info;
    char name[24], unit[16];
    EXPECT(KOOPMAN_OK, koopman_info(&model, &info));
    EXPECT(KOOPMAN_OK, koopman_robot(&model, name, sizeof name));
    printf("robot %s lag %lu horizon %lu\n", name, (unsigned long)info.lag,
           (unsigned long)info.horizon);
    print("sample_time_s", &info.sample_time_s, 1);
    print("coverage", &info.coverage, 1);
    CHECK(info.states == STATES && info.inputs == INPUTS && info.lag < SAMPLES);
    for (size_t i = 0; i < info.states; i++) {
        EXPECT(KOOPMAN_OK, koopman_state_name(&model, i, name, sizeof name));
        EXPECT(KOOPMAN_OK, koopman_state_unit(&model, i, unit, sizeof unit));
        printf("state %s %s\n", name, unit);
    }
    for (size_t i = 0; i < info.inputs; i++) {
        float range[2];
        EXPECT(KOOPMAN_OK, koopman_input_name(&model, i, name, sizeof name));
        EXPECT(KOOPMAN_OK, koopman_input_unit(&model, i, unit, sizeof unit));
        EXPECT(KOOPMAN_OK, koopman_input_range(&model, i, &range[0], &range[1]));
        printf("input %s %s\n", name, unit);
        print("range", range, 2);
    }
    for (uint32_t step = 0; step <= info.horizon; step++) {
        float bounds[STATES];
        for (size_t i = 0; i < info.states; i++) {
            EXPECT(KOOPMAN_OK, koopman_error_bound(&model, step, i, &bounds[i]));
        }
        print("bound", bounds, STATES);
    }
}

/* The loop, and how long it takes until the model has seen enough samples. */
static void run(void) {
    static const float input[INPUTS] = {12.0f, 7.0f};
    float applied[INPUTS] = {0.0f}, path[HORIZON][STATES];
    koopman_info_t info;
    EXPECT(KOOPMAN_OK, koopman_info(&model, &info));
    for (size_t k = 0; k < SAMPLES; k++) {
        koopman_error_t ready = k < info.lag ? KOOPMAN_ERROR_NOT_READY : KOOPMAN_OK;
        EXPECT(ready, predict(applied, drive[k], input, path));
        print("applied", applied, INPUTS);
        print("measured", drive[k], STATES);
        if (ready == KOOPMAN_OK) {
            print("held", input, INPUTS);
            print_path(path);
        }
        memcpy(applied, &drive[k][STATES], sizeof applied);
    }

    /* The last path, step by step. */
    koopman_state_t ahead = state;
    for (uint32_t k = 0; k < HORIZON; k++) {
        float coordinates[STATES];
        uint32_t steps;
        EXPECT(KOOPMAN_OK, koopman_step(&model, &ahead, input, INPUTS));
        EXPECT(KOOPMAN_OK, koopman_coordinates(&model, &ahead, coordinates, STATES));
        EXPECT(KOOPMAN_OK, koopman_steps(&ahead, &steps));
        CHECK(memcmp(coordinates, path[k], sizeof coordinates) == 0 && steps == k + 1);
    }

    /* Another input at every step, the last ones faster than any that the model was trained with. */
    float inputs[HORIZON][INPUTS];
    for (int k = 0; k < HORIZON; k++) {
        inputs[k][0] = (float)(2 * k);
        inputs[k][1] = (float)(8 - k);
    }
    uint32_t step, observable;
    ahead = state;
    EXPECT(KOOPMAN_OK, koopman_rollout(&model, &ahead, inputs[0], HORIZON * INPUTS, path[0],
                                       HORIZON * STATES));
    EXPECT(KOOPMAN_OK, koopman_out_of_range(&ahead, &step, &observable));
    print("inputs", inputs[0], HORIZON * INPUTS);
    print_path(path);
    printf("out_of_range %lu %lu\n", (unsigned long)step, (unsigned long)observable);
}

/* Bytes that are not the model. */
static void bad_blobs(void) {
    size_t length = (size_t)(blob_end - blob), found = 0;
    static uint32_t room[512];
    uint8_t *copy = (uint8_t *)room;
    koopman_model_t bad;
    float x[STATES];
    CHECK(length + 4 <= sizeof room);
    memcpy(copy, blob, length);

    EXPECT(KOOPMAN_OK, koopman_load(&bad, copy, length, NULL));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_load(NULL, copy, length, NULL));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_load(NULL, NULL, 0, NULL));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_load(&bad, NULL, length, NULL));
    EXPECT(KOOPMAN_ERROR_NO_MODEL, koopman_coordinates(&bad, &state, x, STATES));
    EXPECT(KOOPMAN_ERROR_MISALIGNED,
           koopman_load((koopman_model_t *)((char *)&bad + 1), copy, length, NULL));
    EXPECT(KOOPMAN_ERROR_ANOTHER_ROBOT, koopman_load(&bad, copy, length, "rosbot"));
    EXPECT(KOOPMAN_ERROR_ANOTHER_ROBOT, koopman_load(&bad, copy, length, "skid-rosbot-2"));
    EXPECT(KOOPMAN_ERROR_ANOTHER_ROBOT, koopman_load(&bad, copy, length, "skid-rosbo"));
    EXPECT(KOOPMAN_ERROR_ANOTHER_ROBOT, koopman_load(&bad, copy, length, ""));
    EXPECT(KOOPMAN_ERROR_TRAILING, koopman_load(&bad, copy, length + 4, NULL));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_load(&bad, copy, SIZE_MAX, NULL));
    EXPECT(KOOPMAN_ERROR_OVERLAP, koopman_load((koopman_model_t *)room, copy, length, NULL));
    memcpy(copy, blob, length);
    for (size_t shorter = 0; shorter < length; shorter++) {
        EXPECT(KOOPMAN_ERROR_TRUNCATED, koopman_load(&bad, copy, shorter, NULL));
    }
    for (size_t offset = 1; offset < 4; offset++) {
        memmove(copy + offset, blob, length);
        EXPECT(KOOPMAN_ERROR_MISALIGNED, koopman_load(&bad, copy + offset, length, NULL));
    }
    memcpy(copy, blob, length);
    for (size_t at = 0; at < length; at++) {
        for (int bit = 0; bit < 8; bit++) {
            copy[at] ^= (uint8_t)(1 << bit);
            koopman_error_t error = koopman_load(&bad, copy, length, NULL);
            CHECK(error >= 32 && error < 64);
            CHECK(at < 16 || error == KOOPMAN_ERROR_CHECKSUM);
            EXPECT(KOOPMAN_ERROR_NO_MODEL, koopman_coordinates(&bad, &state, x, STATES));
            copy[at] ^= (uint8_t)(1 << bit);
        }
    }
    EXPECT(KOOPMAN_OK, koopman_load(&bad, copy, length, NULL));
    EXPECT(KOOPMAN_OK, koopman_blob_length(copy, sizeof room, &found));
    CHECK(found == length);
    EXPECT(KOOPMAN_ERROR_TRUNCATED, koopman_blob_length(copy, 15, &found));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_blob_length(NULL, 16, &found));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_blob_length(copy, length, NULL));
    EXPECT(KOOPMAN_ERROR_MAGIC, koopman_blob_length(copy + 4, length - 4, &found));
}

/* Arguments that are not what the model asks for. */
static void bad_arguments(void) {
    static koopman_model_t zeros;
    static koopman_state_t blank;
    koopman_state_t fresh, before = state;
    koopman_info_t info;
    float x[STATES] = {0}, u[INPUTS] = {0}, path[HORIZON * STATES], low, high;
    const float *odd = (const float *)((const char *)path + 1);
    char name[4];
    uint32_t number;

    EXPECT(KOOPMAN_ERROR_NO_MODEL, koopman_info(&zeros, &info));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_info(NULL, &info));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_info(&model, NULL));
    EXPECT(KOOPMAN_ERROR_BUFFER, koopman_robot(&model, name, sizeof name));
    EXPECT(KOOPMAN_ERROR_BUFFER, koopman_robot(&model, name, 0));
    EXPECT(KOOPMAN_ERROR_BUFFER, koopman_state_name(&model, 2, name, 3));
    EXPECT(KOOPMAN_OK, koopman_state_name(&model, 2, name, 4));
    CHECK(strcmp(name, "phi") == 0);
    EXPECT(KOOPMAN_ERROR_NULL, koopman_state_unit(&model, 0, NULL, 4));
    EXPECT(KOOPMAN_ERROR_INDEX, koopman_state_name(&model, STATES, name, sizeof name));
    EXPECT(KOOPMAN_ERROR_INDEX, koopman_input_unit(&model, SIZE_MAX, name, sizeof name));
    EXPECT(KOOPMAN_ERROR_INDEX, koopman_input_range(&model, INPUTS, &low, &high));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_input_range(&model, 0, &low, NULL));
    EXPECT(KOOPMAN_ERROR_INDEX, koopman_error_bound(&model, 1, STATES, &low));
    EXPECT(KOOPMAN_ERROR_NO_BOUND, koopman_error_bound(&model, UINT32_MAX, 0, &low));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_error_bound(&model, 1, 0, NULL));

    EXPECT(KOOPMAN_ERROR_NULL, koopman_state_init(NULL));
    EXPECT(KOOPMAN_ERROR_NO_STATE, koopman_step(&model, &blank, u, INPUTS));
    EXPECT(KOOPMAN_ERROR_NO_STATE, koopman_steps(&blank, &number));
    EXPECT(KOOPMAN_OK, koopman_state_init(&fresh));
    EXPECT(KOOPMAN_ERROR_NOT_READY, koopman_coordinates(&model, &fresh, x, STATES));
    EXPECT(KOOPMAN_OK, koopman_observe(&model, &fresh, NULL, 0, x, STATES));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_observe(&model, &fresh, NULL, 0, x, STATES));
    EXPECT(KOOPMAN_OK, koopman_coordinates(&model, &fresh, x, STATES));
    EXPECT(KOOPMAN_ERROR_NOT_READY, koopman_step(&model, &fresh, u, INPUTS));
    EXPECT(KOOPMAN_ERROR_NOT_READY, koopman_rollout_held(&model, &fresh, u, INPUTS, path, STATES));

    EXPECT(KOOPMAN_ERROR_NULL, koopman_observe(&model, NULL, u, INPUTS, x, STATES));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_observe(&model, &state, NULL, INPUTS, x, STATES));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_observe(&model, &state, u, INPUTS, NULL, STATES));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_observe(&model, &state, NULL, 0, x, STATES));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_observe(&model, &state, u, INPUTS, x, STATES - 1));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_observe(&model, &state, u, SIZE_MAX, x, STATES));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_observe(&model, &state, u, SIZE_MAX / 4, x, STATES));
    EXPECT(KOOPMAN_ERROR_MISALIGNED, koopman_observe(&model, &state, odd, INPUTS, x, STATES));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_step(&model, &state, NULL, INPUTS));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_step(&model, &state, u, 1));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_step(&model, &state, NULL, 0));
    EXPECT(KOOPMAN_ERROR_MISALIGNED, koopman_step(&model, &state, odd, INPUTS));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_coordinates(&model, &state, x, 2));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_coordinates(&model, &state, NULL, STATES));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_rollout_held(&model, &state, u, INPUTS, path, 7));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_rollout_held(&model, &state, u, 3, path, STATES));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_rollout_held(&model, &state, u, INPUTS, NULL, STATES));
    EXPECT(KOOPMAN_ERROR_LENGTH, koopman_rollout(&model, &state, u, INPUTS, path, 2 * STATES));
    EXPECT(KOOPMAN_ERROR_OVERLAP, koopman_rollout(&model, &state, path + 2, 2, path, STATES));
    EXPECT(KOOPMAN_ERROR_NULL, koopman_out_of_range(&state, &number, NULL));

    /* Numbers that are none. */
    x[1] = NAN;
    EXPECT(KOOPMAN_ERROR_NOT_FINITE, koopman_observe(&model, &state, u, INPUTS, x, STATES));
    x[1] = INFINITY;
    EXPECT(KOOPMAN_ERROR_NOT_FINITE, koopman_observe(&model, &state, u, INPUTS, x, STATES));
    x[1] = 0.0f;
    u[1] = NAN;
    EXPECT(KOOPMAN_ERROR_INPUT_NOT_FINITE, koopman_observe(&model, &state, u, INPUTS, x, STATES));
    EXPECT(KOOPMAN_ERROR_INPUT_NOT_FINITE, koopman_step(&model, &state, u, INPUTS));
    EXPECT(KOOPMAN_ERROR_INPUT_NOT_FINITE,
           koopman_rollout_held(&model, &state, u, INPUTS, path, STATES));
    u[1] = 1e30f;
    EXPECT(KOOPMAN_ERROR_DIVERGED, koopman_step(&model, &state, u, INPUTS));

    /* None of them has moved the state. */
    float present[STATES];
    EXPECT(KOOPMAN_OK, koopman_coordinates(&model, &state, present, STATES));
    EXPECT(KOOPMAN_OK, koopman_steps(&state, &number));
    EXPECT(KOOPMAN_OK, koopman_coordinates(&model, &before, x, STATES));
    CHECK(memcmp(present, x, sizeof x) == 0 && number == 0);
}

/* For the stack they take. */
static void load(void) {
    EXPECT(KOOPMAN_OK, koopman_load(&model, blob, (size_t)(blob_end - blob), "skid-rosbot"));
}

static void observe(void) {
    EXPECT(KOOPMAN_OK,
           koopman_observe(&model, &state, &drive[0][STATES], INPUTS, drive[1], STATES));
}

static void step(void) {
    EXPECT(KOOPMAN_OK, koopman_step(&model, &state, &drive[0][STATES], INPUTS));
}

static void roll_out(void) {
    static float path[HORIZON * STATES];
    EXPECT(KOOPMAN_OK, koopman_rollout_held(&model, &state, &drive[0][STATES], INPUTS, path,
                                            HORIZON * STATES));
}

int main(void) {
    koopman_error_t error = start();
    if (error != KOOPMAN_OK) {
        printf("# %s\n", koopman_error_name(error));
        return 1;
    }
    describe();
    run();
    bad_blobs();
    bad_arguments();
    printf("# bytes: koopman_model_t %u, koopman_state_t %u\n", (unsigned)sizeof model,
           (unsigned)sizeof state);
    printf("# bytes of stack: load %u, observe %u, step %u, rollout %u\n", (unsigned)stack_of(load),
           (unsigned)stack_of(observe), (unsigned)stack_of(step), (unsigned)stack_of(roll_out));
    if (failures > 0) {
        printf("# %d failed\n", failures);
        return 1;
    }
    return 0;
}
