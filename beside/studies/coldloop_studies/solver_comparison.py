"""Costs of throttled solvers against the computing power of the PLC (paper, figure `solv_cmp`).

The paper compares 20 iterations of the ODE-based solver with 10 of qpOASES: 5 s over tau_1, without a slot for the
preparation (section V), so that slot is left out here. Paired, every solver at every power has the same problems and is
judged by what would be played; harsh problems show what solvers make of the same bad guess in the same PLC time.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np
from matplotlib.figure import Figure

from coldloop.errors import StudyError
from coldloop_plant.load import HOUR_TICKS
from coldloop_rig.figures.plot import COLOURS
from coldloop_rig.plc_sizing.intervals import Interval, crossing, interval_of_mean, jackknife
from coldloop_rig.text_tables import markdown_table
from coldloop_studies import drawing
from coldloop_studies.paired_run import HARSH, INTERIOR_POINT_ITERATIONS
from coldloop_studies.request import Outcome, Procedure, RunRequest, Series
from coldloop_studies.study import PROGRAM, Load, Outcomes, Study, StudyOptions, StudyResult, loads

UNLIMITED = 50.0
"""Power at which qpOASES makes 526 recalculations in a period: more than any problem takes."""


def throttled(
    load: Load, solver: str, power: float, trace_ticks: int = 0, procedure: Procedure = Procedure.CONFIGURED
) -> RunRequest:
    """Return the run of a solver at a power, relative to the PLC of the paper."""
    settings = ("solver=" + solver, f"budget.power={power}", "budget.preparation_slots=0")
    assignments = (PROGRAM + setting for setting in settings)
    return load.request(5.0, *assignments, trace_ticks=trace_ticks, procedure=procedure)


FEW_POWERS: Final = (0.2, 0.6, 1.0, 2.0, 4.0, 10.0)
LABELS: Final = {
    "ode": "ODE", "qpoases": "qpOASES", "interior-point": "interior point", "osqp": "OSQP",
    "fast-gradient": "fast gradient", "daqp": "DAQP, one solve",
}  # fmt: skip


def _paper_powers(options: StudyOptions) -> tuple[float, ...]:
    return (
        (0.2, 1.0, 25.0) if options.quick else tuple(drawing.published_comparison()["ode"]["normalized_power"].tolist())
    )


def powers_of(solver: str, options: StudyOptions) -> tuple[float, ...]:
    """Return the powers at which a solver is compared."""
    if solver in ("ode", "qpoases") or options.quick:
        return _paper_powers(options)
    return (1.0,) if solver == "daqp" else FEW_POWERS


def paired_loads(options: StudyOptions) -> list[Load]:
    """Return ten draws of each of the eight hours' families, or as many as the command says, an hour of each."""
    return loads(options, "8h", usual=10, longest_ticks=HOUR_TICKS)


def paired_request(load: Load, solver: str, power: float) -> RunRequest:
    """Return the request for one solver at one power on the problems of a load."""
    return throttled(load, solver, power, procedure=Procedure.PAIRED_PROBLEMS)


S = TypeVar("S", bound=Hashable)


class Sums(NamedTuple):
    """Summed costs and violations of one solver at one power on the problems of one draw."""

    J_dev: float
    J_cst: float
    c1: float
    c2: float
    lowest: float

    @property
    def J_total(self) -> float:
        """Cost that is compared with the lowest one: J_dev + J_cst."""
        return self.J_dev + self.J_cst


class PairedSums(Generic[S]):
    """Sums of all draws, by solver, power (rising) and draw, of the outcomes of the requests that `request` makes.

    Raises StudyError if a profile costs less than the optimum.
    """

    def __init__(
        self, loads: Sequence[Load], powers: Mapping[S, Sequence[float]],
        request: Callable[[Load, S, float], RunRequest], label: Callable[[S], str], outcomes: Outcomes,
    ) -> None:  # fmt: skip
        self.loads, self.powers = loads, powers
        self.sums: dict[tuple[S, float], list[Sums]] = {}
        for solver, power in ((solver, power) for solver, some in powers.items() for power in some):
            sums = self.sums[solver, power] = []
            for load in loads:
                run = outcomes[request(load, solver, power)]
                cost, what = run.column("j_dev") + run.column("j_cst"), f"{label(solver)} at P = {power:g}"
                watch(run, cost, f"{what}, load {load.name}")
                i = run.indicators
                sums.append(Sums(i.J_dev, i.J_cst, i.c1, i.c2, float(run.column("lowest").sum())))

    def table(self, draw: int) -> dict[S, dict[str, Series]]:
        """Return J_dev, J_cst, J_total, c1, c2 and the lowest of a draw against power, by solver."""
        names = (*Sums._fields, "J_total")
        return {
            solver: {name: np.array([getattr(self.sums[solver, p][draw], name) for p in some]) for name in names}
            for solver, some in self.powers.items()
        }

    def over_lowest(self, solver: S, power: float, which: Sequence[int]) -> float:
        """Return the total cost of some draws together over the lowest there is."""
        some = [self.sums[solver, power][draw] for draw in which]
        return sum(one.J_total for one in some) / sum(one.lowest for one in some)

    def interval(self, solver: S, power: float) -> Interval:
        """Return the interval of `over_lowest`."""
        return jackknife(partial(self.over_lowest, solver, power), len(self.loads), above=1.0)

    def over_converged(self, part: str, solver: S, power: float, reference: S) -> Interval:
        """Return the interval of a part of the cost over that of a reference at its largest power."""
        converged = self.sums[reference, self.powers[reference][-1]]

        def ratio(which: Sequence[int]) -> float:
            mine, theirs = (
                sum(getattr(sums[draw], part) for draw in which) for sums in (self.sums[solver, power], converged)
            )
            return float(mine / theirs) if theirs else np.nan

        return jackknife(ratio, len(self.loads), above=0.0)

    def mean(self, what: str, solver: S, power: float) -> Interval:
        """Return the interval of the mean over the draws of c1 or c2."""
        return interval_of_mean([getattr(one, what) for one in self.sums[solver, power]], above=0.0)

    def crossing(self, one: S, other: S) -> Interval:
        """Return from which power on `one` costs no more than `other`, all draws together."""
        return jackknife(partial(self._crossing, one, other), len(self.loads), above=0.0)

    def crossings(self, one: S, other: S) -> list[float]:
        """Return the same of each draw by itself."""
        return [self._crossing(one, other, [draw]) for draw in range(len(self.loads))]

    def _crossing(self, one: S, other: S, which: Sequence[int]) -> float:
        common = [power for power in self.powers[one] if power in self.powers[other]]
        curves = (np.array([self.over_lowest(solver, power, which) for power in common]) for solver in (one, other))
        return crossing(np.array(common), *curves)


def watch(run: Outcome, cost: Series, what: str) -> None:
    """Make sure that no profile costs less than the best one that can be played.

    Raises StudyError if one does: the study, or the optimum, is wrong. `what` is for the message.
    """
    bound = run.column("lowest")
    below = np.flatnonzero(cost < bound - 1e-9 * (1.0 + np.abs(bound)))  # what rounding may do
    if len(below):
        raise StudyError(
            f"{what}: problem {below[0]} costs {cost[below[0]]:.9g}, less than the optimum of {bound[below[0]]:.9g}; "
            "its costs cannot be compared"
        )


OpenLoop = PairedSums[str]


def open_loop(options: StudyOptions, outcomes: Outcomes) -> OpenLoop:
    """Gather the outcomes. Raises StudyError if a profile costs less than the optimum."""
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
    parts = [table]
    for other in ("ode", "interior-point"):
        power = found.crossing("qpoases", other)
        parts.append(
            f"At no power does qpOASES cost as little as {LABELS[other]}, all draws together."
            if np.isnan(power.value)
            else f"qpOASES costs no more than {LABELS[other]} from P = {power.brief()} on."
        )
    return "\n\n".join(parts)


def _harsh_loads(options: StudyOptions) -> list[Load]:
    return loads(options, *"abcdef", usual=3)  # together they have more than 300 harsh problems


HARSH_SOLVERS: Final = tuple(name for name in LABELS if name != "daqp")
"""One solve of DAQP is longer than all of the times compared."""


def harsh_request(load: Load, solver: str) -> RunRequest:
    """Return the request for one solver on the harsh problems of a load, at P = 1."""
    return throttled(load, solver, 1.0, procedure=Procedure.HARSH_PROBLEMS)


def harsh_ratios(options: StudyOptions, outcomes: Outcomes) -> dict[str, dict[int, Series]]:
    """Return the costs of all harsh problems over the lowest: by solver and by iterations of the interior-point solver.

    Raises StudyError if a profile costs less than the optimum.
    """
    found = {}
    for solver in HARSH_SOLVERS:
        runs = [outcomes[harsh_request(load, solver)] for load in _harsh_loads(options)]
        for run in runs:
            for k in INTERIOR_POINT_ITERATIONS:
                watch(run, run.column(f"after_{k}"), f"harsh problems, {solver}")
        found[solver] = {
            k: np.concatenate([run.column(f"after_{k}") / run.column("lowest") for run in runs])
            for k in INTERIOR_POINT_ITERATIONS
        }
    return found


def harsh_values(ratios: Mapping[str, Mapping[int, Series]]) -> dict[str, list[float]]:
    """Return median and worst by name, and how many problems there were."""
    values: dict[str, list[float]] = {}
    for solver, by_count in ratios.items():
        for k, found in by_count.items():
            if len(found):
                name = f"{LABELS[solver]}, in the time of {k} interior-point iterations"
                values[f"J over the lowest of harsh problems, median: {name}"] = [float(np.median(found))]
                values[f"J over the lowest of harsh problems, worst: {name}"] = [float(found.max())]
    counts = [len(found) for found in next(iter(ratios.values())).values()]
    values["number of harsh problems"] = [float(counts[0])]
    return values


def harsh_table(options: StudyOptions, outcomes: Outcomes) -> str:
    """Return medians and worst ratios of every solver, with its number of iterations, as Markdown."""
    ratios = harsh_ratios(options, outcomes)
    number = len(next(iter(ratios.values()))[INTERIOR_POINT_ITERATIONS[0]])
    if not number:
        return "No problem was harsh."
    first = _harsh_loads(options)
    caption = (
        f"**Harsh problems**: {number} problems of {len(first)} hours whose guess, the shifted profile of the "
        f"converged loop, costs more than {HARSH:g} times the lowest; cost over the lowest, median (worst), after the "
        "PLC time of so many iterations of the interior-point solver; in brackets each solver's own iterations."
    )
    rows = []
    for solver, by_count in ratios.items():
        runs = (outcomes[harsh_request(load, solver)] for load in first)
        some = next(run for run in runs if len(run.column("lowest")))
        counts = {k: some.column(f"count_{k}")[0] for k in by_count}
        cells = [f"{np.median(found):.4g} ({found.max():.3g}) [{counts[k]:.0f}]" for k, found in by_count.items()]
        rows.append((LABELS[solver], *cells))
    return markdown_table(("solver", *(f"time of {k}" for k in INTERIOR_POINT_ITERATIONS)), rows, caption)


Table = Mapping[str, Mapping[str, Series]]
"""Values against power, by solver and indicator."""

SOLVERS: Final = {"ode": "ODE", "qpoases": "qpOASES"}
INDICATORS: Final = ("J_dev", "J_cst", "J_total", "c1", "c2", "J_BF")
COLUMNS: Final = ("part", "load", "solver", "power", *INDICATORS, "J_total over the lowest")


def _comparison_requests(options: StudyOptions) -> list[RunRequest]:
    paired = [
        paired_request(load, solver, power)
        for load in paired_loads(options)  # a worker has the problems of a load at hand
        for solver in LABELS
        for power in powers_of(solver, options)
    ]
    harsh = [harsh_request(load, solver) for load in _harsh_loads(options) for solver in HARSH_SOLVERS]
    closed = [
        throttled(load, solver, power)
        for power in sorted(_paper_powers(options), reverse=True)
        for solver in SOLVERS
        for load in _closed_loads(options)
    ]
    return [*paired, *harsh, *closed]


@np.errstate(divide="ignore", invalid="ignore")  # under a load that never steps nothing costs anything
def _comparison(options: StudyOptions, outcomes: Outcomes) -> StudyResult:
    powers = np.array(_paper_powers(options))
    paired = open_loop(options, outcomes)
    tables: list[Table] = [paired.table(draw) for draw in range(len(paired.loads))]
    closed: list[Table] = [
        {solver: {"J_BF": np.array([outcomes[throttled(load, solver, power)].indicators.J_BF
                                    for power in powers.tolist()])} for solver in SOLVERS}
        for load in _closed_loads(options)
    ]  # fmt: skip
    result = StudyResult(COLUMNS, [], {"indicators": _figure(powers, tables, closed)})
    with drawing.panels(1, 1, 3.0) as (figure, (place,)):
        for (solver, some), colour in zip(paired.powers.items(), COLOURS, strict=False):
            intervals = [paired.interval(solver, power) for power in some]
            drawing.above_lowest(place, some, intervals, colour, LABELS[solver])
        drawing.legend_outside(figure, place)
    result.figures["paired open loop"] = figure
    for load, table in zip(paired.loads, tables, strict=True):
        result.rows += [
            ("paired", load.name, solver, power, *(columns[name][i] for name in INDICATORS[:-1]), np.nan,
             columns["J_total"][i] / columns["lowest"][i])
            for solver, columns in table.items() for i, power in enumerate(paired.powers[solver])
        ]  # fmt: skip
        result.note_all(_open_loop_measures(powers, table))
    nothing = (np.nan,) * (len(INDICATORS) - 1)
    for load, table in zip(_closed_loads(options), closed, strict=True):
        result.rows += [
            ("closed", load.name, solver, power, *nothing, table[solver]["J_BF"][i], np.nan)
            for solver in SOLVERS for i, power in enumerate(powers.tolist())
        ]  # fmt: skip
        result.note_all(_closed_loop_measures(powers, table))
    result.values |= harsh_values(harsh_ratios(options, outcomes))
    result.remarks += [open_loop_table(paired), harsh_table(options, outcomes)]
    return result


SOLVER_COMPARISON: Final = Study(
    "solver-comparison", "Solvers against computing power (figure solv_cmp)", _comparison_requests, _comparison
)
"""Open loop, paired, and closed loop, two solvers at 18 powers and the others at some; harsh problems."""


def _closed_loads(options: StudyOptions) -> list[Load]:
    """Return six draws of two hours of each of the eight hours, which say more than one and a half of eight."""
    return loads(options, "8h", usual=6, longest_ticks=2 * HOUR_TICKS)


def measures(powers: Series, table: Table) -> dict[str, float]:
    """Return what the claims are judged by, of points that have both parts: the paper's own."""
    return {**_open_loop_measures(powers, table), **_closed_loop_measures(powers, table)}


def _open_loop_measures(powers: Series, table: Table) -> dict[str, float]:
    ode, qpoases = table["ode"], table["qpoases"]
    converged = qpoases["J_total"][-1]
    relative = qpoases["J_total"] / converged
    far = np.abs(relative - 1)[:-1][powers[:-1] >= 10]
    one, fifth = _place(powers, 1.0), _place(powers, 0.2)
    return {
        "qpOASES over converged at P = 1": float(relative[one]),
        "qpOASES over converged at P = 0.2": float(relative[fifth]),
        "qpOASES from P = 10 on, largest distance from converged": float(far.max()) if len(far) else np.nan,
        "qpOASES, largest rise of total cost with P": float((relative[1:] / relative[:-1] - 1).max()),
        "ODE over converged, largest from P = 0.6 on": float((ode["J_total"][powers >= 0.6] / converged).max()),
        "qpOASES over ODE in total cost at P = 1": float(qpoases["J_total"][one] / ode["J_total"][one]),
        "crossing in total cost": crossing(powers, qpoases["J_total"], ode["J_total"]),
        "c1 of qpOASES at P = 1": float(qpoases["c1"][one]),
        "c2 of qpOASES at P = 1": float(qpoases["c2"][one]),
        "c1 of ODE at P = 1": float(ode["c1"][one]),
        "c2 of ODE at P = 1": float(ode["c2"][one]),
    }


def _closed_loop_measures(powers: Series, table: Table) -> dict[str, float]:
    ode, qpoases = table["ode"]["J_BF"], table["qpoases"]["J_BF"]
    one = _place(powers, 1.0)
    return {
        "qpOASES over ODE in J_BF at P = 1": float(qpoases[one] / ode[one]),
        "crossing in J_BF": crossing(powers, qpoases, ode),
        "crossing in J_BF within 2 %": crossing(powers, qpoases, 1.02 * ode),
    }


def _place(powers: Series, power: float) -> int:
    return int(np.argmin(np.abs(powers - power)))


def _figure(powers: Series, paired: Sequence[Table], closed: Sequence[Table]) -> Figure:
    """Draw ours and the paper's, each relative to its own qpOASES at the largest power where units differ."""
    labels = {
        "J_dev": "(a) $J^{dev}$, relative (1)",
        "J_cst": "(b) $J^{cst}$, relative (1)", "J_total": "(c) total, relative (1)",
        "c1": "(d) $c_1$ (%, K)", "c2": "(e) $c_2$ (%, K)", "J_BF": "(f) $J^{BF}$, relative (1)",
    }  # fmt: skip
    theirs = drawing.published_comparison()
    with drawing.panels(3, 2, 7.5, sharex=True) as (figure, axes):
        for place, name in zip(axes, INDICATORS, strict=True):
            relative, tables = name.startswith("J"), closed if name == "J_BF" else paired
            for solver, colour in zip(SOLVERS, COLOURS, strict=False):
                ours = [table[solver][name] / (table["qpoases"][name][-1] if relative else 1.0) for table in tables]
                drawing.spread(place, powers, ours, colour, f"{SOLVERS[solver]}, here")
                base = theirs["qpoases"][name][-1] if relative else 1.0
                drawing.paper(place, theirs[solver]["normalized_power"], theirs[solver][name] / base, colour,
                      f"{SOLVERS[solver]}, paper")  # fmt: skip
            place.set(xscale="log", ylabel=labels[name])
            if drawing.spans_decade(np.concatenate([np.ravel(line.get_ydata()) for line in place.lines])):
                place.set_yscale("log")
        drawing.legend_outside(figure, axes[0])
        for place in axes[-2:]:
            place.set_xlabel("normalised power $P$ (1)")
    return figure
