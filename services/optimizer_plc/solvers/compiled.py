"""The solvers that are kernels of our own as one kernel: what the program does with one of them in an updating period.

`solve` has the bits of `start`, `iterate(slots - 1)` and `iterate(1)` of the solver itself. Double precision only.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.compiled import kernel
from optimizer_plc.costs import Matrices, augmented_cost, matrices_of
from optimizer_plc.problem import QuadraticProblem
from optimizer_plc.settings import ProgramSettings
from optimizer_plc.solvers import fast_gradient, hybrid, interior_point, ode
from optimizer_plc.solvers.fast_gradient import FastGradientSolver, Momentum, step_sizes
from optimizer_plc.solvers.hybrid import HybridSolver
from optimizer_plc.solvers.interface import Solver
from optimizer_plc.solvers.interior_point import InteriorPointSolver, Path, Structure, path_in, structure_of
from optimizer_plc.solvers.ode import Flow, OdeSolver, flow_in

Array = NDArray[np.float64]

ODE, INTERIOR_POINT, HYBRID, FAST_GRADIENT = 0, 1, 2, 3
KINDS: Final[dict[type, int]] = {
    OdeSolver: ODE, InteriorPointSolver: INTERIOR_POINT, HybridSolver: HYBRID, FastGradientSolver: FAST_GRADIENT,
}  # fmt: skip


class SolverConstants(NamedTuple):
    """What the solvers compute with that never changes in a session; `kind` says which of them is asked for."""

    kind: int
    alpha: float
    slot_s: float
    """tau_1 of the solver that is asked for."""
    ode_s: float
    """tau_1 of the ODE-based solver."""
    interior_s: float
    """tau_1 of the interior-point solver."""
    switch: float
    """Of the hybrid solver."""
    floor: float
    """Constant that J has besides that of the problem."""
    matrices: Matrices
    flow: Flow
    structure: Structure
    path: Path
    steps: Array
    """Of the fast gradient method, shape (n,)."""
    adaptive_restart: bool


def solver_constants(solver: Solver, settings: ProgramSettings, qp: QuadraticProblem) -> SolverConstants:
    """Return the constants of a solver of a known kind, for a problem like this one."""
    fast = settings.fast_gradient
    return SolverConstants(
        kind=KINDS[type(solver)],
        alpha=solver.alpha,
        slot_s=solver.tau_1_s,
        ode_s=settings.ode.tau_1_s,
        interior_s=settings.interior_point.tau_1_s,
        switch=settings.hybrid.switch,
        floor=settings.adaptive.cost_floor,
        matrices=matrices_of(qp),
        flow=flow_in(settings.ode, settings.penalties, np.float64),
        structure=structure_of(qp),
        path=path_in(settings.interior_point, len(qp.phi) + len(qp.gamma), np.float64),
        steps=step_sizes(qp.Phi, qp.Gamma, fast.alpha),
        adaptive_restart=fast.adaptive_restart,
    )


class Costs(NamedTuple):
    """Of a problem, with constant and floor; infinite where there was none."""

    guessed: float
    """J+."""
    delivered: float
    """Jhat."""


class Answer(NamedTuple):
    """What comes of a problem; costs are without the problem's constant."""

    z: Array
    """Shape (n,)."""
    guessed: float
    """J+, the cost of the guess."""
    last_but_one: float
    """The cost a slot before the end."""
    delivered: float
    slots: int
    """That passed; fewer than were allowed when more iterations would change nothing."""


@kernel
def solve(c: SolverConstants, qp: QuadraticProblem, guess: Array, slots: int, before: Costs) -> Answer:
    """Return the answer of the solver after so many slots.

    Args:
        c: Which solver, and its constants.
        qp: The problem.
        guess: To begin with, shape (n,).
        slots: Iterations of the solver; of the hybrid one, times of the longer of its two.
        before: Of the problem before, for the hybrid solver.
    """
    if c.kind == FAST_GRADIENT:
        return by_fast_gradient(c, qp, guess, slots)
    if c.kind == INTERIOR_POINT:
        return by_interior_point(c, qp, guess, slots)
    z, guessed, dt = ode.warm_start(c.matrices, qp, guess, c.flow)
    if c.kind == HYBRID:
        whole = max(guessed + (qp.constant + c.floor), c.floor)
        if _is_far(c.switch, whole, before.guessed, before.delivered):
            return by_interior_point(c, qp, guess, slots)
    first, every = _iterations_in(slots - 1, c.slot_s, c.ode_s), _iterations_in(slots, c.slot_s, c.ode_s)
    active = np.zeros_like(qp.gamma)
    done, stalled, cost, dt = ode.descend(c.matrices, qp, z, active, guessed, dt, 0, first, c.flow)
    passed = _slots_passed(done, first, 0, slots - 1, c.slot_s, c.ode_s)
    last_but_one = cost
    more, stalled, cost, dt = ode.descend(c.matrices, qp, z, active, cost, dt, stalled, every - done, c.flow)
    passed += _slots_passed(done + more, every, slots - 1, 1, c.slot_s, c.ode_s)
    return Answer(z, guessed, last_but_one, cost, passed)


@kernel
def by_interior_point(c: SolverConstants, qp: QuadraticProblem, guess: Array, slots: int) -> Answer:
    """Return the answer of the interior-point method in the time of so many slots."""
    first, every = _iterations_in(slots - 1, c.slot_s, c.interior_s), _iterations_in(slots, c.slot_s, c.interior_s)
    z, rows = np.empty_like(qp.phi), np.empty_like(qp.gamma)
    guessed, point = interior_point.begin(c.structure, qp, guess, c.path, z, rows)
    done, cost, point = interior_point.descend(c.structure, qp, c.path, point, z, rows, guessed, first)
    passed = _slots_passed(done, first, 0, slots - 1, c.slot_s, c.interior_s)
    last_but_one = cost
    more, cost, point = interior_point.descend(c.structure, qp, c.path, point, z, rows, cost, every - done)
    passed += _slots_passed(done + more, every, slots - 1, 1, c.slot_s, c.interior_s)
    return Answer(z, guessed, last_but_one, cost, passed)


@kernel
def by_fast_gradient(c: SolverConstants, qp: QuadraticProblem, guess: Array, count: int) -> Answer:
    """Return the answer of the fast gradient method after so many iterations."""
    z = np.empty_like(guess)
    for i in range(z.shape[0]):
        z[i] = min(max(guess[i], qp.low[i]), qp.high[i])
    momentum = Momentum(z.copy(), np.ones(1))
    guessed = augmented_cost(qp, z, c.alpha)
    fast_gradient.descend(c.matrices, qp, z, momentum, c.steps, c.alpha, c.adaptive_restart, count - 1)
    last_but_one = augmented_cost(qp, z, c.alpha)
    fast_gradient.descend(c.matrices, qp, z, momentum, c.steps, c.alpha, c.adaptive_restart, 1)
    return Answer(z, guessed, last_but_one, augmented_cost(qp, z, c.alpha), count)


_is_far, _iterations_in, _slots_passed = (
    kernel(hybrid.is_far),
    kernel(hybrid.iterations_in),
    kernel(hybrid.slots_passed),
)
