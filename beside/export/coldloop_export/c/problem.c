@GENERATED@
#include <math.h>
#include <string.h>

#include "problem.h"
#include "tables.h"

@SUMS_OF_BYTES@
uint32_t sum_of_constants(void) {
    uint32_t sum = sum_of_reals(0, literals, N_LITERALS);
@SUMS@
    return sum;
}

void solve_problem(
    const @REAL@ phi[N_VARIABLES], const @REAL@ gamma_[N_ROWS], const @REAL@ low[N_VARIABLES],
    const @REAL@ high[N_VARIABLES], const @REAL@ guess[N_VARIABLES], @REAL@ *guessed,
    @REAL@ points[N_COUNTS * N_VARIABLES], @REAL@ costs[N_COUNTS], int32_t iterations[N_COUNTS]) {
    OdeMethod method;
    Costs before;
    QuadraticProblem qp;
@METHOD@
@BEFORE@
    qp.Phi = Phi;
    qp.Gamma = Gamma;
@VECTORS@
    qp.constant = 0;
    solve(&method, &qp, guess, counts, &before, guessed, points, costs, iterations);
}
