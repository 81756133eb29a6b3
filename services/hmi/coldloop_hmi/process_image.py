"""What the page knows: the newest record of each block, trends, updates, predictions and events.

Readers of a rig or of a recorded run write into it; the pages are made from it. No sockets here.
"""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, TypeVar, cast

from coldloop.process.declaration import Process
from coldloop.registers.audit import Event
from coldloop.registers.codec import blank
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.control_plc import LadderStatus, Mode, Plan, ProcessNow
from coldloop.registers.maps import maps_of
from coldloop.registers.optimizer_plc import OperatingLimits, Optimization, Prediction, UpdatingRuleStatus
from coldloop.registers.plant import StationStatus
from coldloop.registers.safety import Alarm
from coldloop.service.event_text import EventText, describe, utc_text
from coldloop_hmi.quality import Doubts
from coldloop_hmi.signals import values_of
from coldloop_hmi.trends import TrendStore

R = TypeVar("R", bound=tuple[Any, ...])

UPDATES_KEPT: Final = 20_000
PREDICTIONS_KEPT: Final = 1000
EVENTS_KEPT: Final = 10_000
STALE_S: Final = 1.5
"""A value whose source has been silent for this long is crossed out."""


class JournalEntry(NamedTuple):
    """An event in words, and the service whose journal it is from."""

    service: str
    number: int
    boot: int
    utc: str
    tick: int
    text: EventText

    @classmethod
    def of(cls, service: str, event: Event, process: Process) -> "JournalEntry":
        """Return an event of a journal."""
        return cls(service, event.number, event.boot, utc_text(event), event.tick, describe(event, process))


def _same(one: Any, other: Any) -> bool:  # noqa: ANN401 a value of any register
    """Return whether two values are the same; not a number is the same as itself."""
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one):
        return math.isnan(other)
    return bool(one == other)


@dataclass
class Source:
    """One service, as far as it has been heard."""

    heard: float | None = None
    """When it answered last, on the monotonic clock, s."""
    reason: str = "not found yet"
    """Why it is silent; empty while it answers."""
    records: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    """Newest record by block."""
    tick: int = -1
    moved: float = 0.0
    """When its tick moved last."""
    was_silent: bool = False
    """It has been silent since its process was last read."""


class Model:
    """What the page knows of one rig.

    Args:
        process: Which process it has.
        now: Monotonic clock, s.
        kept_s: How much of the trends is kept, s of plant time.
    """

    def __init__(self, process: Process, now: Callable[[], float], kept_s: float) -> None:
        self.process = process
        self.maps = maps_of(process).by_service
        self.now = now
        self.sources = {service: Source() for service in self.maps}
        self.trends = TrendStore(process, kept_s)
        self.updates: deque[Optimization] = deque(maxlen=UPDATES_KEPT)
        self.predictions: deque[Prediction] = deque(maxlen=PREDICTIONS_KEPT)
        self.alarms: list[Alarm] = []
        self.events: deque[JournalEntry] = deque(maxlen=EVENTS_KEPT)
        self.events_told = 0
        """Events so far; the last ones are in `events`."""
        self.changed: set[str] = set()
        """Names of signals, `alarms`, `updates`, `prediction`: what changed since it was last looked at."""
        self.configuration: Mapping[str, Any] = {}
        """The plant's configuration from its registers, by dotted key."""
        self._values: dict[str, float | int | str] = {}
        self._session = 0
        self.faulty_sensors = 0
        """Outputs that a fault was put into for training, a bit for each."""
        self.recorded_doubts: Doubts | None = None
        """Of a recorded run; None on a rig that is up."""
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
            if not _same(self._values.get(name), value):
                self._values[name] = value
                self.changed.add(name)
        if isinstance(record, Identity):
            self._identity(service, record)
        elif isinstance(record, ProcessNow):
            is_after_gap = source.was_silent or self._is_silent(source) or self.is_stopped(service)
            source.was_silent = False
            self._moved(source, record.tick)
            station = self.record("plant", StationStatus)
            signals = station.signals if station else ()
            self.trends.add(record, self.mode, self.doubts, signals, is_after_gap=is_after_gap)
        elif isinstance(record, Prediction):
            self._predicted(record)
        elif isinstance(record, SessionPace):  # from now on ticks follow another clock
            for each in self.sources.values():
                each.moved = self.now()

    def _identity(self, service: str, identity: Identity) -> None:
        source = self.sources[service]
        if service == "control_plc" and identity.session:  # one that was started again looks for its session first
            if identity.session != self._session or identity.tick + STEP_BACK < self.trends.last_tick:
                self._session = identity.session
                self._begin()
        elif service == "plant":
            self._moved(source, identity.tick)

    def _begin(self) -> None:
        """Another session: nothing that was drawn belongs to it."""
        self.trends.clear()
        self.updates.clear()
        self.predictions.clear()
        self.changed |= {"updates", "prediction"}

    def _moved(self, source: Source, tick: int) -> None:
        if tick != source.tick:
            source.tick, source.moved = tick, self.now()

    def _predicted(self, prediction: Prediction) -> None:
        if prediction.tick and (not self.predictions or self.predictions[-1].update != prediction.update):
            self.predictions.append(prediction)
            self.changed.add("prediction")

    def put_alarms(self, rows: list[Alarm]) -> None:
        """Take the rows of the alarms."""
        if rows != self.alarms:
            self.alarms = rows
            self.changed.add("alarms")

    def put_updates(self, updates: Iterable[Optimization]) -> None:
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
    def values(self) -> Mapping[str, float | int | str]:
        """All values by the names of their signals."""
        return self._values

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
    def rule(self) -> UpdatingRuleStatus:
        """What decides the updating period."""
        return self.record("optimizer_plc", UpdatingRuleStatus) or UpdatingRuleStatus()

    @property
    def limits(self) -> OperatingLimits:
        """Bands, bounds and rates."""
        return self.record("optimizer_plc", OperatingLimits) or blank(OperatingLimits, self.maps["optimizer_plc"])

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
        pace = self.record("plant", SessionPace)
        if pace is None or not pace.realtime or pace.paused or not pace.session or not pace.factor > 0:
            return False
        patience = max(STALE_S, 3 * self.process.tick_s / pace.factor)
        return self.now() - self.sources[service].moved > patience

    def stale_prefixes(self) -> list[str]:
        """Return what is not current: names of signals and, with a dot at the end, beginnings of names.

        `update` is the newest updating period: it has no say while something else than MPC drives.
        """
        stale = [f"{service}." for service in self.maps if not self.is_live(service)]
        identity = self.record("control_plc", Identity)
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

    def alarm_rows(self) -> list[tuple[int, Alarm]]:
        """Return the alarms with their kinds."""
        return list(enumerate(self.alarms))


STEP_BACK: Final = 20
"""A tick that goes back by more than this many begins another stretch of time."""
