"""Solvers of the quadratic problem: one file each, one interface, joined here by name."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from optimizer_plc.solvers.interface import Solver
from optimizer_plc.solvers.ode import OdeSolver

if TYPE_CHECKING:
    from optimizer_plc.settings import ProgramSettings

__all__ = ["Solver", "make_solver"]

_MAKERS: "dict[str, Callable[[ProgramSettings], Solver]]" = {
    "ode": lambda settings: OdeSolver(settings.ode),
}


def make_solver(settings: "ProgramSettings") -> Solver:
    """Return the solver that the settings name."""
    return _MAKERS[settings.solver](settings)
