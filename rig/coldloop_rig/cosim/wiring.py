"""Wiring of a rig: endpoints of its three services, endpoints of their clients, and time limits of its answers."""

import socket
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import AbstractContextManager, asynccontextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

from pydantic import BaseModel, Field

from coldloop.errors import PeerUnreachableError, UsageError
from coldloop.modbus.settings import PLANT_PORT, Endpoint, TlsSettings
from coldloop.process.settings import InputLimits, RootSettings
from coldloop.registers.codec import WordOrder
from coldloop.safety.retained import RetainSettings

if TYPE_CHECKING:  # commands to a rig import no service, so that they answer at once
    from coldloop_rig.settings import Settings

REQUIRED: Final = ("plant", "control_plc")
"""Services of every rig; an optimiser may be somebody else's (`up --without optimizer`)."""
ANSWER_S: Final = 10.0
"""Longest time that a rig may take to answer all requests of a command, s."""
QUIET_S: Final = 20.0
"""A run gives up a rig on which nothing happens, or a service that does not answer, for this long."""
HOST: Final = "127.0.0.1"
SERVICES: Final = ("plant", "control_plc", "optimizer_plc")
PEERS: Final = {"control_plc": "plant", "optimizer_plc": "control_plc"}
"""Services that are clients of another one, which their section has an endpoint of."""
RETAINING: Final = ("plant", "control_plc")
"""Services that resume after a restart, from a state file."""
START_PATIENCE_S: Final = 600.0
"""Services that need other kernels than before compile them first, on a slow machine for minutes."""


OTHERS: Final = ("session", "telemetry", "hmi")
"""Sections that a configuration may have and an operator's client does not read."""


class RigSection(BaseModel, frozen=True, extra="forbid"):
    """Section `rig` of the configuration."""

    tls: TlsSettings | None = None
    """The operator's certificate, for servers with TLS."""


class ServerPlace(BaseModel, frozen=True, extra="ignore"):
    """Keys of a service that its clients need; the other keys are the service's own."""

    word_order: WordOrder = WordOrder.HIGH_FIRST


class OperatorSettings(RootSettings):
    """Keys of a configuration that an operator's client reads."""

    limits: InputLimits = Field(default_factory=InputLimits)
    plant: ServerPlace = ServerPlace()
    control_plc: ServerPlace = ServerPlace()
    optimizer_plc: ServerPlace = ServerPlace()
    rig: RigSection = RigSection()


class RigEndpoints(NamedTuple):
    """Endpoints of the three servers."""

    plant: Endpoint
    control_plc: Endpoint
    optimizer_plc: Endpoint


@asynccontextmanager
async def answered_in_time(what: str) -> AsyncIterator[None]:
    """Give up what is done in this context after `ANSWER_S`.

    Raises:
        PeerUnreachableError: It took longer.
    """
    from asyncio import timeout  # noqa: PLC0415 a run in one process does without asyncio

    try:
        async with timeout(ANSWER_S):
            yield
    except TimeoutError:
        raise PeerUnreachableError(f"{what} takes longer than {ANSWER_S:g} s: the rig answers too slowly") from None


class ReservedPorts(AbstractContextManager["ReservedPorts"]):
    """Ports reserved until they are released; a context that releases them.

    A socket that never listens is bound to each. Servers may listen there all the same, again and again, as they set
    SO_REUSEADDR; while none does, connections are refused. Other systems than Linux do not let two sockets have a port
    in this way: there the sockets are closed at once, and another program may take a port before its server does.

    Args:
        count: How many.
        first: Reserve it and those that follow it; 0 is any.

    Raises:
        OSError: One of them is in use.
    """

    def __init__(self, count: int, first: int = 0) -> None:
        self._sockets = [socket.socket() for _ in range(count)]
        try:
            for place, one in enumerate(self._sockets):
                one.bind((HOST, first and first + place))  # alone: only then it lets servers in
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        except (OSError, OverflowError):
            self.release()
            raise
        self.numbers = [int(one.getsockname()[1]) for one in self._sockets]
        if sys.platform != "linux":
            self.release()

    def release(self) -> None:
        """Give the ports back."""
        for one in self._sockets:
            one.close()

    def __exit__(self, *_: object) -> None:
        """Release them."""
        self.release()


class Detours(NamedTuple):
    """Ports that clients are pointed at instead of those of their servers."""

    plant: int
    """Port of the plant, for the control PLC."""
    control_plc: int
    """Port of the control PLC, for the optimiser."""


class Links(Protocol):
    """Proxies in the two links of a rig."""

    detours: Detours

    def put_before(self, ends: RigEndpoints) -> None:
        """Make them, for these servers."""

    async def connect(self) -> None:
        """Start them: until then no client reaches a server."""

    async def close(self) -> None:
        """Close them."""

    def cut(self, link: str) -> AbstractContextManager[None]:
        """Let nothing pass in a link, `plant` or `optimizer`, in this context; its connections stay open."""


def fault_injection(part: str) -> Any:  # noqa: ANN401 a class
    """Return the part of this name that injects faults, by entry point: `links`, called with a seed, or `injector`.

    Raises:
        UsageError: No package brings one.
    """
    found = entry_points(group="coldloop.faults", name=part)
    if not found:
        raise UsageError(f"no package brings {part} to inject faults with (entry point coldloop.faults)")
    return found[part].load()


def endpoints_on(ports: Sequence[int], settings: "Settings") -> RigEndpoints:
    """Return where the services are for the rig, on these ports."""
    ends, tls = [], settings.rig.tls
    for service, port in zip(SERVICES, ports, strict=True):
        one = getattr(settings, service)
        place = {"port": port, "word_order": one.word_order, "tls": tls if one.server.tls else None}
        ends.append(Endpoint(**place, timeout_s=QUIET_S))
    return RigEndpoints(*ends)


def retaining(settings: "Settings", folder: Path, *, always: bool) -> "Settings":
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


def wired(settings: "Settings", endpoints: RigEndpoints, detours: Detours | None = None) -> "Settings":
    """Return the settings with the servers on these endpoints and the clients pointed at them, or at the detours."""
    sections: dict[str, object] = {}
    for service, end in endpoints._asdict().items():
        section = getattr(settings, service)
        update = {"server": section.server.model_copy(update={"host": end.host, "port": end.port})}
        if (peer := PEERS.get(service)) is not None:
            there, own = getattr(endpoints, peer), getattr(section, peer)
            port = there.port if detours is None else getattr(detours, peer)
            update[peer] = there.model_copy(update={"port": port, "timeout_s": own.timeout_s, "tls": own.tls})
        sections[service] = section.model_copy(update=update)
    telemetry, port = settings.telemetry, endpoints.plant.port
    if port != PLANT_PORT and telemetry.prefix == type(telemetry)().prefix:  # another rig may have the same broker
        telemetry = telemetry.model_copy(update={"prefix": f"{telemetry.prefix}/{port}"})
    session = settings.session.model_copy(update={"autostart": False})
    return settings.model_copy(update={**sections, "telemetry": telemetry, "session": session})
