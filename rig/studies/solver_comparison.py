"""Costs of throttled solvers against the computing power of the PLC (paper, figure `solv_cmp`)."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rig import paper as published
from rig.plot import COLOURS
from rig.studies.drawing import legend_outside, panels, paper, spans_decade, spread
from rig.studies.request import RunRequest, Series
from rig.studies.solver_runs import throttled
from rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, loads

Table = Mapping[str, Mapping[str, Series]]
"""Values against power, by solver and indicator."""

SOLVERS: Final = {"ode": "ODE", "qpoases": "qpOASES"}
INDICATORS: Final = ("J_dev", "J_cst", "J_total", "c1", "c2", "J_BF")
QUICK_POWERS: Final = (0.2, 1.0, 25.0)


class SolverComparison:
    """18 powers, two solvers, six indicators, eight hours."""

    name = "solver-comparison"
    title = "Solvers against computing power (figure solv_cmp)"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every solver at every power under every draw; long runs first."""
        return [
            throttled(load, solver, power)
            for power in sorted(_powers(options), reverse=True)
            for solver in SOLVERS
            for load in _loads(options)
        ]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare costs with those of converged qpOASES, and with the paper's."""
        powers = np.array(_powers(options))
        tables = [_table(load, powers, outcomes) for load in _loads(options)]
        result = StudyResult(("load", "solver", "power", *INDICATORS), [], {"indicators": _figure(powers, tables)})
        for load, table in zip(_loads(options), tables, strict=True):
            for solver, indicators in table.items():
                for i, power in enumerate(powers):
                    result.rows.append((load.name, solver, power, *(indicators[name][i] for name in INDICATORS)))
            for claim, value in measures(powers, table).items():
                result.values.setdefault(claim, []).append(value)
        return result


def _powers(options: StudyOptions) -> tuple[float, ...]:
    if options.quick:
        return QUICK_POWERS
    return tuple(published.solver_comparison()["ode"]["normalized_power"].tolist())


def _loads(options: StudyOptions) -> list[Load]:
    return [load for draws in loads(options, "8h").values() for load in draws]


def _table(load: Load, powers: Series, outcomes: Outcomes) -> Table:
    table = {}
    for solver in SOLVERS:
        runs = [outcomes[throttled(load, solver, power)].indicators for power in powers.tolist()]
        table[solver] = {
            name: np.array([run.J_dev + run.J_cst if name == "J_total" else getattr(run, name) for run in runs])
            for name in INDICATORS
        }
    return table


def measures(powers: Series, table: Table) -> dict[str, float]:
    """Return what the claims are judged by; works on the paper's own points as well."""
    ode, qpoases = table["ode"], table["qpoases"]
    converged = qpoases["J_total"][-1]
    relative = qpoases["J_total"] / converged
    distance = np.abs(relative - 1)
    at = {power: int(np.argmin(np.abs(powers - power))) for power in (0.2, 1.0)}
    one = at[1.0]
    return {
        "qpOASES over converged at P = 1": float(relative[one]),
        "qpOASES over converged at P = 0.2": float(relative[at[0.2]]),
        "qpOASES from P = 10 on, largest distance from converged": _largest(distance[:-1], powers[:-1] >= 10),
        "qpOASES, largest rise of total cost with P": float((relative[1:] / relative[:-1] - 1).max()),
        "ODE over converged, largest from P = 0.6 on": float((ode["J_total"][powers >= 0.6] / converged).max()),
        "qpOASES over ODE in total cost at P = 1": float(qpoases["J_total"][one] / ode["J_total"][one]),
        "qpOASES over ODE in J_BF at P = 1": float(qpoases["J_BF"][one] / ode["J_BF"][one]),
        "crossing in total cost": crossing(powers, qpoases["J_total"], ode["J_total"]),
        "crossing in J_BF": crossing(powers, qpoases["J_BF"], ode["J_BF"]),
        "crossing in J_BF within 2 %": crossing(powers, qpoases["J_BF"], 1.02 * ode["J_BF"]),
        "c1 of qpOASES at P = 1": float(qpoases["c1"][one]),
        "c2 of qpOASES at P = 1": float(qpoases["c2"][one]),
        "c1 of ODE at P = 1": float(ode["c1"][one]),
        "c2 of ODE at P = 1": float(ode["c2"][one]),
    }


def _largest(values: Series, which: "NDArray[np.bool_]") -> float:
    return float(values[which].max()) if which.any() else float("nan")


def crossing(powers: Series, one: Series, other: Series) -> float:
    """Return the power from which on `one` is not above `other` any more; NaN if there is none."""
    above = np.log(one / other)
    if not np.isfinite(above).all():
        return float("nan")
    behind = np.flatnonzero(above > 0)
    if len(behind) == 0 or behind[-1] == len(powers) - 1:
        return float("nan") if len(behind) else float(powers[0])
    i = behind[-1]
    share = above[i] / (above[i] - above[i + 1])
    return float(np.exp(np.interp(share, [0, 1], np.log(powers[i : i + 2]))))


def _figure(powers: Series, tables: list[Table]) -> Figure:
    """Draw ours and the paper's, each relative to its own qpOASES at the largest power where units differ."""
    labels = {
        "J_dev": "(a) $J^{dev}$, relative (1)",
        "J_cst": "(b) $J^{cst}$, relative (1)", "J_total": "(c) total, relative (1)",
        "c1": "(d) $c_1$ (%, K)", "c2": "(e) $c_2$ (%, K)", "J_BF": "(f) $J^{BF}$, relative (1)",
    }  # fmt: skip
    theirs = published.solver_comparison()
    with panels(3, 2, (9.5, 10.0), sharex=True) as (figure, axes):
        for place, name in zip(axes, INDICATORS, strict=True):
            relative = name.startswith("J")
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
