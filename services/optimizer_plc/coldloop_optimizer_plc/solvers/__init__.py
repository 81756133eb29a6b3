"""Solvers of the quadratic problem: one file each, one interface, joined here by name."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from coldloop_optimizer_plc.solvers.fast_gradient import fast_gradient_solver
from coldloop_optimizer_plc.solvers.hybrid import hybrid_solver
from coldloop_optimizer_plc.solvers.interface import Answer, KernelSolver, OutsideSolver, Solver, judged
from coldloop_optimizer_plc.solvers.interior_point import interior_point_solver
from coldloop_optimizer_plc.solvers.ode import ode_solver
from coldloop_optimizer_plc.solvers.outside_libraries import DaqpSolver, OsqpSolver, QpoasesSolver

if TYPE_CHECKING:
    from coldloop_optimizer_plc.settings import ProgramSettings

__all__ = ["Answer", "KernelSolver", "Solver", "judged", "make_solver"]
_MAKERS: "dict[str, Callable[[ProgramSettings], Solver]]" = {
    "ode": lambda settings: ode_solver(settings.ode, settings.penalties),
    "qpoases": lambda settings: QpoasesSolver(settings.qpoases),
    "osqp": lambda settings: OsqpSolver(settings.osqp),
    "fast-gradient": lambda settings: fast_gradient_solver(settings.fast_gradient),
    "interior-point": lambda settings: interior_point_solver(settings.interior_point),
    "hybrid": lambda settings: hybrid_solver(
        settings.hybrid, settings.interior_point, settings.ode, settings.adaptive.cost_floor, settings.penalties
    ),
    "daqp": lambda settings: DaqpSolver(settings.daqp),
}


def make_solver(settings: "ProgramSettings") -> Solver:
    """Return the solver that the settings name."""
    return OutsideSolver(settings.outside) if settings.outside.solver else _MAKERS[settings.solver](settings)
