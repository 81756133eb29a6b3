"""Events of a journal in words, for logs, commands and pages.

What `subject`, `cause` and `value` of an event mean depends on its kind (`registers.audit.EventKind`); the tables here
say it in words. A number without a word stays a number: a newer peer may have more of them.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from enum import IntEnum
from typing import Final, NamedTuple

from coldloop.process.declaration import Output
from coldloop.process.load_profile import LOAD_UNIT
from coldloop.process.loaded import PROCESS
from coldloop.process.range_bits import ModelRange
from coldloop.process.signals import INPUT_NAMES, INPUT_UNITS, OUTPUT_NAMES, TICK_S
from coldloop.registers.audit import Event, EventKind
from coldloop.registers.control_plc import (
    Cause,
    CoolDownStep,
    LinkCause,
    Mode,
    OperatorMode,
    PlantLinkState,
    Verdict,
)
from coldloop.registers.plant import SensorFaultKind, StationAlarm, StationMode, Surroundings
from coldloop.registers.safety import AlarmKind
from coldloop.registers.text import from_words

Words = Callable[[int], str]
"""Returns the word for a number."""


def word(member: IntEnum) -> str:
    """Return the name of a member in plain words: ALARM_RAISED is "alarm raised"."""
    return member.name.lower().replace("_", " ")


def word_of(kind: type[IntEnum], number: int) -> str:
    """Return the word for a peer's number; a newer peer may have numbers without a word here."""
    return _members(kind)(number)


def _listed(words: Sequence[str]) -> Words:
    return lambda number: words[number] if number < len(words) else str(number)


def _members(kind: type[IntEnum]) -> Words:
    words = {member.value: word(member) for member in kind}
    return lambda number: words.get(number, str(number))


def _alarm_words() -> dict[int, str]:
    """Return the words for alarms; those of bands are of the first output that has one, and of the others."""
    bands = {AlarmKind.LEVEL_BAND: PROCESS.banded[:1], AlarmKind.T5_BAND: PROCESS.banded[1:]}
    return {kind.value: word(kind) for kind in AlarmKind} | {kind: _band_word(of) for kind, of in bands.items()}


def _band_word(outputs: Sequence[Output]) -> str:
    declared = [output.band.alarm_word for output in outputs if output.band and output.band.alarm_word]
    names = " or ".join(output.name for output in outputs) or "further output"
    return declared[0] if declared else f"{names} outside its band"


_ALARM_WORDS: Final = _alarm_words()


def alarm_word(number: int) -> str:
    """Return the word for an alarm."""
    return _ALARM_WORDS.get(number, str(number))


def _causes(kind: type[IntEnum]) -> Words:
    """Return the words for causes, of which 0 is none."""
    words = _members(kind)
    return lambda number: words(number) if number else ""


def _nothing(number: int) -> str:
    return str(number) if number else ""


def _time_out(ticks: int) -> str:
    return f"{ticks * TICK_S:g} s" if ticks else "off"


def _row(number: int) -> str:
    return f"row {number}"


WARNINGS: Final = frozenset(
    {EventKind.MODE, EventKind.ALARM_RAISED, EventKind.WATCHDOG_TIME, EventKind.WATCHDOG_EXPIRED, EventKind.LOST}
)
"""Events that the log has as warnings."""


class _Wording(NamedTuple):
    """How the fields of one kind of event are put into words."""

    subject: Words = _nothing
    cause: Words = _nothing
    unit: str | None = None
    """Of the value; None when the kind has none."""


_ALARM: Final = _Wording(alarm_word)
_SUPPRESSION: Final = _ALARM._replace(cause=lambda _: "")  # that of an alarm that may never have been raised
_SHELVING: Final = _SUPPRESSION._replace(unit="s")
_WORDINGS: Final[Mapping[int, _Wording]] = {
    EventKind.MODE: _Wording(_members(Mode), _causes(Cause)),
    EventKind.ALARM_RAISED: _ALARM,
    EventKind.ALARM_RETURNED: _ALARM,
    EventKind.ALARM_ACKNOWLEDGED: _ALARM,
    EventKind.ALARM_SHELVED: _SHELVING,
    EventKind.ALARM_UNSHELVED: _SUPPRESSION,
    EventKind.ALARM_OUT_OF_SERVICE: _SUPPRESSION,
    EventKind.ALARM_IN_SERVICE: _SUPPRESSION,
    EventKind.BOOT: _Wording(
        _listed(("fresh", "with a retained state")), _listed(("", "the previous state was set aside"))
    ),
    EventKind.SESSION: _Wording(_listed(("lock-step", "real time")), unit="x real time"),
    EventKind.OPERATOR_MODE: _Wording(_members(OperatorMode)),
    EventKind.SETPOINT: _Wording(_listed(INPUT_NAMES), unit=""),
    EventKind.WATCHDOG_TIME: _Wording(_time_out, lambda ticks: f"was {_time_out(ticks)}"),
    EventKind.PLANT_LINK: _Wording(_members(PlantLinkState), _causes(LinkCause)),
    EventKind.LEASE: _Wording(_listed(("ended", "granted", "a second writer was refused"))),
    EventKind.SENSOR_FAULT: _Wording(_listed(OUTPUT_NAMES), _members(SensorFaultKind)),
    EventKind.LOAD: _Wording(_row, unit=LOAD_UNIT),
    EventKind.CERTIFICATE: _Wording(_listed(("", "expires soon", "has expired")), unit="days left"),
    EventKind.LOST: _Wording(unit="events or lines"),
    EventKind.SENSOR: _Wording(_listed(OUTPUT_NAMES), _listed(("good again", "bad", "suspect"))),
    EventKind.LIVE_LOAD: _Wording(_listed(("from one tick on", "steps ahead")), unit=LOAD_UNIT),
    EventKind.STATION_ALARM: _Wording(
        _listed([str(alarm.name).lower().replace("_", " ") for alarm in StationAlarm]), _listed(("returned", "raised"))
    ),
    EventKind.STATION_MODE: _Wording(_members(StationMode)),
    EventKind.SURROUNDINGS: _Wording(_listed(Surroundings._fields), unit=""),
    EventKind.MODEL_RANGE: _Wording(
        _listed([str(part.name).lower().replace("_", " ") for part in ModelRange]), _listed(("returned", "left"))
    ),
    EventKind.COOL_DOWN: _Wording(_members(CoolDownStep)),
    EventKind.PACE: _Wording(_listed(("lock-step", "real time", "paused")), unit="x real time"),
}
_FURTHER_BANDS: Final = [output.name for output in PROCESS.banded[1:]]
_SHORTAGE: Final = (
    "",
    "too much load: reduce it, or the bath will run dry",
    "too little load: raise it, or the turbine gets too cold and the bath floods",
)
"""Of a plant with a bath: of others it is not known."""
_ALARM_CAUSES: Final[Mapping[int, Words]] = {
    AlarmKind.T5_BAND: _listed(_FURTHER_BANDS if len(_FURTHER_BANDS) > 1 else ("",)),
    AlarmKind.STATE_NOT_RETAINED: _listed(("", "the previous one was set aside")),
    AlarmKind.MODE: _causes(Cause),
    AlarmKind.SENSOR_BAD: _listed(OUTPUT_NAMES),
    AlarmKind.SENSOR_SUSPECT: _listed(OUTPUT_NAMES),
    AlarmKind.INPUT_WITHOUT_EFFECT: _listed(INPUT_NAMES),
    AlarmKind.CAPACITY: _listed(_SHORTAGE),
    AlarmKind.SEQUENCE_REJECTED: _causes(Verdict),
    AlarmKind.PLANT_LOST: _causes(LinkCause),
    AlarmKind.PLANT_OTHER_MASTER: _causes(LinkCause),
    AlarmKind.PLANT_FROZEN: _causes(LinkCause),
    AlarmKind.OUTPUTS_REJECTED: _causes(LinkCause),
    AlarmKind.CLOCK_SKEW: _causes(LinkCause),
    AlarmKind.CERTIFICATE: _listed(("", "expires soon", "has expired", "unreadable")),
}


kind_word: Final = _members(EventKind)
"""Returns the word for a kind of event."""


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
        """What happened, in one line."""
        details = f" ({self.cause})" if self.cause else ""
        value = f", {self.value} {self.unit}".rstrip() if self.value else ""
        who = f", by {self.who}" if self.who else ""
        return f"{self.kind}{': ' if self.subject else ''}{self.subject}{details}{value}{who}"


def alarm_cause(alarm: int, cause: int) -> str:
    """Return the cause of an alarm in words; empty when there is none."""
    return _ALARM_CAUSES.get(alarm, _nothing)(cause)


def describe(event: Event) -> EventText:
    """Return an event in words."""
    wording = _WORDINGS.get(event.kind, _Wording())
    unit = wording.unit
    if event.kind == EventKind.SETPOINT and event.subject < len(INPUT_UNITS):
        unit = INPUT_UNITS[event.subject]
    elif event.kind == EventKind.ALARM_RAISED and event.subject == AlarmKind.CAPACITY:
        unit = LOAD_UNIT
    return EventText(
        kind=kind_word(event.kind),
        subject=wording.subject(event.subject),
        cause=alarm_cause(event.subject, event.cause) if wording is _ALARM else wording.cause(event.cause),
        value="" if unit is None else f"{event.value:.7g}",
        unit=unit or "",
        who=from_words(event.who),
    )


def log_event(log: logging.Logger, event: Event) -> None:
    """Write an event to a log."""
    text = describe(event)
    if event.kind == EventKind.MODE:
        subject = "mode"
    else:
        subject = "alarm" if _WORDINGS.get(event.kind) in (_ALARM, _SHELVING, _SUPPRESSION) else "subject"
    fields = {subject: text.subject, "cause": text.cause, "value": text.value, "who": text.who}
    given = {name: field for name, field in fields.items() if field}
    level = logging.WARNING if event.kind in WARNINGS else logging.INFO
    log.log(level, text.kind, extra={**given, "tick": event.tick, "number": event.number})


def utc_text(event: Event) -> str:
    """Return when an event happened: ISO 8601, UTC, with milliseconds."""
    time = datetime.fromtimestamp(event.utc, UTC)
    return f"{time:%Y-%m-%dT%H:%M:%S}.{event.milliseconds:03}Z"
