@GENERATED@
#include <float.h>
#include <stdio.h>
#include <string.h>

#include "golden.h"
#include "limits.h"
#include "output_guard.h"

static int failures = 0;

static void report(const char *what, int32_t call) {
    failures += 1;
    if (failures <= 10) {
        printf(call >= 0 ? "%s of golden call %ld differs\n" : "%s\n", what, (long)call);
    }
}

static void check_platform(void) {
    volatile double large = 9007199254740992.0;
    volatile double sum = large + 1.0;
    volatile float smallest = FLT_MIN;
    volatile float half = smallest / 2;
    if (!(half > 0)) {
        report("this platform takes the smallest numbers for zero (flush to zero)", -1);
    }
    if (sizeof(double) != 8 || FLT_EVAL_METHOD != 0 || sum != large) {
        report("this platform computes with another precision than that of double (FLT_EVAL_METHOD)", -1);
    }
}

static uint32_t sum_of_floats(uint32_t sum, const float *values, int32_t count) {
    for (int32_t i = 0; i < count; i += 1) {
        int32_t bits;
        memcpy(&bits, &values[i], sizeof bits);
        sum = sum_of_integers(sum, &bits, 1);
    }
    return sum;
}

static void check_constants(void) {
    if (sum_of_constants() != SUM_OF_CONSTANTS) {
        report("a limit or a literal is not what was written", -1);
    }
    uint32_t sum = sum_of_integers(0, &golden_integers[0][0], N_GOLDEN * GOLDEN_INTEGERS);
    sum = sum_of_floats(sum, &golden_reals[0][0], N_GOLDEN * 2 * N_INPUTS);
    sum = sum_of_floats(sum, &golden_rows[0][0], N_GOLDEN_ROWS * N_INPUTS);
    if (sum != SUM_OF_GOLDEN) {
        report("a golden call is not what was written", -1);
    }
}

static void check_call(int32_t place) {
    const int32_t *n = golden_integers[place];
    const float *given = golden_reals[place], *expected = given + N_INPUTS;
    float applied[N_INPUTS];
    bool accepted = true;
    memcpy(applied, expected, sizeof applied);
    switch (n[0]) {
    case 0:
        accepted = guard_restart(given);
        break;
    case 1:
        accepted = guard_scan(n[1], n[2] != 0, given, applied);
        break;
    case 2:
        accepted = guard_resume(n[1], given);
        break;
    default:
        if ((int32_t)guard_judge(n[1], &golden_rows[n[6] + n[5]], n[3], n[4], &golden_rows[n[6]], n[5]) != n[2]) {
            report("the judgement", place);
        }
    }
    if (!accepted || memcmp(applied, expected, sizeof applied) != 0) {
        report("what is applied", place);
    }
}

int main(void) {
    check_platform();
    check_constants();
    if (failures > 0) { /* what follows may go anywhere */
        return 1;
    }
    for (int32_t place = 0; place < N_GOLDEN; place += 1) {
        check_call(place);
    }
    printf("%d golden calls, %d failures\n", N_GOLDEN, failures);
    return failures == 0 ? 0 : 1;
}
