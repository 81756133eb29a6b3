"""The fast gradient method (Nesterov, 1983) on the augmented cost, projected into the box.

Minimises the same J = J_0 + alpha sum max(Gamma z - gamma, 0)^2 as the ODE-based solver. Variables are scaled by the
Hessian's diagonal, which keeps the projection simple; the step is 1 / L with L the largest eigenvalue of the scaled
Hessian with all rows pushing, an upper bound of the curvature anywhere.

- An iteration is one gradient, one projection, one extrapolation.
- A truncated answer is a point of the box that minimises nothing yet. With momentum J is not monotonic (Definition 1
  of the paper), but nearly; l = 30 (`docs/solvers.md`). Adaptive restart (O'Donoghue and Candes, 2015) drops the
  momentum when it points uphill.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.compiled import kernel
from optimizer_plc.computing_settings import FastGradientSettings
from optimizer_plc.costs import Matrices, augmented_cost, gradient, matrices_of
from optimizer_plc.problem import QuadraticProblem
from optimizer_plc.solution import Solution, judge, penalty_multipliers

Array = NDArray[np.float64]

POWER_ITERATIONS = 200
BOUND_MARGIN = 1.02
"""On the largest eigenvalue, which power iteration approaches from below."""


class Momentum(NamedTuple):
    """What is carried from one iteration to the next besides z."""

    extrapolated: Array
    """Point at which the gradient is taken, shape (n,)."""
    t: Array
    """Nesterov's sequence t_k, shape (1,)."""


class FastGradientSolver:
    """Projected gradient steps with momentum."""

    def __init__(self, settings: FastGradientSettings) -> None:
        self.alpha = settings.alpha
        self.tau_1_s = settings.tau_1_s
        self._adaptive_restart = settings.adaptive_restart
        self._source: tuple[Array, Array] | None = None

    def reset(self) -> None:
        """Only the step sizes are kept, which depend on the matrices alone."""

    def start(self, problem: QuadraticProblem, guess: Array) -> None:
        """Begin with `guess` projected into the box, without momentum."""
        self._problem = problem
        self._alpha = problem.phi.dtype.type(self.alpha)
        if self._source is None or problem.Phi is not self._source[0] or problem.Gamma is not self._source[1]:
            self._source, self._matrices = (problem.Phi, problem.Gamma), matrices_of(problem)
            self._steps = step_sizes(problem.Phi, problem.Gamma, self._alpha)
        self._z = np.clip(guess, problem.low, problem.high)
        self._momentum = Momentum(self._z.copy(), np.ones_like(self._z[:1]))

    def iterate(self, count: int) -> int:
        """Take `count` steps."""
        descend(
            self._matrices, self._problem, self._z, self._momentum, self._steps, self._alpha, self._adaptive_restart,
            count,
        )  # fmt: skip
        return count

    @property
    def solution(self) -> Array:
        """The present point, shape (n,)."""
        return self._z.copy()

    @property
    def cost(self) -> float:
        """Augmented cost at the present point."""
        return float(augmented_cost(self._problem, self._z, self._alpha))

    def judged(self) -> Solution:
        """Return `solution` with its residuals; its multipliers are the slopes of the penalties."""
        z = self.solution
        return judge(self._problem, z, self.alpha, penalty_multipliers(self._problem, z, self.alpha))


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
def descend(
    constant: Matrices,
    qp: QuadraticProblem,
    z: Array,
    momentum: Momentum,
    steps: Array,
    alpha: float,
    adaptive_restart: bool,  # noqa: FBT001 a kernel takes its arguments by position
    count: int,
) -> None:
    """Move z and its momentum by `count` iterations."""
    n, half, one, four = z.shape[0], z.dtype.type(0.5), z.dtype.type(1), z.dtype.type(4)
    point, t, slope, moved = momentum.extrapolated, momentum.t, np.empty_like(z), np.empty_like(z)
    active = np.empty_like(qp.gamma)
    for _ in range(count):
        gradient(constant, qp, point, alpha, slope, active)
        uphill = z.dtype.type(0)
        for i in range(n):
            reached = min(max(point[i] - steps[i] * slope[i], qp.low[i]), qp.high[i])
            moved[i] = reached - z[i]
            uphill += (point[i] - reached) / steps[i] * moved[i]
            z[i] = reached
        if adaptive_restart and uphill > 0:
            t[0] = 1
        t_next = half * (one + np.sqrt(one + four * t[0] * t[0]))
        weight = (t[0] - one) / t_next
        t[0] = t_next
        for i in range(n):
            point[i] = z[i] + weight * moved[i]
