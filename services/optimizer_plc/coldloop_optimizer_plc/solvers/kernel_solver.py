"""Solvers that are kernels of our own: one object for all of them, and the call of the right kernel within kernels.

The file of such a solver has a NamedTuple of its constants, its method, and a kernel `solve` that is registered for it.
It takes single and double precision alike.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from coldloop.kernels.implementations import Implementations
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Answer, Costs

Array = NDArray[np.float64]
Kernel = Callable[[Any, QuadraticProblem, Array, NDArray[np.int64], Costs], Answer]
K = TypeVar("K", bound=Callable[..., Answer])

KERNELS: Final[Implementations[Kernel]] = Implementations("solve_by")
"""The kernel of each method."""


def solves_by(method: type) -> Callable[[K], K]:
    """Register a kernel as what solves problems by this method."""

    def register(kernel: K) -> K:
        KERNELS[method] = kernel
        return kernel

    return register


def solve_by(method: Any, qp: QuadraticProblem, guess: Array, counts: NDArray[np.int64], before: Costs) -> Answer:  # noqa: ANN401
    """Return the answer of the kernel that is registered for a method; `before` is of the problem before."""
    return KERNELS[type(method)](method, qp, guess, counts, before)


@overload(solve_by, jit_options={"error_model": "numpy"}, strict=False)
def _solve_by(method: Any, qp: Any, guess: Any, counts: Any, before: Any) -> Any:  # noqa: ANN401, ARG001 types of numba
    solve = KERNELS[method.instance_class]
    return lambda method, qp, guess, counts, before: solve(method, qp, guess, counts, before)  # noqa: PLW0108


class KernelSolver:
    """A solver of our own.

    Args:
        method_of: Makes the method for problems with the matrices of this one.
        alpha: Penalty weight.
        tau_1_s: Time of an iteration.
        floor: Constant that J has besides that of the problem.
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
