"""Looks at a rig while its parts come and go: what is not there is looked at again later."""

import time
from collections.abc import Awaitable
from typing import Final, NamedTuple, TypeVar

from coldloop.endpoints import Endpoint
from coldloop.errors import LinkError, PeerUnreachableError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import CONTROL_MAP, Grant, LadderStatus
from coldloop.registers.optimizer_plc import OPTIMIZER_MAP
from coldloop.registers.plant import HISTORY_ROWS, PLANT_MAP, PlantSample, SensorFault
from coldloop.registers.safety import Alarm, AlarmKind
from rig.chaos.trace import ChaosTrace
from rig.journal_reader import JournalReader
from rig.network import AHEAD
from rig.rig_endpoints import RigEndpoints

T = TypeVar("T")

TIMEOUT_S: Final = 1.0
"""How long an answer may take: a process that stands still must not hold up the rig for long."""


class Sight(NamedTuple):
    """What one look showed."""

    tick: int | None
    """Where the plant is; None while it does not answer."""
    ladder: LadderStatus | None
    """None while the control PLC does not answer."""


class Observer:
    """Client of all three, past the proxies; fills a trace."""

    def __init__(self, endpoints: RigEndpoints, trace: ChaosTrace, session: int) -> None:
        self._plant, self._control, self._optimizer = (
            RegisterClient.at(register_map, _impatient(endpoint))
            for register_map, endpoint in zip((PLANT_MAP, CONTROL_MAP, OPTIMIZER_MAP), endpoints, strict=True)
        )
        self._clients = {"plant": self._plant, "control_plc": self._control, "optimizer_plc": self._optimizer}
        self._trace = trace
        self._session = session
        self._recorded = 0
        self._journal = JournalReader(self._control)
        self._noted = -1
        self._standing_since = time.monotonic()
        self._tick = -1

    def close(self) -> None:
        """Close the connections."""
        for client in self._clients.values():
            client.close()

    @property
    def standing_s(self) -> float:
        """Real time since the plant was last seen to move."""
        return time.monotonic() - self._standing_since

    def moved(self) -> None:
        """Begin to count that time anew."""
        self._standing_since = time.monotonic()

    async def look(self) -> Sight:
        """Record what has happened since the last look."""
        tick = await self._attempt(self._read_plant())
        ladder = await self._attempt(self._read_control())
        if tick is not None and tick != self._tick:
            self._tick = tick
            self.moved()
        return Sight(tick, ladder)

    async def grant(self, until: int) -> None:
        """Let the control PLC go on, but not further than the plant's history reaches back."""
        await self._attempt(self._control.write(Grant(min(until, self._recorded + AHEAD))))

    async def answers(self, service: str) -> bool:
        """Tell whether a service is there."""
        return await self._attempt(self._clients[service].read(Identity)) is not None

    async def set_sensor_fault(self, output: int, fault: SensorFault) -> bool:
        """Put a fault into a sensor; tell whether the plant has taken it."""
        return await self._attempt(self._done(self._plant.write_rows([fault], output))) is not None

    async def read_alarms(self) -> None:
        """Record the alarms."""
        alarms = await self._attempt(self._control.read_rows(Alarm, 0, len(AlarmKind)))
        self._trace.alarms = alarms or self._trace.alarms

    async def _read_plant(self) -> int:
        identity = await self._plant.read(Identity)
        if identity.session != self._session:
            raise LinkError(
                f"{self._plant.peer} is in session {identity.session}, not {self._session}: it was taken over, or was "
                "restarted without a retained state"
            )
        last = min(identity.tick, self._trace.ticks)
        first = max(min(self._recorded, last), last - HISTORY_ROWS + 8)
        for tick in range(first, last):
            (sample,) = await self._plant.read_rows(PlantSample, tick % HISTORY_ROWS, 1)
            if sample.tick == tick:  # a restarted plant has none of the ticks before
                self._trace.sample(sample)
            self._recorded = tick + 1
        self._recorded = last
        return identity.tick

    async def _read_control(self) -> LadderStatus:
        ladder = self._trace.ladder = await self._control.read(LadderStatus)
        if ladder.events != self._noted:
            self._trace.events += await self._journal.read_on()
            self._noted = ladder.events
        return ladder

    async def _attempt(self, request: Awaitable[T]) -> T | None:
        try:
            return await request
        except PeerUnreachableError:
            self._trace.lost_contacts += 1
            return None

    async def _done(self, request: Awaitable[None]) -> bool:
        await request
        return True


def _impatient(endpoint: Endpoint) -> Endpoint:
    return endpoint.model_copy(update={"timeout_s": TIMEOUT_S})
