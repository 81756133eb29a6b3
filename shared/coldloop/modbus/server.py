"""A Modbus/TCP server over one register bank."""

import asyncio
import contextlib
import errno
from typing import Final

from coldloop.errors import PortInUseError
from coldloop.modbus.connection import Connection, OnWrite
from coldloop.modbus.identification import DeviceIdentity
from coldloop.modbus.refusals import ErrorCounters, RefusalLog
from coldloop.modbus.requests import RequestHandler
from coldloop.modbus.settings import ServerSettings
from coldloop.registers.bank import RegisterBank

__all__ = ["DeviceIdentity", "ErrorCounters", "ModbusServer", "OnWrite", "ServerSettings"]

CLOSING_GRACE_S: Final = 1.0
"""How long `close` lets clients take the answers that are on their way."""

_REMEDIES: Final = {
    errno.EADDRINUSE: "it is in use; stop the program that holds it, or choose another port",
    errno.EACCES: "permission is denied; choose a port above 1023",
    errno.EADDRNOTAVAIL: "this machine has no such address; choose another host",
}


class ModbusServer:
    """Serves a bank to any number of clients.

    Args:
        bank: What is served; it also decides the word order.
        settings: Where to listen, whom to answer and how many.
        on_write: Called with each block that a request has written, in the order of their addresses, after everything
            is stored. When it returns an awaitable, the answer (the read half of an FC23 too) is made after it is
            done; other connections are served meanwhile. It is cancelled when its client goes away, so it must not be
            shared. When `on_write` or its awaitable raises, the client gets exception 04.
        identity: Answer to the device identification, function 43 / 14.
    """

    def __init__(
        self, bank: RegisterBank, *, settings: ServerSettings, on_write: OnWrite, identity: DeviceIdentity
    ) -> None:
        self._settings = settings
        self._on_write = on_write
        self._service = bank.map.service
        self._handler = RequestHandler(bank, identity)
        self._refusals = RefusalLog(bank.map.service)
        self._connections: dict[Connection, None] = {}  # in the order of their arrival
        self._none_connected = asyncio.Event()
        self._none_connected.set()
        self._listener: asyncio.Server | None = None

    @property
    def counters(self) -> ErrorCounters:
        """Errors since the server was made, by kind."""
        return self._refusals.counters

    @property
    def connections(self) -> int:
        """Number of connections being served."""
        return len(self._connections)

    @property
    def port(self) -> int:
        """The port that is listened on, also when the settings left the choice to the system."""
        if self._listener is None or not self._listener.sockets:
            return self._settings.port
        return int(self._listener.sockets[0].getsockname()[1])

    async def start(self) -> None:
        """Listen.

        Raises:
            PortInUseError: The address cannot be listened on.
        """
        host, port = self._settings.host, self._settings.port
        try:
            self._listener = await asyncio.get_running_loop().create_server(self._new_connection, host, port)
        except OSError as error:
            reason = _REMEDIES.get(error.errno or 0, f"{error.strerror}; choose another host or port")
            raise PortInUseError(f"{self._service} cannot listen on {host}:{port}: {reason}") from error

    async def close(self) -> None:
        """Stop listening and close all connections; waits of `on_write` are cancelled."""
        if self._listener is not None:
            self._listener.close()
        for connection in tuple(self._connections):
            connection.close()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CLOSING_GRACE_S):
                await self._none_connected.wait()
        for connection in tuple(self._connections):
            connection.abort()
        await self._none_connected.wait()

    def _new_connection(self) -> Connection:
        return Connection(
            handler=self._handler,
            settings=self._settings,
            on_write=self._on_write,
            refusals=self._refusals,
            opened=self._admit,
            lost=self._forget,
        )

    def _admit(self, newcomer: Connection) -> None:
        self._connections[newcomer] = None
        self._none_connected.clear()
        if len(self._connections) <= self._settings.connection_limit:
            return
        idle = [connection for connection in self._connections if connection.idle and connection is not newcomer]
        if idle:
            oldest = min(idle, key=lambda connection: connection.last_request)
            self._refusals.note("connection_evicted", oldest.peer, f"idle longest, replaced by {newcomer.peer}")
            surplus = oldest
        else:
            self._refusals.note("connection_refused", newcomer.peer, "all connections have a request in flight")
            surplus = newcomer
        del self._connections[surplus]
        surplus.abort()

    def _forget(self, connection: Connection) -> None:
        self._connections.pop(connection, None)
        if not self._connections:
            self._none_connected.set()
