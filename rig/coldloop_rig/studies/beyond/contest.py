"""Solvers in the closed loop, under fixed periods and under rules: what a better solver is worth there."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from coldloop_rig.studies.drawing import ratio_rows
from coldloop_rig.studies.intervals import Interval, mean_ratio
from coldloop_rig.studies.paper.updating_period import ADAPTIVE, INTERRUPT, RULE, Policy
from coldloop_rig.studies.request import RunRequest, Series
from coldloop_rig.studies.study import PROGRAM, Load, Outcomes, StudyOptions, StudyResult, first_and_fresh, loads
from coldloop_rig.text_tables import markdown_table

SOLVERS: Final = {
    "ODE": (),
    "ODE as printed": (f"{PROGRAM}preset=as-printed",),
    "interior point": (f"{PROGRAM}solver=interior-point",),
    "hybrid": (f"{PROGRAM}solver=hybrid",),
    "hybrid as printed": (f"{PROGRAM}solver=hybrid", f"{PROGRAM}preset=as-printed"),
}
WAYS: Final = (
    Policy("Algorithm 1", ADAPTIVE),
    Policy("Algorithm 1, interrupt", ADAPTIVE, (INTERRUPT,)),
    Policy("contraction rule, interrupt", ADAPTIVE, (f"{RULE}contraction", INTERRUPT)),
    *(Policy(f"fixed {period:g} s", period) for period in (1.0, 1.5, 2.5, 5.0)),
    Policy("fixed 1.5 s, interrupt", 1.5, (INTERRUPT,)),
)
REFERENCE: Final = ("ODE", "Algorithm 1")
COSTS: Final = {"J_BF": "J_BF", "J_open_mean": "mean open-loop cost"}
DRAWS: Final = 6


class ContestStudy:
    """Every solver under every way to choose the updating period."""

    name = "contest"
    title = "Beyond the paper: solvers and rules in the closed loop"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return all runs."""
        return [
            _request(load, solver, way) for solver in SOLVERS for way in WAYS
            for group in _groups(options).values() for load in group
        ]  # fmt: skip

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare both costs with those of the ODE-based solver under Algorithm 1, hour by hour."""
        result = StudyResult(("load", "solver", "way", "tau_u mean (s)", "J per time", "J_BF"), [], {})
        for title, hours in _groups(options).items():
            table: dict[tuple[str, str], list[tuple[float, float]]] = {}
            for load in hours:
                for solver in SOLVERS:
                    for way in WAYS:
                        run = outcomes[_request(load, solver, way)].indicators
                        result.rows.append(
                            (load.name, solver, way.label, run.tau_u_mean, run.J_open_mean, run.J_BF)
                        )  # fmt: skip
                        table.setdefault((solver, way.label), []).append((run.J_BF, run.J_open_mean))
            costs = {key: np.array(values) for key, values in table.items()}
            for column, cost in enumerate(COSTS.values()):
                ratios = {key: _ratios(values[:, column], costs[REFERENCE][:, column]) for key, values in costs.items()}
                result.remarks.append(_table(f"{title}, {cost}", ratios, len(hours)))
                result.figures[f"{title}, {cost}"] = _figure(ratios, cost)
                for (solver, label), (mean, _) in ratios.items():
                    result.values[f"{cost} over ODE, Algorithm 1, {title}: {solver}, {label}"] = [mean.value]
        return result


def _groups(options: StudyOptions) -> dict[str, list[Load]]:
    """Return the first draws, and those that no constant was chosen on."""
    return first_and_fresh(loads(options, *options.hours, usual=DRAWS))


def _request(load: Load, solver: str, way: Policy) -> RunRequest:
    return load.request(way.period_s, *SOLVERS[solver], *way.assignments)


Ratio = tuple[Interval, float]
"""Geometric mean over the hours, and the largest of one hour."""


def _ratios(costs: Series, reference: Series) -> Ratio:
    return mean_ratio(costs, reference), float((costs / reference).max())


def _table(title: str, ratios: Mapping[tuple[str, str], Ratio], hours: int) -> str:
    caption = (
        f"**{title}** over that of {' under '.join(REFERENCE)}, geometric mean of {hours} hours with its 95 % "
        "interval; in brackets the worst hour."
    )
    rows = []
    for way in WAYS:
        found = (ratios[solver, way.label] for solver in SOLVERS)
        rows.append((way.label, *(f"{mean.text()} ({worst:.2f})" for mean, worst in found)))
    return markdown_table(("way", *SOLVERS), rows, caption)


def _figure(ratios: Mapping[tuple[str, str], Ratio], cost: str) -> Figure:
    means = {solver: {way.label: ratios[solver, way.label][0] for way in WAYS} for solver in SOLVERS}
    return ratio_rows(means, f"{cost} over that of {' under '.join(REFERENCE)} (1)", 4.0, 0.16, len(SOLVERS))
