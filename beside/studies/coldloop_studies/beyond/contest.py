"""Controllers in the closed loop: solvers under fixed periods and under rules; the classical loops as the baseline."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from coldloop_rig.plc_sizing.intervals import Interval, mean_ratio
from coldloop_rig.text_tables import markdown_table
from coldloop_studies.drawing import cost_bars, ratio_rows
from coldloop_studies.paper.updating_period import ADAPTIVE, INTERRUPT, RULE, Policy
from coldloop_studies.request import RunRequest, Series
from coldloop_studies.study import PROGRAM, Load, Outcomes, StudyOptions, StudyResult, first_and_fresh, loads

CASES: Final = {
    "classical loops": (2.5, ("control_plc.driver=classical",)),
    "MPC, 2.5 s": (2.5, ()),
    "MPC, adaptive": (0.0, ()),
}


class ClassicalStudy:
    """Two PI loops against MPC."""

    name = "classical"
    title = "The classical loops as a baseline (section IV-A)"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every case under every draw."""
        return [request for load in loads(options, *"abcdef") for request in _runs(load)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare closed-loop costs and bands."""
        result = StudyResult(("load", "case", "J_BF", "L1 outside (%)", "T5 outside (%)"), [], {})
        for load in loads(options, *"abcdef"):
            runs = [outcomes[request].indicators for request in _runs(load)]
            for label, run in zip(CASES, runs, strict=True):
                result.rows.append((load.name, label, run.J_BF, *run.outside_band_pct.values()))
            result.note("J_BF of the classical loops over MPC at 2.5 s", runs[0].J_BF / runs[1].J_BF)
        result.figures["closed-loop cost"] = cost_bars(result, CASES, 0.25, logarithmic=True)
        result.remarks.append(_classical_table(result))
        return result


def _runs(load: Load) -> list[RunRequest]:
    return [load.request(period, *assignments) for period, assignments in CASES.values()]


def _classical_table(result: StudyResult) -> str:
    """Return a table: J_BF and the time outside the bands of each case."""
    rows = []
    for name in dict.fromkeys(row[0] for row in result.rows):
        mine = [row for row in result.rows if row[0] == name]
        cells = [f"{float(row[2]):,.0f} ({float(row[3]):.1f} / {float(row[4]):.1f})" for row in mine]
        rows.append((name, *cells))
    return markdown_table(("hour", *CASES), rows, "**J_BF (time outside the bands, %: L1 / T5)**")


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
                result.remarks.append(_contest_table(f"{title}, {cost}", ratios, len(hours)))
                means = {solver: {way.label: ratios[solver, way.label][0] for way in WAYS} for solver in SOLVERS}
                what = f"{cost} over that of {' under '.join(REFERENCE)} (1)"
                result.figures[f"{title}, {cost}"] = ratio_rows(means, what, 4.0, 0.16, len(SOLVERS))
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


def _contest_table(title: str, ratios: Mapping[tuple[str, str], Ratio], hours: int) -> str:
    caption = (
        f"**{title}** over that of {' under '.join(REFERENCE)}, geometric mean of {hours} hours with its 95 % "
        "interval; in brackets the worst hour."
    )
    rows = []
    for way in WAYS:
        found = (ratios[solver, way.label] for solver in SOLVERS)
        rows.append((way.label, *(f"{mean.text()} ({worst:.2f})" for mean, worst in found)))
    return markdown_table(("way", *SOLVERS), rows, caption)
