"""DAQP (Arnstrom et al., 2022): a dual active-set method that solves the problem exactly. An oracle, and an option.

- An iteration is a complete solve: the iterates of a dual method are infeasible until the last, and DAQP hands none
  out. So nothing is ever truncated, `tau_1_s` is a whole updating period, and more iterations change nothing.
- J of the answer is that of the hard-constrained optimum, whatever the guess: after a guess that breaks rows a
  little to its advantage, J may rise (Definition 1 of the paper does not hold to the letter).
"""

from collections.abc import Sequence

import daqp
import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.computing_settings import DaqpSettings
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Answer, collected

Array = NDArray[np.float64]

UNBOUNDED = 1e30


class DaqpSolver:
    """One exact solve, always from cold: the same problem gives the same bits."""

    def __init__(self, settings: DaqpSettings) -> None:
        self.alpha = settings.alpha
        self.tau_1_s = settings.tau_1_s
        self._tolerance = settings.primal_tolerance

    def reset(self) -> None:
        """Nothing is kept from one problem to the next."""

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        """Solve the problem, once; the guess is the answer until then, and if there is no optimum."""
        guess = np.clip(guess, problem.low, problem.high)
        z, multipliers = guess, np.zeros_like(problem.gamma)
        solvable = bool(np.isfinite(problem.phi).all() and np.isfinite(problem.gamma).all())
        if solvable and max(counts) > 0:
            z, multipliers = self._optimum(problem, guess)
        points, done = [z if count else guess for count in counts], [int(solvable and count > 0) for count in counts]
        return collected(problem, self.alpha, guess, points, done, multipliers)

    def _optimum(self, qp: QuadraticProblem, guess: Array) -> tuple[Array, Array]:
        """Return the optimum and the multipliers of its rows; the guess and zeros if there is none."""
        n = len(guess)
        lower = np.full(n + len(qp.gamma), -UNBOUNDED)
        lower[:n] = np.maximum(qp.low, -UNBOUNDED)
        upper = np.minimum(np.concatenate([qp.high, qp.gamma]), UNBOUNDED)
        z, _, flag, info = daqp.solve(
            2.0 * qp.Phi, qp.phi.copy(), qp.Gamma, upper, lower, np.zeros(len(upper), np.int32),
            primal_tol=self._tolerance,
        )  # fmt: skip
        if flag != 1:
            return guess, np.zeros_like(qp.gamma)
        return np.clip(z, qp.low, qp.high), np.maximum(info["lam"][n:], 0.0)
