"""The alarms of a recorded run, from what its events say of them."""

from collections.abc import Iterable
from typing import Final

from coldloop.process.signals import TICK_S
from coldloop.registers.audit import EventKind
from coldloop.registers.safety import Alarm, AlarmKind, AlarmState
from coldloop.service.event_text import alarm_cause, alarm_word, kind_word
from control_plc.alarm_settings import AlarmSettings
from control_plc.alarms import TRANSITIONS
from hmi.process_image import JournalEntry

_KINDS: Final = {kind_word(event): event for events in TRANSITIONS.values() for event in events}
_ALARMS: Final = {alarm_word(kind): kind for kind in AlarmKind}
_CAUSES: Final = {kind: {alarm_cause(kind, cause): cause for cause in range(64)} for kind in AlarmKind}


def alarms_after(events: Iterable[JournalEntry]) -> list[Alarm]:
    """Return the alarms after these events, by number."""
    settings = AlarmSettings()
    rows = [Alarm(priority=settings.rule(kind).priority) for kind in AlarmKind]
    for entry in events:
        event, kind = _KINDS.get(entry.text.kind), _ALARMS.get(entry.text.subject)
        if event is not None and kind is not None:
            rows[kind] = _after(rows[kind], event, kind, entry)
    return rows


def _after(row: Alarm, event: EventKind, kind: AlarmKind, entry: JournalEntry) -> Alarm:
    state = TRANSITIONS[AlarmState(row.state)].get(event, AlarmState(row.state))
    row = row._replace(state=state)
    match event:
        case EventKind.ALARM_RAISED:
            cause = _CAUSES[kind].get(entry.text.cause, 0)
            return row._replace(active=1, cause=cause, times=row.times + 1, raised=entry.tick)
        case EventKind.ALARM_RETURNED:
            return row._replace(active=0, returned=entry.tick)
        case EventKind.ALARM_SHELVED:
            return row._replace(shelved_until=entry.tick + round(float(entry.text.value or 0.0) / TICK_S))
        case EventKind.ALARM_UNSHELVED:
            return row._replace(shelved_until=0)
    return row
