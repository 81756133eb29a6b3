"""Interior point while problems are far from their optimum, the ODE-based solver in quiet; chosen for each problem.

An interior point needs some iterations before it is good, and is at the optimum then; the ODE-based solver makes the
most of few. With J+_k the cost of the guess of a problem and Jhat_k that of its answer, both with constant and floor,
the interior-point solver gets problem k if

    max(J+_k, J+_{k-1}) > switch Jhat_{k-1}

that is, after a load step (or any other surprise), and as long as the problem before was still being improved. All of
it is known when the problem begins.

The PLC's time is counted in slots, each as long as the longer of both iterations. In the time of its slots the chosen
solver does as many of its own iterations as fit, never more; what is left of a slot counts for the next one.
"""

import math

import numpy as np
from numpy.typing import NDArray

from optimizer_plc.computing_settings import HybridSettings
from optimizer_plc.problem import QuadraticProblem
from optimizer_plc.solution import Solution
from optimizer_plc.solvers.interface import Solver

Array = NDArray[np.float64]


class HybridSolver:
    """Chooses between two solvers for each problem.

    Args:
        settings: When to switch.
        far: Solver of problems that are far from their optimum.
        quiet: Solver of the others; both have the same alpha.
        floor: Constant that J has besides that of the problem.
    """

    def __init__(self, settings: HybridSettings, far: Solver, quiet: Solver, floor: float) -> None:
        self.alpha = quiet.alpha
        self.tau_1_s = max(far.tau_1_s, quiet.tau_1_s)
        self._switch, self._floor = settings.switch, floor
        self._far, self._quiet = far, quiet
        self.reset()

    def reset(self) -> None:
        """Forget earlier problems; the first one is taken for a quiet one."""
        self._far.reset()
        self._quiet.reset()
        self._chosen: Solver | None = None
        self.guessed = self.delivered = math.inf

    def start(self, problem: QuadraticProblem, guess: Array) -> None:
        """Choose a solver, and begin with `guess` projected into the box."""
        if self._chosen is not None:
            self.delivered = self._whole(self._chosen.cost)
        self._rest = float(problem.constant) + self._floor
        self._quiet.start(problem, guess)
        before, self.guessed = self.guessed, self._whole(self._quiet.cost)
        self._chosen = self._quiet
        if is_far(self._switch, self.guessed, before, self.delivered):
            self._far.start(problem, guess)
            self._chosen = self._far
        self._slots = self._done = 0

    def iterate(self, count: int) -> int:
        """Let this many slots pass, or fewer when more iterations would change nothing; return how many passed."""
        before, chosen = self._slots, self._present
        self._slots += count
        allowed = iterations_in(self._slots, self.tau_1_s, chosen.tau_1_s)
        self._done += chosen.iterate(allowed - self._done)
        return slots_passed(self._done, allowed, before, count, self.tau_1_s, chosen.tau_1_s)

    @property
    def _present(self) -> Solver:
        if self._chosen is None:
            raise RuntimeError("no problem was started")
        return self._chosen

    @property
    def is_far(self) -> bool:
        """Whether the present problem was taken for one far from its optimum."""
        return self._chosen is self._far

    def go_on_after(self, guessed: float, delivered: float) -> None:
        """Go on as after a problem with these costs of guess and answer, constant and floor included."""
        self._chosen, self.guessed, self.delivered = None, guessed, delivered

    @property
    def solution(self) -> Array:
        """The answer of the chosen solver, shape (n,)."""
        return self._present.solution

    @property
    def cost(self) -> float:
        """Augmented cost of `solution`."""
        return self._present.cost

    def judged(self) -> Solution:
        """Return `solution` with its residuals."""
        return self._present.judged()

    def _whole(self, cost: float) -> float:
        return max(cost + self._rest, self._floor)


def is_far(switch: float, guessed: float, guessed_before: float, delivered_before: float) -> bool:
    """Tell whether a problem is far from its optimum, from J+_k, J+_{k-1} and Jhat_{k-1}."""
    return max(guessed, guessed_before) > switch * delivered_before


def iterations_in(slots: int, slot_s: float, tau_1_s: float) -> int:
    """Return the iterations of `tau_1_s` that fit into the time of some slots."""
    return math.floor(slots * slot_s / tau_1_s + 1e-9)


def slots_passed(done: int, allowed: int, before: int, count: int, slot_s: float, tau_1_s: float) -> int:
    """Return how many of `count` slots passed after the first `before`: fewer when the solver ended by itself."""
    if done == allowed:
        return count
    return max(0, math.ceil(done * tau_1_s / slot_s - 1e-9) - before)
