"""A run folder as the operator's page replays it."""

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from functools import cache, cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coldloop.config import load_configuration
from coldloop.process import cold_box, declaration
from coldloop.process.settings import settings_of
from coldloop.registers import common, control_plc, optimizer_plc, plant
from coldloop.service.journal import EventText, alarm_cause, alarm_word
from coldloop_control_plc.alarms import TRANSITIONS, AlarmSettings
from coldloop_hmi import process_image, runtime
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.rules import make_rule
from coldloop_optimizer_plc.settings import OptimizerSettings
from coldloop_optimizer_plc.solvers import make_solver
from coldloop_rig.results import columns, run_folder

SECTIONS: Final = ("limits", "session", "optimizer_plc", "telemetry")
_MODES: Final = {mode.word: int(mode) for mode in control_plc.Mode}
_CAUSES: Final = {cause.word: int(cause) for cause in control_plc.Cause}


class RecordedPage:
    """A run on disk; its trace is kept in memory, 0.5 MB an hour.

    Raises:
        UsageError: There is no run, or it cannot be read.
    """

    def __init__(self, folder: run_folder.RunFolder) -> None:
        self._folder = folder
        self.name = folder.path.resolve().name
        self.process = folder.process
        names = (self.process.load.column, *self.process.input_names, *self.process.output_names)
        with folder.reading("trace.parquet", run_folder.MOST_IN_MEMORY) as file:
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
        if (folder.path / columns.STATION).exists():
            with folder.reading(columns.STATION, run_folder.MOST_IN_MEMORY) as file:
                table = file.read(columns=[*cold_box.STATION_SIGNAL_NAMES, "mode", "alarms"])
            self._station = np.column_stack([column.to_numpy() for column in table.columns]).astype(np.float32)
        self.ticks = len(self._values)
        self.configuration: Mapping[str, Any] = folder.configuration
        with folder.reading("updates.parquet", run_folder.MOST_LISTED) as file:
            rows = file.read().to_pylist()
        for row in rows:
            row["tau_u"] = round(row["tau_u_s"] / self.process.tick_s)
        values = (
            [0.0 if row[name] is None else row[name] for name in optimizer_plc.Optimization._fields] for row in rows
        )
        self.updates: Sequence[optimizer_plc.Optimization] = [*map(optimizer_plc.Optimization._make, values)]
        entries = []
        for row in folder.events():
            value = "" if row["value"] is None else f"{row['value']:.7g}"
            text = EventText(row["kind"], row["subject"], row["cause"], value, row["unit"], row["who"])
            entries.append(
                process_image.JournalEntry(row["service"], row["number"], row["boot"], row["utc"], row["tick"], text)
            )
        self.events: Sequence[process_image.JournalEntry] = sorted(entries, key=lambda entry: entry.tick)
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
        self.limits = optimizer_plc.OperatingLimits(*bands, limits.low, limits.high, limits.rate)

    def frame(self, tick: int) -> runtime.ReplayFrame | None:
        """Return one tick; None if it is missing in the recording."""
        load, *values = self._values[tick].tolist()
        if math.isnan(load):
            return None
        inputs = len(self.process.inputs)
        u, y = tuple(values[:inputs]), tuple(values[inputs:])
        mode = _MODES.get(self._modes[tick], int(control_plc.Mode.MPC))
        cause = _CAUSES.get(self._causes[tick], int(control_plc.Cause.NONE))
        suspect, faulty = self._doubts[max(0, bisect_right(self._doubts, tick, key=lambda one: one[0]) - 1)][1:]
        doubts = process_image.Doubts(suspect, bad=self._bad_sensors[tick], simulated=faulty)
        station = None
        if self._station is not None and tick < len(self._station):
            *signals, station_mode, alarms = self._station[tick].tolist()
            if not math.isnan(station_mode):
                station = plant.StationSample(tick, tuple(signals), int(station_mode), int(alarms))
        return runtime.ReplayFrame(
            control_plc.ProcessNow(tick, load, u, y), mode, cause, self._since[tick], doubts, station
        )

    @cached_property
    def _doubts(self) -> list[tuple[int, int, int]]:
        """Suspect and faulty sensors from a tick on, by the journals: tick, and a bit for each output of both."""
        found = [(0, 0, 0)]
        for entry in self.events:
            kind, subject, cause = entry.text[:3]
            if subject not in self.process.output_names:
                continue
            (_, suspect, faulty), bit = found[-1], self._bits(subject)
            if kind == common.EventKind.SENSOR.word:
                suspect = suspect & ~bit | bit * (cause == "suspect")
            elif kind == common.EventKind.SENSOR_FAULT.word:
                faulty = faulty & ~bit | bit * (cause != plant.SensorFaultKind.NONE.word)
            found.append((entry.tick, suspect, faulty))
        return found

    def _bits(self, names: str) -> int:
        return sum(1 << self.process.output_names.index(name) for name in names.split())

    def alarms(self, events: Sequence[process_image.JournalEntry]) -> list[common.Alarm]:
        """Return the alarms after these events."""
        return alarms_after(events, self.process)


_KINDS: Final = {event.word: event for events in TRANSITIONS.values() for event in events}


@cache
def _alarms(process: declaration.Process) -> dict[str, tuple[int, dict[str, int]]]:
    """Return the alarms by their words, each with its causes by theirs."""
    return {
        alarm_word(kind, process): (kind, {alarm_cause(kind, cause, process): cause for cause in range(64)})
        for kind in common.alarms_of(process)
    }


def alarms_after(events: Iterable[process_image.JournalEntry], process: declaration.Process) -> list[common.Alarm]:
    """Return the alarms of a process after these events, by number."""
    with settings_of(process):
        settings = AlarmSettings()
    rows = [common.Alarm(priority=settings.rule(kind).priority) for kind in common.alarms_of(process)]
    for entry in events:
        event, alarm = _KINDS.get(entry.text.kind), _alarms(process).get(entry.text.subject)
        if event is not None and alarm is not None:
            kind, causes = alarm
            rows[kind] = _after(rows[kind], event, causes, entry, process.tick_s)
    return rows


def _after(
    row: common.Alarm, event: common.EventKind, causes: dict[str, int], entry: process_image.JournalEntry, tick_s: float
) -> common.Alarm:
    state = TRANSITIONS[common.AlarmState(row.state)].get(event, common.AlarmState(row.state))
    row = row._replace(state=state)
    match event:
        case common.EventKind.ALARM_RAISED:
            cause = causes.get(entry.text.cause, 0)
            return row._replace(active=1, cause=cause, times=row.times + 1, raised=entry.tick)
        case common.EventKind.ALARM_RETURNED:
            return row._replace(active=0, returned=entry.tick)
        case common.EventKind.ALARM_SHELVED:
            return row._replace(shelved_until=entry.tick + round(float(entry.text.value or 0.0) / tick_s))
        case common.EventKind.ALARM_UNSHELVED:
            return row._replace(shelved_until=0)
    return row
