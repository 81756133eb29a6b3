"""The connections to the page: how many there may be, and which one gives way to a newcomer."""

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from aiohttp import web

REQUEST_S: Final = 10.0
"""A request that takes longer, because its client is slow to read the answer, keeps no place; a stream does."""


@dataclass
class Use:
    """What a connection is used for."""

    since: float
    """When its last request began or ended; without one, when it was seen first. Monotonic clock, s."""
    is_busy: bool = False
    is_stream: bool = False
    has_session: bool = False
    """Its last request had a login."""

    def rank(self, now: float) -> int | None:
        """Return how soon it gives way, 0 first; None keeps its place."""
        if self.is_busy and (self.is_stream or now - self.since < REQUEST_S):
            return None
        return 2 * self.has_session + self.is_busy


class Connections:
    """Connections of one server, at most so many.

    A newcomer takes the place of a connection that only waits: strangers' first, and of these one from the address
    that has most of them. So idle connections or incomplete requests lock out no user.

    Args:
        most: Connections at a time.
        now: Monotonic clock, s.
    """

    def __init__(self, most: int, now: Callable[[], float]) -> None:
        self._most = most
        self._now = now
        self._uses: dict[web.RequestHandler, Use] = {}  # in the order of their arrival

    def newcomer(self, server: web.Server) -> asyncio.Protocol:
        """Return what serves a new connection of the server: its handler, or a refusal where none gives way."""
        now = self._now()
        connected = [one for one in server.connections if one.transport is not None]
        self._uses = {one: self._uses.get(one) or Use(now) for one in connected}
        if len(connected) >= self._most and not self._make_room(now):
            return _Refused()
        return server()

    def _make_room(self, now: float) -> bool:
        crowd = Counter(map(_address, self._uses))
        ranks = {one: rank for one, use in self._uses.items() if (rank := use.rank(now)) is not None}
        if not ranks:
            return False
        first = min(ranks, key=lambda one: (ranks[one], -crowd[_address(one)], self._uses[one].since))
        transport = first.transport
        if transport is not None:
            transport.abort()  # do not wait for unread data
        first.force_close()
        return True

    @contextmanager
    def serving(self, request: web.Request, *, is_stream: bool, has_session: bool) -> Iterator[None]:
        """Keep the place of a connection while its request, received as a whole, is answered."""
        use = self._uses.setdefault(request.protocol, Use(self._now()))
        use.since, use.is_busy, use.is_stream, use.has_session = self._now(), True, is_stream, has_session
        try:
            yield
        finally:
            use.since, use.is_busy = self._now(), False


def _address(handler: web.RequestHandler) -> str:
    peer = handler.peername
    return str(peer[0]) if isinstance(peer, tuple) else ""


class _Refused(asyncio.Protocol):
    """Ends a connection for which there is no room."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """End it."""
        if isinstance(transport, asyncio.WriteTransport):
            transport.abort()
