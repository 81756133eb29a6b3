"""What is known of a session before its recording begins: how everything is, from what was noted last."""

from typing import cast

import pytest

from coldloop.modbus.client import RegisterClient
from coldloop.operating.observer import UpdateReader
from coldloop.process.cold_box import COLD_BOX
from coldloop.registers.common import AlarmState, Event, EventKind, Identity
from coldloop.registers.control_plc import Status
from coldloop.registers.optimizer_plc import HISTORY_ROWS, Optimization
from coldloop_hmi.process_image import JournalEntry
from coldloop_optimizer_plc.runtime import NO_UPDATE
from coldloop_rig.cosim.session import Lateness, state_of
from coldloop_rig.live.recorded_page import alarms_after
from coldloop_rig.results.recording import LinkStatistics

NOW = 1000
"""A tick after all that is noted."""


def noted(number: int, kind: EventKind, subject: int = 0, cause: int = 0) -> Event:
    return Event(number=number, tick=10 * number, kind=kind, subject=subject, cause=cause)


def test_the_last_mode_and_the_last_of_each_alarm_and_sensor_count() -> None:
    events = [
        noted(1, EventKind.MODE, 1), noted(2, EventKind.ALARM_RAISED, 5), noted(3, EventKind.ALARM_RAISED, 6),
        noted(4, EventKind.SENSOR_FAULT, 2, 1), noted(5, EventKind.SENSOR, 2, 1), noted(6, EventKind.ALARM_RETURNED, 5),
        noted(7, EventKind.MODE, 2), noted(8, EventKind.OPERATOR_MODE, 1), noted(9, EventKind.SENSOR_FAULT, 3, 2),
    ]  # fmt: skip
    assert [event.number for event in state_of(events, NOW)] == [2, 3, 4, 5, 6, 7, 9]


def test_an_alarm_is_as_it_was_when_the_recording_begins() -> None:
    raised, returned, acknowledged = EventKind.ALARM_RAISED, EventKind.ALARM_RETURNED, EventKind.ALARM_ACKNOWLEDGED
    events = [
        noted(1, EventKind.ALARM_SHELVED, 5), noted(2, raised, 5), noted(3, returned, 5), noted(4, raised, 5),
        noted(5, acknowledged, 5), noted(6, raised, 7), noted(7, returned, 7), noted(8, EventKind.ALARM_UNSHELVED, 5),
    ]  # fmt: skip
    entry = [JournalEntry.of("control_plc", event, COLD_BOX) for event in state_of(events, NOW)]
    rows = alarms_after(entry, COLD_BOX)
    assert (rows[5].state, rows[5].active, rows[5].raised) == (AlarmState.ACKNOWLEDGED, 1, 40)
    assert (rows[7].state, rows[7].active) == (AlarmState.RETURNED, 0)


def test_what_was_noted_in_a_session_before_does_not_count() -> None:
    events = [noted(1, EventKind.SENSOR_FAULT, 2, 1), noted(2, EventKind.SESSION), noted(3, EventKind.MODE, 1)]
    assert [event.number for event in state_of(events, NOW)] == [3]
    assert state_of([], NOW) == []


def test_what_happens_while_a_session_is_asked_is_of_its_own_tick() -> None:
    """A session that is quick, or asked by a busy machine, goes on between its tick and its journal."""
    held, driven, raised = noted(2, EventKind.MODE, 2), noted(4, EventKind.MODE, 1), noted(5, EventKind.ALARM_RAISED, 5)
    events = [noted(90, EventKind.MODE, 3), noted(1, EventKind.SESSION), held, driven, raised]
    assert state_of(events, driven.tick - 1) == [held, driven, raised]
    assert state_of(events, driven.tick) == [driven, raised]


def counted(misses: int, overruns: int, lateness_ms: float) -> Status:
    return Status(0, 0, 0, 0, 0, 0, 0, misses, overruns, lateness_ms, lateness_ms / 2)


def test_what_was_late_is_counted_over_a_restart_of_the_control_plc() -> None:
    late = Lateness(counted(100, 50, 3.0))
    assert late.after(counted(103, 50, 3.0)) == LinkStatistics(3, 0, 3.0, 1.5)
    assert late.after(None) == LinkStatistics(3, 0, 3.0, 1.5), "it is away"
    assert late.after(counted(2, 1, 1.0)) == LinkStatistics(5, 1, 3.0, 0.5), "and has counted from 0 again"


class History:
    """The optimiser's registers, as far as a reader of updates looks."""

    peer = "optimizer_plc"

    def __init__(self, *updates: Optimization) -> None:
        self.rows = {update.update % HISTORY_ROWS: update for update in updates}
        self.newest = max(update.update for update in updates)

    async def read(self, _record: type[Identity]) -> Identity:
        return Identity(
            map_digest=0, map_version=0, state=1, model_digest=0, session=1, tick=0, heartbeat=self.newest + 1
        )

    async def read_rows(self, _record: type[Optimization], first: int, count: int) -> list[Optimization]:
        return [self.rows.get(row, NO_UPDATE) for row in range(first, first + count)]


def done(number: int, tick: int) -> Optimization:
    return NO_UPDATE._replace(update=number, tick=tick, tau_u=4)


@pytest.mark.parametrize("tolerant", [False, True])
async def test_an_update_that_was_abandoned_for_a_newer_one_is_not_recorded(*, tolerant: bool) -> None:
    """In real time a busy machine may leave the first update unanswered: its row is empty, and its number is 0."""
    recorded: list[Optimization] = []
    client = cast("RegisterClient", History(done(1, 4), done(3, 12)))
    await UpdateReader(client, recorded.append, session=1, first=0, tolerant=tolerant).read()
    assert [update.update for update in recorded] == [1, 3]
