"""The three services with a proxy in each of their two links."""

from collections.abc import Mapping
from contextlib import AsyncExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from coldloop.config import PREFIX
from rig.chaos.faults import Link
from rig.chaos.proxy import LinkProxy
from rig.cosim.local_services import LocalServices
from rig.cosim.ports import ReservedPorts
from rig.cosim.wiring import Detours
from rig.settings import Settings


class ProxiedServices:
    """Processes of the three services, whose clients are pointed at proxies; an async context in which they run.

    The control PLC and the plant keep their state in the folder: one that is killed and started again goes on.

    Args:
        settings: Their configuration.
        folder: Takes retained states and, in `logs`, their logs.
        seed: Decides which frames a fault of a link hits.
    """

    def __init__(self, settings: Settings, folder: Path, seed: str) -> None:
        self._reserved = ReservedPorts(len(Detours._fields))
        detours = Detours(*self._reserved.numbers)
        self.services = LocalServices(settings, folder / "logs", detours=detours, environment=_retained(folder))
        ends = self.services.endpoints
        self.proxies: Mapping[Link, LinkProxy] = {
            Link.PLANT: LinkProxy(detours.plant, ends.plant, f"{seed}/plant"),
            Link.OPTIMIZER: LinkProxy(detours.control_plc, ends.control_plc, f"{seed}/optimizer"),
        }
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        """Start the services."""
        self._stack.enter_context(self._reserved)
        await self._stack.enter_async_context(self.services)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End proxies and services."""
        await self._stack.__aexit__(kind, error, trace)

    async def connect_links(self) -> None:
        """Start the proxies: until then no service reaches another one."""
        for proxy in self.proxies.values():
            await proxy.start()
            self._stack.push_async_callback(proxy.close)


def _retained(folder: Path) -> dict[str, str]:
    """Return the variables that let the control PLC and the plant come back where they were killed."""
    files = {service: folder / f"retained_{service}.json" for service in ("control_plc", "plant")}
    for file in files.values():
        file.unlink(missing_ok=True)
    return {f"{PREFIX}{service.upper()}__RETAIN__FILE": str(file) for service, file in files.items()}
