"""The page of a rig that is up: pollers, server and operator's desk in one event loop."""

import asyncio
import logging
import time

from coldloop.modbus.endpoints import Endpoint
from coldloop.registers.maps import Maps
from coldloop_hmi.operator_desk import OperatorDesk
from coldloop_hmi.page_server import PageServer, PageSite
from coldloop_hmi.polling import Poller
from coldloop_hmi.process_image import Model
from coldloop_hmi.settings import HmiSection, HmiSettings

log = logging.getLogger("coldloop.hmi")


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
    pollers = [Poller(service, getattr(hmi, service), model, hmi.poll_s) for service in model.maps]
    await server.start()
    log.info("serving", extra={"host": hmi.host, "port": server.port, "address": server.address})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(server.run(), name="stream")
            for service, poller in zip(model.maps, pollers, strict=True):
                tasks.create_task(poller.run(), name=f"poll {service}")
    finally:
        await server.close()


def operator_endpoints(hmi: HmiSection) -> dict[str, Endpoint]:
    """Return where the services are for commands: with the operator's certificate, if there is one."""
    ends: dict[str, Endpoint] = {service: getattr(hmi, service) for service in Maps._fields}
    if hmi.operator_tls is None:
        return ends
    return {service: end.model_copy(update={"tls": hmi.operator_tls}) for service, end in ends.items()}
