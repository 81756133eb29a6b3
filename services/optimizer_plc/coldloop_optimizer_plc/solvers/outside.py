"""Somebody else's solver, by an entry point of the group `coldloop.solvers`: nothing is edited here to use it.

The entry point is a class without arguments that follows `OutsideMethod`; `docs/extending.md` has one of a few lines.
"""

from collections.abc import Sequence
from copy import deepcopy
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.computing_settings import OutsideSettings
from coldloop_optimizer_plc.entry_points import Part, in_its_name, made
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Answer, collected

Array = NDArray[np.float64]


class OutsideMethod(Protocol):
    """What an entry point makes: min z' Phi z + z' phi under Gamma z <= gamma and low <= z <= high, cut off anywhere.

    There is no factor 1/2 before Phi. The same problem, guess and count give the same bits. If it has an attribute
    `alpha`, that is set to the weight of broken rows that its answers are judged with.
    """

    def solve(self, problem: QuadraticProblem, guess: Array, iterations: int) -> tuple[Array, int]:
        """Return the point (n,) after so many iterations from `guess` (n,), and how many were done; 0 is the guess."""


class OutsideSolver:
    """One of these as a solver, given copies: its answer is checked, put into the box, judged by the augmented cost."""

    def __init__(self, settings: OutsideSettings) -> None:
        self.alpha = settings.alpha
        self.tau_1_s = settings.tau_1_s
        self.name = settings.solver
        self._method: OutsideMethod = made(Part.SOLVER, settings.solver)
        with in_its_name(Part.SOLVER, self.name):
            if hasattr(self._method, "alpha"):
                self._method.alpha = settings.alpha

    def reset(self) -> None:
        """Forget earlier problems, where the method has something to forget."""
        with in_its_name(Part.SOLVER, self.name):
            getattr(self._method, "reset", dict)()

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        """Return the answer after each count; a point that is no profile, or not finite, is as good as the guess.

        Raises:
            ConfigurationError: The method raises, or returns something else than a point and a count.
        """
        guess = np.clip(guess, problem.low, problem.high)
        answers = [self._point(problem, guess, int(count)) for count in counts]
        points, done = [point for point, _ in answers], [count for _, count in answers]
        return collected(problem, self.alpha, guess, points, done, np.zeros_like(problem.gamma))

    def _point(self, problem: QuadraticProblem, guess: Array, count: int) -> tuple[Array, int]:
        if not count:
            return guess, 0
        with in_its_name(Part.SOLVER, self.name):
            point, done = self._method.solve(deepcopy(problem), guess.copy(), count)
            found = np.array(point, dtype=np.float64)
            done = max(0, min(int(done), count))
        if found.shape != guess.shape or not np.isfinite(found).all():
            return guess, done
        return np.clip(found, problem.low, problem.high), done
