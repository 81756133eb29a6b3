"""Records a session under way without changing it: writes the files of a run, from now on."""

import asyncio
import contextlib
import time
from collections.abc import Iterable
from functools import partial
from itertools import chain
from typing import Final, NamedTuple

from coldloop.errors import LinkError, UsageError
from coldloop.operating.rings import last_update
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.audit import Event, EventKind
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.control_plc import Status
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import LoadStatus, PlantSample, StationSample
from coldloop_rig.cosim.answer_time import QUIET_S
from coldloop_rig.cosim.journal_reader import JournalReader
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.session_client import SessionClient
from coldloop_rig.cosim.session_events import SessionEvents
from coldloop_rig.cosim.session_reader import SampleReader, UpdateReader
from coldloop_rig.results.driving import CONTROL, PLANT
from coldloop_rig.results.recording import LinkStatistics, Recorder

LONGEST_PAUSE_S: Final = 0.2
SHORTEST_PAUSE_S: Final = 0.002
PASSING: Final = frozenset({EventKind.ALARM_RAISED, EventKind.ALARM_RETURNED, EventKind.ALARM_ACKNOWLEDGED})
"""Of these, what has happened to an alarm since it was raised last says how it is."""
HELD: Final = (
    frozenset({EventKind.MODE}),
    frozenset({EventKind.ALARM_SHELVED, EventKind.ALARM_UNSHELVED}),
    frozenset({EventKind.ALARM_OUT_OF_SERVICE, EventKind.ALARM_IN_SERVICE}),
    frozenset({EventKind.SENSOR}),
    frozenset({EventKind.SENSOR_FAULT}),
)
"""Kinds of events of which the last says how something is from then on: the ladder, an alarm, a sensor."""


class SessionUnderWay(NamedTuple):
    """What is found at a rig."""

    identity: Identity
    pace: SessionPace
    load: float
    """At present, W."""

    def scenario(self, ticks: int) -> Scenario:
        """Return what is recorded of it in so many ticks; what its load will be is not known."""
        load = LoadProfile((0,), (self.load,))
        return Scenario(ticks, load, updating_period_s=0.0, seed=0, realtime=bool(self.pace.realtime),
                        factor=self.pace.factor)  # fmt: skip


async def find_session(rig: SessionClient) -> SessionUnderWay:
    """Return the session of a rig.

    Raises:
        UsageError: It has none.
        LinkError: The plant does not answer.
    """
    identity, pace = await rig.plant.read(Identity), await rig.plant.read(SessionPace)
    if not identity.session:
        raise UsageError(f"{rig.plant.peer} has no session: there is nothing to record")
    return SessionUnderWay(identity, pace, (await rig.plant.read(LoadStatus)).watts)


class _FromNow:
    """Passes on to a recorder what is read, with ticks and updates counted from now on."""

    def __init__(self, recorder: Recorder, first_tick: int, first_update: int) -> None:
        self._recorder, self._tick, self._update = recorder, first_tick, first_update

    @property
    def next_tick(self) -> int:
        return self._tick + self._recorder.next_tick

    def sample(self, sample: PlantSample) -> None:
        self._recorder.sample(sample._replace(tick=sample.tick - self._tick))

    def station(self, sample: StationSample) -> None:
        self._recorder.station(sample._replace(tick=sample.tick - self._tick))

    def update(self, update: Optimization) -> None:
        if update.tick >= self._tick and update.update >= self._update:
            self._recorder.update(update._replace(tick=update.tick - self._tick, update=update.update - self._update))

    def event(self, event: Event, service: str = CONTROL) -> None:
        self._recorder.event(event._replace(tick=max(0, event.tick - self._tick)), service)


async def record_session(rig: SessionClient, scenario: Scenario, recorder: Recorder) -> None:
    """Record a session from now on.

    Args:
        rig: Connected, and tolerant: services may come and go meanwhile.
        scenario: What is recorded.
        recorder: Takes it; its first tick is the present one.

    Raises:
        UsageError: The rig has no session.
        LinkError: The plant does not answer for long, or is in another session.
    """
    session = await find_session(rig)
    first_update = await _next_update(rig)
    from_now = _FromNow(recorder, session.identity.tick, first_update)
    readers = {service: JournalReader(rig.clients[service]) for service in (CONTROL, PLANT)}
    for service, reader in readers.items():
        for event in state_of(await reader.read_on(), session.identity.tick):
            from_now.event(event, service)
    events = SessionEvents(readers, from_now)
    number, end = session.identity.session, session.identity.tick + scenario.ticks
    samples = SampleReader(
        rig.plant, from_now, number, end, first=session.identity.tick, tolerant=True, realtime=scenario.realtime
    )
    updates = UpdateReader(rig.optimizer, from_now, number, first=first_update, tolerant=True)
    late = Lateness(await rig.control.read(Status))
    recorder.begin()
    heard_at = time.monotonic()
    try:
        while from_now.next_tick < end:
            if await rig.contact(samples.read()) is not None:
                heard_at = time.monotonic()
            elif time.monotonic() - heard_at > QUIET_S:
                raise LinkError(f"{rig.plant.peer} has not answered for {QUIET_S:g} s")
            await rig.contact(updates.read())
            await rig.contact(events.look(CONTROL, PLANT))
            recorder.link = late.after(await rig.contact(rig.control.read(Status)))
            pause_s = rig.plant.process.tick_s / scenario.factor if scenario.realtime else SHORTEST_PAUSE_S
            await asyncio.sleep(min(max(pause_s, SHORTEST_PAUSE_S), LONGEST_PAUSE_S))
    finally:  # what ended the recording is reported, not that the last of it cannot be read
        for read in (updates.read, partial(events.read, CONTROL), partial(events.read, PLANT)):
            with contextlib.suppress(LinkError):
                await rig.contact(read())
        with contextlib.suppress(LinkError):
            recorder.link = late.after(await rig.contact(rig.control.read(Status)))


async def _next_update(rig: SessionClient) -> int:
    """Return the number of the update that the optimiser does next."""
    last = await last_update(rig.optimizer, await rig.optimizer.read(Identity))
    return 0 if last is None else last.update + 1


def state_of(events: Iterable[Event], tick: int) -> list[Event]:
    """Return, of what has been noted in a session so far, the events that say how everything is at a tick.

    And all of later ticks: a session goes on while it is asked.
    """
    last: dict[tuple[int, int], Event] = {}
    alarms: dict[int, list[Event]] = {}
    later: list[Event] = []
    for event in events:
        if event.kind == EventKind.SESSION:
            last.clear()
            alarms.clear()
            later.clear()
        if event.tick > tick:
            later.append(event)
            continue
        if event.kind in PASSING:
            before = [] if event.kind == EventKind.ALARM_RAISED else alarms.get(event.subject, [])
            alarms[event.subject] = [*before, event]
        for group, kinds in enumerate(HELD):
            if event.kind in kinds:
                last[group, event.subject if group else 0] = event
    return [*sorted([*last.values(), *chain.from_iterable(alarms.values())]), *later]


class Lateness:
    """Counts what was late since a first look, also where the control PLC was restarted and counts from 0."""

    def __init__(self, first: Status) -> None:
        self._before = first
        self._late = LinkStatistics(0, 0, first.lateness_max, first.lateness_p99)

    def after(self, status: Status | None) -> LinkStatistics:
        """Return what was late up to a look, None where there was no answer; the largest lateness is of the session."""
        if status is not None:
            before, self._before, late = self._before, status, self._late
            self._late = LinkStatistics(
                late.deadline_misses + _gained(before.deadline_misses, status.deadline_misses),
                late.overruns + _gained(before.overruns, status.overruns),
                max(late.lateness_max_ms, status.lateness_max), status.lateness_p99,
            )  # fmt: skip
        return self._late


def _gained(before: int, now: int) -> int:
    return now - before if now >= before else now
