"""The classical loops of section IV-A as the baseline, on the same loads as the predictive controller."""

from typing import Final

from coldloop_rig.studies.drawing import cost_bars
from coldloop_rig.studies.request import RunRequest
from coldloop_rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, loads
from coldloop_rig.text_tables import markdown_table

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
        result.remarks.append(_table(result))
        return result


def _runs(load: Load) -> list[RunRequest]:
    return [load.request(period, *assignments) for period, assignments in CASES.values()]


def _table(result: StudyResult) -> str:
    """Return a table: J_BF and the time outside the bands of each case."""
    rows = []
    for name in dict.fromkeys(row[0] for row in result.rows):
        mine = [row for row in result.rows if row[0] == name]
        cells = [f"{float(row[2]):,.0f} ({float(row[3]):.1f} / {float(row[4]):.1f})" for row in mine]
        rows.append((name, *cells))
    return markdown_table(("hour", *CASES), rows, "**J_BF (time outside the bands, %: L1 / T5)**")
