"""Solvers of the quadratic problem: one file each, one interface, joined here by name; `hybrid`, which chooses of two.

`hybrid` solves problems far from their optimum by the interior point, those in quiet by the ODE-based solver. An
interior point needs some iterations before it is good, and is at the optimum then; the ODE-based solver makes the
most of few. With J+_k the cost of the guess of a problem and Jhat_k that of its answer, both with constant and floor,
the interior-point solver gets problem k if

    max(J+_k, J+_{k-1}) > switch Jhat_{k-1}

that is, after a load step (or any other disturbance), and while the problem before was still being improved. All of
it is known when the problem begins.

The PLC's time is counted in slots, each as long as the longer of both iterations. In the time of its slots the chosen
solver does as many of its own iterations as fit, never more; what is left of a slot counts for the next one.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.qp.costs import matrices_of
from coldloop_optimizer_plc.qp.linear_algebra import Array
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.settings import ProgramSettings
from coldloop_optimizer_plc.solvers import interface, interior_point, ode
from coldloop_optimizer_plc.solvers.fast_gradient import fast_gradient_solver
from coldloop_optimizer_plc.solvers.interface import Answer, KernelSolver, Solver, judged
from coldloop_optimizer_plc.solvers.outside_libraries import DaqpSolver, OsqpSolver, QpoasesSolver

__all__ = ["Answer", "KernelSolver", "Solver", "judged", "make_solver"]


Counts = NDArray[np.int64]

PICOSECONDS = 1_000_000_000_000
ROUNDING = 1_000_000_000
"""A time that misses a whole number of slots or iterations by less than this part of one counts as that number."""


class HybridMethod(NamedTuple):
    """Constants of the solver, the same for all problems; J has `floor` besides the constant of the problem.

    slot_ps, ode_ps, interior_point_ps: a slot, and tau_1 of each of the two solvers.
    """

    ode: ode.OdeMethod
    interior_point: interior_point.InteriorPointMethod
    switch: float
    floor: float
    slot_ps: int
    ode_ps: int
    interior_point_ps: int


def hybrid_solver(settings: ProgramSettings) -> KernelSolver:
    """Return the solver, which keeps the costs of guess and answer from one problem to the next."""
    far, quiet, floor = settings.interior_point, settings.ode, settings.adaptive.cost_floor  # with the same alpha
    slot_s = max(far.tau_1_s, quiet.tau_1_s)

    def method(problem: QuadraticProblem) -> HybridMethod:
        real = problem.phi.dtype.type
        return HybridMethod(
            ode.OdeMethod(matrices_of(problem), ode.flow_in(quiet, settings.penalties, real)),
            interior_point.method_of(far, problem), real(settings.hybrid.switch), real(floor),
            picoseconds(slot_s), picoseconds(quiet.tau_1_s), picoseconds(far.tau_1_s),
        )  # fmt: skip

    return KernelSolver(method, quiet.alpha, slot_s, floor)


def picoseconds(seconds: float) -> int:
    """Return a time as a whole number: what fits into what is then decided without rounding, in any precision."""
    return round(seconds * PICOSECONDS)


@kernel
def is_far(switch: float, guessed: float, before: interface.Costs) -> bool:
    """Return whether a problem is far from its optimum, from J+_k, J+_{k-1} and Jhat_{k-1}."""
    return max(guessed, before.guessed) > switch * before.delivered


@kernel
def iterations_in(slots: Counts, slot_ps: int, tau_1_ps: int) -> Counts:
    """Return the iterations of `tau_1_ps` that fit into the time of each number of slots, shape (k,)."""
    return (slots * slot_ps + tau_1_ps // ROUNDING) // tau_1_ps


@kernel
def slots_begun(iterations: int, slot_ps: int, tau_1_ps: int) -> int:
    """Return the slots that so many iterations need, the last one begun."""
    return -((slot_ps // ROUNDING - iterations * tau_1_ps) // slot_ps)


@kernel
def in_slots(answer: Answer, slots: Counts, allowed: Counts, slot_ps: int, tau_1_ps: int) -> Answer:
    """Return an answer with its iterations counted in slots: fewer passed when the solver ended by itself."""
    passed, latest = np.empty_like(slots), 0
    for k in range(slots.shape[0]):
        ended = answer.iterations[k] < allowed[k]
        latest = max(latest, slots_begun(answer.iterations[k], slot_ps, tau_1_ps)) if ended else slots[k]
        passed[k] = latest
    return Answer(answer.guessed, answer.points, answer.costs, passed, answer.multipliers)


@interface.solves_by(HybridMethod)
@kernel
def solve_hybrid(
    c: HybridMethod, qp: QuadraticProblem, guess: Array, counts: Counts, before: interface.Costs
) -> Answer:
    """Return the answer of the chosen solver after each number of slots."""
    z, guessed, dt = ode.warm_start(c.ode.matrices, qp, guess, c.ode.flow)
    if is_far(c.switch, max(guessed + (qp.constant + c.floor), c.floor), before):
        allowed = iterations_in(counts, c.slot_ps, c.interior_point_ps)
        answer = interior_point.solve(c.interior_point, qp, guess, allowed, before)
        return in_slots(answer, counts, allowed, c.slot_ps, c.interior_point_ps)
    allowed = iterations_in(counts, c.slot_ps, c.ode_ps)
    answer = ode.follow(c.ode, qp, z, guessed, dt, allowed)
    return in_slots(answer, counts, allowed, c.slot_ps, c.ode_ps)


_MAKERS: dict[str, Callable[[ProgramSettings], Solver]] = {
    "ode": lambda settings: ode.ode_solver(settings.ode, settings.penalties),
    "qpoases": lambda settings: QpoasesSolver(settings.qpoases),
    "osqp": lambda settings: OsqpSolver(settings.osqp),
    "fast-gradient": lambda settings: fast_gradient_solver(settings.fast_gradient),
    "interior-point": lambda settings: interior_point.interior_point_solver(settings.interior_point),
    "hybrid": hybrid_solver,
    "daqp": lambda settings: DaqpSolver(settings.daqp),
}


def make_solver(settings: ProgramSettings) -> Solver:
    """Return the solver that the settings name."""
    return interface.OutsideSolver(settings.outside) if settings.outside.solver else _MAKERS[settings.solver](settings)
