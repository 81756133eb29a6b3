"""What the optimiser asks of a solver S: start from a guess, then do one unbreakable iteration at a time."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from optimizer_plc.problem import QuadraticProblem
from optimizer_plc.solution import Solution

Array = NDArray[np.float64]


class Solver(Protocol):
    """An iterative solver whose iterations can be counted and cut off anywhere.

    `tau_1_s` is the time that one iteration takes on the reference PLC (P = 1), in seconds; `alpha` is the penalty
    weight of the augmented cost that it is judged by.
    """

    tau_1_s: float
    alpha: float

    def reset(self) -> None:
        """Forget earlier problems: a session begins."""

    def start(self, problem: QuadraticProblem, guess: Array) -> None:
        """Begin with `guess` (n,), which is projected into the box."""

    def iterate(self, count: int) -> int:
        """Do this many iterations, or fewer when they would change nothing any more; return how many were done."""

    @property
    def solution(self) -> Array:
        """The profile that would be delivered now, shape (n,)."""

    @property
    def cost(self) -> float:
        """Augmented cost of `solution`, without the problem's constant."""

    def judged(self) -> Solution:
        """Return `solution` with its residuals; nothing is computed for them before."""
