"""A throttled primal-dual interior-point method with soft rows (Mehrotra, 1992), cut off after q iterations.

It minimises the same J = J_0 + alpha sum max(Gamma z - gamma, 0)^2 as the ODE-based solver. A row r has the distance
w_r = gamma_r - (Gamma z)_r + lambda_r / (2 alpha) and the multiplier lambda_r; a bound of the box has its distance and
its multiplier. An iteration drives all products of distance and multiplier towards one falling number mu:

    (2 Phi + Gamma' D Gamma + B) dz = -dL/dz, ...    D = lambda / (w + lambda / (2 alpha)) <= 2 alpha

with a predictor and a corrector that share one factorised matrix. Since D is bounded, the matrix is as well conditioned
as that of the ODE-based solver, and single precision suffices.

- Hot start: the guess, moved a little away from its bounds, and on each row the multiplier that puts it on the central
  path for the first mu. So rows are never inconsistent, whatever the iteration after which it is cut off.
- Structure: variables without an upper bound (the slacks) are eliminated first, where the matrix is nearly diagonal;
  zeros of Gamma are left out.
- A truncated answer is the point of lowest J so far, the guess included: it never rises (Definition 1 of the paper).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.computing_settings import InteriorPointSettings
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.linear_algebra import Array, cholesky, cholesky_solve, rounded
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Answer, Costs, KernelSolver, solves_by

Indices = NDArray[np.int64]

SHORT_OF = 0.99  # share of the way to the first bound that a step goes
FINEST = 100.0  # mu, in units of the rounding error of 1, below which there is nothing left to win


class Structure(NamedTuple):
    """The constant matrices, variables in their order of elimination, which is `order` (n,).

    The hessian is 2 Phi (n, n); columns (m, n) are those of each row of Gamma (m, n) that are not zero, rising, and -1.
    """

    order: Indices
    hessian: Array
    Gamma: Array
    columns: Indices


class Point(NamedTuple):
    """Iterate z (n,) in the order of elimination; multipliers of rows (m,) and bounds (n,), 0 where there is none."""

    z: Array
    rows: Array
    low: Array
    high: Array


class InteriorPointMethod(NamedTuple):
    """Constants of the solver, the same for all problems, in their floating-point type.

    softness: of the rows, 1 / (2 alpha). size: number of variables and rows. finest: least mu worth a step.
    """

    structure: Structure
    alpha: float
    softness: float
    first_mu: float
    least_mu: float
    margin: float
    size: float
    finest: float


def method_of(settings: InteriorPointSettings, problem: QuadraticProblem) -> InteriorPointMethod:
    """Return the method for problems with these matrices, in their floating-point type."""
    real = problem.phi.dtype.type
    method = InteriorPointMethod(
        structure_of(problem), settings.alpha, 0.5 / settings.alpha, settings.first_mu, settings.least_mu,
        settings.margin, float(len(problem.phi) + len(problem.gamma)), float(FINEST * np.finfo(real).eps),
    )  # fmt: skip
    return rounded(method, real)


def interior_point_solver(settings: InteriorPointSettings) -> KernelSolver:
    """Return the solver, which keeps nothing from one problem to the next."""
    return KernelSolver(lambda problem: method_of(settings, problem), settings.alpha, settings.tau_1_s)


def structure_of(problem: QuadraticProblem) -> Structure:
    """Return the matrices in the order of elimination, which begins with the variables without upper bound."""
    order = np.argsort(np.isfinite(problem.high), kind="stable")
    Gamma = np.ascontiguousarray(problem.Gamma[:, order])
    columns = np.full(Gamma.shape, -1)
    for r, row in enumerate(Gamma):
        found = np.flatnonzero(row)
        columns[r, : len(found)] = found
    two = problem.Phi.dtype.type(2.0)
    return Structure(order, np.ascontiguousarray(two * problem.Phi[np.ix_(order, order)]), Gamma, columns)


@kernel
def multiply_rows(constant: Structure, z: Array) -> Array:
    """Return Gamma z, shape (m,)."""
    result = np.empty(constant.Gamma.shape[0], z.dtype)
    for r in range(result.shape[0]):
        total = z.dtype.type(0.0)
        for j in constant.columns[r]:
            if j < 0:
                break
            total += constant.Gamma[r, j] * z[j]
        result[r] = total
    return result


@kernel
def add_columns(constant: Structure, weights: Array, result: Array) -> None:
    """Add Gamma' weights to `result` (n,)."""
    for r in range(weights.shape[0]):
        for j in constant.columns[r]:
            if j < 0:
                break
            result[j] += constant.Gamma[r, j] * weights[r]


@kernel
def near(
    constant: Structure, gamma: Array, low: Array, high: Array, guess: Array, softness: float, mu: float, margin: float
) -> Point:  # fmt: skip
    """Return a point near the guess: inside the box, and on each row on the central path for mu."""
    real = guess.dtype.type
    zero, one, two = real(0.0), real(1.0), real(2.0)
    z, of_low, of_high = np.empty_like(guess), np.empty_like(guess), np.zeros_like(guess)
    for i in range(z.shape[0]):
        bounded = np.isfinite(high[i])
        width = high[i] - low[i] if bounded else one
        inside = max(margin * min(width, one), real(1e-6))
        z[i] = max(guess[i], low[i] + inside)
        if bounded:
            z[i] = min(z[i], high[i] - inside) if width > two * inside else low[i] + width / two
            of_high[i] = mu / max(high[i] - z[i], real(1e-6))
        of_low[i] = mu / max(z[i] - low[i], real(1e-6))
    rows = multiply_rows(constant, z)
    for r in range(rows.shape[0]):
        excess = rows[r] - gamma[r]  # w lambda = mu and w = lambda / (2 alpha) - excess
        root = np.sqrt(excess * excess + two * two * softness * mu)
        rows[r] = (excess + root) / (two * softness) if excess > zero else two * mu / (root - excess)
    return Point(z, rows, of_low, of_high)


class Distances(NamedTuple):
    """How far a point is from rows, w (m,), and bounds (n,), infinite where there is none: all are positive."""

    rows: Array
    low: Array
    high: Array


@kernel
def distances(constant: Structure, gamma: Array, low: Array, high: Array, point: Point, softness: float) -> Distances:
    """Return the distances of a point."""
    w = gamma - multiply_rows(constant, point.z) + softness * point.rows
    return Distances(w, point.z - low, high - point.z)


@kernel
def newton_matrix(constant: Structure, point: Point, away: Distances, softness: float) -> Array:
    """Return 2 Phi + Gamma' D Gamma + B, upper triangle."""
    M = constant.hessian.copy()
    for i in range(M.shape[0]):
        M[i, i] += point.low[i] / away.low[i]
        if point.high[i] > 0:
            M[i, i] += point.high[i] / away.high[i]
    for r in range(point.rows.shape[0]):
        weight = point.rows[r] / (away.rows[r] + softness * point.rows[r])
        columns = constant.columns[r]
        for a in range(columns.shape[0]):
            i = columns[a]
            if i < 0:
                break
            factor = weight * constant.Gamma[r, i]
            for b in range(a, columns.shape[0]):
                j = columns[b]
                if j < 0:
                    break
                M[i, j] += factor * constant.Gamma[r, j]
    return M


@kernel
def room(value: Array, change: Array, share: float) -> float:
    """Return the longest step up to `share` after which all positive values are still positive."""
    for i in range(value.shape[0]):
        if value[i] > 0 and value[i] + share * change[i] <= 0:
            share = -value[i] / change[i]
    return share


@kernel
def mean_product(point: Point, away: Distances) -> float:
    """Return mu, the mean product of distance and multiplier."""
    total, count = point.z.dtype.type(0.0), point.rows.shape[0] + point.z.shape[0]
    for r in range(point.rows.shape[0]):
        total += away.rows[r] * point.rows[r]
    for i in range(point.z.shape[0]):
        total += away.low[i] * point.low[i]
        if point.high[i] > 0:
            count += 1
            total += away.high[i] * point.high[i]
    return total / point.z.dtype.type(count)


@kernel
def after(point: Point, change: Point, share: float) -> Point:
    """Return the point after `share` of a change."""
    return Point(
        point.z + share * change.z, point.rows + share * change.rows, point.low + share * change.low,
        point.high + share * change.high,
    )  # fmt: skip


@kernel
def newton_step(
    constant: Structure, U: Array, skyline: NDArray[np.uint64], slope: Array, point: Point, away: Distances,
    products: Distances, softness: float,
) -> tuple[Point, Distances]:  # fmt: skip
    """Return the Newton step that changes the products by `products`, and how the distances change with it."""
    dz, d_low, d_high = -slope, products.low / away.low, products.high.copy()
    of_rows = products.rows / (away.rows + softness * point.rows)
    add_columns(constant, -of_rows, dz)
    for i in range(dz.shape[0]):
        dz[i] += d_low[i]
        if point.high[i] > 0:
            d_high[i] /= away.high[i]
            dz[i] -= d_high[i]
    cholesky_solve(U, skyline, dz)
    moved = multiply_rows(constant, dz)
    of_rows += point.rows * moved / (away.rows + softness * point.rows)
    d_low -= point.low * dz / away.low
    for i in range(dz.shape[0]):
        if point.high[i] > 0:
            d_high[i] += point.high[i] * dz[i] / away.high[i]
    return Point(dz, of_rows, d_low, d_high), Distances(softness * of_rows - moved, dz, -dz)


@kernel
def towards_zero(point: Point, away: Distances) -> Distances:
    """Return by how much the products are to change to vanish."""
    high = np.zeros_like(point.z)
    for i in range(high.shape[0]):
        if point.high[i] > 0:
            high[i] = -(away.high[i] * point.high[i])
    return Distances(-(away.rows * point.rows), -(away.low * point.low), high)


@kernel
def correct(products: Distances, mu: float, point: Point, change: Point, moved: Distances) -> None:
    """Let the products become mu, and make up for what a change adds to them in second order."""
    products.rows[:] += mu - moved.rows * change.rows
    products.low[:] += mu - moved.low * change.low
    for i in range(products.low.shape[0]):
        if point.high[i] > 0:
            products.high[i] += mu - moved.high[i] * change.high[i]


@kernel
def longest(point: Point, away: Distances, change: Point, moved: Distances, share: float) -> float:
    """Return the longest step up to `share` that crosses nothing."""
    share = room(away.rows, moved.rows, room(point.rows, change.rows, share))
    share = room(away.low, moved.low, room(point.low, change.low, share))
    return room(away.high, moved.high, room(point.high, change.high, share))


@kernel
def step(
    constant: Structure, phi: Array, gamma: Array, low: Array, high: Array, point: Point, softness: float, finest: float
) -> tuple[Point, bool]:
    """Return the point after one iteration, and whether there was anything to be won."""
    real = point.z.dtype.type
    one = real(1.0)
    away = distances(constant, gamma, low, high, point, softness)
    mu = mean_product(point, away)
    if not mu > finest:
        return point, False
    slope = phi - point.low + point.high  # of the Lagrangian
    for i in range(slope.shape[0]):
        for j in range(slope.shape[0]):
            slope[j] += constant.hessian[i, j] * point.z[i]
    add_columns(constant, point.rows, slope)
    U = newton_matrix(constant, point, away, softness)
    skyline = cholesky(U)
    products = towards_zero(point, away)
    change, moved = newton_step(constant, U, skyline, slope, point, away, products, softness)
    share = longest(point, away, change, moved, one)
    predicted = after(point, change, share)
    centring = mean_product(predicted, distances(constant, gamma, low, high, predicted, softness)) / mu
    correct(products, mu * centring * centring * centring, point, change, moved)
    change, moved = newton_step(constant, U, skyline, slope, point, away, products, softness)
    share = min(one, real(SHORT_OF) * longest(point, away, change, moved, one / real(SHORT_OF)))
    return after(point, change, share), True


@solves_by(InteriorPointMethod)
@kernel
def solve(
    c: InteriorPointMethod, qp: QuadraticProblem, guess: Array, counts: NDArray[np.int64], before: Costs  # noqa: ARG001
) -> Answer:  # fmt: skip
    """Return the best point after each count of steps, fewer once the products are as small as rounding."""
    best, rows, order = np.empty_like(qp.phi), np.zeros_like(qp.gamma), c.structure.order
    for i in range(best.shape[0]):
        best[i] = min(max(guess[i], qp.low[i]), qp.high[i])
    guessed = augmented_cost(qp, best, c.alpha)
    mu = best.dtype.type(max(c.least_mu, c.first_mu / c.size * (guessed + qp.constant)))
    point = near(c.structure, qp.gamma, qp.low[order], qp.high[order], best[order], c.softness, mu, c.margin)
    phi, low, high = qp.phi[order], qp.low[order], qp.high[order]
    points, costs = np.empty((counts.shape[0], best.shape[0]), best.dtype), np.empty(counts.shape[0], best.dtype)
    iterations, z = np.empty_like(counts), best.copy()
    cost, done, moved = guessed, 0, True
    for k in range(counts.shape[0]):
        while moved and done < counts[k]:
            point, moved = step(c.structure, phi, qp.gamma, low, high, point, c.softness, c.finest)
            if moved:
                done += 1
                z[order] = point.z
                reached = augmented_cost(qp, z, c.alpha)
                if reached < cost:
                    cost = reached
                    best[:], rows[:] = z, point.rows
        points[k], costs[k], iterations[k] = best, cost, done
    return Answer(guessed, points, costs, iterations, rows)
