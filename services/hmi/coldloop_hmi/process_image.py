"""Process image of the page: the newest record of each block, trends (thinned), updates, predictions and events.

Readers of a rig or of a recorded run write into it; the pages are made from it. No sockets here.
"""

import math
from array import array
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache
from itertools import pairwise
from typing import Any, Final, Generic, NamedTuple, TypeVar, cast

from coldloop.process.cold_box import STATION_SIGNAL_NAMES
from coldloop.process.declaration import Process
from coldloop.registers import codec, common, declaration, maps_of, optimizer_plc, plant
from coldloop.registers.control_plc import LadderStatus, Mode, Plan, ProcessNow
from coldloop.service.journal import EventText, describe, utc_text

STATION_NAMES: Final = ("P12", "P11")
"""Signals of a refrigerator's station that are kept: high and low pressure."""
MOST_ROWS: Final = 65_536
SPARE_ROWS: Final = 4096
"""Rows that are removed at a time, so that removing costs little."""
T = TypeVar("T")
R = TypeVar("R", bound=tuple[Any, ...])
UPDATES_KEPT: Final = 20_000
PREDICTIONS_KEPT: Final = 1000
EVENTS_KEPT: Final = 10_000
STALE_S: Final = 1.5
"""A value whose source has been silent for this long is crossed out."""
STEP_BACK: Final = 20
"""A tick that goes back by more than this many begins another stretch of time."""


class Quality(StrEnum):
    """Quality of a value, from the best to the worst."""

    GOOD = "good"
    SUSPECT = "suspect"
    """The optimiser does without it: prediction and other readings contradict it."""
    HELD = "held"
    """The last good value in the place of a bad one."""
    BAD = "bad"
    """Its sensor is bad, by the fail-safe ladder."""
    STALE = "stale"
    """Its source is silent, or does not move."""
    SIMULATED = "simulated"
    """Not measured: a state of the simulation, or a fault that was put into the sensor for training."""


class Doubts(NamedTuple):
    """Outputs whose readings are in doubt; bit i is output i."""

    suspect: int = 0
    held: int = 0
    bad: int = 0
    simulated: int = 0


SOUND = Doubts()


@lru_cache(256)  # those of successive samples are the same
def doubted(doubts: Doubts, process: Process) -> dict[str, Quality]:
    """Return the outputs in doubt, and the worst quality of each."""
    every = zip((Quality.SUSPECT, Quality.HELD, Quality.BAD, Quality.SIMULATED), doubts, strict=True)
    return {name: quality for quality, bits in every for i, name in enumerate(process.output_names) if bits >> i & 1}


def shown_blocks(register_map: declaration.RegisterMap) -> list[declaration.Block]:
    """Return the blocks that the page shows value by value: those with one row that mean something."""
    return [block for block in register_map.shown if block.rows == 1]


def values_of(service: str, block: declaration.Block, record: tuple[Any, ...]) -> dict[str, float | int | str]:
    """Return the values of a record by the names of their signals; texts are decoded."""
    values: dict[str, float | int | str] = {}
    prefix = f"{service}.{block.name}."
    for (name, declared), value in zip(block.fields.items(), record, strict=True):
        if declared.is_text:
            values[prefix + name] = codec.from_words(value)
        elif declared.elements:
            before = prefix if declared.each else f"{prefix}{name}."
            values.update((before + element, one) for element, one in zip(declared.elements, value, strict=True))
        else:
            values[prefix + name] = value
    return values


class Stretch(NamedTuple, Generic[T]):
    """A stretch of plant time with one mode of the ladder, or with one quality of the reading of an output."""

    start: float
    end: float
    value: T


class Gap(NamedTuple):
    """A stretch in which nothing was read: the ticks of the samples before and after it."""

    start: int
    end: int


Columns = dict[str, list[float | None]]
"""Values by signal; None where nothing was read."""


class TrendStore:
    """Samples of the process in the order of their ticks, at most `kept_s` of plant time of them."""

    def __init__(self, process: Process, kept_s: float) -> None:
        self._process = process
        self._kept_ticks = round(kept_s / process.tick_s)
        self.station_names = STATION_NAMES if process.has_station else ()
        self.names = ("load", *process.input_names, *process.output_names, "mode", *self.station_names)
        """Names of its columns; `mode` is that of the fail-safe ladder."""
        self._places = tuple(map(STATION_SIGNAL_NAMES.index, self.station_names))
        self._no_station = [math.nan] * len(self._places)
        self.ticks = array("q")
        self._columns: dict[str, array[float]] = {name: array("f") for name in self.names}
        self._doubts: list[Doubts] = []
        self._gaps: list[Gap] = []

    def __len__(self) -> int:
        return len(self.ticks)

    @property
    def last_tick(self) -> int:
        """Tick of the newest sample; -1 when there is none."""
        return self.ticks[-1] if self.ticks else -1

    def clear(self) -> None:
        """Forget everything."""
        del self.ticks[:], self._doubts[:], self._gaps[:]
        for column in self._columns.values():
            del column[:]

    def add(
        self, process: ProcessNow, mode: int, doubts: Doubts = SOUND, station: Sequence[float] = (), *,
        is_after_gap: bool = False,
    ) -> None:  # fmt: skip
        """Add a sample and the mode of the ladder; one that is not newer than the last one is left out.

        `station` has the signals of a refrigerator's station, empty or all 0 of a plant without. `is_after_gap`:
        between the last sample and this one nothing could be read.
        """
        if process.tick <= self.last_tick:
            return
        if is_after_gap and process.tick - self.last_tick > 1 and self.ticks:
            self._gaps.append(Gap(self.last_tick, process.tick))
        self.ticks.append(process.tick)
        self._doubts.append(doubts)
        kept = [station[place] for place in self._places] if any(station) else self._no_station
        values = (process.load, *process.u, *process.y, float(mode), *kept)
        for name, value in zip(self.names, values, strict=True):
            self._columns[name].append(value)
        oldest = bisect_left(self.ticks, self.ticks[-1] - self._kept_ticks)
        drop = max(len(self.ticks) - MOST_ROWS, oldest)
        if drop >= SPARE_ROWS or (drop and 2 * drop >= len(self.ticks)):
            del self.ticks[:drop], self._doubts[:drop]
            for column in self._columns.values():
                del column[:drop]
            self._gaps = [gap for gap in self._gaps if gap.start >= self.ticks[0]]

    def between(self, start: int, end: int) -> range:
        """Return the rows from tick `start` to tick `end`."""
        return range(bisect_left(self.ticks, start), bisect_right(self.ticks, end))

    def column(self, name: str, rows: range) -> "array[float]":
        """Return values of a column."""
        return self._columns[name][rows.start : rows.stop]

    def gaps(self, start: int, end: int) -> list[Gap]:
        """Return the stretches in which nothing was read that reach into those from tick `start` to `end`."""
        return [gap for gap in self._gaps if gap.end > start and gap.start < end]

    def thinned(self, names: Sequence[str], start: int, end: int, points: int) -> tuple[list[float], Columns]:
        """Return times (s) and columns from tick `start` to `end`, of about `points` points.

        A longer stretch is reduced to the least and the largest value of each of `points / 2` intervals. Where a gap
        begins all columns have None.
        """
        rows, tick_s = self.between(start, end), self._process.tick_s
        times = [tick * tick_s for tick in self.ticks[rows.start : rows.stop]]
        columns = {name: self.column(name, rows) for name in names}
        return thin(times, columns, points, tick_s, [gap.end * tick_s for gap in self.gaps(start, end)])

    def modes(self, start: int, end: int) -> list[Stretch[int]]:
        """Return the modes between two ticks, stretch by stretch."""
        rows, tick_s = self.between(start, end), self._process.tick_s
        after_gap = {gap.end * tick_s for gap in self.gaps(start, end)}
        found: list[Stretch[int]] = []
        for tick, value in zip(self.ticks[rows.start : rows.stop], self.column("mode", rows), strict=True):
            time, mode = tick * tick_s, int(value)
            if found and time not in after_gap:
                found[-1] = found[-1]._replace(end=time)
            if not found or found[-1].value != mode or time in after_gap:
                found.append(Stretch(time, time, mode))
        return found

    def doubtful(self, start: int, end: int) -> dict[str, list[Stretch[Quality]]]:
        """Return the intervals in which readings of outputs are in doubt between two ticks, by name.

        Each lasts until the first sample of another quality, or a gap.
        """
        rows, tick_s = self.between(start, end), self._process.tick_s
        after_gap = {gap.end for gap in self.gaps(start, end)}
        found: dict[str, list[Stretch[Quality]]] = {}
        before: dict[str, Quality] = {}
        last = 0
        for tick, doubts in zip(self.ticks[rows.start : rows.stop], self._doubts[rows.start : rows.stop], strict=True):
            if doubts != SOUND or before:
                reach, now = (last + 1 if tick in after_gap else tick) * tick_s, doubted(doubts, self._process)
                for name in before:
                    found[name][-1] = found[name][-1]._replace(end=reach)
                for name, quality in now.items():
                    if before.get(name) != quality or tick in after_gap:
                        found.setdefault(name, []).append(Stretch(tick * tick_s, tick * tick_s, quality))
                before = now
            last = tick
        for name in before:
            found[name][-1] = found[name][-1]._replace(end=(last + 1) * tick_s)
        return found

    def doubts_at(self, row: int) -> dict[str, Quality]:
        """Return the outputs whose readings are in doubt, and how."""
        return doubted(self._doubts[row], self._process)


def thin(
    times: Sequence[float], columns: Mapping[str, Sequence[float]], points: int, tick_s: float,
    edges: Sequence[float] = (),
) -> tuple[list[float], Columns]:  # fmt: skip
    """Reduce columns to the least and the largest value of each of `points / 2` intervals, if they are longer.

    No interval reaches across one of the times `edges`, in order, that end a gap; a tick after it begins there is None.
    """
    cuts = [0, *(bisect_left(times, edge) for edge in edges), len(times)]
    found: list[float] = []
    reduced: Columns = {name: [] for name in columns}
    for first, end in pairwise(cuts):
        if first == end:
            continue
        if found:
            found.append(found[-1] + tick_s)
            for values in reduced.values():
                values.append(None)
        share = max(2, points * (end - first) // len(times))
        piece_times, piece = _thin_piece(times[first:end], {n: c[first:end] for n, c in columns.items()}, share)
        found += piece_times
        for name in reduced:
            reduced[name] += piece[name]
    return found, reduced


def _thin_piece(
    times: Sequence[float], columns: Mapping[str, Sequence[float]], points: int
) -> tuple[list[float], dict[str, list[float]]]:
    count = len(times)
    if count <= points:
        return list(times), {name: [rounded(value) for value in column] for name, column in columns.items()}
    every = -(-count // max(1, points // 2))
    starts = range(0, count, every)
    thinned_times: list[float] = []
    for first in starts:
        thinned_times += [times[first], times[min(first + every, count) - 1]]
    thinned: dict[str, list[float]] = {}
    for name, column in columns.items():
        values: list[float] = []
        for first in starts:
            part = column[first : first + every]
            least, largest = rounded(min(part)), rounded(max(part))
            values += [least, largest] if part[0] <= part[-1] else [largest, least]
        thinned[name] = values
    return thinned_times, thinned


def rounded(value: float) -> float:
    """Return a single-precision number with the digits that it has."""
    return float(f"{value:.7g}")


class JournalEntry(NamedTuple):
    """An event in words, and the service whose journal it is from."""

    service: str
    number: int
    boot: int
    utc: str
    tick: int
    text: EventText

    @classmethod
    def of(cls, service: str, event: common.Event, process: Process) -> "JournalEntry":
        """Return an event of a journal."""
        return cls(service, event.number, event.boot, utc_text(event), event.tick, describe(event, process))


@dataclass
class Source:
    """One service, as far as it has been heard."""

    heard: float | None = None
    """Time of its last answer, on the monotonic clock, s."""
    reason: str = "not found yet"
    """Why it is silent; empty while it answers."""
    records: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    """Newest record by block."""
    tick: int = -1
    moved: float = 0.0
    """Time at which its tick moved last, on the same clock, s."""
    was_silent: bool = False
    """It has been silent since its process was last read."""


class Model:
    """State of one rig as the page knows it; `kept_s` of plant time of the trends; `now` is a monotonic clock, s."""

    def __init__(self, process: Process, now: Callable[[], float], kept_s: float) -> None:
        self.process = process
        self.maps = maps_of(process).by_service
        self.now = now
        self.sources = {service: Source() for service in self.maps}
        self.trends = TrendStore(process, kept_s)
        self.updates: deque[optimizer_plc.Optimization] = deque(maxlen=UPDATES_KEPT)
        self.predictions: deque[optimizer_plc.Prediction] = deque(maxlen=PREDICTIONS_KEPT)
        self.alarms: list[common.Alarm] = []
        self.events: deque[JournalEntry] = deque(maxlen=EVENTS_KEPT)
        self.events_told = 0
        """Events so far; the last ones are in `events`."""
        self.changed: set[str] = set()
        """Names of signals, `alarms`, `updates`, `prediction`: what changed since it was last looked at."""
        self.configuration: Mapping[str, Any] = {}
        """The plant's configuration from its registers, by dotted key."""
        self.values: dict[str, float | int | str] = {}
        """All values by the names of their signals."""
        self._session = 0
        self.faulty_sensors = 0
        """Outputs that a fault was put into for training, a bit for each."""
        self.recorded_doubts: Doubts | None = None
        """Doubts of a recorded run; None on a rig that is up."""
        self.commands = 0
        """Commands that were carried out here."""
        self.replay: dict[str, object] | None = None
        """State of the replay; None on a rig that is up."""
        self.on_change: Callable[[], None] = lambda: None

    # -- what readers write --------------------------------------------------------------------------------------------

    def put(self, service: str, record: tuple[Any, ...]) -> None:
        """Take a record of a service."""
        block = self.maps[service].block_of(type(record))
        source = self.sources[service]
        if source.records.get(block.name) == record:
            return
        source.records[block.name] = record
        for name, value in values_of(service, block, record).items():
            known = self.values.get(name)
            if known != value and str(known) != str(value):  # not a number is no news either
                self.values[name] = value
                self.changed.add(name)
        if isinstance(record, common.Identity):
            self._identity(service, record)
        elif isinstance(record, ProcessNow):
            is_after_gap = source.was_silent or self._is_silent(source) or self.is_stopped(service)
            source.was_silent = False
            self._moved(source, record.tick)
            station = self.record("plant", plant.StationStatus)
            signals = station.signals if station else ()
            self.trends.add(record, self.mode, self.doubts, signals, is_after_gap=is_after_gap)
        elif isinstance(record, optimizer_plc.Prediction):
            if record.tick and (not self.predictions or self.predictions[-1].update != record.update):
                self.predictions.append(record)
                self.changed.add("prediction")
        elif isinstance(record, common.SessionPace):  # from now on ticks follow another clock
            for each in self.sources.values():
                each.moved = self.now()

    def _identity(self, service: str, identity: common.Identity) -> None:
        if service == "control_plc" and identity.session:  # one that was started again looks for its session first
            if identity.session != self._session or identity.tick + STEP_BACK < self.trends.last_tick:
                self._session = identity.session
                for drawn in (self.trends, self.updates, self.predictions):
                    drawn.clear()  # nothing that was drawn belongs to another session
                self.changed |= {"updates", "prediction"}
        elif service == "plant":
            self._moved(self.sources[service], identity.tick)

    def _moved(self, source: Source, tick: int) -> None:
        if tick != source.tick:
            source.tick, source.moved = tick, self.now()

    def put_alarms(self, rows: list[common.Alarm]) -> None:
        """Take the rows of the alarms."""
        if rows != self.alarms:
            self.alarms = rows
            self.changed.add("alarms")

    def put_updates(self, updates: Iterable[optimizer_plc.Optimization]) -> None:
        """Take updates that are new, oldest first."""
        for update in updates:
            if self.updates and update.tick < self.updates[-1].tick:
                self.updates.clear()
            self.updates.append(update)
            self.changed.add("updates")

    def put_events(self, events: Iterable[JournalEntry]) -> None:
        """Take events that are new, oldest first."""
        for entry in events:
            self.events.append(entry)
            self.events_told += 1

    def heard(self, service: str) -> None:
        """Note that a service has answered."""
        source = self.sources[service]
        source.was_silent = source.was_silent or self._is_silent(source)
        source.heard, source.reason = self.now(), ""
        self.on_change()

    def _is_silent(self, source: Source) -> bool:
        return source.heard is not None and self.now() - source.heard >= STALE_S

    def silent(self, service: str, reason: str) -> None:
        """Note that a service does not answer."""
        source = self.sources[service]
        source.reason, source.was_silent = reason, True
        self.on_change()

    # -- what pages read -----------------------------------------------------------------------------------------------

    def record(self, service: str, kind: type[R]) -> R | None:
        """Return the newest record of a kind; None when none has been read."""
        return cast("R | None", self.sources[service].records.get(self.maps[service].block_of(kind).name))

    @property
    def mode(self) -> int:
        """Mode of the ladder."""
        ladder = self.record("control_plc", LadderStatus)
        return ladder.mode if ladder else 0

    @property
    def doubts(self) -> Doubts:
        """Outputs whose readings are in doubt; those of a recorded run are set."""
        if self.recorded_doubts is not None:
            return self.recorded_doubts
        ladder, plan = self.record("control_plc", LadderStatus), self.record("control_plc", Plan)
        suspect = plan.suspects if plan and self.mode in {Mode.MPC, Mode.REST} else 0
        return Doubts(suspect, held=ladder.bad_sensors if ladder else 0, simulated=self.faulty_sensors)

    @property
    def rule(self) -> optimizer_plc.UpdatingRuleStatus:
        """Rule that decides the updating period."""
        return self.record("optimizer_plc", optimizer_plc.UpdatingRuleStatus) or optimizer_plc.UpdatingRuleStatus()

    @property
    def limits(self) -> optimizer_plc.OperatingLimits:
        """Bands, bounds and rates."""
        return self.record("optimizer_plc", optimizer_plc.OperatingLimits) or codec.blank(
            optimizer_plc.OperatingLimits, self.maps["optimizer_plc"]
        )

    @property
    def tick(self) -> int:
        """Tick of the process that is shown."""
        process = self.record("control_plc", ProcessNow)
        return process.tick if process else 0

    def age_s(self, service: str) -> float | None:
        """Return how long ago a service answered; None when it never has."""
        heard = self.sources[service].heard
        return None if heard is None else max(0.0, self.now() - heard)

    def is_live(self, service: str) -> bool:
        """Return whether a service answers."""
        age = self.age_s(service)
        return age is not None and age < STALE_S

    def is_stopped(self, service: str) -> bool:
        """Return whether the tick of a service does not move although its session runs in real time."""
        pace = self.record("plant", common.SessionPace)
        if pace is None or not pace.realtime or pace.paused or not pace.session or not pace.factor > 0:
            return False
        patience = max(STALE_S, 3 * self.process.tick_s / pace.factor)
        return self.now() - self.sources[service].moved > patience

    def stale_prefixes(self) -> list[str]:
        """Return what is not current: names of signals and, with a dot at the end, beginnings of names.

        `update` is the newest updating period: it has no say while something else than MPC drives.
        """
        stale = [f"{service}." for service in self.maps if not self.is_live(service)]
        identity = self.record("control_plc", common.Identity)
        is_looking = identity is not None and not identity.session  # for its session: nothing is measured
        if self.is_live("control_plc") and (is_looking or self.is_stopped("control_plc")):
            stale.append("control_plc.process.")
        if self.is_live("plant") and self.is_stopped("plant"):
            stale += ["plant.measurement.", "plant.station."]
        if self.mode != Mode.MPC and self.record("control_plc", LadderStatus) is not None:
            stale.append("update")
        return stale

    @property
    def is_planned(self) -> bool:
        """Whether the newest prediction is played: the optimiser is heard, and its sequence drives the outputs."""
        return self.mode == Mode.MPC and self.is_live("control_plc") and self.is_live("optimizer_plc")
