"""The paired part of the solver comparison: every solver and every power on the same problems, as they are played."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from coldloop_plant.load import HOUR_TICKS
from coldloop_rig.figures.plot import COLOURS
from coldloop_rig.studies import published
from coldloop_rig.studies.drawing import above_lowest, legend_outside, panels
from coldloop_rig.studies.intervals import Interval
from coldloop_rig.studies.paired_sums import PairedSums
from coldloop_rig.studies.request import Procedure, RunRequest
from coldloop_rig.studies.solver_runs import throttled
from coldloop_rig.studies.study import Load, Outcomes, StudyOptions, loads
from coldloop_rig.text_tables import markdown_table

DRAWS: Final = 10
"""Of the eight hours' families, an hour each, unless another number is asked for."""
FEW_POWERS: Final = (0.2, 0.6, 1.0, 2.0, 4.0, 10.0)
QUICK_POWERS: Final = (0.2, 1.0, 25.0)
LABELS: Final = {
    "ode": "ODE", "qpoases": "qpOASES", "interior-point": "interior point", "osqp": "OSQP",
    "fast-gradient": "fast gradient", "daqp": "DAQP, one solve",
}  # fmt: skip


def paper_powers(options: StudyOptions) -> tuple[float, ...]:
    """Return the powers of the paper's figure, or three of them."""
    return QUICK_POWERS if options.quick else tuple(published.solver_comparison()["ode"]["normalized_power"].tolist())


def powers_of(solver: str, options: StudyOptions) -> tuple[float, ...]:
    """Return the powers at which a solver is compared."""
    if solver in ("ode", "qpoases") or options.quick:
        return paper_powers(options)
    return (1.0,) if solver == "daqp" else FEW_POWERS


def paired_loads(options: StudyOptions) -> list[Load]:
    """Return the draws, an hour of each."""
    return loads(options, "8h", usual=DRAWS, longest_ticks=HOUR_TICKS)


def paired_request(load: Load, solver: str, power: float) -> RunRequest:
    """Return the request for one solver at one power on the problems of a load."""
    return throttled(load, solver, power, procedure=Procedure.PAIRED_PROBLEMS)


def paired_requests(options: StudyOptions) -> list[RunRequest]:
    """Return all of them, load by load: a worker has the problems of a load at hand."""
    return [
        paired_request(load, solver, power)
        for load in paired_loads(options)
        for solver in LABELS
        for power in powers_of(solver, options)
    ]


OpenLoop = PairedSums[str]


def open_loop(options: StudyOptions, outcomes: Outcomes) -> OpenLoop:
    """Gather the outcomes.

    Raises:
        StudyError: A profile costs less than the optimum.
    """
    powers = {solver: powers_of(solver, options) for solver in LABELS}
    return PairedSums(paired_loads(options), powers, paired_request, str, outcomes)


def open_loop_table(found: OpenLoop) -> str:
    """Return total costs over the lowest with their intervals, and where solvers cross, as Markdown."""
    some = [power for power in FEW_POWERS if any(power in powers for powers in found.powers.values())]
    caption = (
        f"**Paired, open loop**: total cost of all draws ({len(found.loads)}) over the lowest cost of any profile "
        "that can be played [95 % interval over the draws]. All solvers have the same problems, each with "
        "its own hot starts, and are judged by what the control PLC would play; no ratio can be below 1."
    )
    rows = []
    for solver, powers in found.powers.items():
        cells = [found.interval(solver, power).brief(4) if power in powers else "" for power in some]
        rows.append((LABELS[solver], *cells))
    table = markdown_table(("solver", *(f"P = {power:g}" for power in some)), rows, caption)
    crossings = [_crossing_text(found.crossing("qpoases", other), LABELS[other]) for other in ("ode", "interior-point")]
    return "\n\n".join([table, *crossings])


def _crossing_text(power: Interval, other: str) -> str:
    if np.isnan(power.value):
        return f"At no power does qpOASES cost as little as {other}, all draws together."
    return f"qpOASES costs no more than {other} from P = {power.brief()} on."


def open_loop_figure(found: OpenLoop) -> Figure:
    """Draw by which share the total cost is above the lowest, against power, with intervals."""
    with panels(1, 1, 3.0) as (figure, (place,)):
        for (solver, powers), colour in zip(found.powers.items(), COLOURS, strict=False):
            intervals = [found.interval(solver, power) for power in powers]
            above_lowest(place, powers, intervals, colour, LABELS[solver])
        legend_outside(figure, place)
    return figure
