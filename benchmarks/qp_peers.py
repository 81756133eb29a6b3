"""PIQP, ProxQP and Clarabel on the controller's problems, cut off after a number of iterations.

They get J itself: each row may be broken, and by how much is a variable t >= 0 that costs alpha t^2. What comes back is
projected into the box and judged by J. PIQP and Clarabel are interior-point methods that begin at a point of their own;
ProxQP, an augmented Lagrangian method, begins at the guess, and an iteration of it is one Newton step in one outer
iteration. Optional: `pip install -r benchmarks/qp_peers.txt`.
"""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from optimizer_plc.qp.problem import QuadraticProblem

Array = NDArray[np.float64]

UNBOUNDED: Final = 1e30
TO_THE_END: Final = 200
"""Iterations after which all of them have converged."""
TOLERANCE: Final = 1e-9


class SoftProblem(NamedTuple):
    """min x' H x / 2 + g' x under C x <= u and low <= x <= high, with x = (z, t)."""

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


def piqp(p: SoftProblem, guess: Array, count: int) -> Array:  # noqa: ARG001 it begins at a point of its own
    """Return x after `count` iterations of PIQP (Schwan, Jiang, Kuhn, Jones, 2023)."""
    import piqp as library  # noqa: PLC0415 optional

    solver = library.DenseSolver()
    solver.settings.max_iter = count
    solver.settings.eps_abs = solver.settings.eps_rel = TOLERANCE
    below = np.full(len(p.u), -UNBOUNDED)
    solver.setup(np.asfortranarray(p.H), p.g, None, None, np.asfortranarray(p.C), below, p.u, p.low, p.high)
    solver.solve()
    return np.array(solver.result.x)


def proxqp(p: SoftProblem, guess: Array, count: int) -> Array:
    """Return x after `count` iterations of ProxQP (Bambade, El-Kazdadi, Taylor, Carpentier, 2022)."""
    from proxsuite import proxqp as library  # noqa: PLC0415 optional

    n, m = len(p.g), len(p.u)
    solver = library.dense.QP(n, 0, m + n)  # the box as rows: a warm start beside a box of its own is an error in 0.8.0
    solver.settings.max_iter, solver.settings.max_iter_in = count, 1
    solver.settings.eps_abs = TOLERANCE
    solver.settings.initial_guess = library.InitialGuess.WARM_START
    low, high = np.concatenate([np.full(m, -UNBOUNDED), p.low]), np.concatenate([p.u, p.high])
    solver.init(p.H, p.g, None, None, np.vstack([p.C, np.eye(n)]), low, high)
    solver.solve(guess, None, np.zeros(m + n))
    return np.array(solver.results.x)


def clarabel(p: SoftProblem, guess: Array, count: int) -> Array:  # noqa: ARG001 it begins at a point of its own
    """Return x after `count` iterations of Clarabel (Goulart, Chen, 2024)."""
    import clarabel as library  # noqa: PLC0415 optional

    above, below = p.high < UNBOUNDED, p.low > -UNBOUNDED
    one = np.eye(len(p.g))
    rows = sparse.csc_matrix(np.vstack([p.C, one[above], -one[below]]))
    limits = np.concatenate([p.u, p.high[above], -p.low[below]])
    settings = library.DefaultSettings()
    settings.verbose, settings.max_iter = False, count
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    cones = [library.NonnegativeConeT(len(limits))]
    solver = library.DefaultSolver(sparse.triu(p.H, format="csc"), p.g, rows, limits, cones, settings)
    return np.array(solver.solve().x)


_EVERY: Final[dict[str, tuple[str, Callable[[SoftProblem, Array, int], Array]]]] = {
    "piqp": ("piqp", piqp), "proxqp": ("proxsuite", proxqp), "clarabel": ("clarabel", clarabel),
}  # fmt: skip


def installed_peers() -> dict[str, Callable[[SoftProblem, Array, int], Array]]:
    """Return those that are installed; print a line that names the others."""
    found: dict[str, Any] = {name: solve for name, (module, solve) in _EVERY.items() if find_spec(module)}
    absent = [name for name in _EVERY if name not in found]
    if absent:
        print(f"without {', '.join(absent)}: pip install -r benchmarks/qp_peers.txt")
    return found


def peer_answer(
    solve: Callable[[SoftProblem, Array, int], Array], qp: QuadraticProblem, alpha: float, guess: Array, count: int
) -> Array:
    """Return the profile (n,) of one of them after `count` iterations, inside the box; the guess if it has none."""
    n = len(qp.phi)
    excess = np.maximum(qp.Gamma @ np.clip(guess, qp.low, qp.high) - qp.gamma, 0.0)
    x = solve(softened(qp, alpha), np.concatenate([guess, excess]), count)[:n]
    z: Array = np.clip(np.where(np.isfinite(x), x, guess), qp.low, qp.high)
    return z
