"""Operations of one iteration of each solver, and of the preparation, as functions of the sizes.

Convention, the same for the Cholesky factorisation that the PLC's speed was measured with: an addition, subtraction,
multiplication, division, square root or power is one operation; comparisons, minima, maxima, signs, masks and
indices are none. Bytes are single-precision matrix elements read or written, pass by pass; vectors are left out.
n variables, m rows of Gamma, a of them active; matrices are dense.
"""

from typing import NamedTuple

WORD = 4
"""Bytes of a number."""


class Operations(NamedTuple):
    """Arithmetic operations, and bytes of matrices moved."""

    flops: float
    bytes: float = 0.0

    def plus(self, *others: "Operations") -> "Operations":
        """Return this and then the others."""
        every = (self, *others)
        return Operations(sum(one.flops for one in every), sum(one.bytes for one in every))

    def times(self, count: float) -> "Operations":
        """Return this `count` times."""
        return Operations(self.flops * count, self.bytes * count)


def matrix_vector(rows: float, columns: float) -> Operations:
    """Return those of y += A x."""
    return Operations(2 * rows * columns, WORD * rows * columns)


def cholesky(n: float) -> Operations:
    """Return those of `linear_algebra.cholesky`: n^3/3 + n^2/2 + 7n/6."""
    return Operations(n**3 / 3 + n**2 / 2 + 7 * n / 6, WORD * (3 * (n**3 - n) / 6 + n**2))


def cholesky_solve(n: float) -> Operations:
    """Return those of both triangular solves."""
    return Operations(2 * n**2, WORD * (n**2 + n))


def gradient(n: float, m: float, active: float) -> Operations:
    """Return those of the gradient of the augmented cost."""
    rows = Operations(2 * n + 2, WORD * n).times(active)
    return matrix_vector(n, n).plus(matrix_vector(m, n), rows, Operations(3 * n))


def augmented_cost(n: float, m: float, active: float) -> Operations:
    """Return those of the augmented cost."""
    return matrix_vector(n, n).plus(matrix_vector(m, n), Operations(2 * n + 2 * active + 2))


def stage_matrix(n: float, active: float) -> Operations:
    """Return those of I + w Hess(J), upper triangle."""
    triangle = n * (n + 1) / 2
    row = Operations(2 * n + 2 * triangle, WORD * (2 * n + 3 * triangle))
    return Operations(3 + triangle + n, 2 * WORD * triangle).plus(row.times(active))


def ode(n: float, m: float, active: float) -> Operations:
    """Return those of one step of TR-BDF2 that is accepted, with the same rows active at its three points."""
    vectors = Operations(18 * n + 5)  # two stages 11n + 2, error 7n, next step size 3
    return gradient(n, m, active).times(3).plus(
        stage_matrix(n, active), cholesky(n), cholesky_solve(n).times(2), augmented_cost(n, m, active), vectors
    )  # fmt: skip


def ode_kept(n: float, m: float, active: float) -> Operations:
    """Return those of the same step after another one: its first velocity and the cost's Gamma z are known."""
    known = gradient(n, m, active).plus(matrix_vector(m, n))
    return ode(n, m, active).plus(known.times(-1))


def qpoases(n: float, m: float, active: float) -> Operations:
    """Return those of one working-set change of a dense null-space active-set method with `active` constraints fixed.

    After Ferreau et al., qpOASES: a parametric active-set algorithm (Math. Prog. Comp. 6, 2014), and Gill et al.,
    Procedures for optimization problems with a mixture of bounds and general linear constraints (ACM TOMS 10, 1984):
    products with Q = (Z Y) and H, solves with T and the Cholesky factor R of Z' H Z, the steps of all rows and of
    the multipliers for the ratio test, then plane rotations (6 operations a pair) of Q, T and R.
    """
    free = n - active
    direction = matrix_vector(n, n).times(3).plus(matrix_vector(active, active), matrix_vector(free, free))
    ratio_test = matrix_vector(m, n).plus(matrix_vector(n, active), Operations(2 * (n + m)))
    rotated = free * n + (active**2 + free**2) / 2
    return direction.plus(ratio_test, Operations(6 * rotated, 4 * WORD * rotated))


def osqp(n: float, m: float) -> Operations:
    """Return those of one ADMM iteration; rows are those of Gamma and the n bounds.

    After Stellato et al., OSQP (Math. Prog. Comp. 12, 2020), algorithm 1. The rows' diagonal block is eliminated first,
    so L has the rows' elements and a dense triangle.
    """
    rows = m + n
    elements = n * m + n + n * (n - 1) / 2
    return Operations(4 * elements + (n + rows), 2 * WORD * elements).plus(Operations(5 * n + 14 * rows))


def fast_gradient(n: float, m: float, active: float) -> Operations:
    """Return those of one gradient step of the augmented cost with momentum; its projection only compares."""
    return gradient(n, m, active).plus(Operations(5 * n))


class SparseRows(NamedTuple):
    """Elements of Gamma that are not zero: k_r in row r."""

    elements: float
    """Their number: the sum of k_r."""
    pairs: float
    """The sum of k_r (k_r + 1) / 2: elements of the upper triangle that the rows add to."""


def slacks_first(n: float, slacks: int, chains: int) -> Operations:
    """Return those of `linear_algebra.cholesky` where the first `slacks` variables are `chains` tridiagonal blocks.

    Each is coupled with the next one of its chain, `chains` places on, and with all variables behind the slacks.
    """
    dense = n - slacks
    flops = bytes_moved = 0.0
    for k in range(slacks):
        neighbour = 2 * (n - k - chains) if k + chains < slacks else 0.0
        flops += n - k + 1 + neighbour + dense * (dense + 1)
        bytes_moved += WORD * (2 * (n - k) + 1.5 * (neighbour + dense * (dense + 1)))
    return Operations(flops, bytes_moved).plus(cholesky(dense))


def interior_point(n: float, m: float, bounded: float, rows: SparseRows, factorisation: Operations) -> Operations:
    """Return those of one predictor and corrector step; `bounded` variables have an upper bound, too.

    With each step the augmented cost is computed, which is not part of this.
    """
    bounds = n + bounded
    through = Operations(2 * rows.elements, WORD * rows.elements)  # Gamma z, or Gamma' lambda
    away = through.plus(Operations(3 * m + 2 * n))
    mean = Operations(2 * (m + bounds) + 1)
    gradient = matrix_vector(n, n).plus(through, Operations(2 * n))
    matrix = Operations(2 * bounds + 3 * m + rows.elements + 2 * rows.pairs, 2 * WORD * (rows.pairs + n * n / 2))
    solve = through.times(2).plus(cholesky_solve(n), Operations(10 * m + 5 * bounds))
    products = Operations(4 * (m + bounds) + 4)
    reach = Operations(2 * (2 * m + 2 * n + n + bounded))
    moves = Operations(2 * (3 * n + m)).plus(reach).times(2)
    return away.times(2).plus(mean.times(2), gradient, matrix, factorisation, solve.times(2), products, moves)


def daqp(n: float, m: float, active: float) -> Operations:
    """Return those of one working-set change of a dual active-set method with an LDL' factor of size `active`.

    After Arnstroem, Bemporad, Axehill, A dual active-set solver for embedded quadratic programming using recursive
    LDL' updates (IEEE TAC 67, 2022): the new row of M M', its row of L, two solves, u = M' lambda, and all rows' slack.
    """
    update = matrix_vector(active, n).plus(matrix_vector(active, active).times(0.5))
    direction = matrix_vector(active, active).plus(matrix_vector(n, active), Operations(4 * active))
    return update.plus(direction, matrix_vector(m + n, n))


class PreparationSizes(NamedTuple):
    """Sizes of what happens once an updating period."""

    n: int
    rows: int
    rate_rows: int
    knots: int
    states: int
    inputs: int
    outputs: int
    segments: int
    """Runs of equal inputs in the updating period."""
    samples: int
    """Sampling periods in a sequence."""


def preparation(sizes: PreparationSizes, active: float) -> Operations:
    """Return those of the Kalman correction, J_k, the prediction, the instance, the shift, the start, the sequence."""
    n, m, states = sizes.n, sizes.rows, sizes.states
    correct = _response(sizes.outputs, sizes).plus(
        matrix_vector(states + 1, sizes.outputs), Operations(states + sizes.inputs + 2 * sizes.outputs + 4)
    )
    predict = _response(states, sizes).times(sizes.segments)
    start = gradient(n, m, active).plus(Operations(2 * n + 2))
    sequence = matrix_vector(sizes.samples * sizes.inputs, sizes.knots).plus(
        Operations(4 * sizes.samples * sizes.inputs)
    )
    costs = augmented_cost(n, m, active).times(2)
    return correct.plus(predict, instance(sizes).times(2), matrix_vector(n, n), costs, start, sequence)


def instance(sizes: PreparationSizes) -> Operations:
    """Return those of phi, gamma, the bounds and the constant."""
    s = sizes.states + 1
    maps = matrix_vector(sizes.n, s).plus(matrix_vector(sizes.rows - sizes.rate_rows, s), matrix_vector(s, s))
    return maps.plus(
        matrix_vector(sizes.rate_rows, sizes.inputs), Operations(sizes.rate_rows + 4 * sizes.inputs + 2 * s)
    )


def _response(results: int, sizes: PreparationSizes) -> Operations:
    """Return those of A x + B u + F w."""
    return matrix_vector(results, sizes.states + sizes.inputs).plus(Operations(results, WORD * results))
