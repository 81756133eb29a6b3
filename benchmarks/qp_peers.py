"""PIQP, ProxQP, Clarabel and QPALM on the controller's problems, cut off after a number of iterations.

All but ProxQP are the outside solvers of these names (`coldloop_optimizer_plc/solvers/outside_libraries.py`). ProxQP,
an augmented Lagrangian method, gets the same problems with soft rows and begins at the guess; an iteration of it is one
Newton step in one outer iteration. What comes back is projected into the box and judged by J. Optional:
`pip install -r benchmarks/qp_peers.txt`, and `pip install 'coldloop[qpalm]'`.
"""

from importlib.util import find_spec
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.outside_libraries import (
    TOLERANCE,
    UNBOUNDED,
    Clarabel,
    Library,
    Piqp,
    Qpalm,
    SoftProblem,
)

Array = NDArray[np.float64]

TO_THE_END: Final = 200
"""Iterations after which all of them have converged."""


class Proxqp(Library):
    """ProxQP (Bambade, El-Kazdadi, Taylor, Carpentier, 2022)."""

    name = "proxsuite"

    def iterated(self, p: SoftProblem, first: Array, count: int) -> tuple[Array, int]:
        """Begin at `first`."""
        library = self.library.proxqp
        n, m = len(p.g), len(p.u)
        solver = library.dense.QP(n, 0, m + n)  # the box as rows: a warm start beside its own box fails in 0.8.0
        solver.settings.max_iter, solver.settings.max_iter_in = count, 1
        solver.settings.eps_abs = TOLERANCE
        solver.settings.initial_guess = library.InitialGuess.WARM_START
        low, high = np.concatenate([np.full(m, -UNBOUNDED), p.low]), np.concatenate([p.u, p.high])
        solver.init(p.H, p.g, None, None, np.vstack([p.C, np.eye(n)]), low, high)
        solver.solve(first, None, np.zeros(m + n))
        return np.array(solver.results.x), solver.results.info.iter


_EVERY: Final[dict[str, type[Library]]] = {"piqp": Piqp, "proxqp": Proxqp, "clarabel": Clarabel, "qpalm": Qpalm}


def installed_peers() -> dict[str, Library]:
    """Return those that are installed; print a line that names the others."""
    found = {name: each() for name, each in _EVERY.items() if find_spec(each.name)}
    absent = [name for name in _EVERY if name not in found]
    if absent:
        print(f"without {', '.join(absent)}: pip install -r benchmarks/qp_peers.txt 'coldloop[qpalm]'")
    return found


def peer_answer(peer: Library, qp: QuadraticProblem, alpha: float, guess: Array, count: int) -> Array:
    """Return the profile (n,) of one of them after `count` iterations, inside the box; the guess if it has none."""
    peer.alpha = alpha
    guess = np.clip(guess, qp.low, qp.high)
    x, _ = peer.solve(qp, guess, count)
    z: Array = np.clip(np.where(np.isfinite(x), x, guess), qp.low, qp.high)
    return z
