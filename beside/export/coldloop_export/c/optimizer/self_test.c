@GENERATED@
#include <float.h>
#include <stdio.h>
#include <string.h>

#include "constants.h"
#include "golden.h"
#include "optimizer.h"

static int failures = 0;

static void report(const char *what, int32_t update) {
    failures += 1;
    if (failures <= 10) {
        printf(update >= 0 ? "%s of golden update %ld differs\n" : "%s\n", what, (long)update);
    }
}

static void check_platform(void) {
    volatile float smallest = FLT_MIN;
    volatile float half = smallest / 2;
    if (FLT_EVAL_METHOD != 0) {
        report("this platform computes with more precision than a number has (FLT_EVAL_METHOD)", -1);
    }
    if (!(half > 0)) {
        report("this platform takes the smallest numbers for zero (flush to zero)", -1);
    }
}

static void check_constants(void) {
    if (sum_of_constants() != SUM_OF_CONSTANTS) {
        report("a constant or a literal is not what was written", -1);
    }
    uint32_t sum = sum_of_integers(0, &golden_integers[0][0], N_GOLDEN * GOLDEN_INTEGERS);
    sum = sum_of_reals(sum, &golden_reals[0][0], N_GOLDEN * GOLDEN_REALS);
    sum = sum_of_reals(sum, &golden_rows[0][0], N_GOLDEN_ROWS * N_INPUTS);
    if (sum != SUM_OF_GOLDEN) {
        report("a golden vector is not what was written", -1);
    }
}

static bool same(const float *one, const float *other, int32_t count) {
    return memcmp(one, other, (size_t)count * sizeof *one) == 0;
}

/* Check an update; `rows` are those of its sequence. Return how many they are. */
static int32_t check_update(int32_t place, const float (*rows)[N_INPUTS]) {
    const int32_t *n = golden_integers[place];
    const float *r = golden_reals[place];
    Update update = {.update = n[1], .tick = n[2], .playing = n[3], .load = r[0]};
    Plan plan;
    static Sequence sequence;
    memcpy(update.u_before, r + 1, sizeof update.u_before);
    memcpy(update.u, r + 1 + N_INPUTS, sizeof update.u);
    memcpy(update.y, r + 1 + 2 * N_INPUTS, sizeof update.y);
    memcpy(update.x, r + 1 + 2 * N_INPUTS + N_OUTPUTS, sizeof update.x);
    const float *planned = r + 1 + 2 * N_INPUTS + N_OUTPUTS + N_STATES;
    if (n[0] >= 0 && !optimizer_restart(n[0])) {
        report("the session", place);
    }
    if (!optimizer_plan(&update, &plan) || plan.update != n[1] || plan.next_update_tick != n[4] ||
        plan.suspects != n[5] || !same(&plan.load_step, planned, 1) || !same(&plan.shortage, planned + 1, 1)) {
        report("the plan", place);
    }
    if (n[9] == 0) { /* it was interrupted before its sequence was computed */
        return 0;
    }
    if (!optimizer_solve(&sequence) || sequence.number != n[6] || sequence.update != n[1] ||
        sequence.first_tick != n[7] || sequence.tau_u != n[8] || sequence.length != n[9] ||
        !same(&sequence.rows[0][0], &rows[0][0], n[9] * N_INPUTS)) {
        report("the sequence", place);
    }
    return n[9];
}

int main(void) {
    check_platform();
    check_constants();
    if (failures > 0) { /* what follows may go anywhere */
        return 1;
    }
    int32_t row = 0;
    for (int32_t place = 0; place < N_GOLDEN; place += 1) {
        row += check_update(place, &golden_rows[row]);
    }
    printf("%d golden updates, %d failures\n", N_GOLDEN, failures);
    return failures == 0 ? 0 : 1;
}
