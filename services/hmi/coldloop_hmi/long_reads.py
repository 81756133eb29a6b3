"""Long requests take turns, so that other requests wait for at most one of them."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Final

from aiohttp import web

MOST_WAITING: Final = 128


@dataclass
class _Queue:
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    waiting: int = 0
    free_from: float = 0.0


class LongReads:
    """Turns of requests that compute for long; who has logged in does not wait for strangers.

    After a turn the event loop is free for as long as it took, before the next one of the same queue.

    Args:
        now: Monotonic clock, s.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._queues = {False: _Queue(), True: _Queue()}

    @asynccontextmanager
    async def turn(self, *, has_session: bool) -> AsyncIterator[None]:
        """Wait for a turn; it ends with the context.

        Raises:
            HTTPServiceUnavailable: Too many wait already.
        """
        queue = self._queues[has_session]
        if queue.waiting >= MOST_WAITING:
            raise web.HTTPServiceUnavailable(reason="too many requests for trends and tables: wait a little")
        queue.waiting += 1
        try:
            async with queue.turn:
                await asyncio.sleep(queue.free_from - self._now())
                begun = self._now()
                yield
                ended = self._now()
                queue.free_from = 2 * ended - begun
        finally:
            queue.waiting -= 1
