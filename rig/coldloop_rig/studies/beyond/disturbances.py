"""What happens to a refrigerator besides its load: trips, nitrogen, leaks, weather, pulses; under MPC and the loops."""

from dataclasses import replace
from typing import Final, NamedTuple

from coldloop.process.cold_box import COLD_BOX, TICK_S
from coldloop.registers.audit import EventKind
from coldloop.registers.control_plc import Mode
from coldloop.registers.plant import StationAlarm, StationMode
from coldloop.service.event_text import alarm_word
from coldloop_rig.results.driving import CONTROL
from coldloop_rig.studies.beyond.coupling import REFRIGERATOR, TRACE_TICKS
from coldloop_rig.studies.drawing import over_time
from coldloop_rig.studies.request import Happening, Outcome, RunRequest
from coldloop_rig.studies.study import TUNED, Load, Outcomes, StudyOptions, StudyResult, loads


def _events(*events: tuple[int, str, float]) -> tuple[str, ...]:
    """Return the setting of a refrigerator's events, each with its second, target and value."""
    listed = ",".join(f"{{at_s={at},target='{target}',value={value}}}" for at, target, value in events)
    return (f"plant.refrigerator.events=[{listed}]",)


def _both_off_until(s: int) -> tuple[str, ...]:
    """Return the events of a total trip at ten minutes, after which the compressors start one after the other."""
    return _events((600, "nc1", 0), (600, "nc2", 0), (s, "nc1", 1), (s + 30, "nc2", 1))


class DisturbanceCase(NamedTuple):
    """What happens, under which load."""

    load: str
    assignments: tuple[str, ...]


CASES: Final = {
    "nothing": DisturbanceCase("a", ()),
    "a compressor trips for 2 min": DisturbanceCase("a", _events((600, "nc1", 0), (720, "nc1", 1))),
    "no nitrogen for 45 min": DisturbanceCase("a", _events((300, "nitrogen", 0), (3000, "nitrogen", 1))),
    "a leak for 20 min": DisturbanceCase("a", _events((600, "leak", 1), (1800, "leak", 0))),
    "10 K warmer outside": DisturbanceCase("a", _events((600, "ambient", 310))),
    "a train of pulses": DisturbanceCase("pulses", ()),
    "magnets quench, 5 kW for 30 s": DisturbanceCase("quench", ()),
    "both compressors trip for 2 min": DisturbanceCase("a", _both_off_until(720)),
    "both compressors trip for 10 min": DisturbanceCase("a", _both_off_until(1200)),
    "the turbine trips for 2 min": DisturbanceCase("a", _events((600, "turbine", 0), (720, "turbine", 1))),
    "CV155 stuck for 20 min": DisturbanceCase("c", _events((600, "cv155", 0), (1800, "cv155", 1))),
    "CV156 stuck for 20 min": DisturbanceCase("c", _events((600, "cv156", 0), (1800, "cv156", 1))),
    "the heater fully on for 10 min": DisturbanceCase("a", _events((600, "heater", 2), (1200, "heater", 1))),
    "NEF34 blocks up, 20 % in an hour": DisturbanceCase("a", _events((600, "blocked_nef34", 0.2))),
}
DRIVERS: Final = {"MPC": (TUNED,), "classical loops": ("control_plc.driver=classical",)}
STATION: Final = {"LQ": (), "PI": ("plant.station.control=pi",)}
COLUMNS: Final = (
    "event", "cold box", "station", "J_BF", "L1 outside (%)", "T5 outside (%)", "L1 (%)", "T5 (K)", "HP (bar)",
    "LP (bar)", "lost (kg)", "station's modes", "station's alarms", "control PLC", "control PLC's alarms",
)  # fmt: skip
SHOWN: Final = {
    "load": "load (W)", "L1": "L1 (%)", "T5": "T5 (K)", "P12": "HP (bar)", "P11": "LP (bar)", "L_N2": "nitrogen (%)",
    "T9": "T9 (K)", "mode": "station",
}  # fmt: skip


class DisturbancesStudy:
    """Events of a refrigerator, with LQ and PI at the station, MPC and loops at the cold box."""

    name = "disturbances"
    title = "Beyond the paper: what happens to a refrigerator"

    def requests(self, options: StudyOptions) -> list[RunRequest]:
        """Return every event with every pair of controllers."""
        return [run for event in CASES.values() for load in _loads(event, options) for run in _runs(event, load)]

    def evaluate(self, options: StudyOptions, outcomes: Outcomes) -> StudyResult:
        """Tabulate bands, pressures, modes and alarms of each run."""
        result = StudyResult(COLUMNS, [], {}, always_shown=True)
        for name, event in CASES.items():
            for load in _loads(event, options):
                runs = [outcomes[request] for request in _runs(event, load)]
                for (driver, station), run in zip(_pairs(), runs, strict=True):
                    result.rows.append((f"{name} ({load.name})", driver, station, *_measures(run)))
                if load.draw == 1:
                    labelled = list(zip(map(", ".join, _pairs()), runs, strict=True))
                    result.figures[name] = over_time("", labelled, SHOWN, 8.0)
        return result


def _pairs() -> list[tuple[str, str]]:
    return [(driver, station) for driver in DRIVERS for station in STATION]


def _loads(event: DisturbanceCase, options: StudyOptions) -> list[Load]:
    return loads(replace(options, loads=options.loads[:1]), event.load)


def _runs(event: DisturbanceCase, load: Load) -> list[RunRequest]:
    return [
        load.request(
            0.0, REFRIGERATOR, *event.assignments, *DRIVERS[driver], *STATION[station], trace_ticks=TRACE_TICKS
        )
        for driver, station in _pairs()
    ]


def _measures(run: Outcome) -> tuple[str | float, ...]:
    i = run.indicators
    spans = [
        f"{run.series(name).min():.{digits}f}..{run.series(name).max():.{digits}f}"
        for name, digits in (("L1", 2), ("T5", 2), ("P12", 2), ("P11", 3))
    ]
    modes = sorted({StationMode(int(mode)).name.lower() for mode in run.series("mode")})
    raised = {
        alarm.name.lower() for bits in set(run.series("alarms")) for alarm in StationAlarm(int(bits)) if alarm.name
    }
    lost = round(float(run.series("lost")[-1]), 3)
    return (
        i.J_BF, *i.outside_band_pct.values(), *spans, lost, ", ".join(modes),
        ", ".join(sorted(raised)) or "none", _ladder(run), ", ".join(_alarms(run)) or "none",
    )  # fmt: skip


def _ladder(run: Outcome) -> str:
    """Return the control PLC's modes in order, each with the second in which it began."""
    began = [(one.tick, one.subject) for one in _of_control_plc(run, EventKind.MODE)]
    return ", ".join(f"{Mode.word_of(mode)} {tick * TICK_S:.0f} s" for tick, mode in began)


def _alarms(run: Outcome) -> list[str]:
    """Return the control PLC's alarms in the order in which they were first raised."""
    raised = [alarm_word(one.subject, COLD_BOX) for one in _of_control_plc(run, EventKind.ALARM_RAISED)]
    return list(dict.fromkeys(raised))


def _of_control_plc(run: Outcome, kind: EventKind) -> list[Happening]:
    return [event for event in run.events if event.service == CONTROL and event.kind == kind]
