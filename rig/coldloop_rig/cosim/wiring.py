"""Where three services on localhost listen, and where their clients are pointed at."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from coldloop.modbus.endpoints import PLANT_PORT, Endpoint
from coldloop.safety.retained import RetainSettings
from coldloop_rig.cosim.answer_time import QUIET_S
from coldloop_rig.cosim.endpoints import RigEndpoints
from coldloop_rig.settings import Settings

SERVICES: Final = ("plant", "control_plc", "optimizer_plc")
RETAINING: Final = ("plant", "control_plc")
"""Services that resume after a restart, from a state file."""
START_PATIENCE_S: Final = 600.0
"""Services that need other kernels than before compile them first, on a slow machine for minutes."""


class Detours(NamedTuple):
    """Ports that clients are pointed at instead of those of their servers."""

    plant: int
    """For the control PLC."""
    control_plc: int
    """For the optimiser."""


def endpoints_on(ports: Sequence[int], settings: Settings) -> RigEndpoints:
    """Return where the services are for the rig, on these ports."""
    return RigEndpoints(*(_endpoint(settings, service, port) for service, port in zip(SERVICES, ports, strict=True)))


def _endpoint(settings: Settings, service: str, port: int) -> Endpoint:
    section = getattr(settings, service)
    return Endpoint(
        port=port,
        word_order=section.word_order,
        tls=settings.rig.tls if section.server.tls else None,
        timeout_s=QUIET_S,
    )


def retaining(settings: Settings, folder: Path, *, always: bool) -> Settings:
    """Return settings with which services retain their state in a folder; what an earlier rig left there is removed.

    Unless `always`, those that have a file of their own keep it.
    """
    sections = {}
    for service in RETAINING:
        section = getattr(settings, service)
        if always or section.retain.file is None:
            file = folder / f"retained_{service}.json"
            file.unlink(missing_ok=True)
            sections[service] = section.model_copy(update={"retain": RetainSettings(file=file)})
    return settings.model_copy(update=sections)


def wired(settings: Settings, endpoints: RigEndpoints, detours: Detours | None = None) -> Settings:
    """Return the settings with the servers on these endpoints and the clients pointed at them, or at the detours."""

    def client(endpoint: Endpoint, configured: Endpoint, detour: int | None) -> Endpoint:
        port = endpoint.port if detour is None else detour
        return endpoint.model_copy(update={"port": port, "timeout_s": configured.timeout_s, "tls": configured.tls})

    def server(section: str, endpoint: Endpoint) -> object:
        return getattr(settings, section).server.model_copy(update={"host": endpoint.host, "port": endpoint.port})

    plant, control_plc = detours or (None, None)
    telemetry, port = settings.telemetry, endpoints.plant.port
    if port != PLANT_PORT and telemetry.prefix == type(telemetry)().prefix:  # another rig may have the same broker
        telemetry = telemetry.model_copy(update={"prefix": f"{telemetry.prefix}/{port}"})
    return settings.model_copy(
        update={
            "telemetry": telemetry,
            "session": settings.session.model_copy(update={"autostart": False}),
            "plant": settings.plant.model_copy(update={"server": server("plant", endpoints.plant)}),
            "control_plc": settings.control_plc.model_copy(
                update={
                    "server": server("control_plc", endpoints.control_plc),
                    "plant": client(endpoints.plant, settings.control_plc.plant, plant),
                }
            ),
            "optimizer_plc": settings.optimizer_plc.model_copy(
                update={
                    "server": server("optimizer_plc", endpoints.optimizer_plc),
                    "control_plc": client(endpoints.control_plc, settings.optimizer_plc.control_plc, control_plc),
                }
            ),
        }
    )
