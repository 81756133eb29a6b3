"""The classical loops of section IV-A as the baseline, on the same loads as the predictive controller."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from rig.figures.plot import COLOURS
from rig.studies.drawing import legend_outside, panels
from rig.studies.request import RunRequest
from rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, loads

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
        return [request for load in _loads(options) for request in _runs(load)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare closed-loop costs and bands."""
        result = StudyResult(("load", "case", "J_BF", "L1 outside (%)", "T5 outside (%)"), [], {})
        for load in _loads(options):
            runs = [outcomes[request].indicators for request in _runs(load)]
            for label, run in zip(CASES, runs, strict=True):
                result.rows.append((load.name, label, run.J_BF, run.L1_outside_band_pct, run.T5_outside_band_pct))
            result.values.setdefault("J_BF of the classical loops over MPC at 2.5 s", []).append(
                runs[0].J_BF / runs[1].J_BF
            )
        result.figures["closed-loop cost"] = _figure(result)
        result.remarks.append(_table(result))
        return result


def _loads(options: StudyOptions) -> list[Load]:
    return [load for draws in loads(options, *"abcdef").values() for load in draws]


def _runs(load: Load) -> list[RunRequest]:
    return [load.request(period, *assignments) for period, assignments in CASES.values()]


def _table(result: StudyResult) -> str:
    """Return a table: J_BF and the time outside the bands of each case."""
    lines = [
        "**J_BF (time outside the bands, %: L1 / T5)**",
        "",
        "| hour | " + " | ".join(CASES) + " |",
        "|---|" + "---|" * len(CASES),
    ]
    for name in dict.fromkeys(row[0] for row in result.rows):
        mine = [row for row in result.rows if row[0] == name]
        cells = [f"{float(row[2]):,.0f} ({float(row[3]):.1f} / {float(row[4]):.1f})" for row in mine]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _figure(result: StudyResult) -> Figure:
    names = list(dict.fromkeys(str(row[0]) for row in result.rows))
    with panels(1, 1, (9.0, 3.6)) as (figure, (place,)):
        for offset, (label, colour) in enumerate(zip(CASES, COLOURS, strict=False)):
            heights = [float(row[2]) for row in result.rows if row[1] == label]
            place.bar(np.arange(len(names)) + 0.27 * (offset - 1), heights, 0.25, color=colour, label=label)
        place.set_yscale("log")
        place.set_xticks(range(len(names)), names, rotation=0 if len(names) < 9 else 60)
        place.set_xlabel("load")
        place.set_ylabel("$J^{BF}$ (1)")
        legend_outside(figure, place)
    return figure
