"""Events of a journal in words, for logs, commands and pages.

What `subject`, `cause` and `value` of an event mean depends on its kind (`registers.audit.EventKind`); the tables here
say it in words. A number without a word stays a number: a newer peer may have more of them.
"""

import logging
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from enum import IntFlag
from functools import cache
from typing import Final, NamedTuple

from coldloop.process.declaration import Process
from coldloop.process.station import ModelRange
from coldloop.registers.audit import Event, EventKind
from coldloop.registers.common import TimeBaseKind
from coldloop.registers.control_plc import (
    Cause,
    CoolDownStep,
    LinkCause,
    Mode,
    OperatorMode,
    PlantLinkState,
    Verdict,
)
from coldloop.registers.declaration import Worded
from coldloop.registers.plant import SensorFaultKind, StationAlarm, StationMode, Surroundings
from coldloop.registers.safety import AlarmKind, CapacityCause, LeaseEvent, band_alarms
from coldloop.registers.text import from_words

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


def _row(number: int) -> str:
    return f"row {number}"


WARNINGS: Final = frozenset(
    {EventKind.MODE, EventKind.ALARM_RAISED, EventKind.WATCHDOG_TIME, EventKind.WATCHDOG_EXPIRED, EventKind.LOST}
)
"""Events that the log has as warnings."""
OF_ALARMS: Final = frozenset({EventKind.ALARM_RAISED, EventKind.ALARM_RETURNED, EventKind.ALARM_ACKNOWLEDGED})
"""Events of an alarm with its cause."""
SUPPRESSIONS: Final = frozenset(
    {EventKind.ALARM_SHELVED, EventKind.ALARM_UNSHELVED, EventKind.ALARM_OUT_OF_SERVICE, EventKind.ALARM_IN_SERVICE}
)


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
        self.alarm_causes = self._alarm_causes()
        alarm = _Wording(self.alarm_word)
        suppression = alarm._replace(cause=lambda _: "")  # that of an alarm that may never have been raised
        shelving = suppression._replace(unit="s")
        self.wordings = self._wordings() | {
            EventKind.ALARM_RAISED: alarm,
            EventKind.ALARM_RETURNED: alarm,
            EventKind.ALARM_ACKNOWLEDGED: alarm,
            EventKind.ALARM_SHELVED: shelving,
            EventKind.ALARM_UNSHELVED: suppression,
            EventKind.ALARM_OUT_OF_SERVICE: suppression,
            EventKind.ALARM_IN_SERVICE: suppression,
        }

    def alarm_word(self, number: int) -> str:
        return self.alarms.get(number, str(number))

    def _time_out(self, ticks: int) -> str:
        return f"{ticks * self.process.tick_s:g} s" if ticks else "off"

    def _wordings(self) -> dict[int, _Wording]:
        inputs, outputs = _listed(self.process.input_names), _listed(self.process.output_names)
        unit = self.process.load.unit
        return {
            EventKind.MODE: _Wording(Mode.word_of, _causes(Cause)),
            EventKind.BOOT: _Wording(
                _listed(("fresh", "with a retained state")), _listed(("", "the previous state was set aside"))
            ),
            EventKind.SESSION: _Wording(_texts(TimeBaseKind), unit="x real time"),
            EventKind.OPERATOR_MODE: _Wording(OperatorMode.word_of),
            EventKind.SETPOINT: _Wording(inputs, unit=""),
            EventKind.WATCHDOG_TIME: _Wording(self._time_out, lambda ticks: f"was {self._time_out(ticks)}"),
            EventKind.PLANT_LINK: _Wording(PlantLinkState.word_of, _causes(LinkCause)),
            EventKind.LEASE: _Wording(_texts(LeaseEvent)),
            EventKind.SENSOR_FAULT: _Wording(outputs, SensorFaultKind.word_of),
            EventKind.LOAD: _Wording(_row, unit=unit),
            EventKind.CERTIFICATE: _Wording(_listed(("", "expires soon", "has expired")), unit="days left"),
            EventKind.LOST: _Wording(unit="events or lines"),
            EventKind.SENSOR: _Wording(outputs, _listed(("good again", "bad", "suspect"))),
            EventKind.LIVE_LOAD: _Wording(_listed(("from one tick on", "steps ahead")), unit=unit),
            EventKind.STATION_ALARM: _Wording(_listed(flag_words(StationAlarm)), _listed(("returned", "raised"))),
            EventKind.STATION_MODE: _Wording(StationMode.word_of),
            EventKind.SURROUNDINGS: _Wording(_listed(Surroundings._fields), unit=""),
            EventKind.MODEL_RANGE: _Wording(_listed(flag_words(ModelRange)), _listed(("returned", "left"))),
            EventKind.COOL_DOWN: _Wording(CoolDownStep.word_of),
            EventKind.PACE: _Wording(_texts(TimeBaseKind), unit="x real time"),
        }

    def _alarm_causes(self) -> dict[int, Words]:
        inputs, outputs = _listed(self.process.input_names), _listed(self.process.output_names)
        return {
            AlarmKind.STATE_NOT_RETAINED: _listed(("", "the previous one was set aside")),
            AlarmKind.MODE: _causes(Cause),
            AlarmKind.SENSOR_BAD: outputs,
            AlarmKind.SENSOR_SUSPECT: outputs,
            AlarmKind.INPUT_WITHOUT_EFFECT: inputs,
            AlarmKind.CAPACITY: _texts(CapacityCause, CapacityCause.TOO_MUCH),
            AlarmKind.SEQUENCE_REJECTED: _causes(Verdict),
            AlarmKind.PLANT_LOST: _causes(LinkCause),
            AlarmKind.PLANT_OTHER_MASTER: _causes(LinkCause),
            AlarmKind.PLANT_FROZEN: _causes(LinkCause),
            AlarmKind.OUTPUTS_REJECTED: _causes(LinkCause),
            AlarmKind.CLOCK_SKEW: _causes(LinkCause),
            AlarmKind.CERTIFICATE: _listed(("", "expires soon", "has expired", "unreadable")),
        }


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
