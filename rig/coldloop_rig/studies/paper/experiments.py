"""The paper's experiments with a networked PLC: figures `scenario_exp` and `diff_upt`."""

from collections.abc import Sequence
from dataclasses import dataclass

from coldloop_rig.studies.drawing import time_panels
from coldloop_rig.studies.paper.load_response import response
from coldloop_rig.studies.paper.trajectories import BANDS
from coldloop_rig.studies.request import RunRequest
from coldloop_rig.studies.study import Load, Outcomes, StudyOptions, StudyResult, loads

TRACE_TICKS = 4


@dataclass(frozen=True)
class ExperimentStudy:
    """Runs on the bus, three services and Modbus/TCP, each repeated in one process."""

    name: str
    title: str
    cases: tuple[tuple[str, float], ...]
    """Label and updating period, s; 0 is adaptive."""

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return each case on the bus and in one process, under the first draw."""
        return [request for load in self._loads(options) for _, period in self.cases for request in _both(load, period)]

    def _loads(self, options: StudyOptions) -> list[Load]:
        return [load for load in loads(options, "2h") if load.draw == 1]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Compare traces, bands and updating periods."""
        result = StudyResult(
            ("load", "case", "rig", "J_BF", "L1 outside (%)", "T5 outside (%)", "tau_u mean (s)",
             "tau_u mean per update (s)", "trace"), [], {},
        )  # fmt: skip
        for load in self._loads(options):
            labelled = []
            for label, period in self.cases:
                networked, alone = (outcomes[request] for request in _both(load, period))
                labelled.append((label, networked))
                for rig, run in (("networked", networked), ("one process", alone)):
                    i = run.indicators
                    result.rows.append(
                        (load.name, label, rig, i.J_BF, *i.outside_band_pct.values(), i.tau_u_mean,
                         i.tau_u_mean_per_update, run.trace_sha256)
                    )  # fmt: skip
                same = networked.trace_sha256 == alone.trace_sha256
                result.note(f"{self.name}: same trace, {label}", same)
                outside = max(networked.indicators.outside_band_pct.values())
                result.note(f"{self.name}: time outside the bands, {label}", outside)
                if not period:
                    for what, value in response([(networked, load)], label).items():
                        result.note(f"{self.name}: {what}", value)
            if not result.figures:
                result.figures["time courses"] = time_panels(labelled, BANDS)
        return result


def _both(load: Load, period_s: float) -> Sequence[RunRequest]:
    return [load.request(period_s, networked=networked, trace_ticks=TRACE_TICKS) for networked in (True, False)]


PLC_2H = ExperimentStudy("plc-2h", "Two hours on the bus at tau_u = 5 s (figure scenario_exp)", (("5 s", 5.0),))
ADAPTIVE_2H = ExperimentStudy(
    "adaptive-2h",
    "Two hours on the bus, 2.5 s against adaptive (figure diff_upt)",
    (("2.5 s", 2.5), ("adaptive", 0.0)),
)
