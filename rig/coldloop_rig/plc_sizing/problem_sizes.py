"""How long iterations and preparation take for a problem of other sizes than the cold box's, by counted operations."""

from typing import Final, NamedTuple

from coldloop_optimizer_plc.settings import SolverName
from coldloop_rig.plc_sizing.operations import PreparationSizes, preparation
from coldloop_rig.plc_sizing.reference_plc import ACTIVE_ROWS
from coldloop_rig.plc_sizing.sizes import dense_sizes
from coldloop_rig.plc_sizing.solver_counts import SOLVERS

COUNTED: Final = tuple(name for name in SolverName if name is not SolverName.HYBRID)
"""Solvers with an iteration time of their own."""


class ProblemSizes(NamedTuple):
    """What the sizes of a problem follow from."""

    knots: int
    inputs: int
    outputs: int
    bands: int
    constraints: int
    """Constraint instants."""
    states: int
    """With those of the estimated constants and of the load."""


COLD_BOX_SIZES: Final = ProblemSizes(knots=7, inputs=3, outputs=22, bands=2, constraints=14, states=49)


def iteration_shares(sizes: ProblemSizes) -> dict[str, float]:
    """Return the time of each solver's iteration, and of the preparation, over those of the cold box's problem.

    Dense operations are counted in both, with the cold box's number of active rows.
    """
    here, there = (_operations(each) for each in (sizes, COLD_BOX_SIZES))
    return {name: here[name] / there[name] for name in here}


def _operations(sizes: ProblemSizes) -> dict[str, float]:
    n_inputs, rate_rows = sizes.knots * sizes.inputs, 2 * sizes.knots * sizes.inputs
    rows = 2 * sizes.bands * sizes.constraints + rate_rows
    problem = dense_sizes(n_inputs + 2 * sizes.bands * sizes.knots, rows, n_inputs)
    once = PreparationSizes(
        problem=problem, rate_rows=rate_rows, knots=sizes.knots, states=sizes.states, inputs=sizes.inputs,
        outputs=sizes.outputs, segments=1, samples=1, targets=False, limited=False,
    )  # fmt: skip
    counts = {str(name): SOLVERS[name].operations(problem).flops for name in COUNTED}
    return {**counts, "preparation": preparation(once, ACTIVE_ROWS.mean).flops}
