"""A run folder as the operator's page replays it."""

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from functools import cache, cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coldloop.config import load_configuration
from coldloop.process.cold_box import STATION_SIGNAL_NAMES
from coldloop.process.declaration import Process
from coldloop.process.settings import settings_of
from coldloop.registers.common import Alarm, AlarmState, EventKind, alarms_of
from coldloop.registers.control_plc import Cause, Mode, ProcessNow
from coldloop.registers.optimizer_plc import OperatingLimits, Optimization
from coldloop.registers.plant import SensorFaultKind, StationSample
from coldloop.service.journal import EventText, alarm_cause, alarm_word
from coldloop_control_plc.alarms import TRANSITIONS, AlarmSettings
from coldloop_hmi.process_image import Doubts, JournalEntry
from coldloop_hmi.runtime import ReplayFrame
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.rules import make_rule
from coldloop_optimizer_plc.settings import OptimizerSettings
from coldloop_optimizer_plc.solvers import make_solver
from coldloop_rig.results.columns import STATION
from coldloop_rig.results.run_folder import MOST_IN_MEMORY, MOST_LISTED, RunFolder

SECTIONS: Final = ("limits", "session", "optimizer_plc", "telemetry")
_MODES: Final = {mode.word: int(mode) for mode in Mode}
_CAUSES: Final = {cause.word: int(cause) for cause in Cause}


class RecordedPage:
    """A run on disk; its trace is kept in memory, 0.5 MB an hour.

    Raises:
        UsageError: There is no run, or it cannot be read.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder
        self.name = folder.path.resolve().name
        self.process = folder.process
        names = (self.process.load.column, *self.process.input_names, *self.process.output_names)
        with folder.reading("trace.parquet", MOST_IN_MEMORY) as file:
            table = file.read(columns=[*names, "mode", "cause", "bad_sensors"])
            self._values = np.column_stack([table[name].to_numpy() for name in names]).astype(np.float32)
            self._modes = table["mode"].to_pylist()
            self._causes = table["cause"].to_pylist()
            bits = cache(self._bits)
            self._bad_sensors = [bits(bad or "") for bad in table["bad_sensors"].to_pylist()]
        self._since: list[int] = []
        """First tick of the mode of each tick."""
        for tick, mode in enumerate(self._modes):
            self._since.append(self._since[-1] if tick and mode == self._modes[tick - 1] else tick)
        self._station: NDArray[np.float32] | None = None
        """Signals, mode and alarms of the station, a row a tick; None of a cold box alone."""
        if (folder.path / STATION).exists():
            with folder.reading(STATION, MOST_IN_MEMORY) as file:
                table = file.read(columns=[*STATION_SIGNAL_NAMES, "mode", "alarms"])
            self._station = np.column_stack([column.to_numpy() for column in table.columns]).astype(np.float32)
        self.ticks = len(self._values)
        self.configuration: Mapping[str, Any] = folder.configuration
        with folder.reading("updates.parquet", MOST_LISTED) as file:
            rows = file.read().to_pylist()
        for row in rows:
            row["tau_u"] = round(row["tau_u_s"] / self.process.tick_s)
        values = ([0.0 if row[name] is None else row[name] for name in Optimization._fields] for row in rows)
        self.updates: Sequence[Optimization] = [*map(Optimization._make, values)]
        entries = []
        for row in folder.events():
            value = "" if row["value"] is None else f"{row['value']:.7g}"
            text = EventText(row["kind"], row["subject"], row["cause"], value, row["unit"], row["who"])
            entries.append(JournalEntry(row["service"], row["number"], row["boot"], row["utc"], row["tick"], text))
        self.events: Sequence[JournalEntry] = sorted(entries, key=lambda entry: entry.tick)
        copy = folder.manifest["inputs"].get("model", {}).get("file")
        read = {key: value for key, value in folder.configuration.items() if key.split(".")[0] in SECTIONS}
        read["model.file"] = str(folder.held(copy)) if copy else "cold-box"
        options: Mapping[str, tuple[object, str]] = {key: (value, "manifest") for key, value in read.items()}
        settings = load_configuration(OptimizerSettings, environment={}, options=options).settings
        program, limits = settings.optimizer_plc.program, settings.limits
        budget = PlcBudget(program.budget, make_solver(program).tau_1_s)
        rule, times = make_rule(program, budget, round(program.updating_period_s / self.process.tick_s)), budget.times
        self.rule = rule.status._replace(slots=times.slots, preparation=times.preparation, iteration=times.iteration)
        bands = program.design.output_low, program.design.output_high
        self.limits = OperatingLimits(*bands, limits.low, limits.high, limits.rate)

    def frame(self, tick: int) -> ReplayFrame | None:
        """Return one tick; None if it is missing in the recording."""
        load, *values = self._values[tick].tolist()
        if math.isnan(load):
            return None
        inputs = len(self.process.inputs)
        u, y = tuple(values[:inputs]), tuple(values[inputs:])
        mode = _MODES.get(self._modes[tick], int(Mode.MPC))
        cause = _CAUSES.get(self._causes[tick], int(Cause.NONE))
        suspect, faulty = self._doubts[max(0, bisect_right(self._doubts, tick, key=lambda one: one[0]) - 1)][1:]
        doubts = Doubts(suspect, bad=self._bad_sensors[tick], simulated=faulty)
        station = None
        if self._station is not None and tick < len(self._station):
            *signals, station_mode, alarms = self._station[tick].tolist()
            if not math.isnan(station_mode):
                station = StationSample(tick, tuple(signals), int(station_mode), int(alarms))
        return ReplayFrame(ProcessNow(tick, load, u, y), mode, cause, self._since[tick], doubts, station)

    @cached_property
    def _doubts(self) -> list[tuple[int, int, int]]:
        """Suspect and faulty sensors from a tick on, by the journals: tick, and a bit for each output of both."""
        found = [(0, 0, 0)]
        for entry in self.events:
            kind, subject, cause = entry.text[:3]
            if subject not in self.process.output_names:
                continue
            (_, suspect, faulty), bit = found[-1], self._bits(subject)
            if kind == EventKind.SENSOR.word:
                suspect = suspect & ~bit | bit * (cause == "suspect")
            elif kind == EventKind.SENSOR_FAULT.word:
                faulty = faulty & ~bit | bit * (cause != SensorFaultKind.NONE.word)
            found.append((entry.tick, suspect, faulty))
        return found

    def _bits(self, names: str) -> int:
        return sum(1 << self.process.output_names.index(name) for name in names.split())

    def alarms(self, events: Sequence[JournalEntry]) -> list[Alarm]:
        """Return the alarms after these events."""
        return alarms_after(events, self.process)


_KINDS: Final = {event.word: event for events in TRANSITIONS.values() for event in events}


@cache
def _alarms(process: Process) -> dict[str, tuple[int, dict[str, int]]]:
    """Return the alarms by their words, each with its causes by theirs."""
    return {
        alarm_word(kind, process): (kind, {alarm_cause(kind, cause, process): cause for cause in range(64)})
        for kind in alarms_of(process)
    }


def alarms_after(events: Iterable[JournalEntry], process: Process) -> list[Alarm]:
    """Return the alarms of a process after these events, by number."""
    with settings_of(process):
        settings = AlarmSettings()
    rows = [Alarm(priority=settings.rule(kind).priority) for kind in alarms_of(process)]
    for entry in events:
        event, alarm = _KINDS.get(entry.text.kind), _alarms(process).get(entry.text.subject)
        if event is not None and alarm is not None:
            kind, causes = alarm
            rows[kind] = _after(rows[kind], event, causes, entry, process.tick_s)
    return rows


def _after(row: Alarm, event: EventKind, causes: dict[str, int], entry: JournalEntry, tick_s: float) -> Alarm:
    state = TRANSITIONS[AlarmState(row.state)].get(event, AlarmState(row.state))
    row = row._replace(state=state)
    match event:
        case EventKind.ALARM_RAISED:
            cause = causes.get(entry.text.cause, 0)
            return row._replace(active=1, cause=cause, times=row.times + 1, raised=entry.tick)
        case EventKind.ALARM_RETURNED:
            return row._replace(active=0, returned=entry.tick)
        case EventKind.ALARM_SHELVED:
            return row._replace(shelved_until=entry.tick + round(float(entry.text.value or 0.0) / tick_s))
        case EventKind.ALARM_UNSHELVED:
            return row._replace(shelved_until=0)
    return row
