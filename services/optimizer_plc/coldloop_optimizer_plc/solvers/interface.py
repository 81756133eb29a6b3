"""The one protocol of all solvers: a problem, a guess and counts of iterations in; the answer and its costs out."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.qp.solution import Solution, judge, penalty_multipliers

Array = NDArray[np.float64]


class Costs(NamedTuple):
    """Of the problem before, with constant and floor; infinite where there was none."""

    guessed: float
    """J+, of the guess."""
    delivered: float
    """Jhat, of the answer."""


class Answer(NamedTuple):
    """What a solver makes of a problem, after each of k counts of iterations; costs are without the constant."""

    guessed: float
    """Augmented cost of the guess inside the box."""
    points: Array
    """What would be delivered, shape (k, n)."""
    costs: Array
    """Augmented costs of the points, shape (k,)."""
    iterations: NDArray[np.int64]
    """Iterations done, shape (k,): fewer than allowed when more would change nothing."""
    multipliers: Array
    """Of the rows at the last point, shape (m,); (0,) of a penalty method, whose multipliers follow from the point."""

    @property
    def z(self) -> Array:
        """The last point, shape (n,)."""
        point: Array = self.points[-1]
        return point

    @property
    def cost(self) -> float:
        """The cost of the last point."""
        return float(self.costs[-1])


class Solver(Protocol):
    """An iterative solver whose iterations can be counted and cut off anywhere.

    `tau_1_s` is the time that one iteration takes on the reference PLC (P = 1), in seconds; `alpha` is the penalty
    weight of the augmented cost that it is judged by.
    """

    tau_1_s: float
    alpha: float

    def reset(self) -> None:
        """Forget earlier problems: a session begins."""

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        """Begin with `guess` (n,) projected into the box; return the answer after each count.

        Counts do not fall. A point does not depend on which other counts are asked for.
        """


def collected(
    problem: QuadraticProblem,
    alpha: float,
    guess: Array,
    points: list[Array],
    iterations: list[int],
    multipliers: Array,
) -> Answer:
    """Return the points of a solver that knows no augmented cost as an answer."""
    costs = [float(augmented_cost(problem, z, alpha)) for z in (guess, *points)]
    return Answer(costs[0], np.array(points), np.array(costs[1:]), np.array(iterations), multipliers)


def judged(problem: QuadraticProblem, answer: Answer, alpha: float) -> Solution:
    """Return the last point of an answer with its residuals."""
    z, multipliers = answer.z, answer.multipliers
    return judge(problem, z, alpha, multipliers if multipliers.size else penalty_multipliers(problem, z, alpha))
