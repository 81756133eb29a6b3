"""Reads the three services over Modbus, once for all browsers, and keeps polling a silent one."""

import asyncio
import logging
import time
from contextlib import suppress
from typing import Any, Final

from coldloop.errors import DamagedAnswerError, LinkError, RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.endpoints import Endpoint
from coldloop.operating.rings import last_update, read_ring
from coldloop.registers.audit import EVENT_ROWS, Event, JournalPage
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.configuration import ConfigurationDigest, ConfigurationLine, configuration_of, lines_of
from coldloop.registers.control_plc import LadderStatus, Operator, PlantLinkStatus, ProcessNow, Status
from coldloop.registers.optimizer_plc import HISTORY_ROWS, ControlLinkStatus, Optimization, Prediction
from coldloop.registers.plant import LoadStatus, SensorFault, StationStatus
from coldloop.registers.safety import Alarm, alarms_of
from coldloop_hmi.compression_station import KIND, REFRIGERATOR
from coldloop_hmi.process_image import JournalEntry, Model
from coldloop_hmi.signals import shown_blocks

log = logging.getLogger("coldloop.hmi")

FAST: Final[dict[str, tuple[type[tuple[Any, ...]], ...]]] = {
    "plant": (Identity, SessionPace, LoadStatus),
    "control_plc": (LadderStatus, ProcessNow, Status, PlantLinkStatus, Operator),
    "optimizer_plc": (ControlLinkStatus,),
}
"""Records that are read in each look; the mode is read before the process that is drawn with it."""
SLOW_S: Final = 1.0
"""Time between two looks at a record that is not among these."""
ALARMS_S: Final = 0.25
RETRY_S: Final = 0.25
UPDATES_AT_ONCE: Final = 64
"""When there are more new updates, as with a high factor, only the newest are read."""
EVENTS_AT_ONCE: Final = 64


class Poller:
    """Reads one service until cancelled.

    Args:
        service: Which one.
        endpoint: Where it is.
        model: Receives what is read.
        poll_s: Time between two looks.
    """

    def __init__(self, service: str, endpoint: Endpoint, model: Model, poll_s: float) -> None:
        self._service = service
        self._model = model
        self._poll_s = poll_s
        self._client = RegisterClient.at(model.maps[service], endpoint)
        self._slow = [block.record for block in shown_blocks(model.maps[service]) if block.record not in FAST[service]]
        self._slow_at = 0.0
        self._alarms_at = 0.0
        self._next_event = 0
        self._last_event: Event | None = None
        self._next_update = 0
        self._checked = False
        self._configured: ConfigurationDigest | None = None
        self._told = ""

    async def run(self) -> None:
        """Read on and on."""
        try:
            while True:
                begun = time.monotonic()
                try:
                    await self._look()
                except LinkError as error:
                    self._lose(error)
                    await asyncio.sleep(RETRY_S)
                else:
                    self._found()
                    await asyncio.sleep(max(0.005, begun + self._poll_s - time.monotonic()))
        finally:
            self._client.close()

    def _lose(self, error: LinkError) -> None:
        self._client.close()
        self._checked = False
        self._model.silent(self._service, str(error))
        if str(error) != self._told:
            self._told = str(error)
            log.warning("silent", extra={"peer": self._service, "reason": self._told})

    def _found(self) -> None:
        self._model.heard(self._service)
        if self._told:
            self._told = ""
            log.info("answers", extra={"peer": self._service})

    async def _look(self) -> None:
        if not self._checked:
            await self._client.connect(0.0)
            self._checked = True
            self._slow_at = 0.0
            await self._check_journal()
        model, service = self._model, self._service
        model.put(service, await self._client.read(Identity))
        for record in FAST[service]:
            model.put(service, await self._client.read(record))
        if service == "plant" and model.configuration.get(KIND) == REFRIGERATOR:
            model.put(service, await self._client.read(StationStatus))
        if service == "optimizer_plc":
            await self._read_updates()
        now = time.monotonic()
        if service == "control_plc" and now - self._alarms_at >= ALARMS_S:
            self._alarms_at = now
            model.put_alarms(await self._client.read_rows(Alarm, 0, len(alarms_of(self._client.process))))
        if now - self._slow_at >= SLOW_S:
            self._slow_at = now
            await self._read_slow()
        else:
            model.put(service, await self._client.read(JournalPage))
        await self._read_events()

    async def _read_slow(self) -> None:
        for record in self._slow:
            try:
                self._model.put(self._service, await self._client.read(record))
            except (DamagedAnswerError, RequestRefusedError):  # not sealed: not written yet
                continue
        if self._service == "plant":
            await self._read_configuration()
            with suppress(RequestRefusedError):  # a plant without sensor faults
                faults = await self._client.read_rows(SensorFault, 0, len(self._model.process.outputs))
                self._model.faulty_sensors = sum(bool(fault.kind) << i for i, fault in enumerate(faults))

    async def _read_configuration(self) -> None:
        """Read what the service runs, when it is not what was read last."""
        digest = self._model.record(self._service, ConfigurationDigest)
        if digest is None or digest == self._configured:
            return
        lines = await self._client.read_rows(ConfigurationLine, 0, lines_of(digest))
        try:
            self._model.configuration = configuration_of(digest, lines)
        except ValueError:  # not one of ours, or it has changed meanwhile
            return
        self._configured = digest

    async def _read_updates(self) -> None:
        identity = self._model.record("optimizer_plc", Identity)
        newest = None if identity is None else await last_update(self._client, identity)
        if newest is None:
            self._next_update = 0
            return
        if newest.update + 1 < self._next_update:
            self._next_update = 0
        first = max(self._next_update, newest.update + 1 - UPDATES_AT_ONCE)
        if first > newest.update:
            return
        rows = await read_ring(self._client, Optimization, HISTORY_ROWS, first, newest.update)
        self._model.put_updates(sorted(row for row in rows if first <= row.update <= newest.update and row.tau_u))
        self._next_update = newest.update + 1
        self._model.put("optimizer_plc", await self._client.read(Prediction))

    async def _check_journal(self) -> None:
        """Begin with the first event again if the last one is unknown: the service has restarted its count."""
        last = self._last_event
        if last and await read_ring(self._client, Event, EVENT_ROWS, last.number, last.number) != [last]:
            self._next_event, self._last_event = 0, None

    async def _read_events(self) -> None:
        page = self._model.record(self._service, JournalPage)
        if page is None or page.newest + 1 == self._next_event:
            return
        if page.newest < self._next_event:  # it has restarted its count
            self._next_event = 0
        first = max(self._next_event, page.newest - EVENTS_AT_ONCE + 1, 1)
        rows = await read_ring(self._client, Event, EVENT_ROWS, first, page.newest)
        news = sorted(row for row in rows if first <= row.number <= page.newest)
        self._last_event = news[-1] if news else self._last_event
        self._model.put_events(JournalEntry.of(self._service, row, self._model.process) for row in news)
        self._next_event = page.newest + 1
