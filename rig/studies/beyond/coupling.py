"""What it costs the predictive controller that pressures and inlet temperature move, constant in its model."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from rig.figures.plot import COLOURS
from rig.studies.drawing import legend_outside, panels
from rig.studies.request import Outcome, RunRequest
from rig.studies.study import Cell, Load, Outcomes, StudyOptions, StudyResult, loads

REFRIGERATOR: Final = "plant.kind=refrigerator"
CASES: Final = {
    "cold box alone": (),
    "refrigerator, LQ": (REFRIGERATOR,),
    "refrigerator, PI": (REFRIGERATOR, "plant.station.control=pi"),
    "refrigerator, LQ, its model": (REFRIGERATOR, "model.file=refrigerator"),
}
TRACE_TICKS: Final = 4
SHOWN_ANYWAY: Final = 24
"""Rows of a table that each section of a report shows."""
COLUMNS: Final = (
    "load", "plant", "J_BF", "L1 outside (%)", "T5 outside (%)", "tau_u mean (s)", "HP (bar)", "LP (bar)", "T9 (K)",
    "power (kW)", "nitrogen (g/s)",
)  # fmt: skip


class CouplingStudy:
    """The cold box alone against the whole refrigerator."""

    name = "coupling"
    title = "Beyond the paper: the whole refrigerator under MPC"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every plant under every draw."""
        return [request for load in _loads(options) for request in _runs(load)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare closed-loop costs, bands, updating periods and what the pressures do."""
        result = StudyResult(COLUMNS, [], {})
        for load in _loads(options):
            runs = [outcomes[request] for request in _runs(load)]
            for label, run in zip(CASES, runs, strict=True):
                i = run.indicators
                result.rows.append(
                    (load.name, label, i.J_BF, i.L1_outside_band_pct, i.T5_outside_band_pct, i.tau_u_mean, *warm(run))
                )
            for label, run in list(zip(CASES, runs, strict=True))[1:]:
                ratio = run.indicators.J_BF / runs[0].indicators.J_BF
                result.values.setdefault(f"J_BF on the {label}, over the cold box alone", []).append(ratio)
            if "pressures" not in result.figures:
                result.figures["pressures"] = _pressures(load, runs)
        result.figures["closed-loop cost"] = _costs(result)
        if len(result.rows) > SHOWN_ANYWAY:
            result.remarks.append(_table(result))
        return result


def warm(run: Outcome) -> tuple[Cell, ...]:
    """Return ranges of pressures and inlet temperature, mean power and mean nitrogen; dashes for a cold box alone."""
    if "P12" not in run.trace:
        return ("-",) * 5
    power, nitrogen = float(run.series("E_NC").mean()), float(run.series("M_GN2").mean())
    return _range(run, "P12", 2), _range(run, "P11", 4), _range(run, "T9", 2), round(power, 1), round(nitrogen, 2)


def _range(run: Outcome, name: str, digits: int) -> str:
    series = run.series(name)
    return f"{series.min():.{digits}f}..{series.max():.{digits}f}"


def _loads(options: StudyOptions) -> list[Load]:
    return [load for draws in loads(options, *"abcdef").values() for load in draws]


def _runs(load: Load) -> list[RunRequest]:
    return [load.request(0.0, *assignments, trace_ticks=TRACE_TICKS) for assignments in CASES.values()]


def _table(result: StudyResult) -> str:
    """Return a table of one line a run."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    for row in result.rows:
        cells = [f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _costs(result: StudyResult) -> Figure:
    names = list(dict.fromkeys(str(row[0]) for row in result.rows))
    with panels(1, 1, (9.0, 3.6)) as (figure, (place,)):
        for offset, (label, colour) in enumerate(zip(CASES, COLOURS, strict=False)):
            heights = [float(row[2]) for row in result.rows if row[1] == label]
            place.bar(np.arange(len(names)) + 0.21 * (offset - 1.5), heights, 0.19, color=colour, label=label)
        place.set_xticks(range(len(names)), names, rotation=0 if len(names) < 9 else 60)
        place.set_xlabel("load")
        place.set_ylabel("$J^{BF}$ (1)")
        legend_outside(figure, place)
    return figure


def _pressures(load: Load, runs: list[Outcome]) -> Figure:
    shown = (("load", "load (W)"), ("P12", "HP (bar)"), ("P11", "LP (bar)"), ("T9", "T9 (K)"), ("T5", "T5 (K)"))
    with panels(len(shown), 1, (9.0, 8.0), sharex=True) as (figure, axes):
        for (label, run), colour in zip(zip(CASES, runs, strict=True), COLOURS, strict=False):
            for (name, _), place in zip(shown, axes, strict=True):
                if name in run.trace:
                    place.plot(run.series("time_s") / 60, run.series(name), color=colour, linewidth=0.9, label=label)
        for (_, label), place in zip(shown, axes, strict=True):
            place.set_ylabel(label)
        axes[0].set_title(f"hour {load.name}", loc="left", fontsize=8)
        axes[-1].set_xlabel("plant time (min)")
        legend_outside(figure, axes[0])
        figure.align_ylabels(axes)
    return figure
