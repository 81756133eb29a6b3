"""Clarabel, PIQP and QPALM as outside solvers: entry points of these names; each library is an extra of that name.

They get J itself: each row may be broken, and by how much is a variable t >= 0 that costs alpha t^2. So there always is
a point that keeps all rows, and an answer is judged by what was minimised.

- All three are throttled: they count iterations and hand out the iterate at their limit. Each count is a solve of its
  own, with the library's own settings but for tolerances: nothing is kept.
- Clarabel and PIQP are interior-point methods that begin at a point of their own, whatever the guess. An iteration is
  a predictor and a corrector.
- QPALM, a proximal augmented Lagrangian method, begins at the guess. An iteration is a semismooth Newton step or an
  update of multipliers.
- A truncated answer may be outside the box, into which it is projected, and J is not monotonic. Where a library ends
  with a status of failure the answer is the guess.
"""

from abc import ABC, abstractmethod
from importlib import import_module
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop_optimizer_plc.computing_settings import PENALTY_WEIGHT
from coldloop_optimizer_plc.qp.problem import QuadraticProblem

Array = NDArray[np.float64]

UNBOUNDED: Final = 1e30
TOLERANCE: Final = 1e-9
"""Absolute and relative, of all residuals."""


class SoftProblem(NamedTuple):
    """min x' H x / 2 + g' x under C x <= u and low <= x <= high, with x = (z, t); shapes (n + m, n + m), (m, n + m)."""

    H: Array
    g: Array
    C: Array
    u: Array
    low: Array
    high: Array


def softened(qp: QuadraticProblem, alpha: float) -> SoftProblem:
    """Return a problem with a variable t >= 0 for each row: Gamma z - t <= gamma, at the price alpha t^2."""
    n, m = len(qp.phi), len(qp.gamma)
    H = np.zeros((n + m, n + m))
    H[:n, :n], H[n:, n:] = 2.0 * qp.Phi, 2.0 * alpha * np.eye(m)
    low = np.maximum(np.concatenate([qp.low, np.zeros(m)]), -UNBOUNDED)
    high = np.minimum(np.concatenate([qp.high, np.full(m, UNBOUNDED)]), UNBOUNDED)
    return SoftProblem(H, np.concatenate([qp.phi, np.zeros(m)]), np.hstack([qp.Gamma, -np.eye(m)]), qp.gamma, low, high)


class Library(ABC):
    """An `OutsideMethod` by a library, which is imported when the solver is made.

    Raises:
        ConfigurationError: The library is not installed.
    """

    name: ClassVar[str]
    """Of the module, of the extra and of the entry point."""

    def __init__(self) -> None:
        self.alpha = PENALTY_WEIGHT
        try:
            self.library: Any = import_module(self.name)
        except ModuleNotFoundError:
            raise ConfigurationError(
                f"optimizer_plc.program.outside.solver: the library of {self.name} is not installed here: "
                f"pip install 'coldloop[{self.name}]', or choose another solver"
            ) from None

    def solve(self, problem: QuadraticProblem, guess: Array, iterations: int) -> tuple[Array, int]:
        """Return the point after so many iterations, fewer at the optimum, and their number; or the guess."""
        finite = all(np.isfinite(vector).all() for vector in (problem.phi, problem.gamma, problem.low))
        if not (iterations and finite and (problem.low <= problem.high).all()):
            return guess, 0
        excess = np.maximum(problem.Gamma @ guess - problem.gamma, 0.0)
        x, done = self.iterated(softened(problem, self.alpha), np.concatenate([guess, excess]), iterations)
        return (guess if x is None else x[: len(guess)]), done

    @abstractmethod
    def iterated(self, p: SoftProblem, first: Array, count: int) -> tuple[Array | None, int]:
        """Return x (n + m,) after at most `count` iterations, which may begin at `first`; None after a failure."""


class Clarabel(Library):
    """Clarabel (Goulart, Chen, 2024)."""

    name = "clarabel"

    def iterated(self, p: SoftProblem, first: Array, count: int) -> tuple[Array | None, int]:  # noqa: ARG002
        """Begin at a point of its own; an iterate from which it makes no more progress is an answer."""
        from scipy import sparse  # noqa: PLC0415 only what needs it loads it

        above, below = p.high < UNBOUNDED, p.low > -UNBOUNDED
        one = np.eye(len(p.g))
        rows = sparse.csc_matrix(np.vstack([p.C, one[above], -one[below]]))
        limits = np.concatenate([p.u, p.high[above], -p.low[below]])
        settings = self.library.DefaultSettings()
        settings.verbose, settings.max_iter = False, count
        settings.direct_solve_method = "qdldl"  # one thread: the same bits
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
        cones = [self.library.NonnegativeConeT(len(limits))]
        H = sparse.triu(p.H, format="csc")
        found = self.library.DefaultSolver(H, p.g, rows, limits, cones, settings).solve()
        usable = str(found.status) in {"Solved", "AlmostSolved", "MaxIterations", "InsufficientProgress"}
        return np.array(found.x) if usable else None, found.iterations


class Piqp(Library):
    """PIQP (Schwan, Jiang, Kuhn, Jones, 2023)."""

    name = "piqp"

    def iterated(self, p: SoftProblem, first: Array, count: int) -> tuple[Array | None, int]:  # noqa: ARG002
        """Begin at a point of its own."""
        solver = self.library.DenseSolver()
        solver.settings.max_iter = count
        solver.settings.eps_abs = solver.settings.eps_rel = TOLERANCE
        below = np.full(len(p.u), -UNBOUNDED)
        solver.setup(np.asfortranarray(p.H), p.g, None, None, np.asfortranarray(p.C), below, p.u, p.low, p.high)
        usable = solver.solve() in {self.library.PIQP_SOLVED, self.library.PIQP_MAX_ITER_REACHED}
        return np.array(solver.result.x) if usable else None, solver.result.info.iter


class Qpalm(Library):
    """QPALM (Hermans, Themelis, Patrinos, 2022); its licence is LGPL-3.0."""

    name = "qpalm"

    def iterated(self, p: SoftProblem, first: Array, count: int) -> tuple[Array | None, int]:
        """Begin at `first`, with multipliers of 0: those of its broken rows make truncated answers worse."""
        from scipy import sparse  # noqa: PLC0415 only what needs it loads it

        n, m = len(p.g), len(p.u)
        data = self.library.Data(n, m + n)
        data.Q, data.q = sparse.csc_matrix(p.H), p.g
        data.A = sparse.csc_matrix(np.vstack([p.C, np.eye(n)]))
        data.bmin = np.concatenate([np.full(m, -UNBOUNDED), p.low])
        data.bmax = np.concatenate([p.u, p.high])
        settings = self.library.Settings()
        settings.verbose, settings.max_iter = False, count
        settings.eps_abs = settings.eps_rel = 100.0 * TOLERANCE  # at an optimum it may not get nearer, and not end
        solver = self.library.Solver(data, settings)
        solver.warm_start(first, np.zeros(m + n))
        solver.solve()
        usable = str(solver.info.status) in {"solved", "maximum iterations reached"}
        return np.array(solver.solution.x) if usable else None, solver.info.iter
