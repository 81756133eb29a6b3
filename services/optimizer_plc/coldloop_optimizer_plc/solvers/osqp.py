"""OSQP (Stellato et al., 2020): the alternating direction method of multipliers, cut off after q iterations.

The matrices are scaled and factorised once, with a fixed rho; from problem to problem only vectors change.

- An iteration is one of ADMM: a solve with the factors, and a projection of the rows. Calls continue where the last one
  stopped; OSQP keeps its multipliers, and begins each problem at the guess.
- A truncated answer is near the problem's rows and box without keeping them; it is projected into the box.
  J is not monotonic (Definition 1 of the paper): see `docs/solvers.md`.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.computing_settings import OsqpSettings
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Answer, collected

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

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        """Iterate from the guess and the last multipliers."""
        guess = np.clip(guess, problem.low, problem.high)
        z, multipliers, done = guess, np.zeros_like(problem.gamma), 0
        osqp = self._prepared(problem, guess)
        points, iterations = [], []
        for count in counts:
            if osqp is not None and count > done:
                osqp.update_settings(max_iter=count - done)
                result = osqp.solve(raise_error=False)
                z, done = np.clip(result.x, problem.low, problem.high), count
                multipliers = np.maximum(result.y[len(z) :], 0.0)
            points.append(z)
            iterations.append(done)
        return collected(problem, self.alpha, guess, points, iterations, multipliers)

    def _prepared(self, problem: QuadraticProblem, guess: Array) -> "OSQP | None":
        """Return the object with the next problem; None if its data are no numbers, which it would never forget."""
        if not (np.isfinite(problem.phi).all() and np.isfinite(problem.gamma).all()):
            return None
        lower = np.concatenate([problem.low, np.full(len(problem.gamma), -np.inf)])
        upper = np.concatenate([problem.high, problem.gamma])
        if self._osqp is None:
            self._osqp = self._set_up(problem, lower, upper)
        else:
            self._osqp.update(q=problem.phi, l=lower, u=upper)
        self._osqp.warm_start(x=guess)
        return self._osqp

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
