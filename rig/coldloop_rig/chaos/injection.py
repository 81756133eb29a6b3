"""Brings faults about, and takes them back."""

import asyncio
import signal
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Final, TypeVar

from coldloop.config import PREFIX
from coldloop.errors import LinkError, PeerUnreachableError, RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.plant import SensorFault, SensorFaultKind, Surroundings
from coldloop_rig.chaos.faults import (
    SERVICE_OF,
    AnyFault,
    BoundaryFault,
    Clock,
    Kill,
    Link,
    LinkFault,
    Pause,
    Restart,
    Sensor,
    WrongModel,
)
from coldloop_rig.chaos.models import WRONG_MODEL
from coldloop_rig.chaos.proxy import LinkProxy
from coldloop_rig.cosim.local_services import LocalServices
from coldloop_rig.cosim.session import CONTACT_S
from coldloop_rig.cosim.wiring import SERVICES

T = TypeVar("T")

ATTEMPTS: Final = 20
_SHOWN: Final = {"nan": SensorFaultKind.NOT_A_NUMBER, "frozen": SensorFaultKind.FROZEN, "value": SensorFaultKind.VALUE}


class Injector:
    """Acts on the processes, the proxies and the plant's sensors of one run."""

    def __init__(
        self,
        services: LocalServices,
        proxies: Mapping[Link, LinkProxy],
        plant: RegisterClient,
        folder: Path,
    ) -> None:
        self._services = services
        self._proxies = proxies
        self._plant = plant
        self._given_before: dict[str, float] = {}
        self._wrong_model = folder / WRONG_MODEL

    async def begin(self, fault: AnyFault) -> None:
        """Bring a fault about."""
        if isinstance(fault, LinkFault):
            self._proxies[fault.link].begin(fault)
        elif isinstance(fault, Kill):
            await self._services.stop(SERVICE_OF[fault.process], signal.SIGKILL)
        elif isinstance(fault, Restart):
            await self._services.stop(SERVICE_OF[fault.process], signal.SIGTERM)
        elif isinstance(fault, Pause):
            self._services.pause(SERVICE_OF[fault.process])
        elif isinstance(fault, Clock):
            for service in SERVICES:
                self._services.pause(service)
        elif isinstance(fault, Sensor):
            await self._set_sensor(fault.output, SensorFault(_SHOWN[fault.shows], fault.value or 0.0))
        elif isinstance(fault, BoundaryFault):
            before = await self._give(fault.target, fault.value)
            self._given_before.setdefault(fault.target, before)
        elif isinstance(fault, WrongModel):
            await self._services.stop("optimizer_plc", signal.SIGTERM)
            await self._services.start("optimizer_plc", {f"{PREFIX}MODEL__FILE": str(self._wrong_model)}, may_end=True)

    async def end(self, fault: AnyFault) -> str | None:
        """Take a fault back; return the service that has been started again, if one has."""
        if isinstance(fault, LinkFault):
            self._proxies[fault.link].end(fault)
        elif isinstance(fault, Kill | Restart):
            service = SERVICE_OF[fault.process]
            await self._services.start(service)
            return service
        elif isinstance(fault, Pause):
            self._services.resume(SERVICE_OF[fault.process])
        elif isinstance(fault, Clock):
            for service in SERVICES:
                self._services.resume(service)
        elif isinstance(fault, Sensor):
            await self._set_sensor(fault.output, SensorFault(SensorFaultKind.NONE, 0.0))
        elif isinstance(fault, BoundaryFault):
            await self._give(fault.target, self._given_before.pop(fault.target))
        elif isinstance(fault, WrongModel):
            await self._services.stop("optimizer_plc", signal.SIGTERM)
            await self._services.start("optimizer_plc")
            return "optimizer_plc"
        return None

    async def _give(self, target: str, value: float) -> float:
        """Change one of a refrigerator's surroundings; return its old value."""

        async def write() -> float:
            given = await self._plant.read(Surroundings)
            before = getattr(given, target)
            await self._plant.write(given._replace(**{target: type(before)(value)}))
            return float(before)

        return await _insisted(write, f"{target} = {value:g}")

    async def _set_sensor(self, output: str, fault: SensorFault) -> None:
        row = self._plant.process.output_names.index(output)
        await _insisted(lambda: self._plant.write_rows([fault], row), f"sensor fault for {output}")


async def _insisted(request: Callable[[], Awaitable[T]], what: str) -> T:
    """Return the answer to a request, which is repeated for a while."""
    reason = "no answer in time"
    for _ in range(ATTEMPTS):
        try:
            async with asyncio.timeout(CONTACT_S):
                return await request()
        except (PeerUnreachableError, RequestRefusedError) as error:
            reason = str(error)
        except TimeoutError:
            pass
        await asyncio.sleep(0.5)
    raise LinkError(f"the plant did not accept {what}: {reason}")
