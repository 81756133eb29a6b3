"""Solvers of other projects: qpOASES, OSQP and DAQP by their names, Clarabel, PIQP and QPALM as outside solvers.

The last three are entry points, and each library is an extra of that name. They get J itself: each row may be broken,
and by how much is a variable t >= 0 that costs alpha t^2. So there always is a point that keeps all rows, and an answer
is judged by what was minimised.

- All three are throttled: they count iterations and hand out the iterate at their limit. Each count is a solve of its
  own, with the library's own settings but for tolerances: nothing is kept.
- Clarabel and PIQP are interior-point methods that begin at a point of their own, whatever the guess. An iteration is
  a predictor and a corrector.
- QPALM, a proximal augmented Lagrangian method, begins at the guess. An iteration is a semismooth Newton step or an
  update of multipliers.
- A truncated answer may be outside the box, into which it is projected, and J is not monotonic. Where a library ends
  with a status of failure the answer is the guess.
"""

import importlib
import io
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import redirect_stdout
from functools import cache
from types import ModuleType
from typing import Any, ClassVar, Final, Generic, NamedTuple, TypeVar

import daqp
import numpy as np

from coldloop.errors import ConfigurationError
from coldloop_optimizer_plc.computing_settings import PENALTY_WEIGHT, DaqpSettings, OsqpSettings, QpoasesSettings
from coldloop_optimizer_plc.qp.linear_algebra import Array
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Answer, collected

SOLVED, ON_THE_WAY = "SOLVER_RET_SUCCESS", "SOLVER_RET_LIMITED"
FIRST_SOLVE_LIMIT = 10_000  # steps after which the first problem of a chain is given up; it takes some tens


def are_numbers(problem: QuadraticProblem) -> bool:
    """Return whether phi and gamma of a problem are finite."""
    return bool(np.isfinite(problem.phi).all() and np.isfinite(problem.gamma).all())


def is_well_posed(problem: QuadraticProblem) -> bool:
    """Return whether its low bounds are finite, too, and none is above the upper one."""
    return are_numbers(problem) and bool((np.isfinite(problem.low) & (problem.low <= problem.high)).all())


S = TypeVar("S", QpoasesSettings, OsqpSettings, DaqpSettings)


class BorrowedSolver(ABC, Generic[S]):
    """A solver of another project: its iterates are put into the box."""

    def __init__(self, settings: S) -> None:
        self.settings: S = settings
        self.alpha, self.tau_1_s = settings.alpha, settings.tau_1_s
        self.reset()

    def reset(self) -> None:
        """Forget earlier problems: a session begins."""

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        """Return the answer after each count: the guess until the first iteration, and where there is no other."""
        self.problem, self.guess = problem, np.clip(guess, problem.low, problem.high)
        z, multipliers, done = self.guess, np.zeros_like(problem.gamma), 0
        usable, points, iterations = self.begin(), list[Array](), list[int]()
        for count in counts:
            if usable and count > done:
                more, found = self.advance(count - done)
                done += more
                if found is not None:
                    z, multipliers = np.clip(found[0], problem.low, problem.high), np.maximum(found[1], 0.0)
            points.append(z)
            iterations.append(done)
        return collected(problem, self.alpha, self.guess, points, iterations, multipliers)

    @abstractmethod
    def begin(self) -> bool:
        """Take `problem` and `guess` (n,); return whether the data can be used."""

    @abstractmethod
    def advance(self, count: int) -> tuple[int, tuple[Array, Array] | None]:
        """Iterate up to `count` times; return how often, point (n,) and multipliers (m,), or None after a failure."""


class QpoasesSolver(BorrowedSolver[QpoasesSettings]):
    """Throttled qpOASES (Ferreau et al., 2014): the online active-set method, cut off after q working-set changes.

    qpOASES moves along the line from the previous problem to the present one and stops where the working set changes.
    It is the qpOASES inside CasADi; its CPU-time limit is not used, since it would make runs irreproducible.

    - An iteration is one step of that homotopy. The limit nWSR of a CasADi object is fixed when it is made, so ours is
      1 and an iteration is a call: another call with the same data continues along the same line, and a steps and then
      b are a + b steps to the bit. One object with nWSR = q gives the same points to rounding until, at some harsh
      load jumps, it takes another path (ramping restarts at each call); neither is better on average.
    - A truncated answer is the optimum of an intermediate problem. It may violate the box and the rows of the present
      one; it is projected into the box. J is not monotonic (Definition 1 of the paper): see `docs/solvers.md`.
    - The guess is the answer until the first iteration. The method itself continues from where it stopped before.
    - A chain begins at an optimum, as `qpOASES_sequence` is begun by 'i' before it is hot-started: the first problem of
      a session is solved to the end, whatever the count.
    """

    def __init__(self, settings: QpoasesSettings) -> None:
        super().__init__(settings)
        self._casadi = load_casadi()

    def reset(self) -> None:
        """Drop the chain: the next problem begins a new one."""
        self._chain: _Chain | None = None

    def begin(self) -> bool:
        """Let the homotopy lead to this problem; ill-posed data never reach the chain, which they would end."""
        if not is_well_posed(self.problem):
            return False
        first = self._chain is None
        chain = self._chain = self._chain or _Chain(self._casadi, self.problem)
        chain.set_target(self.problem)
        for _ in range(FIRST_SOLVE_LIMIT * first):
            if chain.step() != ON_THE_WAY:
                break
        self._status = ON_THE_WAY
        return True

    def advance(self, count: int) -> tuple[int, tuple[Array, Array] | None]:
        """Go along the homotopy, or up to its end."""
        done = 0
        while self._chain is not None and done < count and self._status == ON_THE_WAY:
            self._status = self._chain.step()
            done += 1
        if self._status not in (SOLVED, ON_THE_WAY):
            self._chain = None  # a chain that broke stays broken; the answer is the last one that was good
        return done, (self._chain.z, self._chain.multipliers) if self._chain else None


class _Chain:
    """A CasADi object with nWSR = 1: one chain of hot starts. Its arguments and results are arrays shared with it."""

    def __init__(self, casadi: ModuleType, problem: QuadraticProblem) -> None:
        m, n = problem.Gamma.shape
        shapes = {"h": casadi.Sparsity.dense(n, n), "a": casadi.Sparsity.dense(m, n)}
        options = {"nWSR": 1, "printLevel": "none", "error_on_fail": False}
        with redirect_stdout(io.StringIO()):  # each object prints a banner
            self._conic: Any = casadi.conic("qp", "qpoases", shapes, options)
            self._buffer, self._evaluate = self._conic.buffer()
        self._inputs = {name: np.zeros(self._conic.numel_in(name)) for name in self._conic.name_in()}
        self._outputs = {name: np.zeros(self._conic.numel_out(name)) for name in self._conic.name_out()}
        for i, array in enumerate(self._inputs.values()):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate(self._outputs.values()):
            self._buffer.set_res(i, array.data)
        self._inputs["lba"][:] = -np.inf
        self.z, self.multipliers = self._outputs["x"], self._outputs["lam_a"]

    def set_target(self, problem: QuadraticProblem) -> None:
        """Say where the homotopy leads to."""
        self._inputs["h"][:] = 2.0 * problem.Phi.ravel()
        self._inputs["a"][:] = problem.Gamma.ravel(order="F")
        for name, value in (("g", problem.phi), ("uba", problem.gamma), ("lbx", problem.low), ("ubx", problem.high)):
            self._inputs[name][:] = value

    def step(self) -> str:
        """Go one step; return CasADi's status."""
        with redirect_stdout(io.StringIO()):  # failures are printed whatever the print level
            self._evaluate()
        return str(self._buffer.stats()["unified_return_status"])


@cache
def load_casadi() -> ModuleType:
    """Import CasADi, large and optional; raises ConfigurationError if it is not installed, or has no qpOASES."""
    try:
        casadi = importlib.import_module("casadi")
    except ImportError:
        raise ConfigurationError(
            "optimizer_plc.program.solver: qpoases needs CasADi, which is not installed here: "
            "install coldloop[qpoases], or choose another solver"
        ) from None
    if not casadi.has_conic("qpoases"):
        raise ConfigurationError(
            f"optimizer_plc.program.solver: CasADi {casadi.__version__} was built without qpOASES: "
            "install CasADi from its wheel, or choose another solver"
        )
    return casadi


NEVER = 1e-15  # tolerance that does not end the iterations: they are counted


class OsqpSolver(BorrowedSolver[OsqpSettings]):
    """OSQP (Stellato et al., 2020): the alternating direction method of multipliers, cut off after q iterations.

    The matrices are scaled and factorised once, with a fixed rho; from problem to problem only vectors change.

    - An iteration is one of ADMM: a solve with the factors, and a projection of the rows. Calls continue where the last
      one stopped; OSQP keeps its multipliers, and begins each problem at the guess.
    - A truncated answer is near the problem's rows and box without keeping them; it is projected into the box. J is not
      monotonic (Definition 1 of the paper): see `docs/solvers.md`.
    """

    def reset(self) -> None:
        """Drop the object with its factors and multipliers."""
        self._osqp: Any = None

    def begin(self) -> bool:
        """Set the next problem and its guess; data that are no numbers it would never forget."""
        from osqp import OSQP  # noqa: PLC0415 with scipy.sparse, a fifth of what the optimiser loads at its start
        from scipy import sparse  # noqa: PLC0415

        problem = self.problem
        if not are_numbers(problem):
            return False
        lower = np.concatenate([problem.low, np.full(len(problem.gamma), -np.inf)])
        upper = np.concatenate([problem.high, problem.gamma])
        if self._osqp is None:
            self._osqp = OSQP()
            P = sparse.csc_matrix(np.triu(2.0 * problem.Phi))
            A = sparse.csc_matrix(np.vstack([np.eye(len(problem.phi)), problem.Gamma]))
            self._osqp.setup(
                P, problem.phi, A, lower, upper,
                rho=self.settings.rho, alpha=self.settings.relaxation, adaptive_rho=False, check_termination=0,
                eps_abs=NEVER, eps_rel=0.0, eps_prim_inf=NEVER, eps_dual_inf=NEVER, verbose=False,
            )  # fmt: skip
        else:
            self._osqp.update(q=problem.phi, l=lower, u=upper)
        self._osqp.warm_start(x=self.guess)
        return True

    def advance(self, count: int) -> tuple[int, tuple[Array, Array] | None]:
        """Iterate on from the last point and multipliers."""
        self._osqp.update_settings(max_iter=count)
        result = self._osqp.solve(raise_error=False)
        return count, (result.x, result.y[len(self.guess) :])


class DaqpSolver(BorrowedSolver[DaqpSettings]):
    """DAQP (Arnstrom et al., 2022): a dual active-set method that solves the problem exactly. An oracle, and an option.

    - An iteration is a complete solve, always from cold: the iterates of a dual method are infeasible until the last,
      and DAQP hands none out. So nothing is ever truncated, `tau_1_s` is a whole updating period, and more iterations
      change nothing.
    - J of the answer is that of the hard-constrained optimum, whatever the guess: after a guess that breaks rows a
      little to its advantage, J may rise (Definition 1 of the paper does not hold to the letter).
    """

    def begin(self) -> bool:
        """Take a problem that is still to be solved."""
        self._is_solved = False
        return are_numbers(self.problem)

    def advance(self, count: int) -> tuple[int, tuple[Array, Array] | None]:
        """Solve the problem, once."""
        if self._is_solved:
            return 0, None
        self._is_solved, problem, n = True, self.problem, len(self.guess)
        lower = np.full(n + len(problem.gamma), -UNBOUNDED)
        lower[:n] = np.maximum(problem.low, -UNBOUNDED)
        upper = np.minimum(np.concatenate([problem.high, problem.gamma]), UNBOUNDED)
        z, _, flag, info = daqp.solve(
            2.0 * problem.Phi, problem.phi.copy(), problem.Gamma, upper, lower, np.zeros(len(upper), np.int32),
            primal_tol=self.settings.primal_tolerance,
        )  # fmt: skip
        return min(count, 1), (z, info["lam"][n:]) if flag == 1 else None


UNBOUNDED: Final = 1e30
TOLERANCE: Final = 1e-9  # absolute and relative, of all residuals


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
    """An `OutsideMethod` by a library, imported when it is made; raises ConfigurationError if it is not installed."""

    name: ClassVar[str]
    """Name of the module, of the extra and of the entry point."""

    def __init__(self) -> None:
        self.alpha = PENALTY_WEIGHT
        try:
            self.library: Any = importlib.import_module(self.name)
        except ModuleNotFoundError:
            raise ConfigurationError(
                f"optimizer_plc.program.outside.solver: the library of {self.name} is not installed here: "
                f"pip install 'coldloop[{self.name}]', or choose another solver"
            ) from None

    def solve(self, problem: QuadraticProblem, guess: Array, iterations: int) -> tuple[Array, int]:
        """Return the point after so many iterations, fewer at the optimum, and their number; or the guess."""
        if not (iterations and is_well_posed(problem)):
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
