"""The ODE-based solver (paper, section III): TR-BDF2 along dz/dt = -dJ/dz of the augmented cost.

One iteration is one step of the two-stage method of Bank et al. (1985). Both stages share one factorised matrix and
take one Newton step each; the result is projected into the box. A step that would raise J is rejected and spends its
iteration on a smaller step size, so J never rises (Definition 1 of the paper).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.computing_settings import OdeSettings
from coldloop_optimizer_plc.qp import costs
from coldloop_optimizer_plc.qp.costs import Matrices, matrices_of
from coldloop_optimizer_plc.qp.linear_algebra import Array, Real, cholesky, cholesky_solve, rounded
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.settings import PenaltySettings
from coldloop_optimizer_plc.solvers.interface import Answer, Costs, KernelSolver, solves_by

G = 2.0 - np.sqrt(2.0)  # gamma of TR-BDF2: with this value both stages have the same matrix
C1 = 1.0 / (G * (2.0 - G))
C0 = (1.0 - G) ** 2 * C1
D = G / 2.0
ERROR_CONSTANT = (-3.0 * G * G + 4.0 * G - 2.0) / (12.0 * (2.0 - G))
STATIONARITY = 1e-6  # a step that lowers J by no more than this share of |J| has stalled
STALLED_STEPS = 20  # stalled steps in a row after which z counts as stationary


class Flow(NamedTuple):
    """Constants of the integration: those of `OdeSettings`, and two more.

    box: penalty weight of the box. longest: step size that is never exceeded, far below the largest number there is,
    so that its products stay finite.
    """

    alpha: float
    cost_scale: float
    tolerance: float
    growth: float
    rejection: float
    box: float
    look_ahead_rows: bool
    hold_at_bounds: bool
    longest: float


def flow_in(settings: OdeSettings, penalties: PenaltySettings | None, real: Real) -> Flow:
    """Return the constants as scalars of a floating-point type."""
    box = (penalties or PenaltySettings()).box * settings.alpha
    flow = Flow(
        settings.alpha, settings.cost_scale, settings.tolerance, settings.growth, settings.rejection, box,
        settings.look_ahead_rows, settings.hold_at_bounds, longest=np.sqrt(np.finfo(real).max),
    )  # fmt: skip
    return rounded(flow, real)


class OdeMethod(NamedTuple):
    """Constants of the solver, the same for all problems."""

    matrices: Matrices
    flow: Flow


def ode_solver(settings: OdeSettings, penalties: PenaltySettings | None = None) -> KernelSolver:
    """Return the solver, which keeps nothing from one problem to the next."""
    return KernelSolver(
        lambda problem: OdeMethod(matrices_of(problem), flow_in(settings, penalties, problem.phi.dtype.type)),
        settings.alpha,
        settings.tau_1_s,
    )


@kernel
def velocity(
    constant: Matrices, qp: QuadraticProblem, z: Array, excess: Array, flow: Flow, result: Array, active: Array
) -> None:  # fmt: skip
    """Write dz/dt = -cost_scale dJ/dz into `result` (n,) and which rows push into `active` (m,) as 1.0 or 0.0.

    `excess` (m,) is Gamma z - gamma.
    """
    costs.gradient(constant, qp, z, excess, flow.alpha, result, active)
    zero, two = z.dtype.type(0.0), z.dtype.type(2.0)
    if flow.box > zero:  # the gradient of box sum max(z - high, low - z, 0)^2
        for i in range(z.shape[0]):
            result[i] += two * flow.box * (max(z[i] - qp.high[i], zero) - max(qp.low[i] - z[i], zero))
    for i in range(z.shape[0]):
        result[i] *= -flow.cost_scale


@kernel
def hold_at_bounds(qp: QuadraticProblem, z: Array, v: Array) -> Array:
    """Stop the components of v that would leave the box at z; return which ones (1.0) as a mask (n,)."""
    zero, one = z.dtype.type(0.0), z.dtype.type(1.0)
    held = np.zeros_like(z)
    for i in range(z.shape[0]):
        if (z[i] <= qp.low[i] and v[i] < zero) or (z[i] >= qp.high[i] and v[i] > zero):
            held[i] = one
            v[i] = zero
    return held


@kernel
def decouple(M: Array, held: Array) -> None:
    """Make the rows and columns of held components those of the identity, so that a solve leaves them alone."""
    n = M.shape[0]
    zero, one = M.dtype.type(0.0), M.dtype.type(1.0)
    for i in range(n):
        for j in range(i, n):
            if held[i] + held[j] > zero:
                M[i, j] = one if i == j else zero


@kernel
def warm_start(constant: Matrices, qp: QuadraticProblem, guess: Array, flow: Flow) -> tuple[Array, float, float]:
    """Return the guess inside the box, its cost, and the first step size sqrt(1 / |dz/dt|) there."""
    z = np.empty_like(guess)
    for i in range(z.shape[0]):
        z[i] = min(max(guess[i], qp.low[i]), qp.high[i])
    v = np.empty_like(z)
    excess = costs.excess_by_columns(constant, qp, z)
    velocity(constant, qp, z, excess, flow, v, np.empty_like(qp.gamma))
    total = z.dtype.type(0.0)
    for i in range(v.shape[0]):
        total += v[i] * v[i]
    speed = max(math.sqrt(total), z.dtype.type(1e-12))
    return z, costs.cost_with_excess(constant, qp, z, excess, flow.alpha), math.sqrt(z.dtype.type(1.0) / speed)


@kernel
def stage_matrix(constant: Matrices, qp: QuadraticProblem, in_matrix: Array, dt: float, flow: Flow) -> Array:
    """Return I + (gamma / 2) dt Hess(cost_scale J), upper triangle, with the rows that are 1.0 in `in_matrix` (m,)."""
    n = qp.phi.shape[0]
    M = np.zeros((n, n), qp.phi.dtype)
    zero, one = M.dtype.type(0.0), M.dtype.type(1.0)
    weight = M.dtype.type(D) * dt * flow.cost_scale * M.dtype.type(2.0)
    for i in range(n):
        for j in range(np.uint64(i), constant.Phi.end[i]):
            M[i, j] = weight * qp.Phi[i, j]
        M[i, i] += one
    for r in range(qp.Gamma.shape[0]):
        if in_matrix[r] > zero:
            end = constant.rows.end[r]
            for i in range(constant.rows.first[r], end):
                factor = weight * flow.alpha * qp.Gamma[r, i]
                if factor != zero:
                    for j in range(i, end):
                        M[i, j] += factor * qp.Gamma[r, j]
    return M


@kernel
def descend(
    constant: Matrices, qp: QuadraticProblem, z: Array, look_ahead_rows: Array, cost: float, dt: float, stalled: int,
    count: int, flow: Flow,
) -> tuple[int, int, float, float]:  # fmt: skip
    """Move z by `count` steps, or fewer once it is stationary.

    `look_ahead_rows` (m,) are those that `step` has left for the next step, `stalled` is the number of stalled steps in
    a row up to here. Returns how many were done, the new number of stalled ones, the cost at z and the next step size.
    """
    stationarity = z.dtype.type(STATIONARITY)
    v, active = np.empty_like(z), np.empty_like(qp.gamma)
    velocity(constant, qp, z, costs.excess_by_columns(constant, qp, z), flow, v, active)
    for done in range(count):
        if stalled == STALLED_STEPS:
            return done, stalled, cost, dt
        dt, reached = step(constant, qp, z, v, active, look_ahead_rows, cost, dt, flow)
        stalled = stalled + 1 if cost - reached <= stationarity * abs(cost) else 0
        cost = reached
    return count, stalled, cost, dt


@kernel
def step(
    constant: Matrices, qp: QuadraticProblem, z: Array, v: Array, active: Array, look_ahead_rows: Array, cost: float,
    dt: float, flow: Flow,
) -> tuple[float, float]:  # fmt: skip
    """Move z by one TR-BDF2 step of size dt, or not at all; return the next step size and the cost at z.

    `v` (n,) and `active` (m,) are `velocity` at z, before and after. The matrix has the rows that are active at z or in
    `look_ahead_rows` (m,): those that were active at the middle stage of the step before, which is overwritten by those
    of this one.
    """
    n, real = z.shape[0], z.dtype.type
    v0, vg, v1 = v.copy(), np.empty_like(z), np.empty_like(z)
    in_matrix, active_ahead = active.copy(), np.empty_like(active)
    if flow.look_ahead_rows:
        for r in range(active.shape[0]):
            in_matrix[r] = max(look_ahead_rows[r], active[r])
    held = hold_at_bounds(qp, z, v0) if flow.hold_at_bounds else np.zeros_like(z)
    M = stage_matrix(constant, qp, in_matrix, dt, flow)
    decouple(M, held)
    skyline = cholesky(M)
    change = real(G) * dt * v0
    cholesky_solve(M, skyline, change)
    zg = z + change
    velocity(constant, qp, zg, costs.excess_by_columns(constant, qp, zg), flow, vg, look_ahead_rows)
    for i in range(n):
        vg[i] *= real(1.0) - held[i]
    change = real(C1) * zg - real(C0) * z - zg + real(D) * dt * vg
    cholesky_solve(M, skyline, change)
    candidate = zg + change
    excess = costs.excess_by_columns(constant, qp, candidate)
    velocity(constant, qp, candidate, excess, flow, v1, active_ahead)
    error, inside = real(0.0), True
    for i in range(n):
        curvature = v0[i] / real(G) - vg[i] / real(G * (1.0 - G)) + v1[i] * (real(1.0) - held[i]) / real(1.0 - G)
        local = real(2.0 * ERROR_CONSTANT) * dt * curvature
        error = max(error, abs(local))
        bounded = min(max(candidate[i], qp.low[i]), qp.high[i])
        inside = inside and bounded == candidate[i]
        candidate[i] = bounded
    if not inside:
        excess = costs.excess_by_columns(constant, qp, candidate)
        velocity(constant, qp, candidate, excess, flow, v1, active_ahead)
    reached = costs.cost_with_excess(constant, qp, candidate, excess, flow.alpha)
    if not reached <= cost:
        return dt * flow.rejection, cost
    z[:], v[:], active[:] = candidate, v1, active_ahead
    wanted = (flow.tolerance / max(error, real(1e-12))) ** real(1.0 / 3.0)
    return min(dt * min(flow.growth, max(flow.rejection, wanted)), flow.longest), reached


@kernel
def follow(
    c: OdeMethod, qp: QuadraticProblem, z: Array, guessed: float, dt: float, counts: NDArray[np.int64]
) -> Answer:
    """Return the answer after each count of steps from z, whose cost and first step size are `guessed` and `dt`."""
    points, costs = np.empty((counts.shape[0], z.shape[0]), z.dtype), np.empty(counts.shape[0], z.dtype)
    iterations = np.empty_like(counts)
    look_ahead_rows, cost, stalled, done = np.zeros_like(qp.gamma), guessed, 0, 0
    for k in range(counts.shape[0]):
        if counts[k] > done:
            more, stalled, cost, dt = descend(
                c.matrices, qp, z, look_ahead_rows, cost, dt, stalled, counts[k] - done, c.flow
            )
            done += more
        points[k], costs[k], iterations[k] = z, cost, done
    return Answer(guessed, points, costs, iterations, np.empty(0, z.dtype))


@solves_by(OdeMethod)
@kernel
def solve(c: OdeMethod, qp: QuadraticProblem, guess: Array, counts: NDArray[np.int64], before: Costs) -> Answer:  # noqa: ARG001
    """Return the answer after each count of steps, fewer once z is stationary."""
    z, guessed, dt = warm_start(c.matrices, qp, guess, c.flow)
    return follow(c, qp, z, guessed, dt, counts)
