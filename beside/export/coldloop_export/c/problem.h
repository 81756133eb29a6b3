@GENERATED@
#ifndef PROBLEM_H
#define PROBLEM_H

#include <stdint.h>

#define N_VARIABLES @N@
#define N_ROWS @M@
#define N_COUNTS @K@

/* The answer after @FIRST@ to @LAST@ iterations. */
void solve_problem(
    const @REAL@ phi[N_VARIABLES], const @REAL@ gamma[N_ROWS], const @REAL@ low[N_VARIABLES],
    const @REAL@ high[N_VARIABLES], const @REAL@ guess[N_VARIABLES], @REAL@ *guessed,
    @REAL@ points[N_COUNTS * N_VARIABLES], @REAL@ costs[N_COUNTS], int32_t iterations[N_COUNTS]);

#endif
