"""Operations of one iteration of each solver, and of the preparation, as functions of the sizes.

Convention, the same for the Cholesky factorisation that the PLC's speed was measured with: an addition, subtraction,
multiplication, division, square root or power is one operation; comparisons, minima, maxima, signs, masks and
indices are none. Bytes are single-precision matrix elements read or written, pass by pass; vectors are left out.
The sizes say which elements count: all, or those that can be non-zero. Active rows are mean ones.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.settings import SolverName

Array = NDArray[np.float64] | NDArray[np.int64]
Pattern = NDArray[np.bool_]


class QpSizes(NamedTuple):
    """Sizes of a QP on which the operations of an iteration depend."""

    n: int
    """Variables."""
    m: int
    """Rows of Gamma."""
    bounded: int
    """Variables with an upper bound; all have a lower one."""
    Phi: int
    """Elements of Phi."""
    Gamma: int
    """Elements of Gamma."""
    outer: int
    """Elements on and above the diagonal of g g', summed over the rows g' of Gamma."""
    factor: NDArray[np.int64]
    """Elements right of the diagonal, row by row, of the Cholesky factor of Phi + Gamma' Gamma, shape (n,)."""
    transformed: int
    """Elements of (I; Gamma) R^-1, where R is the Cholesky factor of Phi."""

    @property
    def triangle(self) -> float:
        """Elements on and above the diagonal of Phi."""
        return (self.Phi + self.n) / 2

    @property
    def row(self) -> float:
        """Elements of a mean row of Gamma."""
        return self.Gamma / self.m


def sizes_without_zeros(Phi: Array, Gamma: Array, bounded: Pattern) -> QpSizes:
    """Return the sizes with the zeros of Phi and Gamma left out; `bounded` (n,) are variables with an upper bound."""
    order = np.argsort(bounded, kind="stable")
    quadratic, rows = (Phi != 0)[np.ix_(order, order)], (Gamma != 0)[:, order]
    lengths = rows.sum(axis=1)
    inverse = inverse_pattern(factor_pattern(quadratic))
    return QpSizes(
        n=len(Phi), m=len(Gamma), bounded=int(bounded.sum()),
        Phi=int(quadratic.sum()), Gamma=int(rows.sum()), outer=int((lengths * (lengths + 1)).sum()) // 2,
        factor=factor_pattern(quadratic | (rows.T @ rows)).sum(axis=1) - 1,
        transformed=int(inverse.sum() + (rows @ inverse).sum()),
    )  # fmt: skip


def dense_sizes(n: int, m: int, bounded: int) -> QpSizes:
    """Return the sizes of a problem without zeros."""
    return sizes_without_zeros(np.ones((n, n)), np.ones((m, n)), np.arange(n) >= n - bounded)


def factor_pattern(pattern: Pattern) -> Pattern:
    """Return where the Cholesky factor U, U' U = A, of a matrix with this pattern (n, n) can be non-zero."""
    filled = pattern.copy()
    for k in range(len(filled)):
        row = k + np.flatnonzero(filled[k, k:])
        filled[np.ix_(row, row)] = True
    return np.asarray(np.triu(filled))


def inverse_pattern(upper: Pattern) -> Pattern:
    """Return where the inverse of an upper triangular matrix with this pattern (n, n) can be non-zero."""
    inverse = np.eye(len(upper), dtype=bool)
    for i in reversed(range(len(upper))):
        inverse[i] |= inverse[upper[i]].any(axis=0)
    return inverse


WORD = 4
"""Bytes of a number."""


class ActiveRows(NamedTuple):
    """Rows of Gamma in the ODE solver's stage matrix."""

    mean: float
    worst: float


ACTIVE_ROWS = ActiveRows(mean=2.5, worst=31.0)
"""Measured in the closed loop over hours a to f, tau_u = 5 s; the hourly means are 0.7 to 4.4 (`docs/budget.md`)."""
WORKING_SET = 25.0
"""Constraints assumed in the working set of the active-set methods: half of the variables."""


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


def product(elements: float) -> Operations:
    """Return those of y += A x, where A has so many elements."""
    return Operations(2 * elements, WORD * elements)


def cholesky(factor: Array) -> Operations:
    """Return those of a factorisation U' U = A, where the rows of U have so many elements right of the diagonal, (n,).

    Row by row: a root, a reciprocal, the row, and its outer product with itself, subtracted from the rows below.
    """
    return Operations(
        float((2 + 2 * factor + factor**2).sum()), WORD * float((1.5 * factor * (factor + 1) + 2 * factor + 1).sum())
    )


def dense_cholesky(n: float) -> Operations:
    """Return those of a dense factorisation: n^3/3 + n^2/2 + 7n/6."""
    return cholesky(np.arange(n))


def cholesky_solve(factor: Array) -> Operations:
    """Return those of both triangular solves."""
    n, elements = len(factor), float(factor.sum())
    return Operations(4 * elements + 2 * n, 2 * WORD * (elements + n))


def gradient(s: QpSizes, active: float) -> Operations:
    """Return those of the gradient of the augmented cost."""
    rows = Operations(2 * s.row + 2, WORD * s.row).times(active)
    return product(s.Phi).plus(product(s.Gamma), rows, Operations(2 * s.n))


def augmented_cost(s: QpSizes, active: float) -> Operations:
    """Return those of the augmented cost."""
    return product(s.Phi).plus(product(s.Gamma), Operations(2 * s.n + 2 * active + 2))


def ode(s: QpSizes, active: float = ACTIVE_ROWS.mean) -> Operations:
    """Return those of one step of TR-BDF2 that is accepted, with the same rows active at its three points."""
    velocity, outer = gradient(s, active).plus(Operations(s.n)), s.outer / s.m
    row = Operations(2 * s.row + 2 * outer, WORD * (2 * s.row + 3 * outer))  # of I + w Hess(J), its upper triangle
    matrix = Operations(3 + s.triangle + s.n, 2 * WORD * s.triangle).plus(row.times(active))
    vectors = Operations(18 * s.n + 5)  # two stages 11n + 2, error 7n, next step size 3
    solved = cholesky_solve(s.factor).times(2)
    return velocity.times(3).plus(matrix, cholesky(s.factor), solved, augmented_cost(s, active), vectors)


def ode_kept(s: QpSizes, active: float) -> Operations:
    """Return those of the same step after another one: its first velocity and the cost's Gamma z are known."""
    known = gradient(s, active).plus(Operations(s.n), product(s.Gamma))
    return ode(s, active).plus(known.times(-1))


def qpoases(s: QpSizes, active: float = WORKING_SET) -> Operations:
    """Return those of one working-set change of a null-space active-set method with `active` constraints fixed.

    After Ferreau et al., qpOASES: a parametric active-set algorithm (Math. Prog. Comp. 6, 2014), and Gill et al.,
    Procedures for optimization problems with a mixture of bounds and general linear constraints (ACM TOMS 10, 1984):
    products with Q = (Z Y) and H, solves with T and the Cholesky factor R of Z' H Z, the steps of all rows and of
    the multipliers for the ratio test, then plane rotations (6 operations a pair) of Q, T and R, which are dense.
    """
    n, free = s.n, s.n - active
    direction = product(n * n).times(2).plus(product(s.Phi), product(active**2), product(free**2))
    ratio_test = product(s.Gamma).plus(product(n * active), Operations(2 * (n + s.m)))
    rotated = free * n + (active**2 + free**2) / 2
    return direction.plus(ratio_test, Operations(6 * rotated, 4 * WORD * rotated))


def osqp(s: QpSizes) -> Operations:
    """Return those of one ADMM iteration; rows are those of Gamma and the n bounds.

    After Stellato et al., OSQP (Math. Prog. Comp. 12, 2020), algorithm 1. The rows' diagonal block is eliminated first,
    so L has the rows' elements and the factor of what is left.
    """
    rows = s.m + s.n
    elements = s.Gamma + s.n + float(s.factor.sum())
    return Operations(4 * elements + (s.n + rows), 2 * WORD * elements).plus(Operations(5 * s.n + 14 * rows))


def fast_gradient(s: QpSizes, active: float = ACTIVE_ROWS.mean) -> Operations:
    """Return those of one gradient step of the augmented cost with momentum; its projection only compares."""
    return gradient(s, active).plus(Operations(9 * s.n + 8))


def interior_point(s: QpSizes, active: float = ACTIVE_ROWS.mean) -> Operations:
    """Return those of one predictor and corrector step, and of the augmented cost after it."""
    n, m = s.n, s.m
    bounds = n + s.bounded
    through = product(s.Gamma)  # Gamma z, or Gamma' lambda
    away = through.plus(Operations(3 * m + 2 * n))
    mean = Operations(2 * (m + bounds) + 1)
    slope = product(s.Phi).plus(through, Operations(2 * n))
    matrix = Operations(2 * bounds + 3 * m + s.Gamma + 2 * s.outer, 2 * WORD * (s.outer + s.triangle))
    solve = through.times(2).plus(cholesky_solve(s.factor), Operations(10 * m + 5 * bounds))
    products = Operations(4 * (m + bounds) + 4)
    reach = Operations(2 * (2 * m + 2 * n + bounds))
    moves = Operations(2 * (3 * n + m)).plus(reach).times(2)
    return away.times(2).plus(
        mean.times(2), slope, matrix, cholesky(s.factor), solve.times(2), products, moves, augmented_cost(s, active)
    )


def daqp(s: QpSizes, active: float = WORKING_SET) -> Operations:
    """Return those of one working-set change of a dual active-set method with an LDL' factor of size `active`.

    After Arnstroem, Bemporad, Axehill, A dual active-set solver for embedded quadratic programming using recursive
    LDL' updates (IEEE TAC 67, 2022), with M = (I; Gamma) R^-1: the new row of M M', its row of L, two solves,
    u = M' lambda, and all rows' slack.
    """
    held = product(active * s.transformed / (s.m + s.n))
    update = held.plus(product(active**2).times(0.5))
    direction = product(active**2).plus(held, Operations(4 * active))
    return update.plus(direction, product(s.transformed))


class PreparationSizes(NamedTuple):
    """Sizes of what is computed once in an updating period."""

    problem: QpSizes
    rate_rows: int
    knots: int
    states: int
    inputs: int
    outputs: int
    targets: bool
    """Whether the cost is about a target that is sought."""
    limited: bool
    """Whether there is a limit of the feed, by two outputs that are estimated."""
    apart: int = 0
    """Predictions without the watched reading, beside the filter's."""


def preparation(sizes: PreparationSizes, active: float) -> Operations:
    """Return those of the Kalman correction, J_k, the prediction, the instance, the shift, the start, the sequence.

    Inputs are equal in the updating period, and in the sequence, which is of one sampling period.
    """
    n, states = sizes.problem.n, sizes.states
    correct = _response(sizes.outputs, sizes).plus(
        product((states + 1) * sizes.outputs), Operations(states + sizes.inputs + 2 * sizes.outputs + 4)
    )
    predict = _response(states, sizes)
    apart = correct.plus(Operations(2 * sizes.outputs + 1), predict).times(sizes.apart)
    start = gradient(sizes.problem, active).plus(Operations(3 * n + 2))
    sequence = product(sizes.inputs * sizes.knots).plus(Operations(4 * sizes.inputs))
    costs = augmented_cost(sizes.problem, active).times(2)
    sought = target(sizes.inputs) if sizes.targets else Operations(0)
    limit = _response(2, sizes).plus(Operations(13)) if sizes.limited else Operations(0)
    once = (product(n * n), costs, start, sequence, sought, limit)
    return correct.plus(predict, apart, instance(sizes).times(2), *once)


def instance(sizes: PreparationSizes) -> Operations:
    """Return those of phi, gamma, the bounds and the constant."""
    s = sizes.states + 1
    output_rows = sizes.problem.m - sizes.rate_rows
    maps = product(sizes.problem.n * s).plus(product(output_rows * s), product(s * s))
    if sizes.targets:
        about = Operations(4 * sizes.inputs * sizes.knots + sizes.inputs)
        maps = maps.plus(product(sizes.inputs * s), product(sizes.inputs * sizes.problem.n), about)
    return maps.plus(product(sizes.rate_rows * sizes.inputs), Operations(sizes.rate_rows + 4 * sizes.inputs + 2 * s))


def target(inputs: int) -> Operations:
    """Return those of a target: all points of its plane where up to two bounds meet, of inputs and outlet."""
    rows = inputs + 1
    bounds, corners = 2 * rows, 2 * rows * (rows - 1)
    judged = 5 * rows + 3
    plane = Operations(judged + bounds * (judged + 3) + 3 * rows + corners * (judged + 11))
    return plane.plus(Operations(3 * rows + 15 * inputs + 3))


def _response(results: int, sizes: PreparationSizes) -> Operations:
    """Return those of A x + B u + F w."""
    return product(results * (sizes.states + sizes.inputs)).plus(Operations(results, WORD * results))


class SolverCount(NamedTuple):
    """An iteration of a solver, with the usual number of active rows or of constraints held."""

    operations: Callable[[QpSizes], Operations]
    default: str
    """Source of the default of `tau_1_s`."""
    paper_s: float | None = None
    """Time of an iteration in the paper, s; None if the paper has none."""


SOLVERS: Final = {
    SolverName.ODE: SolverCount(ode, "paper", 0.25),
    SolverName.QPOASES: SolverCount(qpoases, "paper", 0.48),
    SolverName.OSQP: SolverCount(osqp, "dense"),
    SolverName.FAST_GRADIENT: SolverCount(fast_gradient, "dense"),
    SolverName.INTERIOR_POINT: SolverCount(interior_point, "our code"),
    SolverName.HYBRID: SolverCount(lambda sizes: max(ode(sizes), interior_point(sizes)), "the longer one"),
    SolverName.DAQP: SolverCount(daqp, "one solve in 5 s"),
}


class ProblemSizes(NamedTuple):
    """Dimensions of process and design from which the sizes of a problem follow."""

    knots: int
    inputs: int
    outputs: int
    bands: int
    constraints: int
    """Constraint instants."""
    states: int
    """States of the estimator: those of the model, of the estimated biases and of the load."""


COLD_BOX_SIZES: Final = ProblemSizes(knots=7, inputs=3, outputs=22, bands=2, constraints=14, states=49)


def iteration_shares(sizes: ProblemSizes) -> dict[str, float]:
    """Return the time of each solver's iteration, and of the preparation, over those of the cold box's problem.

    Dense operations are counted in both, with the cold box's number of active rows.
    """
    counts: list[dict[str, float]] = []
    for knots, inputs, outputs, bands, constraints, states in (sizes, COLD_BOX_SIZES):
        moves = knots * inputs
        problem = dense_sizes(moves + 2 * bands * knots, 2 * (bands * constraints + moves), moves)
        once = PreparationSizes(problem, 2 * moves, knots, states, inputs, outputs, targets=False, limited=False)
        solvers = {str(name): each for name, each in SOLVERS.items() if name is not SolverName.HYBRID}
        counts.append({name: each.operations(problem).flops for name, each in solvers.items()})
        counts[-1]["preparation"] = preparation(once, ACTIVE_ROWS.mean).flops
    here, there = counts
    return {name: here[name] / there[name] for name in here}
