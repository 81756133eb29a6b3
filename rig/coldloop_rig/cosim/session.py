"""Client of a rig on the bus, for one session at a time: begins it, grants ticks, records what happens, follows it.

`coldloop run`, `up`, `chaos` and networked studies use it; what is recorded goes to the sinks of a `Recorder`.
`record_session` records a session under way without changing it, from now on.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Final, NamedTuple, TypeVar

from coldloop.errors import LinkError, ModelFileError, PeerUnreachableError, UsageError
from coldloop.modbus.client import RegisterClient
from coldloop.operating import execution, observer
from coldloop.process.load_profile import LoadProfile
from coldloop.registers import codec, control_plc, maps_of, optimizer_plc, plant
from coldloop.registers.common import Event, EventKind, Identity, JournalPage, SessionPace
from coldloop_plant.kinds import own_header
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.cosim.wiring import QUIET_S, SERVICES, RigEndpoints
from coldloop_rig.results.recording import CONTROL, PLANT, SETTLED_TICKS, LinkStatistics, Recorder
from coldloop_rig.settings import Settings

T = TypeVar("T")

AHEAD: Final = plant.HISTORY_ROWS - 32
"""Ticks that the control PLC may be ahead of the recording, so that the history still has them."""
STATION_AHEAD: Final = plant.STATION_ROWS - 32
"""Ticks that the control PLC may be ahead where the station's history is recorded too."""
SHORTEST_PAUSE_S: Final = 0.001
LONGEST_PAUSE_S: Final = 0.2
LONGEST_LOCKSTEP_PAUSE_S: Final = 0.01
"""Longest interval at which a rig whose time does not advance is polled, s."""
EVENTS_S: Final = 0.25
"""Interval at which the journals are polled, s of real time."""
CONTACT_S: Final = 1.0
"""Longest time of an answer with `tolerant`, s: a stopped process must not delay the others for long."""
PASSING: Final = frozenset({EventKind.ALARM_RAISED, EventKind.ALARM_RETURNED, EventKind.ALARM_ACKNOWLEDGED})
"""Alarm transitions: those since an alarm was last raised determine its state."""
HELD: Final = (
    frozenset({EventKind.MODE}),
    frozenset({EventKind.ALARM_SHELVED, EventKind.ALARM_UNSHELVED}),
    frozenset({EventKind.ALARM_OUT_OF_SERVICE, EventKind.ALARM_IN_SERVICE}),
    frozenset({EventKind.SENSOR}),
    frozenset({EventKind.SENSOR_FAULT}),
)
"""Kinds of events of which the last says how something is from then on: the ladder, an alarm, a sensor."""


def next_session(present: Sequence[int]) -> int:
    """Return a number for a new session that none of the services is in; after the largest they begin with 1 again."""
    session = max(present) % 0xFFFF_FFFF + 1
    while session in present:
        session += 1
    return session


class SessionEvents:
    """Passes what control PLC and plant note from now on to a recorder."""

    def __init__(self, readers: Mapping[str, observer.JournalReader], recorder: observer.Subscriber) -> None:
        self._readers = readers
        self._recorder = recorder
        self._looked_at = 0.0
        self._tick = 0

    async def look(self, *services: str) -> None:
        """Read new events of these services, if the last look was long ago.

        Raises:
            LinkError: One of them does not answer.
        """
        ticks = self._recorder.next_tick
        if time.monotonic() - self._looked_at < EVENTS_S and ticks - self._tick < SETTLED_TICKS // 2:
            return  # the recorder waits for events no longer than `SETTLED_TICKS`
        self._looked_at, self._tick = time.monotonic(), ticks
        for service in services:
            await self.read(service)

    async def read(self, service: str) -> int:
        """Read new events of a service; return how many there were.

        Raises:
            LinkError: It does not answer.
        """
        events = await self._readers[service].read_on()
        for event in events:
            self._recorder.event(event, service)
        return len(events)


class SessionClient:
    """Client of the services of a rig.

    Args:
        endpoints: Where they are.
        settings: What they are expected to run.
        tolerant: For a rig whose parts come and go: a service that does not answer is asked again later, ticks that it
            does not keep any more are left out. Otherwise either ends the run.
        services: Which ones there are; without the optimiser, sessions can be started and held, and not recorded.
    """

    def __init__(
        self, endpoints: RigEndpoints, settings: Settings, *, tolerant: bool = False, services: Sequence[str] = SERVICES
    ) -> None:
        self._settings = settings
        self._tolerant = tolerant
        self.plant, self.control, self.optimizer = map(RegisterClient.at, maps_of(settings.process), endpoints)
        self._tick_s = settings.process.tick_s
        every = {"plant": self.plant, "control_plc": self.control, "optimizer_plc": self.optimizer}
        self.clients = {service: every[service] for service in services}
        self.session = 0
        """The session that was started last; 0 is none."""
        self.load: execution.LoadStream | None = None
        """The load of the session that was started last."""
        self.lost_contacts = 0
        """Requests that were not answered, with `tolerant`."""
        self._noted_events = -1
        self._background: asyncio.Future[int | None] | None = None

    async def connect(self, patience_s: float) -> None:
        """Connect to all of them, and make sure that they run the model of our configuration.

        Raises:
            PeerUnreachableError: One is not there.
            ModelFileError: One runs another model.
        """
        file = self._settings.model.file
        ours = own_header(file).short_digest
        for client in self.clients.values():
            await client.connect(patience_s)
            theirs = (await client.read(Identity)).model_digest
            if theirs != ours:
                raise ModelFileError(
                    f"{client.peer} runs model {theirs:08x}, not {ours:08x} of {file}: give all of them the same model"
                )

    def close(self) -> None:
        """Close the connections."""
        if self._background is not None:
            self._background.cancel()
        for client in self.clients.values():
            client.close()

    async def run(self, scenario: Scenario, recorder: Recorder) -> None:
        """Start a session for the scenario and record it to its end.

        Raises:
            LinkError: The rig stopped moving, or went faster than it could be recorded.
        """
        await self.begin(scenario, recorder)
        try:
            quiet_since, lockstep = time.monotonic(), not scenario.realtime
            pause_s = SHORTEST_PAUSE_S if lockstep else min(20 * self._tick_s / scenario.factor, LONGEST_PAUSE_S)
            while (done := recorder.next_tick) < scenario.ticks:
                await self.grant(scenario.ticks)
                await self.look()
                ticks, now = recorder.next_tick - done, time.monotonic()
                if ticks > 0:
                    quiet_since = now
                elif now - quiet_since > max(QUIET_S, 4 * self._tick_s / scenario.factor):
                    raise LinkError(
                        f"{self.plant.peer} has been at tick {done} for {now - quiet_since:.0f} s: "
                        "see the logs of the control PLC and of the optimiser"
                    )
                if lockstep and ticks > 2 * observer.BATCH:  # the rig must not come to the end of its grant, ...
                    pause_s /= 2
                elif lockstep and ticks < observer.BATCH:  # ... and a look asks all three services
                    pause_s = min(pause_s * 1.5, LONGEST_LOCKSTEP_PAUSE_S)
                pause_s = max(pause_s, SHORTEST_PAUSE_S)
                await asyncio.sleep(pause_s)
            await self.conclude()
        finally:
            await self.last_look()

    async def begin(self, scenario: Scenario, recorder: Recorder) -> None:
        """Start a session for the scenario, recorded from now on."""
        readers = {
            service: observer.JournalReader(client, (await client.read(JournalPage)).newest + 1)
            for service, client in ((CONTROL, self.control), (PLANT, self.plant))
        }
        self._events = SessionEvents(readers, recorder)
        session = await self.start(scenario)
        self._scenario, self._recorder = scenario, recorder
        self._samples = observer.SampleReader(
            self.plant, recorder, session, scenario.ticks, realtime=scenario.realtime, tolerant=self._tolerant
        )
        self._updates = observer.UpdateReader(
            self.optimizer, recorder.update, session, first=0, tolerant=self._tolerant
        )
        recorder.begin()

    async def start(self, scenario: Scenario) -> int:
        """Write the load and the settings of a new session to all of them; return its number.

        Raises:
            LinkError: A service does not answer or refuses.
        """
        session = next_session([(await client.read(Identity)).session for client in self.clients.values()])
        self.session = session
        realtime = int(scenario.realtime)
        if "optimizer_plc" in self.clients:
            period = round(scenario.updating_period_s / self._tick_s)
            await self.optimizer.write(optimizer_plc.OptimizerSession(session, realtime, scenario.factor, period))
        rows = await execution.write_table(self.plant, scenario.load)
        await self.plant.write(plant.PlantSession(session, realtime, scenario.factor, scenario.seed, rows))
        self.load = execution.LoadStream(self.plant, session, scenario.load, sent=rows)
        await self.control.write(control_plc.ControlSession(session, realtime, scenario.factor))
        return session

    async def hold(self, look_s: float, failed: Callable[[LinkError], object]) -> None:
        """Keep the session that was started last, in real time, supplied with its load until cancelled.

        A load that another client writes replaces all of it, as it replaces the plant's later steps.

        Args:
            look_s: Interval at which the plant is polled, s.
            failed: Takes the error where the plant does not answer (`PeerUnreachableError`), or refuses the load, which
                is not written any more.
        """
        while True:
            try:
                identity = await self.plant.read(Identity)
                if identity.session != self.session:  # another client has begun one
                    self.load = None
                elif self.load is not None and not self.load.done:
                    await self._supply(self.load, identity.tick)
            except LinkError as error:
                failed(error)
            await asyncio.sleep(look_s)

    async def _supply(self, load: execution.LoadStream, tick: int) -> None:
        is_over = False
        try:
            is_over = await load.was_replaced()
            if not is_over:
                await load.feed(tick)
        except LinkError as error:
            is_over = not isinstance(error, PeerUnreachableError)
            raise
        finally:
            if is_over and self.load is load:  # not that of a session that has begun meanwhile
                self.load = None

    async def conclude(self) -> None:
        """Read what was still under way when the last tick was done.

        Raises:
            LinkError: The optimiser stopped before.
        """
        if self._background is not None:
            await self._background
        status = await self.contact(self.control.read(control_plc.Status))
        if status is not None and status.mode != control_plc.Mode.CLASSICAL:  # the loops ask for no updates
            last = 0 if self._scenario.realtime else status.update
            updates = self._updates.read_until(self._scenario.ticks, last, QUIET_S)
            await self.contact(updates, within_s=2.0 * QUIET_S)  # it gives up by itself, and says why
            status = await self.contact(self.control.read(control_plc.Status))
        if status is not None:
            self._recorder.link = LinkStatistics(
                status.deadline_misses, status.overruns, status.lateness_max, status.lateness_p99
            )

    async def last_look(self) -> None:
        """Read the last events; what ended the run is what is reported, not that these cannot be read."""
        with contextlib.suppress(LinkError, TimeoutError):
            async with asyncio.timeout(2.0):
                await self._events.read(CONTROL)
                await self._events.read(PLANT)

    async def grant(self, until: int) -> None:
        """Advance the rig to a tick, limited by the known load and by the length of the plant's history."""
        done = self._samples.read_until
        most = AHEAD if self._samples.has_station is False else STATION_AHEAD
        await self.advance(done, min(until, done + most), realtime=self._scenario.realtime)

    async def advance(self, tick: int, until: int, *, realtime: bool = False) -> None:
        """Write the load that follows a tick; in lock-step grant the ticks before `until`, as far as it is known."""
        if self.load is not None:
            await self.contact(self.load.feed(tick))
        if not realtime:
            known = None if self.load is None else self.load.known_until
            await self.contact(self.control.write(control_plc.Grant(until if known is None else min(until, known))))

    async def look(self) -> int | None:
        """Record what has happened since the last look; return the plant's tick, None when it does not answer.

        With `tolerant` the events of the control PLC are read by `ladder`.
        """
        tick = await self.contact(self._samples.read())
        if not self._tolerant:
            await self._updates.read()
            await self._events.look(CONTROL, PLANT)
            return tick
        if self._background is None or self._background.done():
            if self._background is not None:
                self._background.result()  # raises what is wrong with more than the contact
            read = self.contact(self._updates.read())  # a silent optimiser must not hold up the rest
            self._background = asyncio.ensure_future(read)
        if tick is not None:
            await self.contact(self._events.look(PLANT))
        return tick

    async def ladder(self) -> control_plc.LadderStatus | None:
        """Return the state of the fail-safe ladder, and record the events of the control PLC when there are new ones.

        None when it does not answer.
        """
        ladder = await self.contact(self.control.read(control_plc.LadderStatus))
        if ladder is None or ladder.events == self._noted_events:
            return ladder
        if await self.contact(self._events.read(CONTROL)) is None:
            return None
        self._noted_events = ladder.events
        return ladder

    async def contact(self, request: Awaitable[T], *, within_s: float = CONTACT_S) -> T | None:
        """Return the answer to a request; with `tolerant`, None when the service does not answer in time."""
        if not self._tolerant:
            return await request
        try:
            async with asyncio.timeout(within_s):
                return await request
        except (PeerUnreachableError, TimeoutError):
            self.lost_contacts += 1
            return None


async def find_session(rig: SessionClient) -> Identity:
    """Return the session of a rig.

    Raises:
        UsageError: It has none.
        LinkError: The plant does not answer.
    """
    identity = await rig.plant.read(Identity)
    if not identity.session:
        raise UsageError(f"{rig.plant.peer} has no session: there is nothing to record")
    return identity


async def present_scenario(rig: SessionClient, ticks: int) -> Scenario:
    """Return what is recorded of the session of a rig in so many ticks; what its load will be is not known.

    Raises:
        UsageError: It has none.
        LinkError: The plant does not answer.
    """
    await find_session(rig)
    pace, load = await rig.plant.read(SessionPace), (await rig.plant.read(plant.LoadStatus)).watts
    return Scenario(ticks, LoadProfile((0,), (load,)), 0.0, 0, realtime=bool(pace.realtime), factor=pace.factor)


class _FromNow:
    """Passes on to a recorder what is read, with ticks and updates counted from now on."""

    def __init__(self, recorder: Recorder, first_tick: int, first_update: int) -> None:
        self._recorder, self._tick, self._update = recorder, first_tick, first_update

    @property
    def next_tick(self) -> int:
        return self._tick + self._recorder.next_tick

    def sample(self, sample: plant.PlantSample) -> None:
        self._recorder.sample(sample._replace(tick=sample.tick - self._tick))

    def station(self, sample: plant.StationSample) -> None:
        self._recorder.station(sample._replace(tick=sample.tick - self._tick))

    def update(self, update: optimizer_plc.Optimization) -> None:
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
    identity, last = await find_session(rig), await observer.last_update(rig.optimizer)
    first_update = 0 if last is None else last.update + 1
    from_now = _FromNow(recorder, identity.tick, first_update)
    readers = {service: observer.JournalReader(rig.clients[service]) for service in (CONTROL, PLANT)}
    for service, reader in readers.items():
        for event in state_of(await reader.read_on(), identity.tick):
            from_now.event(event, service)
    events = SessionEvents(readers, from_now)
    number, end = identity.session, identity.tick + scenario.ticks
    samples = observer.SampleReader(
        rig.plant, from_now, number, end, first=identity.tick, tolerant=True, realtime=scenario.realtime
    )
    updates = observer.UpdateReader(rig.optimizer, from_now.update, number, first=first_update, tolerant=True)
    late = Lateness(await rig.control.read(control_plc.Status))
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
            recorder.link = late.after(await rig.contact(rig.control.read(control_plc.Status)))
            pause_s = rig.plant.process.tick_s / scenario.factor if scenario.realtime else 0.0
            await asyncio.sleep(min(max(pause_s, 2 * SHORTEST_PAUSE_S), LONGEST_PAUSE_S))
    finally:  # reports what ended the recording, not a failed read of its last part
        for read in (updates.read, partial(events.read, CONTROL), partial(events.read, PLANT)):
            with contextlib.suppress(LinkError):
                await rig.contact(read())
        with contextlib.suppress(LinkError):
            recorder.link = late.after(await rig.contact(rig.control.read(control_plc.Status)))


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

    def __init__(self, first: control_plc.Status) -> None:
        self._before = first
        self._late = LinkStatistics(0, 0, first.lateness_max, first.lateness_p99)

    def after(self, status: control_plc.Status | None) -> LinkStatistics:
        """Return what was late up to a look, None where there was no answer; the largest lateness is of the session."""
        if status is not None:
            before, self._before, late = self._before, status, self._late
            pairs = (before.deadline_misses, status.deadline_misses), (before.overruns, status.overruns)
            misses, overruns = (now - then if now >= then else now for then, now in pairs)
            largest, total = max(late.lateness_max_ms, status.lateness_max), late.deadline_misses + misses
            self._late = LinkStatistics(total, late.overruns + overruns, largest, status.lateness_p99)
        return self._late


log = logging.getLogger("coldloop.rig")


class SavedSession(NamedTuple):
    """State of a rig when the client attached."""

    pace: SessionPace
    operator: control_plc.Operator
    load: LoadProfile
    """Load from that tick on, W."""


async def save_session(rig: SessionClient) -> SavedSession | None:
    """Return the session of a rig if it runs in real time.

    Raises:
        LinkError: A service does not answer, or its load is invalid.
    """
    identity, pace = await rig.plant.read(Identity), await rig.plant.read(SessionPace)
    if not identity.session or not pace.realtime:
        return None
    operator, now = await rig.control.read(control_plc.Operator), identity.tick
    status, asked = await rig.plant.read(plant.LoadStatus), await rig.plant.read(plant.PlantSession)
    steps: list[plant.LoadStep] = []
    if status.upcoming:
        steps = await rig.plant.read_rows(plant.LoadStep, 0, min(asked.load_steps, plant.LOAD_ROWS))
    if not steps or steps[-1].tick != status.last_tick:  # another client has written a load since
        steps = []
    coming = [step for step in steps if step.tick > now]
    try:
        times, watts = (0, *(step.tick - now for step in coming)), (status.watts, *(step.watts for step in coming))
        return SavedSession(pace, operator, LoadProfile(times, watts))
    except ValueError as error:
        raise LinkError(f"{rig.plant.peer}: its load is invalid: {error}") from None


async def restore_session(rig: SessionClient, saved: SavedSession | None, session: int) -> None:
    """Restore real time, factor, load and operating mode of the rig in the session of our run.

    Nothing is done where the rig was in lock-step, or where another client has begun another session. A failure
    is logged: the run is recorded all the same.
    """
    if saved is None:
        return
    try:
        identity = await rig.plant.read(Identity)
        if identity.session != session:
            return
        await execution.write_pace(rig.clients, saved.pace._replace(session=0))
        if saved.operator.mode != control_plc.OperatorMode.AUTO:
            await rig.control.write(saved.operator)
        tick = (await rig.plant.read(Identity)).tick
        await rig.plant.write(codec.sealed(plant.LiveLoad(0, saved.load.watts[0]), rig.plant.map))
        coming = LoadProfile(saved.load.times, saved.load.watts)
        await execution.LoadStream(
            rig.plant, session, coming, begin=tick + execution.lead_ticks(saved.pace, rig.plant.process.tick_s)
        ).feed(tick)
    except LinkError as error:
        log.warning("the rig was not restored: %s", error)
    else:
        log.info("restored at %g s", tick * rig.plant.process.tick_s)
