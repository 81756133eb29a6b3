"""The alarms of a recorded run, from what its events say of them."""

from collections.abc import Iterable
from functools import cache
from typing import Final

from coldloop.process.declaration import Process
from coldloop.process.settings import settings_of
from coldloop.registers.audit import EventKind
from coldloop.registers.safety import Alarm, AlarmState, alarms_of
from coldloop.service.event_text import alarm_cause, alarm_word
from coldloop_control_plc.alarms import TRANSITIONS, AlarmSettings
from coldloop_hmi.process_image import JournalEntry

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
