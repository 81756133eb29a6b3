@GENERATED@
#include <float.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

#include "golden.h"
#include "problem.h"
#include "tables.h"

static int failures = 0;
static double took_us = 0;

static void report(const char *what, int32_t vector, int32_t place) {
    failures += 1;
    if (vector >= 0) {
        printf("%s of golden vector %ld differs first at element %ld\n", what, (long)vector, (long)place);
    } else {
        printf("%s\n", what);
    }
}

static void compare(const char *what, int32_t vector, const @REAL@ *got, const @REAL@ *expected, int32_t count) {
    for (int32_t i = 0; i < count; i += 1) {
        if (memcmp(&got[i], &expected[i], sizeof got[i]) != 0) {
            report(what, vector, i);
            return;
        }
    }
}

static void check_platform(void) {
    volatile @REAL@ smallest = @SMALLEST@;
    volatile @REAL@ half = smallest / 2;
    if (FLT_EVAL_METHOD != 0) {
        report("this platform computes with more precision than a number has (FLT_EVAL_METHOD)", -1, 0);
    }
    if (!(half > 0)) {
        report("this platform takes the smallest numbers for zero (flush to zero)", -1, 0);
    }
}

static void check_constants(void) {
    if (sum_of_constants() != SUM_OF_CONSTANTS) {
        report("a constant or a literal is not what was written", -1, 0);
    }
    uint32_t sum = sum_of_reals(0, golden_phi, N_GOLDEN * N_VARIABLES);
    sum = sum_of_reals(sum, golden_gamma, N_GOLDEN * N_ROWS);
    sum = sum_of_reals(sum, golden_low, N_GOLDEN * N_VARIABLES);
    sum = sum_of_reals(sum, golden_high, N_GOLDEN * N_VARIABLES);
    sum = sum_of_reals(sum, golden_guess, N_GOLDEN * N_VARIABLES);
    sum = sum_of_reals(sum, golden_guessed, N_GOLDEN);
    sum = sum_of_reals(sum, golden_points, N_GOLDEN * N_COUNTS * N_VARIABLES);
    sum = sum_of_reals(sum, golden_costs, N_GOLDEN * N_COUNTS);
    sum = sum_of_integers(sum, golden_iterations, N_GOLDEN * N_COUNTS);
    if (sum != SUM_OF_GOLDEN) {
        report("a golden vector is not what was written", -1, 0);
    }
}

static void check_vector(int32_t vector) {
    static @REAL@ points[N_COUNTS * N_VARIABLES], costs[N_COUNTS];
    static int32_t iterations[N_COUNTS];
    @REAL@ guessed;
    const clock_t begun = clock();
    solve_problem(
        &golden_phi[vector * N_VARIABLES], &golden_gamma[vector * N_ROWS], &golden_low[vector * N_VARIABLES],
        &golden_high[vector * N_VARIABLES], &golden_guess[vector * N_VARIABLES], &guessed, points, costs, iterations);
    took_us += 1e6 * (double)(clock() - begun) / (double)CLOCKS_PER_SEC;
    compare("the cost of the guess", vector, &guessed, &golden_guessed[vector], 1);
    compare("the profile", vector, points, &golden_points[vector * N_COUNTS * N_VARIABLES], N_COUNTS * N_VARIABLES);
    compare("the cost", vector, costs, &golden_costs[vector * N_COUNTS], N_COUNTS);
    for (int32_t i = 0; i < N_COUNTS; i += 1) {
        if (iterations[i] != golden_iterations[vector * N_COUNTS + i]) {
            report("the number of iterations", vector, i);
            return;
        }
    }
}

int main(void) {
    check_platform();
    check_constants();
    if (failures > 0) { /* what follows may go anywhere */
        return 1;
    }
    for (int32_t vector = 0; vector < N_GOLDEN; vector += 1) {
        check_vector(vector);
    }
    printf("%.0f us for the %d iterations\n", took_us, N_GOLDEN * N_COUNTS);
    printf("%d golden vectors, %d failures\n", N_GOLDEN, failures);
    return failures == 0 ? 0 : 1;
}
