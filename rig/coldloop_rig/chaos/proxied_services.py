"""The three services with a proxy in each of their two links."""

from collections.abc import Mapping
from contextlib import AsyncExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from coldloop_rig.chaos.faults import Link
from coldloop_rig.chaos.proxy import LinkProxy
from coldloop_rig.cosim.local_services import LocalServices
from coldloop_rig.cosim.wiring import Detours, ReservedPorts, RigEndpoints, retaining
from coldloop_rig.settings import Settings


class LinkProxies:
    """A proxy in each of the two links; a context that has their ports.

    Args:
        seed: Decides which frames a fault of a link hits.
    """

    def __init__(self, seed: str) -> None:
        self._seed = seed
        self._reserved = ReservedPorts(len(Detours._fields))
        self.detours = Detours(*self._reserved.numbers)
        self.by_link: Mapping[Link, LinkProxy] = {}

    def put_before(self, ends: RigEndpoints) -> None:
        """Make them, for these servers."""
        self.by_link = {
            Link.PLANT: LinkProxy(self.detours.plant, ends.plant, f"{self._seed}/plant"),
            Link.OPTIMIZER: LinkProxy(self.detours.control_plc, ends.control_plc, f"{self._seed}/optimizer"),
        }

    async def connect(self) -> None:
        """Start them: until then no client reaches a server."""
        for proxy in self.by_link.values():
            await proxy.start()

    async def __aenter__(self) -> Self:
        """Return them, not started yet."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close them."""
        for proxy in self.by_link.values():
            await proxy.close()
        self._reserved.release()


class ProxiedServices:
    """Processes of the three services, whose clients are pointed at proxies; an async context in which they run.

    The control PLC and the plant keep their state in the folder: one that is killed and restarted resumes.

    Args:
        settings: Their configuration.
        folder: Takes retained states and, in `logs`, their logs.
        seed: Decides which frames a fault of a link hits.
    """

    def __init__(self, settings: Settings, folder: Path, seed: str) -> None:
        self._proxies = LinkProxies(seed)
        self.services = LocalServices(
            retaining(settings, folder, always=True), folder / "logs", detours=self._proxies.detours
        )
        self._proxies.put_before(self.services.endpoints)
        self.proxies = self._proxies.by_link
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        """Start the services."""
        await self._stack.enter_async_context(self._proxies)
        await self._stack.enter_async_context(self.services)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End services and proxies."""
        await self._stack.__aexit__(kind, error, trace)

    async def connect_links(self) -> None:
        """Start the proxies: until then no service reaches another one."""
        await self._proxies.connect()
