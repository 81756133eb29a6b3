"""The whole refrigerator under MPC: what coupling costs, and what happens to it besides its load.

Pressures and inlet temperature move, which are constant in the model of the predictive controller. Trips, nitrogen,
leaks, weather and pulses come under MPC and under the classical loops.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

from coldloop.process.cold_box import COLD_BOX, TICK_S
from coldloop.registers import common, control_plc
from coldloop.registers.plant import StationAlarm, StationMode
from coldloop.service.journal import alarm_word
from coldloop_rig.results.recording import CONTROL
from coldloop_rig.text_tables import Cell
from coldloop_studies import drawing, study
from coldloop_studies.request import Outcome, RunRequest

REFRIGERATOR: Final = "plant.kind=refrigerator"
PLANTS: Final = {
    "cold box alone": (),
    "refrigerator, LQ": (REFRIGERATOR,),
    "refrigerator, PI": (REFRIGERATOR, "plant.station.control=pi"),
    "refrigerator, LQ, its model": (REFRIGERATOR, "model.file=refrigerator"),
}
TRACE_TICKS: Final = 4
COUPLING_COLUMNS: Final = (
    "load", "plant", "J_BF", "L1 outside (%)", "T5 outside (%)", "tau_u mean (s)", "HP (bar)", "LP (bar)", "T9 (K)",
    "power (kW)", "nitrogen (g/s)",
)  # fmt: skip
COUPLING_SHOWN: Final = {"load": "load (W)", "P12": "HP (bar)", "P11": "LP (bar)", "T9": "T9 (K)", "T5": "T5 (K)"}


def _coupling(found: study.Found[str]) -> study.StudyResult:
    result = study.StudyResult(COUPLING_COLUMNS, [], {}, always_shown=True)
    for load, runs in found:
        alone, *_ = runs.values()
        for plant, run in runs.items():
            i = run.indicators
            result.rows.append((load.name, plant, i.J_BF, *i.outside_band_pct.values(), i.tau_u_mean, *warm(run)))
            if run is not alone:
                result.note(f"J_BF on the {plant}, over the cold box alone", i.J_BF / alone.indicators.J_BF)
        if "pressures" not in result.figures:
            title = f"hour {Path(load.name).name}"
            result.figures["pressures"] = drawing.over_time(title, list(runs.items()), COUPLING_SHOWN, 6.0)
    result.figures["closed-loop cost"] = drawing.cost_bars(result, PLANTS, 0.19)
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


COUPLING: Final = study.study_of_loads(
    "coupling",
    "Beyond the paper: the whole refrigerator under MPC",
    lambda options: study.loads(options, *"abcdef"),
    lambda load: {plant: load.request(0.0, *own, trace_ticks=TRACE_TICKS) for plant, own in PLANTS.items()},
    _coupling,
)
"""The cold box alone against the whole refrigerator."""


def _events(*events: tuple[int, str, float]) -> tuple[str, ...]:
    """Return the setting of a refrigerator's events, each with its second, target and value."""
    listed = ",".join(f"{{at_s={at},target='{target}',value={value}}}" for at, target, value in events)
    return (f"plant.refrigerator.events=[{listed}]",)


def _both_off_until(s: int) -> tuple[str, ...]:
    """Return the events of a total trip at ten minutes, after which the compressors start one after the other."""
    return _events((600, "nc1", 0), (600, "nc2", 0), (s, "nc1", 1), (s + 30, "nc2", 1))


Case = tuple[str, tuple[str, ...]]
"""A load, and the settings of what happens under it."""
CASES: Final[dict[str, Case]] = {
    "nothing": ("a", ()),
    "a compressor trips for 2 min": ("a", _events((600, "nc1", 0), (720, "nc1", 1))),
    "no nitrogen for 45 min": ("a", _events((300, "nitrogen", 0), (3000, "nitrogen", 1))),
    "a leak for 20 min": ("a", _events((600, "leak", 1), (1800, "leak", 0))),
    "10 K warmer outside": ("a", _events((600, "ambient", 310))),
    "a train of pulses": ("pulses", ()),
    "magnets quench, 5 kW for 30 s": ("quench", ()),
    "both compressors trip for 2 min": ("a", _both_off_until(720)),
    "both compressors trip for 10 min": ("a", _both_off_until(1200)),
    "the turbine trips for 2 min": ("a", _events((600, "turbine", 0), (720, "turbine", 1))),
    "CV155 stuck for 20 min": ("c", _events((600, "cv155", 0), (1800, "cv155", 1))),
    "CV156 stuck for 20 min": ("c", _events((600, "cv156", 0), (1800, "cv156", 1))),
    "the heater fully on for 10 min": ("a", _events((600, "heater", 2), (1200, "heater", 1))),
    "NEF34 blocks up, 20 % in an hour": ("a", _events((600, "blocked_nef34", 0.2))),
}
DRIVERS: Final = {"MPC": (study.TUNED,), "classical loops": ("control_plc.driver=classical",)}
STATION: Final = {"LQ": (), "PI": ("plant.station.control=pi",)}
COLUMNS: Final = (
    "event", "cold box", "station", "J_BF", "L1 outside (%)", "T5 outside (%)", "L1 (%)", "T5 (K)", "HP (bar)",
    "LP (bar)", "lost (kg)", "station's modes", "station's alarms", "control PLC", "control PLC's alarms",
)  # fmt: skip
SHOWN: Final = {
    "load": "load (W)", "L1": "L1 (%)", "T5": "T5 (K)", "P12": "HP (bar)", "P11": "LP (bar)", "L_N2": "nitrogen (%)",
    "T9": "T9 (K)", "mode": "station",
}  # fmt: skip


def _disturbances(options: study.StudyOptions, outcomes: study.Outcomes) -> study.StudyResult:
    result = study.StudyResult(COLUMNS, [], {}, always_shown=True)
    for name, event in CASES.items():
        for load in _loads(event, options):
            runs = {pair: outcomes[request] for pair, request in _runs(event, load).items()}
            result.rows += [(f"{name} ({load.name})", *pair, *_measures(run)) for pair, run in runs.items()]
            if load.draw == 1:
                labelled = [(", ".join(pair), run) for pair, run in runs.items()]
                result.figures[name] = drawing.over_time("", labelled, SHOWN, 8.0)
    return result


DISTURBANCES: Final = study.Study(
    "disturbances",
    "Beyond the paper: what happens to a refrigerator",
    lambda options: [
        run for event in CASES.values() for load in _loads(event, options) for run in _runs(event, load).values()
    ],
    _disturbances,
)
"""Events of a refrigerator, with LQ and PI at the station, MPC and loops at the cold box."""


def _loads(event: Case, options: study.StudyOptions) -> list[study.Load]:
    return study.loads(replace(options, loads=options.loads[:1]), event[0])


def _runs(event: Case, load: study.Load) -> dict[tuple[str, str], RunRequest]:
    return {
        (driver, station): load.request(0.0, REFRIGERATOR, *event[1], *driving, *control, trace_ticks=TRACE_TICKS)
        for driver, driving in DRIVERS.items() for station, control in STATION.items()
    }  # fmt: skip


def _measures(run: Outcome) -> tuple[str | float, ...]:
    i = run.indicators
    spans = [_range(run, name, digits) for name, digits in (("L1", 2), ("T5", 2), ("P12", 2), ("P11", 3))]
    modes = sorted({StationMode(int(mode)).name.lower() for mode in run.series("mode")})
    raised = {
        alarm.name.lower() for bits in set(run.series("alarms")) for alarm in StationAlarm(int(bits)) if alarm.name
    }
    lost = round(float(run.series("lost")[-1]), 3)
    events = [event for event in run.events if event.service == CONTROL]
    ladder = [
        f"{control_plc.Mode.word_of(one.subject)} {one.tick * TICK_S:.0f} s"
        for one in events
        if one.kind == common.EventKind.MODE
    ]
    alarms = [alarm_word(one.subject, COLD_BOX) for one in events if one.kind == common.EventKind.ALARM_RAISED]
    return (
        i.J_BF, *i.outside_band_pct.values(), *spans, lost, ", ".join(modes),
        ", ".join(sorted(raised)) or "none", ", ".join(ladder), ", ".join(dict.fromkeys(alarms)) or "none",
    )  # fmt: skip
