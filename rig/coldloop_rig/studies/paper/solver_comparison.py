"""Costs of throttled solvers against the computing power of the PLC (paper, figure `solv_cmp`)."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from coldloop_plant.load import HOUR_TICKS
from coldloop_rig.figures.plot import COLOURS
from coldloop_rig.studies import published
from coldloop_rig.studies.crossing import crossing
from coldloop_rig.studies.drawing import legend_outside, panels, paper, spans_decade, spread
from coldloop_rig.studies.harsh_problems import harsh_ratios, harsh_requests, harsh_table, harsh_values
from coldloop_rig.studies.paper.open_loop import (
    open_loop,
    open_loop_figure,
    open_loop_table,
    paired_requests,
    paper_powers,
)
from coldloop_rig.studies.request import RunRequest, Series
from coldloop_rig.studies.solver_runs import throttled
from coldloop_rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, loads
from coldloop_rig.text_tables import Cell

Table = Mapping[str, Mapping[str, Series]]
"""Values against power, by solver and indicator."""

SOLVERS: Final = {"ode": "ODE", "qpoases": "qpOASES"}
INDICATORS: Final = ("J_dev", "J_cst", "J_total", "c1", "c2", "J_BF")
CLOSED_DRAWS: Final = 6
CLOSED_TICKS: Final = 2 * HOUR_TICKS
"""Of the eight hours, in the closed loop: six draws of two hours say more than one and a half of eight."""
COLUMNS: Final = ("part", "load", "solver", "power", *INDICATORS, "J_total over the lowest")


class SolverComparison:
    """Open loop, paired, and closed loop, two solvers at 18 powers and the others at some; harsh problems."""

    name = "solver-comparison"
    title = "Solvers against computing power (figure solv_cmp)"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return the problems of all solvers, then every solver of the paper in the closed loop, long runs first."""
        closed = [
            throttled(load, solver, power)
            for power in sorted(paper_powers(options), reverse=True)
            for solver in SOLVERS
            for load in _closed_loads(options)
        ]
        return [*paired_requests(options), *harsh_requests(options), *closed]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare costs with those of converged qpOASES, with the lowest there are, and with the paper's."""
        with np.errstate(divide="ignore", invalid="ignore"):  # under a load that never steps nothing costs anything
            return self._evaluate(options, outcomes)

    def _evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        powers = np.array(paper_powers(options))
        paired = open_loop(options, outcomes)
        tables: list[Table] = [paired.table(draw) for draw in range(len(paired.loads))]
        closed = [_closed_table(load, powers, outcomes) for load in _closed_loads(options)]
        result = StudyResult(COLUMNS, [], {
            "indicators": _figure(powers, tables, closed),
            "paired open loop": open_loop_figure(paired),
        })  # fmt: skip
        for load, table in zip(paired.loads, tables, strict=True):
            result.rows += _open_rows(load, table, paired.powers)
            _gather(result, open_loop_measures(powers, table))
        for load, table in zip(_closed_loads(options), closed, strict=True):
            result.rows += [
                (
                    "closed",
                    load.name,
                    solver,
                    power,
                    *(np.nan,) * (len(INDICATORS) - 1),
                    table[solver]["J_BF"][i],
                    np.nan,
                )
                for solver in SOLVERS
                for i, power in enumerate(powers.tolist())
            ]
            _gather(result, closed_loop_measures(powers, table))
        result.values |= harsh_values(harsh_ratios(options, outcomes))
        result.remarks += [open_loop_table(paired), harsh_table(options, outcomes)]
        return result


def _gather(result: StudyResult, values: Mapping[str, float]) -> None:
    for claim, value in values.items():
        result.note(claim, value)


def _open_rows(
    load: Load, table: Mapping[str, Mapping[str, Series]], powers: Mapping[str, Sequence[float]]
) -> list[tuple[Cell, ...]]:
    return [
        ("paired", load.name, solver, power, *(columns[name][i] for name in INDICATORS[:-1]), np.nan,
         columns["J_total"][i] / columns["lowest"][i])
        for solver, columns in table.items()
        for i, power in enumerate(powers[solver])
    ]  # fmt: skip


def _closed_loads(options: StudyOptions) -> list[Load]:
    return loads(options, "8h", usual=CLOSED_DRAWS, longest_ticks=CLOSED_TICKS)


def _closed_table(load: Load, powers: Series, outcomes: Outcomes) -> Table:
    return {
        solver: {"J_BF": np.array([outcomes[throttled(load, solver, p)].indicators.J_BF for p in powers.tolist()])}
        for solver in SOLVERS
    }


def measures(powers: Series, table: Table) -> dict[str, float]:
    """Return what the claims are judged by, of points that have both parts: the paper's own."""
    return {**open_loop_measures(powers, table), **closed_loop_measures(powers, table)}


def open_loop_measures(powers: Series, table: Table) -> dict[str, float]:
    """Return what the claims on predicted costs are judged by."""
    ode, qpoases = table["ode"], table["qpoases"]
    converged = qpoases["J_total"][-1]
    relative = qpoases["J_total"] / converged
    distance = np.abs(relative - 1)
    one, fifth = _place(powers, 1.0), _place(powers, 0.2)
    return {
        "qpOASES over converged at P = 1": float(relative[one]),
        "qpOASES over converged at P = 0.2": float(relative[fifth]),
        "qpOASES from P = 10 on, largest distance from converged": _largest(distance[:-1], powers[:-1] >= 10),
        "qpOASES, largest rise of total cost with P": float((relative[1:] / relative[:-1] - 1).max()),
        "ODE over converged, largest from P = 0.6 on": float((ode["J_total"][powers >= 0.6] / converged).max()),
        "qpOASES over ODE in total cost at P = 1": float(qpoases["J_total"][one] / ode["J_total"][one]),
        "crossing in total cost": crossing(powers, qpoases["J_total"], ode["J_total"]),
        "c1 of qpOASES at P = 1": float(qpoases["c1"][one]),
        "c2 of qpOASES at P = 1": float(qpoases["c2"][one]),
        "c1 of ODE at P = 1": float(ode["c1"][one]),
        "c2 of ODE at P = 1": float(ode["c2"][one]),
    }


def closed_loop_measures(powers: Series, table: Table) -> dict[str, float]:
    """Return what the claims on J_BF are judged by."""
    ode, qpoases = table["ode"]["J_BF"], table["qpoases"]["J_BF"]
    one = _place(powers, 1.0)
    return {
        "qpOASES over ODE in J_BF at P = 1": float(qpoases[one] / ode[one]),
        "crossing in J_BF": crossing(powers, qpoases, ode),
        "crossing in J_BF within 2 %": crossing(powers, qpoases, 1.02 * ode),
    }


def _place(powers: Series, power: float) -> int:
    return int(np.argmin(np.abs(powers - power)))


def _largest(values: Series, which: "NDArray[np.bool_]") -> float:
    return float(values[which].max()) if which.any() else float("nan")


def _figure(powers: Series, paired: Sequence[Table], closed: Sequence[Table]) -> Figure:
    """Draw ours and the paper's, each relative to its own qpOASES at the largest power where units differ."""
    labels = {
        "J_dev": "(a) $J^{dev}$, relative (1)",
        "J_cst": "(b) $J^{cst}$, relative (1)", "J_total": "(c) total, relative (1)",
        "c1": "(d) $c_1$ (%, K)", "c2": "(e) $c_2$ (%, K)", "J_BF": "(f) $J^{BF}$, relative (1)",
    }  # fmt: skip
    theirs = published.solver_comparison()
    with panels(3, 2, 7.5, sharex=True) as (figure, axes):
        for place, name in zip(axes, INDICATORS, strict=True):
            relative, tables = name.startswith("J"), closed if name == "J_BF" else paired
            for solver, colour in zip(SOLVERS, COLOURS, strict=False):
                ours = [table[solver][name] / (table["qpoases"][name][-1] if relative else 1.0) for table in tables]
                spread(place, powers, ours, colour, f"{SOLVERS[solver]}, here")
                base = theirs["qpoases"][name][-1] if relative else 1.0
                paper(place, theirs[solver]["normalized_power"], theirs[solver][name] / base, colour,
                      f"{SOLVERS[solver]}, paper")  # fmt: skip
            drawn = np.concatenate([np.ravel(line.get_ydata()) for line in place.lines])
            _axes(place, labels[name], logarithmic=spans_decade(drawn))
        legend_outside(figure, axes[0])
        for place in axes[-2:]:
            place.set_xlabel("normalised power $P$ (1)")
    return figure


def _axes(place: Axes, label: str, *, logarithmic: bool) -> None:
    place.set_xscale("log")
    place.set_ylabel(label)
    if logarithmic:
        place.set_yscale("log")
