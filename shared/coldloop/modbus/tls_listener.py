"""Listens for TLS clients, and hands a connection on once it is secure.

The event loop's own TLS server does not report failed handshakes, and has no limit on those under way. Here each
is a task: it is counted when it fails, with the reason, and the oldest one gives way when there are too many.
"""

import asyncio
import ssl
from collections.abc import Callable, Sequence
from functools import partial
from socket import AI_PASSIVE, SOCK_STREAM, create_server, socket
from typing import Final, Self

from coldloop.modbus.connection import RefusalLog

HANDSHAKE_S: Final = 5.0
"""How long a handshake may take."""
FAREWELL_S: Final = 1.0
"""How long a client may take to answer the end of the TLS session."""
PAUSE_S: Final = 0.1
"""How long to wait when the system has no more sockets."""


class TlsListener:
    """Sockets that are listened on, and the handshakes under way.

    Args:
        sockets: Listening sockets.
        context: Of a server.
        make_protocol: Makes what serves a connection that is secure.
        limit: How many handshakes may be under way.
        refusals: Takes those that fail.
    """

    def __init__(
        self,
        sockets: Sequence[socket],
        context: ssl.SSLContext,
        make_protocol: Callable[[], asyncio.Protocol],
        limit: int,
        refusals: RefusalLog,
    ) -> None:
        self.sockets = tuple(sockets)
        self._context = context
        self._make_protocol = make_protocol
        self._limit = limit
        self._refusals = refusals
        self._handshakes: dict[asyncio.Task[None], str] = {}  # with the peer of each, the oldest first
        self._doors = [asyncio.create_task(self._listen(door), name="TLS listener") for door in self.sockets]

    @classmethod
    async def at(
        cls,
        host: str,
        port: int,
        context: ssl.SSLContext,
        *,
        make_protocol: Callable[[], asyncio.Protocol],
        limit: int,
        refusals: RefusalLog,
    ) -> Self:
        """Listen on all addresses of a host.

        Raises:
            OSError: One of them cannot be listened on.
        """
        loop = asyncio.get_running_loop()
        infos = await loop.getaddrinfo(host or None, port, type=SOCK_STREAM, flags=AI_PASSIVE)
        sockets: list[socket] = []
        try:
            for family, _, _, _, address in dict.fromkeys(infos):
                sockets.append(create_server(address, family=family, backlog=100))
                sockets[-1].setblocking(False)  # noqa: FBT003 - it takes it by position only
        except OSError:
            for each in sockets:
                each.close()
            raise
        return cls(sockets, context, make_protocol, limit, refusals)

    def close(self) -> None:
        """Listen no more, and give up the handshakes under way."""
        for task in (*self._doors, *self._handshakes):
            task.cancel()
        for each in self.sockets:
            each.close()

    async def _listen(self, door: socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                client, address = await loop.sock_accept(door)
            except OSError:
                await asyncio.sleep(PAUSE_S)
                continue
            if len(self._handshakes) >= self._limit:
                self._give_up_oldest()
            peer = f"{address[0]}:{address[1]}"
            task = loop.create_task(self._secure(client, peer), name="TLS handshake")
            self._handshakes[task] = peer
            task.add_done_callback(partial(self._forget, client))

    def _give_up_oldest(self) -> None:
        task, peer = next(iter(self._handshakes.items()))
        del self._handshakes[task]
        task.cancel()
        self._refusals.note("tls_refused", peer, "too many handshakes under way, and this is the oldest")

    def _forget(self, client: socket, task: asyncio.Task[None]) -> None:
        self._handshakes.pop(task, None)
        if task.cancelled():
            client.close()

    async def _secure(self, client: socket, peer: str) -> None:
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                self._make_protocol, client,
                ssl=self._context, ssl_handshake_timeout=HANDSHAKE_S, ssl_shutdown_timeout=FAREWELL_S,
            )  # fmt: skip
        except OSError as error:
            self._refusals.note("tls_refused", peer, _reason(error))


def _reason(error: OSError) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is invalid: {error.verify_message}"
    if isinstance(error, ssl.SSLError):
        return (error.reason or "TLS failed").replace("_", " ").lower()
    return f"the handshake ended early: {error}".rstrip(": ")
