"""Throttled qpOASES (Ferreau et al., 2014): the online active-set method, cut off after q working-set recalculations.

qpOASES moves along the line from the previous problem to the present one and stops wherever the working set changes.
It is the qpOASES inside CasADi; its CPU-time limit is not used, since it would make runs irreproducible.

- An iteration is one step of that homotopy. The limit nWSR of a CasADi object is fixed when it is made, so ours is 1
  and an iteration is a call: another call with the same data continues along the same line, and a steps and then b are
  a + b steps to the bit. One object with nWSR = q gives the same points to rounding until, at some
  harsh load jumps, it takes another path (ramping restarts at each call); neither is better on average.
- A truncated answer is the optimum of an intermediate problem. It may violate the box and the rows of the present one;
  it is projected into the box. J is not monotonic (Definition 1 of the paper): see `docs/solvers.md`.
- The guess is what `solution` is until the first iteration. The method itself continues from where it stopped before.
- A chain begins at an optimum, as `qpOASES_sequence` is begun by 'i' before it is hot-started: the first problem of a
  session is solved to the end, whatever the count.
"""

import importlib
import io
from collections.abc import Sequence
from contextlib import redirect_stdout
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop_optimizer_plc.computing_settings import QpoasesSettings
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import Answer, collected

Array = NDArray[np.float64]

SOLVED, ON_THE_WAY = "SOLVER_RET_SUCCESS", "SOLVER_RET_LIMITED"
FIRST_SOLVE_LIMIT = 10_000
"""Steps after which the first problem of a chain is given up; it takes some tens."""


class QpoasesSolver:
    """One homotopy step an iteration, hot-started from problem to problem."""

    def __init__(self, settings: QpoasesSettings) -> None:
        self.alpha = settings.alpha
        self.tau_1_s = settings.tau_1_s
        self._casadi = load_casadi()
        self._chain: _Chain | None = None

    def reset(self) -> None:
        """Drop the chain: the next problem begins a new one."""
        self._chain = None

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        """Go along the homotopy to this problem, or up to its end; the guess is the answer until the first step."""
        guess = np.clip(guess, problem.low, problem.high)
        z, multipliers, done = guess, np.zeros_like(problem.gamma), 0
        status = ON_THE_WAY if _well_posed(problem) else "ill-posed data"
        if status == ON_THE_WAY:  # other data never reach the chain, which they would end
            self._begin_or_continue(problem)
        points, iterations = [], []
        for count in counts:
            before = done
            while done < count and self._chain is not None and status == ON_THE_WAY:
                status = self._chain.step()
                done += 1
            if self._chain is not None and done > before:
                if status in (SOLVED, ON_THE_WAY):
                    z = np.clip(self._chain.z, problem.low, problem.high)
                    multipliers = np.maximum(self._chain.multipliers, 0.0)
                else:  # a chain that broke stays broken; the answer is the last one that was good
                    self._chain = None
            points.append(z)
            iterations.append(done)
        return collected(problem, self.alpha, guess, points, iterations, multipliers)

    def _begin_or_continue(self, problem: QuadraticProblem) -> None:
        fresh = self._chain is None
        if self._chain is None:
            self._chain = _Chain(self._casadi, problem)
        self._chain.set_target(problem)
        if fresh:
            for _ in range(FIRST_SOLVE_LIMIT):
                if self._chain.step() != ON_THE_WAY:
                    break


def _well_posed(problem: QuadraticProblem) -> bool:
    vectors = (problem.phi, problem.gamma, problem.low)
    return all(np.isfinite(v).all() for v in vectors) and bool((problem.low <= problem.high).all())


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

    @property
    def z(self) -> Array:
        return self._outputs["x"]

    @property
    def multipliers(self) -> Array:
        return self._outputs["lam_a"]


@cache
def load_casadi() -> ModuleType:
    """Import CasADi, which is large and optional.

    Raises:
        ConfigurationError: It is not installed, or has no qpOASES.
    """
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
