"""The page of a rig that is up: pollers, server and operator's desk in one event loop.

A poller reads one service over Modbus, once for all browsers, and keeps polling a silent one.
"""

import asyncio
import logging
import time
from contextlib import suppress
from typing import Any, Final

from coldloop.errors import DamagedAnswerError, LinkError, RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.settings import Endpoint
from coldloop.operating.observer import JournalReader, UpdateReader, read_alarms
from coldloop.registers.audit import JournalPage
from coldloop.registers.common import Identity, SessionPace
from coldloop.registers.configuration import ConfigurationDigest, ConfigurationLine, configuration_of, lines_of
from coldloop.registers.control_plc import LadderStatus, Operator, PlantLinkStatus, ProcessNow, Status
from coldloop.registers.maps import Maps
from coldloop.registers.optimizer_plc import ControlLinkStatus, Prediction
from coldloop.registers.plant import LoadStatus, SensorFault, StationStatus
from coldloop_hmi.documents import KIND, REFRIGERATOR
from coldloop_hmi.operator_desk import OperatorDesk
from coldloop_hmi.page_server import PageServer, PageSite
from coldloop_hmi.process_image import JournalEntry, Model
from coldloop_hmi.settings import HmiSection, HmiSettings
from coldloop_hmi.signals import shown_blocks

log = logging.getLogger("coldloop.hmi")

FAST: Final[dict[str, tuple[type[tuple[Any, ...]], ...]]] = {
    "plant": (SessionPace, LoadStatus),
    "control_plc": (LadderStatus, ProcessNow, Status, PlantLinkStatus, Operator),
    "optimizer_plc": (ControlLinkStatus,),
}
"""Records that are read in each look; the mode is read before the process that is drawn with it."""
SLOW_S: Final = 1.0
"""Time between two looks at a record that is not among these."""
ALARMS_S: Final = 0.25
RETRY_S: Final = 0.25
AT_ONCE: Final = 64
"""When there are more new updates or events, as with a high factor, only the newest are read."""


async def serve(settings: HmiSettings) -> None:
    """Serve the page until cancelled.

    Raises:
        ConfigurationError: A file of the settings cannot be used.
        PortInUseError: Another program listens there.
    """
    hmi = settings.hmi
    model = Model(settings.process, time.monotonic, hmi.kept_s)
    desk = OperatorDesk(operator_endpoints(hmi), model, time.monotonic, training=hmi.training)
    server = PageServer(hmi, PageSite(model, desk))
    clients = {service: RegisterClient.at(each, getattr(hmi, service)) for service, each in model.maps.items()}
    pollers = [Poller(service, client, model, hmi.poll_s) for service, client in clients.items()]
    await server.start()
    log.info("serving", extra={"host": hmi.host, "port": server.port, "address": server.address})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(server.run(), name="stream")
            for service, poller in zip(clients, pollers, strict=True):
                tasks.create_task(poller.run(), name=f"poll {service}")
    finally:
        await server.close()


def operator_endpoints(hmi: HmiSection) -> dict[str, Endpoint]:
    """Return where the services are for commands: with the operator's certificate, if there is one."""
    ends: dict[str, Endpoint] = {service: getattr(hmi, service) for service in Maps._fields}
    if hmi.operator_tls is None:
        return ends
    return {service: end.model_copy(update={"tls": hmi.operator_tls}) for service, end in ends.items()}


class Poller:
    """Reads one service into a model until cancelled, with `poll_s` between two looks."""

    def __init__(self, service: str, client: RegisterClient, model: Model, poll_s: float) -> None:
        self._service = service
        self._client = client
        self._model = model
        self._poll_s = poll_s
        self._journal = JournalReader(client, queries=False, most=AT_ONCE)
        self._updates = UpdateReader(client, lambda update: model.put_updates([update]), most=AT_ONCE)
        frequent = (Identity, JournalPage, *FAST[service])
        self._slow = [block.record for block in shown_blocks(model.maps[service]) if block.record not in frequent]
        self._slow_at = 0.0
        self._alarms_at = 0.0
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
                    self._model.heard(self._service)
                    if self._told:
                        self._told = ""
                        log.info("answers", extra={"peer": self._service})
                    await asyncio.sleep(max(0.005, begun + self._poll_s - time.monotonic()))
        finally:
            self._client.close()

    def _lose(self, error: LinkError) -> None:
        self._client.close()
        self._checked = False
        self._journal.connection_lost()
        self._model.silent(self._service, str(error))
        if str(error) != self._told:
            self._told = str(error)
            log.warning("silent", extra={"peer": self._service, "reason": self._told})

    async def _look(self) -> None:
        model, service, client = self._model, self._service, self._client
        if not self._checked:
            await client.connect(0.0)
            self._checked = True
            self._slow_at = 0.0
        identity = await client.read(Identity)
        model.put(service, identity)
        for record in FAST[service]:
            model.put(service, await client.read(record))
        if service == "plant" and model.configuration.get(KIND) == REFRIGERATOR:
            model.put(service, await client.read(StationStatus))
        if service == "optimizer_plc" and await self._updates.read(identity):
            model.put(service, await client.read(Prediction))
        now = time.monotonic()
        if service == "control_plc" and now - self._alarms_at >= ALARMS_S:
            self._alarms_at = now
            model.put_alarms(await read_alarms(client))
        if now - self._slow_at >= SLOW_S:
            self._slow_at = now
            await self._read_slow()
        events = await self._journal.read_on()
        model.put(service, self._journal.page)
        model.put_events(JournalEntry.of(service, event, model.process) for event in events)

    async def _read_slow(self) -> None:
        for record in self._slow:
            with suppress(DamagedAnswerError, RequestRefusedError):  # not sealed: not written yet
                self._model.put(self._service, await self._client.read(record))
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
        with suppress(ValueError):  # not one of ours, or it has changed meanwhile
            self._model.configuration = configuration_of(digest, lines)
            self._configured = digest
