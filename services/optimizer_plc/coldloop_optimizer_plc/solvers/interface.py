"""The one protocol of all solvers: a problem, a guess and counts of iterations in; the answer and its costs out.

A solver of our own is a NamedTuple of its constants, its method, and a kernel `solve` that is registered for it and
takes single and double precision alike: one object serves all of them, and `solve_by` calls the right kernel within
kernels. Somebody else's is a class without arguments that follows `OutsideMethod`, by an entry point of the group
`coldloop.solvers`; `docs/extending.md` has one of a few lines.
"""

import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from coldloop.kernels.intrinsics import Implementations
from coldloop_optimizer_plc.computing_settings import OutsideSettings, Part, in_its_name, made
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.linear_algebra import Array
from coldloop_optimizer_plc.qp.problem import QuadraticProblem


class Costs(NamedTuple):
    """J+ of the guess and Jhat of the answer of the problem before, with constant and floor; infinite if none was."""

    guessed: float
    delivered: float


class Answer(NamedTuple):
    """Answer of a solver to a problem, after each of k counts of iterations.

    guessed is the augmented cost of the guess inside the box, costs (k,) are those of the points (k, n) that would be
    delivered, all without the constant. iterations (k,) were done, fewer than allowed when more would change nothing.
    multipliers (m,) are those of the rows at the last point; (0,) of a penalty method, where they follow from it.
    """

    guessed: float
    points: Array
    costs: Array
    iterations: NDArray[np.int64]
    multipliers: Array

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
    problem: QuadraticProblem, alpha: float, guess: Array, points: list[Array], iterations: list[int],
    multipliers: Array,
) -> Answer:  # fmt: skip
    """Return the points of a solver that knows no augmented cost as an answer."""
    costs = [float(augmented_cost(problem, z, alpha)) for z in (guess, *points)]
    return Answer(costs[0], np.array(points), np.array(costs[1:]), np.array(iterations), multipliers)


CONTACT = 1e-7  # distance within which a variable touches its bound: the precision of the exact solvers


class Solution(NamedTuple):
    """A profile z (n,), judged for min J_0(z) = z' Phi z + z' phi under Gamma z <= gamma and low <= z <= high.

    Costs are without the problem's constant: base_cost J_0, and cost J_0 + alpha sum max(Gamma z - gamma, 0)^2.
    multipliers lambda (m,) are those of the rows, >= 0. violation: largest violated row, in the scaled units of the
    rows; primal_residual: that of a row or of the box; dual_residual: largest component of the Lagrangian's gradient
    that no bound of the box holds up; gap: complementarity, |lambda' (Gamma z - gamma)|. At an optimum both residuals
    and the gap are zero; a minimiser of the augmented cost J keeps a primal residual, and a gap of twice its penalty.
    """

    z: Array
    multipliers: Array
    base_cost: float
    cost: float
    violation: float
    primal_residual: float
    dual_residual: float
    gap: float


def judged(problem: QuadraticProblem, answer: Answer, alpha: float) -> Solution:
    """Return the last point of an answer with its residuals; multipliers of the box are the best there are."""
    z, multipliers, excess = answer.z, answer.multipliers, problem.Gamma @ answer.z - problem.gamma
    if not multipliers.size:  # those of a penalty method
        multipliers = 2.0 * alpha * np.maximum(excess, 0.0)
    violation = float(np.max(excess, initial=0.0))
    outside = float(np.max(np.maximum(problem.low - z, z - problem.high), initial=0.0))
    base_cost = float(z @ problem.Phi @ z + problem.phi @ z)
    slope = 2.0 * problem.Phi @ z + problem.phi + problem.Gamma.T @ multipliers
    at_low, at_high = z <= problem.low + CONTACT, z >= problem.high - CONTACT
    stationarity = np.where(at_low, np.minimum(slope, 0.0), slope)
    stationarity = np.where(at_high, np.maximum(stationarity, 0.0), stationarity)
    return Solution(
        z=z, multipliers=multipliers, base_cost=base_cost,
        cost=base_cost + alpha * float(np.sum(np.maximum(excess, 0.0) ** 2)), violation=violation,
        primal_residual=max(violation, outside), dual_residual=float(np.max(np.abs(stationarity), initial=0.0)),
        gap=abs(float(multipliers @ excess)),
    )  # fmt: skip


Kernel = Callable[[Any, QuadraticProblem, Array, NDArray[np.int64], Costs], Answer]
KERNELS: Final[Implementations[Kernel]] = Implementations("solve_by")  # the kernel of each method
solves_by = KERNELS.register  # decorator of the kernel that solves problems by a method


def solve_by(method: Any, qp: QuadraticProblem, guess: Array, counts: NDArray[np.int64], before: Costs) -> Answer:  # noqa: ANN401
    """Return the answer of the kernel that is registered for a method; `before` is of the problem before."""
    return KERNELS[type(method)](method, qp, guess, counts, before)


@overload(solve_by, jit_options={"error_model": "numpy"}, strict=False)
def _solve_by(method: Any, qp: Any, guess: Any, counts: Any, before: Any) -> Any:  # noqa: ANN401, ARG001 types of numba
    solve = KERNELS[method.instance_class]
    return lambda method, qp, guess, counts, before: solve(method, qp, guess, counts, before)  # noqa: PLW0108


class KernelSolver:
    """A solver of our own, whose method `method_of` makes for problems with the matrices of one.

    It has a penalty weight alpha and the time of an iteration; J has `floor` besides the constant of the problem.
    """

    def __init__(
        self, method_of: Callable[[QuadraticProblem], Any], alpha: float, tau_1_s: float, floor: float = 1.0
    ) -> None:
        self.alpha, self.tau_1_s = alpha, tau_1_s
        self._method_of, self._floor = method_of, floor
        self._source: tuple[Array, Array] | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the problem before."""
        self.before = Costs(math.inf, math.inf)

    def method(self, problem: QuadraticProblem) -> Any:  # noqa: ANN401 a method that a kernel is registered for
        """Return the method for problems with these matrices, in their floating-point type."""
        if self._source is None or problem.Phi is not self._source[0] or problem.Gamma is not self._source[1]:
            self._source, self._method = (problem.Phi, problem.Gamma), self._method_of(problem)
        return self._method

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        """Return the answer after each count."""
        real = problem.phi.dtype.type
        before = Costs(*map(real, self.before))
        answer = solve_by(self.method(problem), problem, guess, np.array(counts, np.int64), before)
        rest, floor = real(problem.constant) + real(self._floor), real(self._floor)
        self.before = Costs(*(float(max(real(cost) + rest, floor)) for cost in (answer.guessed, answer.costs[-1])))
        return answer


class OutsideMethod(Protocol):
    """Solver of an entry point: min z' Phi z + z' phi under Gamma z <= gamma and low <= z <= high, cut off anywhere.

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

        Raises ConfigurationError if the method raises, or returns something else than a point and a count.
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
