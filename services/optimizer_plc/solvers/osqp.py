"""OSQP (Stellato et al., 2020): the alternating direction method of multipliers, cut off after q iterations.

The matrices are scaled and factorised once, with a fixed rho; from problem to problem only vectors change.

- An iteration is one of ADMM: a solve with the factors, and a projection of the rows. Calls go on where the last one
  stopped; OSQP keeps its multipliers, and begins each problem at the guess.
- A truncated answer is near the problem's rows and box without keeping them; it is projected into the box.
  J is not monotonic (Definition 1 of the paper): see `docs/solvers.md`.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from optimizer_plc.computing_settings import OsqpSettings
from optimizer_plc.costs import augmented_cost
from optimizer_plc.problem import QuadraticProblem
from optimizer_plc.solution import Solution, judge

if TYPE_CHECKING:
    from osqp import OSQP

Array = NDArray[np.float64]

NEVER = 1e-15
"""Tolerance that does not end the iterations: they are counted."""


class OsqpSolver:
    """Counted iterations of one OSQP object, warm-started."""

    def __init__(self, settings: OsqpSettings) -> None:
        self.alpha = settings.alpha
        self.tau_1_s = settings.tau_1_s
        self._settings = settings
        self._osqp: OSQP | None = None

    def reset(self) -> None:
        """Drop the object with its factors and multipliers."""
        self._osqp = None

    def start(self, problem: QuadraticProblem, guess: Array) -> None:
        """Take the next problem, and begin at `guess` with the last multipliers."""
        self._problem = problem
        self._z = np.clip(guess, problem.low, problem.high)
        self._multipliers = np.zeros_like(problem.gamma)
        self._finite = bool(np.isfinite(problem.phi).all() and np.isfinite(problem.gamma).all())
        if not self._finite:  # OSQP would never forget them
            return
        lower = np.concatenate([problem.low, np.full(len(problem.gamma), -np.inf)])
        upper = np.concatenate([problem.high, problem.gamma])
        if self._osqp is None:
            self._osqp = self._set_up(problem, lower, upper)
        else:
            self._osqp.update(q=problem.phi, l=lower, u=upper)
        self._osqp.warm_start(x=self._z)

    def _set_up(self, problem: QuadraticProblem, lower: Array, upper: Array) -> "OSQP":
        from osqp import OSQP  # noqa: PLC0415 with scipy.sparse, a fifth of what the optimiser loads at its start
        from scipy import sparse  # noqa: PLC0415

        solver = OSQP()
        P = sparse.csc_matrix(np.triu(2.0 * problem.Phi))
        A = sparse.csc_matrix(np.vstack([np.eye(len(problem.phi)), problem.Gamma]))
        solver.setup(
            P, problem.phi, A, lower, upper,
            rho=self._settings.rho, alpha=self._settings.relaxation, adaptive_rho=False, check_termination=0,
            eps_abs=NEVER, eps_rel=0.0, eps_prim_inf=NEVER, eps_dual_inf=NEVER, verbose=False,
        )  # fmt: skip
        return solver

    def iterate(self, count: int) -> int:
        """Do `count` iterations."""
        if count < 1 or self._osqp is None or not self._finite:
            return 0
        self._osqp.update_settings(max_iter=count)
        result = self._osqp.solve(raise_error=False)
        n = len(self._z)
        self._z = np.clip(result.x, self._problem.low, self._problem.high)
        self._multipliers = np.maximum(result.y[n:], 0.0)
        return count

    @property
    def solution(self) -> Array:
        """The present point, projected into the box, shape (n,)."""
        return self._z.copy()

    @property
    def cost(self) -> float:
        """Augmented cost of `solution`."""
        return float(augmented_cost(self._problem, self._z, self.alpha))

    def judged(self) -> Solution:
        """Return `solution` with its residuals."""
        return judge(self._problem, self.solution, self.alpha, self._multipliers.copy())
