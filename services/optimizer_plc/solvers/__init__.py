"""Solvers of the quadratic problem: one file each, one interface, joined here by name."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from optimizer_plc.solvers.daqp import DaqpSolver
from optimizer_plc.solvers.fast_gradient import FastGradientSolver
from optimizer_plc.solvers.hybrid import HybridSolver
from optimizer_plc.solvers.interface import Solver
from optimizer_plc.solvers.interior_point import InteriorPointSolver
from optimizer_plc.solvers.ode import OdeSolver
from optimizer_plc.solvers.osqp import OsqpSolver
from optimizer_plc.solvers.qpoases import QpoasesSolver

if TYPE_CHECKING:
    from optimizer_plc.settings import ProgramSettings

__all__ = ["Solver", "make_solver"]

_MAKERS: "dict[str, Callable[[ProgramSettings], Solver]]" = {
    "ode": lambda settings: OdeSolver(settings.ode, settings.penalties),
    "qpoases": lambda settings: QpoasesSolver(settings.qpoases),
    "osqp": lambda settings: OsqpSolver(settings.osqp),
    "fast-gradient": lambda settings: FastGradientSolver(settings.fast_gradient),
    "interior-point": lambda settings: InteriorPointSolver(settings.interior_point),
    "hybrid": lambda settings: HybridSolver(
        settings.hybrid,
        InteriorPointSolver(settings.interior_point),
        OdeSolver(settings.ode, settings.penalties),
        settings.adaptive.cost_floor,
    ),
    "daqp": lambda settings: DaqpSolver(settings.daqp),
}


def make_solver(settings: "ProgramSettings") -> Solver:
    """Return the solver that the settings name."""
    return _MAKERS[settings.solver](settings)
