"""The one disturbing proxy, doing to each frame what a test says."""

import asyncio
from collections.abc import Callable
from typing import Self

from coldloop.modbus.settings import Endpoint
from coldloop_chaos.faults import Direction
from coldloop_chaos.proxy import LinkProxy, Mangler, reset

Treatment = Callable[[Direction, bytes], bytes | None]
"""Takes a frame; returns what goes on of it. None resets the connection."""


def untouched(_way: Direction, frame: bytes) -> bytes:
    return frame


class TreatedLink(LinkProxy):
    """A proxy in front of a server on this machine; a context in which it listens."""

    def __init__(self, target: int, treat: Treatment = untouched) -> None:
        super().__init__(0, Endpoint(port=target), "treated")
        self.treat = treat

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def _pass(self, frame: bytes, writer: asyncio.StreamWriter, mangler: Mangler) -> bool:
        treated = self.treat(mangler.direction, frame)
        if treated is None:
            reset(writer)
            return False
        writer.write(treated)
        await writer.drain()
        return True
