"""The fast gradient method (Nesterov, 1983) on the augmented cost, projected into the box.

Minimises the same J = J_0 + alpha sum max(Gamma z - gamma, 0)^2 as the ODE-based solver. Variables are scaled by the
Hessian's diagonal, which keeps the projection simple; the step is 1 / L with L the largest eigenvalue of the scaled
Hessian with all rows pushing, an upper bound of the curvature anywhere.

- An iteration is one gradient, one projection, one extrapolation.
- A truncated answer is a point of the box that minimises nothing yet. With momentum J is not monotonic (Definition 1
  of the paper), but nearly; l = 30 (`docs/evidence-solvers.md`). Adaptive restart (O'Donoghue and Candes, 2015) drops
  the momentum when it points uphill.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.computing_settings import FastGradientSettings
from coldloop_optimizer_plc.qp.costs import Matrices, augmented_cost, excess_by_columns, gradient, matrices_of
from coldloop_optimizer_plc.qp.linear_algebra import Array
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Answer, Costs, KernelSolver, solves_by

POWER_ITERATIONS = 200
BOUND_MARGIN = 1.02  # margin on the largest eigenvalue, which power iteration approaches from below


class FastGradientMethod(NamedTuple):
    """Constants of the solver, the same for all problems; step sizes have shape (n,)."""

    matrices: Matrices
    steps: Array
    alpha: float
    adaptive_restart: bool


def fast_gradient_solver(settings: FastGradientSettings) -> KernelSolver:
    """Return the solver, which keeps nothing from one problem to the next."""

    def method(problem: QuadraticProblem) -> FastGradientMethod:
        alpha = problem.phi.dtype.type(settings.alpha)
        steps = step_sizes(problem.Phi, problem.Gamma, alpha)
        return FastGradientMethod(matrices_of(problem), steps, alpha, settings.adaptive_restart)

    return KernelSolver(method, settings.alpha, settings.tau_1_s)


@kernel
def stiffest_hessian(Phi: Array, Gamma: Array, alpha: float) -> Array:
    """Return 2 Phi + 2 alpha Gamma' Gamma, shape (n, n): the Hessian of J where all rows push."""
    two = Phi.dtype.type(2)
    H = two * Phi
    for r in range(Gamma.shape[0]):
        for i in range(H.shape[0]):
            factor = two * alpha * Gamma[r, i]
            if factor != 0:
                for j in range(H.shape[0]):
                    H[i, j] += factor * Gamma[r, j]
    return H


@kernel
def step_sizes(Phi: Array, Gamma: Array, alpha: float) -> Array:
    """Return 1 / (L d), shape (n,): d is the stiffest Hessian's diagonal, L bounds its eigenvalues once scaled."""
    H = stiffest_hessian(Phi, Gamma, alpha)
    n = H.shape[0]
    one, tiny = Phi.dtype.type(1), Phi.dtype.type(1e-12)
    d = np.empty(n, Phi.dtype)
    for i in range(n):
        d[i] = max(H[i, i], tiny)
    v, image = np.ones_like(d), np.empty_like(d)
    largest = tiny
    for _ in range(POWER_ITERATIONS):
        squares = tiny * tiny
        for i in range(n):
            image[i] = 0
            for j in range(n):
                image[i] += H[i, j] / np.sqrt(d[i] * d[j]) * v[j]
            squares += image[i] * image[i]
        largest = np.sqrt(squares)
        for i in range(n):
            v[i] = image[i] / largest
    result = np.empty_like(d)
    for i in range(n):
        result[i] = one / (Phi.dtype.type(BOUND_MARGIN) * largest * d[i])
    return result


@kernel
def descend(c: FastGradientMethod, qp: QuadraticProblem, z: Array, point: Array, t: Array, count: int) -> None:
    """Move z, the point (n,) at which the gradient is taken, and Nesterov's t_k (1,) by `count` iterations."""
    n, half, one, four = z.shape[0], z.dtype.type(0.5), z.dtype.type(1), z.dtype.type(4)
    slope, moved, active = np.empty_like(z), np.empty_like(z), np.empty_like(qp.gamma)
    for _ in range(count):
        gradient(c.matrices, qp, point, excess_by_columns(c.matrices, qp, point), c.alpha, slope, active)
        uphill = z.dtype.type(0)
        for i in range(n):
            reached = min(max(point[i] - c.steps[i] * slope[i], qp.low[i]), qp.high[i])
            moved[i] = reached - z[i]
            uphill += (point[i] - reached) / c.steps[i] * moved[i]
            z[i] = reached
        if c.adaptive_restart and uphill > 0:
            t[0] = 1
        t_next = half * (one + np.sqrt(one + four * t[0] * t[0]))
        weight = (t[0] - one) / t_next
        t[0] = t_next
        point[:] = z + weight * moved


@solves_by(FastGradientMethod)
@kernel
def solve(
    c: FastGradientMethod, qp: QuadraticProblem, guess: Array, counts: NDArray[np.int64], before: Costs  # noqa: ARG001
) -> Answer:  # fmt: skip
    """Return the answer after each count of steps, which begin without momentum."""
    z = np.empty_like(guess)
    for i in range(z.shape[0]):
        z[i] = min(max(guess[i], qp.low[i]), qp.high[i])
    guessed, point, t = augmented_cost(qp, z, c.alpha), z.copy(), np.ones_like(z[:1])
    points, costs = np.empty((counts.shape[0], z.shape[0]), z.dtype), np.empty(counts.shape[0], z.dtype)
    done = 0
    for k in range(counts.shape[0]):
        descend(c, qp, z, point, t, counts[k] - done)
        done = counts[k]
        points[k], costs[k] = z, augmented_cost(qp, z, c.alpha)
    return Answer(guessed, points, costs, counts.copy(), np.empty(0, z.dtype))
