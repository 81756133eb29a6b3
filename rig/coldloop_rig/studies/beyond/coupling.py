"""What it costs the predictive controller that pressures and inlet temperature move, constant in its model."""

from pathlib import Path
from typing import Final

from coldloop_rig.studies.drawing import cost_bars, over_time
from coldloop_rig.studies.request import Outcome, RunRequest
from coldloop_rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, loads
from coldloop_rig.text_tables import Cell

REFRIGERATOR: Final = "plant.kind=refrigerator"
CASES: Final = {
    "cold box alone": (),
    "refrigerator, LQ": (REFRIGERATOR,),
    "refrigerator, PI": (REFRIGERATOR, "plant.station.control=pi"),
    "refrigerator, LQ, its model": (REFRIGERATOR, "model.file=refrigerator"),
}
TRACE_TICKS: Final = 4
COLUMNS: Final = (
    "load", "plant", "J_BF", "L1 outside (%)", "T5 outside (%)", "tau_u mean (s)", "HP (bar)", "LP (bar)", "T9 (K)",
    "power (kW)", "nitrogen (g/s)",
)  # fmt: skip
SHOWN: Final = {"load": "load (W)", "P12": "HP (bar)", "P11": "LP (bar)", "T9": "T9 (K)", "T5": "T5 (K)"}


class CouplingStudy:
    """The cold box alone against the whole refrigerator."""

    name = "coupling"
    title = "Beyond the paper: the whole refrigerator under MPC"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every plant under every draw."""
        return [request for load in loads(options, *"abcdef") for request in _runs(load)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare closed-loop costs, bands, updating periods and what the pressures do."""
        result = StudyResult(COLUMNS, [], {}, always_shown=True)
        for load in loads(options, *"abcdef"):
            runs = [outcomes[request] for request in _runs(load)]
            for label, run in zip(CASES, runs, strict=True):
                i = run.indicators
                result.rows.append((load.name, label, i.J_BF, *i.outside_band_pct.values(), i.tau_u_mean, *warm(run)))
            for label, run in list(zip(CASES, runs, strict=True))[1:]:
                ratio = run.indicators.J_BF / runs[0].indicators.J_BF
                result.note(f"J_BF on the {label}, over the cold box alone", ratio)
            if "pressures" not in result.figures:
                labelled = list(zip(CASES, runs, strict=True))
                result.figures["pressures"] = over_time(f"hour {Path(load.name).name}", labelled, SHOWN, 6.0)
        result.figures["closed-loop cost"] = cost_bars(result, CASES, 0.19)
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


def _runs(load: Load) -> list[RunRequest]:
    return [load.request(0.0, *assignments, trace_ticks=TRACE_TICKS) for assignments in CASES.values()]
