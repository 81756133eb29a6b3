"""DAQP (Arnstrom et al., 2022): a dual active-set method that solves the problem exactly. An oracle, and an option.

- An iteration is a complete solve: the iterates of a dual method are infeasible until the last, and DAQP hands none
  out. So nothing is ever truncated, `tau_1_s` is a whole updating period, and more iterations change nothing.
- J of the answer is that of the hard-constrained optimum, whatever the guess: after a guess that breaks rows a
  little to its advantage, J may rise (Definition 1 of the paper does not hold to the letter).
"""

import daqp
import numpy as np
from numpy.typing import NDArray

from optimizer_plc.computing_settings import DaqpSettings
from optimizer_plc.costs import augmented_cost
from optimizer_plc.problem import QuadraticProblem
from optimizer_plc.solution import Solution, judge

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

    def start(self, problem: QuadraticProblem, guess: Array) -> None:
        """Take the problem; `guess` is the answer until the first iteration, and if there is no optimum."""
        self._problem = problem
        self._z = np.clip(guess, problem.low, problem.high)
        self._multipliers = np.zeros_like(problem.gamma)
        self._done = not (np.isfinite(problem.phi).all() and np.isfinite(problem.gamma).all())

    def iterate(self, count: int) -> int:
        """Solve the problem, once."""
        if count < 1 or self._done:
            return 0
        self._done = True
        qp, n = self._problem, len(self._z)
        lower = np.full(n + len(qp.gamma), -UNBOUNDED)
        lower[:n] = np.maximum(qp.low, -UNBOUNDED)
        upper = np.minimum(np.concatenate([qp.high, qp.gamma]), UNBOUNDED)
        z, _, flag, info = daqp.solve(
            2.0 * qp.Phi, qp.phi.copy(), qp.Gamma, upper, lower, np.zeros(len(upper), np.int32),
            primal_tol=self._tolerance,
        )  # fmt: skip
        if flag == 1:
            self._z = np.clip(z, qp.low, qp.high)
            self._multipliers = np.maximum(info["lam"][n:], 0.0)
        return 1

    @property
    def solution(self) -> Array:
        """The optimum, or the guess before it is known, shape (n,)."""
        return self._z.copy()

    @property
    def cost(self) -> float:
        """Augmented cost of `solution`."""
        return float(augmented_cost(self._problem, self._z, self.alpha))

    def judged(self) -> Solution:
        """Return `solution` with its residuals."""
        return judge(self._problem, self.solution, self.alpha, self._multipliers.copy())
