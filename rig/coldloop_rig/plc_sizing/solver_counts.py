"""What an iteration of each solver takes on the reference PLC, and what its `tau_1_s` follows."""

from collections.abc import Callable
from typing import Final, NamedTuple

from coldloop_optimizer_plc.settings import ProgramSettings, SolverName
from coldloop_rig.plc_sizing import operations
from coldloop_rig.plc_sizing.operations import Operations
from coldloop_rig.plc_sizing.reference_plc import ACTIVE_ROWS, WORKING_SET
from coldloop_rig.plc_sizing.sizes import QpSizes


class SolverCount(NamedTuple):
    """An iteration of a solver, with the usual number of active rows or of constraints held."""

    operations: Callable[[QpSizes], Operations]
    tau_1_s: Callable[[ProgramSettings], float]
    default: str
    """What the default of `tau_1_s` follows."""
    paper_s: float | None = None
    """Its time in the paper."""


def _ode(sizes: QpSizes) -> Operations:
    return operations.ode(sizes, ACTIVE_ROWS.mean)


def _interior_point(sizes: QpSizes) -> Operations:
    return operations.interior_point(sizes, ACTIVE_ROWS.mean)


SOLVERS: Final = {
    SolverName.ODE: SolverCount(_ode, lambda program: program.ode.tau_1_s, "paper", 0.25),
    SolverName.QPOASES: SolverCount(
        lambda sizes: operations.qpoases(sizes, WORKING_SET), lambda program: program.qpoases.tau_1_s, "paper", 0.48
    ),
    SolverName.OSQP: SolverCount(operations.osqp, lambda program: program.osqp.tau_1_s, "dense"),
    SolverName.FAST_GRADIENT: SolverCount(
        lambda sizes: operations.fast_gradient(sizes, ACTIVE_ROWS.mean),
        lambda program: program.fast_gradient.tau_1_s, "dense",
    ),
    SolverName.INTERIOR_POINT: SolverCount(
        _interior_point, lambda program: program.interior_point.tau_1_s, "our code"
    ),
    SolverName.HYBRID: SolverCount(
        lambda sizes: max(_ode(sizes), _interior_point(sizes)),
        lambda program: max(program.ode.tau_1_s, program.interior_point.tau_1_s), "the longer one",
    ),
    SolverName.DAQP: SolverCount(
        lambda sizes: operations.daqp(sizes, WORKING_SET), lambda program: program.daqp.tau_1_s, "one solve in 5 s"
    ),
}  # fmt: skip
