"""A solver's answer that judges itself: costs, violation and the residuals of the optimality conditions."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.qp.problem import QuadraticProblem

Array = NDArray[np.float64]

CONTACT = 1e-7
"""Distance within which a variable touches its bound: the precision of the exact solvers."""


class Solution(NamedTuple):
    """A profile z, judged for min J_0(z) = z' Phi z + z' phi under Gamma z <= gamma and low <= z <= high.

    Costs are without the problem's constant. At an optimum both residuals and the gap are zero; a minimiser of the
    augmented cost J keeps a primal residual, and a gap of twice its penalty.
    """

    z: Array
    """Shape (n,)."""
    multipliers: Array
    """Of the rows, lambda >= 0, shape (m,)."""
    base_cost: float
    """J_0."""
    cost: float
    """J = J_0 + alpha sum max(Gamma z - gamma, 0)^2."""
    violation: float
    """Largest violated row, max(Gamma z - gamma, 0), in the scaled units of the rows."""
    primal_residual: float
    """Largest violation of a row or of the box."""
    dual_residual: float
    """Largest component of the Lagrangian's gradient that no bound of the box holds up."""
    gap: float
    """Complementarity: |lambda' (Gamma z - gamma)|."""


def judge(problem: QuadraticProblem, z: Array, alpha: float, multipliers: Array) -> Solution:
    """Return z (n,) with its judgement; `multipliers` (m,) are those of the rows, the box's are the best there are."""
    excess = problem.Gamma @ z - problem.gamma
    violation = float(np.max(excess, initial=0.0))
    outside = float(np.max(np.maximum(problem.low - z, z - problem.high), initial=0.0))
    base_cost = float(z @ problem.Phi @ z + problem.phi @ z)
    slope = 2.0 * problem.Phi @ z + problem.phi + problem.Gamma.T @ multipliers
    at_low, at_high = z <= problem.low + CONTACT, z >= problem.high - CONTACT
    stationarity = np.where(at_low, np.minimum(slope, 0.0), slope)
    stationarity = np.where(at_high, np.maximum(stationarity, 0.0), stationarity)
    return Solution(
        z=z,
        multipliers=multipliers,
        base_cost=base_cost,
        cost=base_cost + alpha * float(np.sum(np.maximum(excess, 0.0) ** 2)),
        violation=violation,
        primal_residual=max(violation, outside),
        dual_residual=float(np.max(np.abs(stationarity), initial=0.0)),
        gap=abs(float(multipliers @ excess)),
    )


def penalty_multipliers(problem: QuadraticProblem, z: Array, alpha: float) -> Array:
    """Return what a penalty method has for multipliers: 2 alpha max(Gamma z - gamma, 0), shape (m,)."""
    result: Array = 2.0 * alpha * np.maximum(problem.Gamma @ z - problem.gamma, 0.0)
    return result
