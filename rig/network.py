"""A rig of three services on the bus: started here, or already up; driven and recorded over Modbus alone."""

import asyncio
import contextlib
import time

from coldloop.errors import LinkError, ModelFileError
from coldloop.modbus.client import RegisterClient
from coldloop.process import TICK_S
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import CONTROL_MAP, ControlSession, Grant, Mode, Status
from coldloop.registers.optimizer_plc import HISTORY_ROWS as UPDATE_ROWS
from coldloop.registers.optimizer_plc import OPTIMIZER_MAP, Optimization, OptimizerSession
from coldloop.registers.plant import HISTORY_ROWS, PLANT_MAP, PlantSample, PlantSession, StationSample
from plant.runtime import own_header
from rig.load_stream import LoadStream, write_table
from rig.recording import LinkStatistics, Recorder
from rig.rig_endpoints import RigEndpoints
from rig.scenario import Scenario
from rig.session_events import SessionEvents
from rig.settings import Settings

AHEAD = HISTORY_ROWS - 32
"""Ticks that the control PLC may be ahead of the recording, so that the history still has them."""
QUIET_S = 20.0
"""A rig on which nothing happens for this long is given up."""
LAST_LOOK_S = 2.0
"""How long the events of a run that has ended are waited for."""
LAST_TICK = 2**32 - 1
BATCH = 64
"""Ticks to wait for before reading, in lock-step."""


class NetworkRig:
    """Client of all three services."""

    def __init__(self, endpoints: RigEndpoints, settings: Settings) -> None:
        self._settings = settings
        self.plant = RegisterClient.at(PLANT_MAP, endpoints.plant)
        self.control = RegisterClient.at(CONTROL_MAP, endpoints.control_plc)
        self.optimizer = RegisterClient.at(OPTIMIZER_MAP, endpoints.optimizer_plc)
        self.session = 0
        """The session that was started last; 0 is none."""
        self.load: LoadStream | None = None
        """The load of the session that was started last."""
        self._has_station = False

    async def connect(self, patience_s: float) -> None:
        """Connect to all three, and make sure that all run the model of our configuration.

        Raises:
            PeerUnreachableError: One is not there.
            ModelFileError: One runs another model.
        """
        file = self._settings.model.file
        ours = own_header(file).short_digest
        for client in (self.plant, self.control, self.optimizer):
            await client.connect(patience_s)
            theirs = (await client.read(Identity)).model_digest
            if theirs != ours:
                raise ModelFileError(
                    f"{client.peer} runs model {theirs:08x}, not {ours:08x} of {file}: give all of them the same model"
                )

    def close(self) -> None:
        """Close the connections."""
        for client in (self.plant, self.control, self.optimizer):
            client.close()

    async def run(self, scenario: Scenario, recorder: Recorder) -> None:
        """Start a session for the scenario and record it.

        Raises:
            LinkError: The rig stopped moving, or went faster than it could be recorded.
        """
        events = await SessionEvents.after_now(self.control, self.plant, recorder)
        session = await self.start(scenario)
        recorder.begin()
        try:
            await self._follow(scenario, recorder, session, events)
        finally:
            with contextlib.suppress(LinkError, TimeoutError):  # what ended the run is what is reported
                async with asyncio.timeout(LAST_LOOK_S):
                    await events.look(now=True)

    async def hold(self, session: int, look_s: float) -> None:
        """Keep a session in real time supplied with its load until cancelled, or until another one begins.

        Raises:
            LinkError: The plant does not answer.
        """
        while True:
            identity = await self.plant.read(Identity)
            if identity.session != session:
                self.load = None
            elif self.load is not None and not self.load.done:
                if await self.load.was_replaced():
                    self.load = None
                else:
                    await self.load.feed(identity.tick)
            await asyncio.sleep(look_s)

    async def _follow(self, scenario: Scenario, recorder: Recorder, session: int, events: SessionEvents) -> None:
        updates = _UpdateReader(self.optimizer, recorder, session)
        quiet_since = time.monotonic()
        pause_s = 20 * TICK_S / scenario.factor if scenario.realtime else 0.001
        while len(recorder.samples) < scenario.ticks:
            arrived = await self._read_samples(session, scenario, recorder)
            await updates.read()
            await events.look()
            now = time.monotonic()
            if arrived:
                quiet_since = now
            elif now - quiet_since > max(QUIET_S, 4 * TICK_S / scenario.factor):
                raise LinkError(
                    f"{self.plant.peer} stands at tick {len(recorder.samples)} for {now - quiet_since:.0f} s: "
                    "see the logs of the control PLC and of the optimiser"
                )
            await asyncio.sleep(min(max(pause_s, 0.001), 0.2))
        status = await self.control.read(Status)
        if status.mode != Mode.CLASSICAL:  # the loops ask for no updates
            await updates.read_until(scenario.ticks, 0 if scenario.realtime else status.update)
            status = await self.control.read(Status)
        recorder.link = LinkStatistics(
            status.deadline_misses, status.overruns, status.lateness_max, status.lateness_p99
        )

    async def start(self, scenario: Scenario) -> int:
        """Write the load and the settings of a new session to all three; return its number."""
        session = 1
        for client in (self.plant, self.control, self.optimizer):
            session = max(session, (await client.read(Identity)).session + 1)
        realtime = int(scenario.realtime)
        await self.optimizer.write(
            OptimizerSession(session, realtime, scenario.factor, round(scenario.updating_period_s / TICK_S))
        )
        rows = await write_table(self.plant, scenario.load)
        await self.plant.write(PlantSession(session, realtime, scenario.factor, scenario.seed, rows))
        self.load = LoadStream(self.plant, session, scenario.load, sent=rows)
        await self.control.write(ControlSession(session, realtime, scenario.factor))
        self.session = session
        return session

    @property
    def _load_known_until(self) -> int:
        """Lock-step goes no further than the load is known."""
        known = None if self.load is None else self.load.known_until
        return LAST_TICK if known is None else known

    async def _read_samples(self, session: int, scenario: Scenario, recorder: Recorder) -> int:
        """Read the ticks that have gone by since the last call; return their number."""
        first = len(recorder.samples)
        if self.load is not None:
            await self.load.feed(first)
        if not scenario.realtime:
            await self.control.write(Grant(min(scenario.ticks, first + AHEAD, self._load_known_until)))
        identity = await self.plant.read(Identity)
        if identity.session != session:
            raise LinkError(f"{self.plant.peer} was taken over by session {identity.session}: one run at a time")
        last = min(identity.tick, scenario.ticks)
        worthwhile = 1 if scenario.realtime else min(BATCH, scenario.ticks - first)
        if last - first < worthwhile:
            return 0
        for tick in range(first, last):
            (sample,) = await self.plant.read_rows(PlantSample, tick % HISTORY_ROWS, 1)
            await self._read_station(tick, recorder)
            if sample.tick != tick:
                raise LinkError(
                    f"{self.plant.peer} has overwritten tick {tick} before it was recorded: choose a lower --factor"
                )
            recorder.sample(sample)
        return last - first

    async def _read_station(self, tick: int, recorder: Recorder) -> None:
        """Read what goes with a tick, if the plant is a whole refrigerator: its first row tells."""
        if tick and not self._has_station:
            return
        (station,) = await self.plant.read_rows(StationSample, tick % HISTORY_ROWS, 1)
        self._has_station = any(station.signals)
        if self._has_station and station.tick == tick:
            recorder.station(station)


class _UpdateReader:
    """Reads the optimiser's history as it grows."""

    def __init__(self, client: RegisterClient, recorder: Recorder, session: int) -> None:
        self._client = client
        self._recorder = recorder
        self._session = session

    async def read(self) -> None:
        """Read the updates that have been done since the last call."""
        done = len(self._recorder.updates)
        identity = await self._client.read(Identity)
        if identity.session != self._session:
            return
        new = (identity.heartbeat - done) & 0xFFFF
        if new > UPDATE_ROWS:
            raise LinkError(f"{self._client.peer} has overwritten update {done} before it was recorded")
        for update in range(done, done + new):
            self._recorder.update((await self._client.read_rows(Optimization, update % UPDATE_ROWS, 1))[0])

    async def read_until(self, ticks: int, last: int) -> None:
        """Read on until update `last` is there, and one that reaches beyond the run."""
        deadline = time.monotonic() + QUIET_S
        updates = self._recorder.updates
        while not updates or updates[-1].update < last or updates[-1].tick + updates[-1].tau_u < ticks:
            if time.monotonic() > deadline:
                raise LinkError(f"{self._client.peer} stopped after update {len(updates) - 1}: see its log")
            await self.read()
            await asyncio.sleep(0.002)
