"""The journal of a service: what happened, when, and who did it; and its events in words, for logs, commands and pages.

Events are numbered without gaps, over restarts too where the service retains its count. They are kept in memory, are
shown in registers (the last ones, and those that a query selects) and are written to the log.

What `subject`, `cause` and `value` of an event mean depends on its kind (`registers.common.EventKind`); the tables here
say it in words. A number without a word stays a number: a newer peer may have more of them.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from enum import IntFlag
from functools import cache
from itertools import islice
from typing import Final, NamedTuple

from coldloop.process.cold_box import ModelRange
from coldloop.process.declaration import Process
from coldloop.registers import common, control_plc
from coldloop.registers.bank import RegisterBank
from coldloop.registers.codec import from_words, to_words
from coldloop.registers.common import AlarmKind, CapacityCause, Event, EventKind, LeaseEvent, TimeBaseKind, band_alarms
from coldloop.registers.declaration import Worded
from coldloop.registers.plant import SensorFaultKind, StationAlarm, StationMode, Surroundings

KEPT: Final = 10_000
"""Events kept in memory."""
LOOKED_AT: Final = 500
"""Events that one query looks at, so that its answer takes a fraction of a millisecond."""
ANY_SUBJECT: Final = 0xFFFF


class Journal:
    """Numbers events and keeps the last ones.

    `boot` is the number of this start of the service, from 1, `count` that of the last event before it; `now` returns
    the time, seconds since 1970 UTC.
    """

    def __init__(self, *, boot: int = 1, count: int = 0, now: Callable[[], float] = time.time) -> None:
        self.boot = boot
        self.before = count
        """Number of the last event before this start."""
        self.noted = 0
        """Events of this start."""
        self._now = now
        self._events: deque[Event] = deque(maxlen=KEPT)

    @property
    def count(self) -> int:
        """Number of the newest event; 0 is none."""
        return self.before + self.noted

    @property
    def oldest(self) -> int:
        """Number of the oldest event kept; 0 is none."""
        return self._events[0].number if self._events else 0

    def continue_from(self, boot: int, count: int) -> None:
        """Continue the numbering of an earlier start after its event `count`; present events are renumbered."""
        moved = count - self.before
        self._events = deque(
            [event._replace(number=event.number + moved, boot=boot & 0xFFFF) for event in self._events], maxlen=KEPT
        )
        self.boot, self.before = boot, count

    def note(
        self, tick: int, kind: EventKind, subject: int = 0, cause: int = 0, *, value: float = 0.0, who: str = ""
    ) -> None:
        """Add an event; its arguments are the fields of `Event`."""
        self.noted += 1
        milliseconds = max(0, int(self._now() * 1000))
        self._events.append(
            Event(
                self.count, self.boot & 0xFFFF, tick & 0xFFFFFFFF, milliseconds // 1000 & 0xFFFFFFFF,
                milliseconds % 1000, kind, subject & 0xFFFF, cause & 0xFFFF, value, to_words(who, common.WHO_WORDS),
            )
        )  # fmt: skip

    def since(self, number: int) -> list[Event]:
        """Return the events after event `number`, those that are still kept."""
        return self.last(self.count - number)

    def last(self, events: int) -> list[Event]:
        """Return the last events, oldest first, at most so many and those that are still kept."""
        newest_first = islice(reversed(self._events), max(0, events))
        return list(newest_first)[::-1]

    def select(self, query: common.JournalQuery) -> tuple[common.JournalPage, list[common.JournalAnswer]]:
        """Return the first events that a query selects, and where the next query continues.

        At most `LOOKED_AT` events are looked at: a page may have fewer events than fit, even none, and `next_first`
        still says that there is more.
        """
        place = max(0, query.first - self.oldest)
        found: list[common.JournalAnswer] = []
        for event in islice(self._events, place, place + LOOKED_AT):
            place += 1
            if query.kind in (0, event.kind) and query.subject in (ANY_SUBJECT, event.subject):
                found.append(common.JournalAnswer(*event))
                if len(found) == common.QUERY_ROWS:
                    break
        next_first = self.oldest + place if place < len(self._events) else 0
        return common.JournalPage(self.oldest, self.count, len(found), next_first), found


class JournalPublication:
    """Shows a journal in the registers of its service."""

    def __init__(self, journal: Journal, bank: RegisterBank) -> None:
        self._journal = journal
        self._bank = bank
        self._shown = journal.noted
        self._start = journal.boot, journal.before

    @property
    def is_behind(self) -> bool:
        """There are events that have not been shown, or not with the numbers that they have by now."""
        return self._journal.noted != self._shown or self._renumbered

    @property
    def _renumbered(self) -> bool:
        return self._start != (self._journal.boot, self._journal.before)

    def show(self) -> list[Event]:
        """Put new events into the registers; return them."""
        journal = self._journal
        if not self.is_behind:
            return []
        new = shown = journal.last(journal.noted - self._shown)
        if self._renumbered:
            shown = journal.last(journal.noted)
            for row in range(common.EVENT_ROWS):
                self._bank.put(Event(), row)
        for event in shown[-common.EVENT_ROWS :]:
            self._bank.put(event, event.number % common.EVENT_ROWS)
        self._shown, self._start = journal.noted, (journal.boot, journal.before)
        page = self._bank.get(common.JournalPage)  # what the last query found may still have to be read
        self._bank.put(page._replace(oldest=journal.oldest, newest=journal.count))
        return new

    def answer(self, query: common.JournalQuery) -> None:
        """Put what a query selects into the registers."""
        page, found = self._journal.select(query)
        self._bank.put(page)
        for row in range(common.QUERY_ROWS):
            self._bank.put(found[row] if row < len(found) else common.JournalAnswer(), row)


Words = Callable[[int], str]
"""Returns the word for a number."""


def flag_words(flags: type[IntFlag] | IntFlag) -> list[str]:
    """Return the names of flags in plain words: HP_HIGH is "hp high"."""
    return [str(one.name).lower().replace("_", " ") for one in flags]


def _listed(words: Sequence[str]) -> Words:
    return lambda number: words[number] if number < len(words) else str(number)


def _causes(kind: type[Worded]) -> Words:
    """Return the words for causes, of which 0 is none."""
    return lambda number: kind.word_of(number) if number else ""


def _texts(kind: type[Worded], first: int = 0) -> Words:
    """Return the texts of the members from this number on; those before mean nothing."""
    return _listed(["" if one < first else one.text for one in kind])


def _nothing(number: int) -> str:
    return str(number) if number else ""


WARNINGS: Final = frozenset(
    {EventKind.MODE, EventKind.ALARM_RAISED, EventKind.WATCHDOG_TIME, EventKind.WATCHDOG_EXPIRED, EventKind.LOST}
)
"""Events that the log has as warnings."""
OF_ALARMS: Final = frozenset({EventKind.ALARM_RAISED, EventKind.ALARM_RETURNED, EventKind.ALARM_ACKNOWLEDGED})
"""Events of an alarm with its cause."""
SUPPRESSIONS: Final = frozenset(
    {EventKind.ALARM_SHELVED, EventKind.ALARM_UNSHELVED, EventKind.ALARM_OUT_OF_SERVICE, EventKind.ALARM_IN_SERVICE}
)
LINK_ALARMS: Final[tuple[int, ...]] = (
    AlarmKind.PLANT_LOST, AlarmKind.PLANT_OTHER_MASTER, AlarmKind.PLANT_FROZEN, AlarmKind.OUTPUTS_REJECTED,
    AlarmKind.CLOCK_SKEW,
)  # fmt: skip
"""Alarms whose cause is one of the link to the plant."""


class _Wording(NamedTuple):
    """Wording of the fields of one kind of event."""

    subject: Words = _nothing
    cause: Words = _nothing
    unit: str | None = None
    """Unit of the value; None when the kind has none."""


class _Words:
    """Wording of the events of a process."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.alarms = {kind.value: kind.word for kind in AlarmKind} | {
            number: one.alarm_word or f"{one.name} outside its band"
            for number, one in zip(band_alarms(process), process.banded, strict=True)
        }
        inputs, outputs = _listed(process.input_names), _listed(process.output_names)
        self.alarm_causes: dict[int, Words] = dict.fromkeys(LINK_ALARMS, _causes(control_plc.LinkCause)) | {
            AlarmKind.STATE_NOT_RETAINED: _listed(("", "the previous one was set aside")),
            AlarmKind.MODE: _causes(control_plc.Cause),
            AlarmKind.SENSOR_BAD: outputs,
            AlarmKind.SENSOR_SUSPECT: outputs,
            AlarmKind.INPUT_WITHOUT_EFFECT: inputs,
            AlarmKind.CAPACITY: _texts(CapacityCause, CapacityCause.TOO_MUCH),
            AlarmKind.SEQUENCE_REJECTED: _causes(control_plc.Verdict),
            AlarmKind.CERTIFICATE: _listed(("", "expires soon", "has expired", "unreadable")),
        }
        suppression = _Wording(self.alarm_word, cause=lambda _: "")  # of an alarm that may never have been raised
        unit = process.load.unit
        self.wordings: dict[int, _Wording] = {
            EventKind.MODE: _Wording(control_plc.Mode.word_of, _causes(control_plc.Cause)),
            EventKind.BOOT: _Wording(
                _listed(("fresh", "with a retained state")), _listed(("", "the previous state was set aside"))
            ),
            EventKind.SESSION: _Wording(_texts(TimeBaseKind), unit="x real time"),
            EventKind.OPERATOR_MODE: _Wording(control_plc.OperatorMode.word_of),
            EventKind.SETPOINT: _Wording(inputs, unit=""),
            EventKind.WATCHDOG_TIME: _Wording(self._time_out, lambda ticks: f"was {self._time_out(ticks)}"),
            EventKind.PLANT_LINK: _Wording(control_plc.PlantLinkState.word_of, _causes(control_plc.LinkCause)),
            EventKind.LEASE: _Wording(_texts(LeaseEvent)),
            EventKind.SENSOR_FAULT: _Wording(outputs, SensorFaultKind.word_of),
            EventKind.LOAD: _Wording("row {}".format, unit=unit),
            EventKind.CERTIFICATE: _Wording(_listed(("", "expires soon", "has expired")), unit="days left"),
            EventKind.LOST: _Wording(unit="events or lines"),
            EventKind.SENSOR: _Wording(outputs, _listed(("good again", "bad", "suspect"))),
            EventKind.LIVE_LOAD: _Wording(_listed(("from one tick on", "steps ahead")), unit=unit),
            EventKind.STATION_ALARM: _Wording(_listed(flag_words(StationAlarm)), _listed(("returned", "raised"))),
            EventKind.STATION_MODE: _Wording(StationMode.word_of),
            EventKind.SURROUNDINGS: _Wording(_listed(Surroundings._fields), unit=""),
            EventKind.MODEL_RANGE: _Wording(_listed(flag_words(ModelRange)), _listed(("returned", "left"))),
            EventKind.COOL_DOWN: _Wording(control_plc.CoolDownStep.word_of),
            EventKind.PACE: _Wording(_texts(TimeBaseKind), unit="x real time"),
            **dict.fromkeys(OF_ALARMS, _Wording(self.alarm_word)),
            **dict.fromkeys(SUPPRESSIONS, suppression),
            EventKind.ALARM_SHELVED: suppression._replace(unit="s"),
        }

    def alarm_word(self, number: int) -> str:
        return self.alarms.get(number, str(number))

    def _time_out(self, ticks: int) -> str:
        return f"{ticks * self.process.tick_s:g} s" if ticks else "off"


_words_of: Final = cache(_Words)


class EventText(NamedTuple):
    """An event in words; what does not apply to its kind is empty."""

    kind: str
    subject: str
    cause: str
    value: str
    """A number."""
    unit: str
    who: str

    @property
    def sentence(self) -> str:
        """Sentence that says what happened, in one line."""
        details = f" ({self.cause})" if self.cause else ""
        value = f", {self.value} {self.unit}".rstrip() if self.value else ""
        who = f", by {self.who}" if self.who else ""
        return f"{self.kind}{': ' if self.subject else ''}{self.subject}{details}{value}{who}"


def alarm_word(number: int, process: Process) -> str:
    """Return the word for an alarm of a process."""
    return _words_of(process).alarm_word(number)


def alarm_cause(alarm: int, cause: int, process: Process) -> str:
    """Return the cause of an alarm in words; empty when there is none."""
    return _words_of(process).alarm_causes.get(alarm, _nothing)(cause)


def describe(event: Event, process: Process) -> EventText:
    """Return an event of a process in words."""
    wording = _words_of(process).wordings.get(event.kind, _Wording())
    unit = wording.unit
    if event.kind == EventKind.SETPOINT and event.subject < len(process.inputs):
        unit = process.inputs[event.subject].unit
    elif event.kind == EventKind.ALARM_RAISED and event.subject == AlarmKind.CAPACITY:
        unit = process.load.unit
    return EventText(
        kind=EventKind.word_of(event.kind),
        subject=wording.subject(event.subject),
        cause=alarm_cause(event.subject, event.cause, process)
        if event.kind in OF_ALARMS
        else wording.cause(event.cause),
        value="" if unit is None else f"{event.value:.7g}",
        unit=unit or "",
        who=from_words(event.who),
    )


def log_event(log: logging.Logger, event: Event, process: Process) -> None:
    """Write an event of a process to a log."""
    text = describe(event, process)
    if event.kind == EventKind.MODE:
        subject = "mode"
    else:
        subject = "alarm" if event.kind in OF_ALARMS | SUPPRESSIONS else "subject"
    fields = {subject: text.subject, "cause": text.cause, "value": text.value, "who": text.who}
    given = {name: field for name, field in fields.items() if field}
    grave = event.kind in WARNINGS or (event.kind, event.subject) == (EventKind.LEASE, LeaseEvent.REFUSED)
    level = logging.WARNING if grave else logging.INFO
    log.log(level, text.kind, extra={**given, "tick": event.tick, "number": event.number})


def utc_text(event: Event) -> str:
    """Return when an event happened: ISO 8601, UTC, with milliseconds."""
    time = datetime.fromtimestamp(event.utc, UTC)
    return f"{time:%Y-%m-%dT%H:%M:%S}.{event.milliseconds:03}Z"
