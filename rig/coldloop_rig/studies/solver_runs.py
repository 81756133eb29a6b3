"""How solvers are throttled to a power P in the studies: 5 s updating period, all of it for iterations.

The paper compares 20 iterations of the ODE-based solver with 10 of qpOASES: 5 s over tau_1, without a slot for the
preparation (section V), so that slot is left out here.
"""

from coldloop_rig.studies.request import Procedure, RunRequest
from coldloop_rig.studies.study import PROGRAM, Load

PERIOD_S = 5.0
UNLIMITED = 50.0
"""Power at which qpOASES makes 526 recalculations in a period: more than any problem takes."""


def throttled(
    load: Load, solver: str, power: float, trace_ticks: int = 0, procedure: Procedure = Procedure.CONFIGURED
) -> RunRequest:
    """Return the run of a solver at a power, relative to the PLC of the paper."""
    return load.request(
        PERIOD_S,
        f"{PROGRAM}solver={solver}",
        f"{PROGRAM}budget.power={power}",
        f"{PROGRAM}budget.preparation_slots=0",
        trace_ticks=trace_ticks,
        procedure=procedure,
    )
