"""Reads the samples and the updates of a session as they come, and passes them to a recorder."""

import asyncio
import time
from typing import Final

from coldloop.errors import LinkError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.transport import REQUESTS_AT_ONCE
from coldloop.operating.rings import read_ring
from coldloop.registers.common import Identity
from coldloop.registers.optimizer_plc import HISTORY_ROWS as UPDATE_ROWS
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import HISTORY_ROWS, STATION_ROWS, PlantSample, StationSample
from coldloop_rig.results.recording import Records

BATCH: Final = 64
"""Ticks to wait for before reading, in lock-step."""
MARGIN: Final = 8
"""Rows of the history that may be overwritten while others are read."""


class SampleReader:
    """Reads the plant's history as it grows.

    Args:
        client: Of the plant.
        recorder: Takes the ticks.
        session: Whose ticks they are.
        end: Tick before which reading ends.
        first: First tick to be read.
        realtime: Ticks come one by one; otherwise some are waited for.
        tolerant: Ticks that are not kept any more are left out, and the plant may go back after a restart. Each tick
            is read as soon as possible, for a plant that is killed takes its history with it.
    """

    def __init__(
        self, client: RegisterClient, recorder: Records, session: int, end: int, *, first: int = 0, realtime: bool,
        tolerant: bool,
    ) -> None:  # fmt: skip
        self._client = client
        self._recorder = recorder
        self._session = session
        self._end = end
        self._realtime = realtime
        self._tolerant = tolerant
        self.read_until = first
        """First tick that is still to be read."""
        self.has_station: bool | None = None
        """Whether the plant is a whole refrigerator; None while that is not known."""

    async def read(self) -> int:
        """Read the ticks that have gone by since the last call; return the plant's tick.

        Raises:
            LinkError: The plant does not answer, is in another session, or has overwritten ticks.
        """
        identity = await self._client.read(Identity)
        if identity.session != self._session:
            raise LinkError(
                f"{self._client.peer} was taken over by session {identity.session}, or was restarted without a "
                "retained state: one run at a time"
            )
        last = min(identity.tick, self._end)
        if self._tolerant:
            self.read_until = max(min(self.read_until, last), last - HISTORY_ROWS + MARGIN)
        if last - self.read_until >= self._worthwhile:
            await self._read_rows(last)
        return identity.tick

    @property
    def _worthwhile(self) -> int:
        if self._tolerant or self._realtime:
            return 1
        return max(1, min(BATCH, self._end - self.read_until))

    async def _read_rows(self, last: int) -> None:
        """Read the ticks before `last`, as many together as requests may be under way."""
        while self.read_until < last:
            first = self.read_until
            until = min(last, first + REQUESTS_AT_ONCE)
            samples = await read_ring(self._client, PlantSample, HISTORY_ROWS, first, until - 1)
            await self._read_stations(first, until)
            for tick, sample in enumerate(samples, first):
                if sample.tick == tick:
                    self._recorder.sample(sample)
                elif not self._tolerant:
                    raise LinkError(
                        f"{self._client.peer} has overwritten tick {tick} before it was recorded: "
                        "choose a lower --factor"
                    )
                self.read_until = tick + 1

    async def _read_stations(self, first: int, until: int) -> None:
        """Read what goes with ticks, if the plant is a whole refrigerator: the first row that is read decides."""
        if self.has_station is None:
            (station,) = await read_ring(self._client, StationSample, STATION_ROWS, first, first)
            self.has_station = any(station.signals)
        if not self.has_station:
            return
        stations = await read_ring(self._client, StationSample, STATION_ROWS, first, until - 1)
        for tick, station in enumerate(stations, first):
            if any(station.signals) and station.tick == tick:
                self._recorder.station(station)


class UpdateReader:
    """Reads the optimiser's history as it grows.

    Args:
        client: Of the optimiser.
        recorder: Takes the updates.
        session: Whose updates they are.
        first: Number of the first one to be read.
        tolerant: Updates that are not kept any more are left out, and their numbers may go back after a restart.
    """

    def __init__(
        self, client: RegisterClient, recorder: Records, session: int, *, first: int = 0, tolerant: bool
    ) -> None:
        self._client = client
        self._recorder = recorder
        self._session = session
        self._tolerant = tolerant
        self._next = first
        self._last: Optimization | None = None

    async def read(self) -> None:
        """Read the updates that have been done since the last call.

        Raises:
            LinkError: The optimiser does not answer, or has overwritten updates.
        """
        identity = await self._client.read(Identity)
        if identity.session != self._session:
            return
        new = ((identity.heartbeat - self._next + 0x8000) & 0xFFFF) - 0x8000
        newest = self._next + new
        if not 0 <= new <= UPDATE_ROWS:
            if not self._tolerant:
                raise LinkError(f"{self._client.peer} has overwritten update {self._next} before it was recorded")
            self._next = max(0, newest - UPDATE_ROWS)
        for update in await read_ring(self._client, Optimization, UPDATE_ROWS, self._next, newest - 1):
            if self._follows(update):
                self._recorder.update(update)
                self._last = update
            self._next += 1

    def _follows(self, update: Optimization) -> bool:
        """Return whether a row is the update that is looked for, and not one that was recorded before.

        An update that was abandoned for a newer one leaves its row empty, or as it was 256 updates before.
        """
        later = self._last is None or update.tick > self._last.tick
        return update.update == self._next and update.tau_u > 0 and later

    async def read_until(self, ticks: int, last: int, patience_s: float) -> None:
        """Read on until update `last` is there, and one that reaches beyond the run.

        Raises:
            LinkError: It does not come.
        """
        deadline = time.monotonic() + patience_s
        while self._last is None or self._last.update < last or self._last.tick + self._last.tau_u < ticks:
            if time.monotonic() > deadline:
                raise LinkError(f"{self._client.peer} stopped after update {self._next - 1}: see its log")
            await self.read()
            await asyncio.sleep(0.002)
