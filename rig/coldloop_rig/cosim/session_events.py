"""The events of a session: read from the journals of control PLC and plant as it runs."""

import time
from typing import Final

from coldloop.modbus.client import RegisterClient
from coldloop.registers.audit import JournalPage
from coldloop_rig.cosim.journal_reader import JournalReader
from coldloop_rig.results.driving import CONTROL, PLANT
from coldloop_rig.results.recording import SETTLED_TICKS, Records

LOOK_S: Final = 0.25
"""Real time between two looks at the journals."""
LOOK_TICKS: Final = SETTLED_TICKS // 2
"""Ticks after which they are looked at in any case: the recorder waits for events no longer than `SETTLED_TICKS`."""


class SessionEvents:
    """Passes what control PLC and plant note from now on to a recorder."""

    def __init__(self, readers: dict[str, JournalReader], recorder: Records) -> None:
        self._readers = readers
        self._recorder = recorder
        self._looked_at = 0.0
        self._tick = 0

    @classmethod
    async def after_now(cls, control: RegisterClient, plant: RegisterClient, recorder: Records) -> "SessionEvents":
        """Return a reader of all that is noted after what there is.

        Raises:
            LinkError: One of them does not answer.
        """
        readers = {}
        for service, client in ((CONTROL, control), (PLANT, plant)):
            newest = (await client.read(JournalPage)).newest
            readers[service] = JournalReader(client, newest + 1)
        return cls(readers, recorder)

    async def look(self, *services: str) -> None:
        """Read new events of these services, if the last look was long ago.

        Raises:
            LinkError: One of them does not answer.
        """
        ticks = self._recorder.next_tick
        if time.monotonic() - self._looked_at < LOOK_S and ticks - self._tick < LOOK_TICKS:
            return
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
