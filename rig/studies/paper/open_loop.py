"""The paired part of the solver comparison: every solver and every power on the same problems, as they are played."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coldloop.errors import StudyError
from plant.load import HOUR_TICKS
from rig.figures.plot import COLOURS
from rig.studies import published
from rig.studies.crossing import crossing
from rig.studies.drawing import above_lowest, legend_outside, panels
from rig.studies.intervals import Interval, over_draws
from rig.studies.request import Outcome, Procedure, RunRequest, Series
from rig.studies.solver_runs import throttled
from rig.studies.study import Load, Outcomes, StudyOptions, loads
from rig.text_tables import markdown_table

DRAWS: Final = 10
"""Of the eight hours' families, an hour each, unless another number is asked for."""
FEW_POWERS: Final = (0.2, 0.6, 1.0, 2.0, 4.0, 10.0)
QUICK_POWERS: Final = (0.2, 1.0, 25.0)
LABELS: Final = {
    "ode": "ODE", "qpoases": "qpOASES", "interior-point": "interior point", "osqp": "OSQP",
    "fast-gradient": "fast gradient", "daqp": "DAQP, one solve",
}  # fmt: skip
BELOW: Final = 1e-9
"""Share of the lowest cost, or of 1, by which rounding may let a cost be below it."""


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


@dataclass(frozen=True)
class OpenLoop:
    """What all draws gave."""

    loads: Sequence[Load]
    powers: Mapping[str, Series]
    tables: Sequence[Mapping[str, Mapping[str, Series]]]
    """For each draw, by solver: J_dev, J_cst, J_total, c1, c2 and the sum of the lowest costs against power."""

    @classmethod
    def of(cls, options: StudyOptions, outcomes: Outcomes) -> "OpenLoop":
        """Gather the outcomes.

        Raises:
            StudyError: A profile costs less than the optimum: the study, or the optimum, is wrong.
        """
        drawn = paired_loads(options)
        powers = {solver: np.array(powers_of(solver, options)) for solver in LABELS}
        return cls(drawn, powers, [
            {solver: _against_power(load, solver, powers[solver], outcomes) for solver in powers} for load in drawn
        ])  # fmt: skip

    def relative(self, solver: str, power: int, which: list[int]) -> float:
        """Return the total cost of a solver over the lowest, of some draws together, at the power of this number."""
        total, lowest = (
            sum(self.tables[draw][solver][name][power] for draw in which) for name in ("J_total", "lowest")
        )
        return float(total / lowest)

    def interval(self, solver: str, power: int) -> Interval:
        """Return the interval of `relative`."""
        return over_draws(partial(self.relative, solver, power), len(self.tables))

    def crossing(self, one: str, other: str) -> Interval:
        """Return from which power on `one` costs no more than `other`, all draws together."""
        common = [power for power in self.powers[one].tolist() if power in self.powers[other]]

        def curve(solver: str, which: list[int]) -> Series:
            places = [self.powers[solver].tolist().index(power) for power in common]
            return np.array([self.relative(solver, place, which) for place in places])

        return over_draws(
            lambda which: crossing(np.array(common), curve(one, which), curve(other, which)), len(self.tables)
        )


def _against_power(load: Load, solver: str, powers: Series, outcomes: Outcomes) -> dict[str, Series]:
    runs = [outcomes[paired_request(load, solver, power)] for power in powers.tolist()]
    for run, power in zip(runs, powers.tolist(), strict=True):
        watch(run, "lowest", run.column("j_dev") + run.column("j_cst"), f"{solver} at P = {power:g}, load {load.name}")
    columns = {name: [getattr(run.indicators, name) for run in runs] for name in ("J_dev", "J_cst", "c1", "c2")}
    columns["J_total"] = [run.indicators.J_dev + run.indicators.J_cst for run in runs]
    columns["lowest"] = [float(run.column("lowest").sum()) for run in runs]
    return {name: np.array(values) for name, values in columns.items()}


def watch(run: Outcome, lowest: str, cost: Series, what: str) -> None:
    """Make sure that no profile costs less than the best one that can be played.

    Raises:
        StudyError: One does.
    """
    bound = run.column(lowest)
    below: NDArray[np.intp] = np.flatnonzero(cost < bound - BELOW * (1.0 + np.abs(bound)))
    if len(below):
        raise StudyError(
            f"{what}: problem {below[0]} costs {cost[below[0]]:.9g}, less than the optimum of {bound[below[0]]:.9g}; "
            "its costs cannot be compared"
        )


def open_loop_table(found: OpenLoop) -> str:
    """Return total costs over the lowest with their intervals, and where solvers cross, as Markdown."""
    some = [power for power in FEW_POWERS if any(power in powers for powers in found.powers.values())]
    caption = (
        f"**Paired, open loop**: total cost of all draws ({len(found.tables)}) over the lowest cost of any profile "
        "that can be played [95 % percentile interval over the draws]. All solvers have the same problems, each with "
        "its own hot starts, and are judged by what the control PLC would play; no ratio can be below 1."
    )
    rows = []
    for solver, powers in found.powers.items():
        cells = [
            found.interval(solver, powers.tolist().index(power)).brief(4) if power in powers else "" for power in some
        ]
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
    with panels(1, 1, (8.0, 4.2)) as (figure, (place,)):
        for (solver, powers), colour in zip(found.powers.items(), COLOURS, strict=False):
            intervals = [found.interval(solver, number) for number in range(len(powers))]
            above_lowest(place, powers, intervals, colour, LABELS[solver])
        legend_outside(figure, place)
    return figure
