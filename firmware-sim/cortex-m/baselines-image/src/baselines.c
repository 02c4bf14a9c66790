/* One prediction as it is written from the formula: the lift is the Kronecker product of [1, v] of all six
   variables, the first one slowest, and the outputs are the operator times the lift. Compiled once for each
   LEVEL of optimisation, which becomes part of the names. */

#define VARIABLES 6
#define TERMS 64
#define OUTPUTS 4

#define JOIN(name, level) name##_##level
#define AT(name, level) JOIN(name, level)

/* A loop for each variable. */
static void naive_lift(const float v[VARIABLES], float lift[TERMS]) {
    float h[VARIABLES][2];
    for (int i = 0; i < VARIABLES; i++) {
        h[i][0] = 1.0f;
        h[i][1] = v[i];
    }
    int t = 0;
    for (int a = 0; a < 2; a++) {
        for (int b = 0; b < 2; b++) {
            for (int c = 0; c < 2; c++) {
                for (int d = 0; d < 2; d++) {
                    for (int e = 0; e < 2; e++) {
                        for (int f = 0; f < 2; f++) {
                            lift[t++] = h[0][a] * h[1][b] * h[2][c] * h[3][d] * h[4][e] * h[5][f];
                        }
                    }
                }
            }
        }
    }
}

/* Every variable, from the last one on, doubles the terms that there are: one product for each term. */
static void doubling_lift(const float v[VARIABLES], float lift[TERMS]) {
    lift[0] = 1.0f;
    int terms = 1;
    for (int i = VARIABLES - 1; i >= 0; i--) {
        for (int t = 0; t < terms; t++) {
            lift[terms + t] = v[i] * lift[t];
        }
        terms *= 2;
    }
}

static void product(const float operator[OUTPUTS][TERMS], const float lift[TERMS], float out[OUTPUTS]) {
    for (int o = 0; o < OUTPUTS; o++) {
        float sum = 0.0f;
        for (int t = 0; t < TERMS; t++) {
            sum += operator[o][t] * lift[t];
        }
        out[o] = sum;
    }
}

void AT(naive, LEVEL)(const float v[VARIABLES], const float operator[OUTPUTS][TERMS], float out[OUTPUTS]) {
    float lift[TERMS];
    naive_lift(v, lift);
    product(operator, lift, out);
}

void AT(doubling, LEVEL)(const float v[VARIABLES], const float operator[OUTPUTS][TERMS], float out[OUTPUTS]) {
    float lift[TERMS];
    doubling_lift(v, lift);
    product(operator, lift, out);
}

#ifdef CMSIS
#include "dsp/matrix_functions.h"

void AT(cmsis_vector, LEVEL)(const float v[VARIABLES], const float operator[OUTPUTS][TERMS], float out[OUTPUTS]) {
    float lift[TERMS];
    doubling_lift(v, lift);
    /* The library reads the operator only, but knows no constant matrices. */
    arm_matrix_instance_f32 a = {OUTPUTS, TERMS, (float *)operator[0]};
    arm_mat_vec_mult_f32(&a, lift, out);
}

void AT(cmsis_matrix, LEVEL)(const float v[VARIABLES], const float operator[OUTPUTS][TERMS], float out[OUTPUTS]) {
    float lift[TERMS];
    doubling_lift(v, lift);
    arm_matrix_instance_f32 a = {OUTPUTS, TERMS, (float *)operator[0]};
    arm_matrix_instance_f32 b = {TERMS, 1, lift}, c = {OUTPUTS, 1, out};
    arm_mat_mult_f32(&a, &b, &c);
}
#endif
