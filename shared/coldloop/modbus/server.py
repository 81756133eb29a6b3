"""A Modbus/TCP server over one register bank."""

import asyncio
import contextlib
import errno
import ssl
from collections.abc import Callable
from functools import partial
from time import monotonic
from typing import TYPE_CHECKING, Final

from coldloop.errors import PortInUseError
from coldloop.modbus.connection import Connection, OnWrite, RefusalLog, Turns
from coldloop.modbus.requests import DeviceIdentity, RequestHandler
from coldloop.modbus.settings import ServerSettings
from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.common import ServerStatistics
from coldloop.registers.declaration import Role

if TYPE_CHECKING:
    from coldloop.modbus.tls import TlsListener

__all__ = ["DeviceIdentity", "ModbusServer", "OnWrite", "ServerSettings"]

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
        on_write: Called with each block that a request has written, in the order of their addresses, and with who
            wrote it, after everything is stored. When it returns an awaitable, the answer (the read half of an FC23
            too) is made after it is done; other connections are served meanwhile. It is cancelled when its client goes
            away, so it must not be shared. When `on_write` or its awaitable raises, the client gets exception 04.
        identity: Answer to the device identification, function 43 / 14.
        on_departure: Called with a role when the last open connection that has written a block of that role closes,
            unless the server itself is being closed.
        on_close: Called with the caller of each connection that closes.
        on_refusal: Called with the kind, one of `connection.REFUSALS`, of everything that is refused.

    The block of `ServerStatistics`, where the map has one, is kept up to date.
    """

    def __init__(
        self, bank: RegisterBank, *, settings: ServerSettings, on_write: OnWrite, identity: DeviceIdentity,
        on_departure: Callable[[Role], None] | None = None, on_close: Callable[[Caller], None] | None = None,
        on_refusal: Callable[[str], None] | None = None,
    ) -> None:  # fmt: skip
        self._settings = settings
        self._on_write = on_write
        self._service = bank.map.service
        self._on_departure = on_departure
        self._on_close = on_close
        self._handler_for = partial(RequestHandler, bank, identity)
        self.refusals = RefusalLog(bank.map.service, on_refusal)
        """Counts of what was refused."""
        self._closing = False
        self._accepted = self._past_requests = 0
        self._connections: dict[Connection, None] = {}  # in the order of their arrival
        self._none_connected = asyncio.Event()
        self._none_connected.set()
        self._listener: asyncio.Server | TlsListener | None = None
        if any(block.record is ServerStatistics for block in bank.map.blocks):
            bank.keep_fresh(ServerStatistics, self.statistics)

    @property
    def connections(self) -> int:
        """Number of connections being served."""
        return len(self._connections)

    def statistics(self) -> ServerStatistics:
        """Return what the server has done so far; counts wrap as their registers do."""
        requests = self._past_requests + sum(connection.requests for connection in self._connections)
        errors = {kind: count & 0xFFFFFFFF for kind, count in self.refusals.counts.items()}
        return ServerStatistics(
            connections=min(self.connections, 0xFFFF), accepted=self._accepted & 0xFFFFFFFF,
            requests=requests & 0xFFFFFFFF, **errors,
        )  # fmt: skip

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
            ConfigurationError: The files for TLS cannot be used.
        """
        host, port, tls = self._settings.host, self._settings.port, self._settings.tls
        make_connection = partial(
            Connection, handler_for=self._handler_for, settings=self._settings, on_write=self._on_write,
            refusals=self.refusals, turns=Turns(), opened=self._admit, lost=self._forget,
        )  # fmt: skip
        try:
            if tls is None:
                self._listener = await asyncio.get_running_loop().create_server(make_connection, host, port)
            else:
                from coldloop.modbus.tls import TlsListener, tls_context  # noqa: PLC0415 nothing else needs cryptography

                context = tls_context(tls, f"{self._service}.server.tls", ssl.PROTOCOL_TLS_SERVER)
                self._listener = await TlsListener.at(
                    host, port, context, make_protocol=make_connection, limit=self._settings.connection_limit,
                    refusals=self.refusals,
                )  # fmt: skip
        except OSError as error:
            reason = _REMEDIES.get(error.errno or 0, f"{error.strerror}; choose another host or port")
            raise PortInUseError(f"{self._service} cannot listen on {host}:{port}: {reason}") from error

    async def close(self) -> None:
        """Stop listening and close all connections; waits of `on_write` are cancelled."""
        self._closing = True
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

    def _admit(self, newcomer: Connection) -> None:
        """Take a connection in, where need be in the place of an idle one, or close it."""
        if len(self._connections) >= self._settings.connection_limit and not self._make_room(newcomer):
            self.refusals.note("connection_refused", newcomer.peer, "too many connections, and none is idle")
            newcomer.close()
            return
        self._accepted += 1
        self._connections[newcomer] = None
        self._none_connected.clear()

    def _make_room(self, newcomer: Connection) -> bool:
        """Close the connection that has been idle longest, first those that never made a request.

        For a newcomer with a role one that only reads makes room, however busy, and one with a role never does for a
        newcomer that only reads: readers neither keep a PLC out nor end its link, also where a scan takes long.
        """
        before = monotonic() - self._settings.replaceable_after_s
        idle = [
            connection
            for connection in self._connections
            if connection.idle
            and (newcomer.has_role or not connection.has_role)
            and (not connection.requests or connection.last_request <= before)
        ]
        if not idle and newcomer.has_role:
            idle = [connection for connection in self._connections if not connection.has_role]
        if not idle:
            return False
        oldest = min(idle, key=lambda connection: (connection.requests > 0, connection.last_request))
        self.refusals.note("connection_evicted", oldest.peer, f"idle longest, replaced by {newcomer.peer}")
        del self._connections[oldest]
        oldest.abort()
        return True

    def _forget(self, connection: Connection) -> None:
        self._connections.pop(connection, None)
        self._past_requests += connection.requests
        if not self._connections:
            self._none_connected.set()
        if self._on_close is not None:
            self._on_close(connection.caller)
        if self._on_departure is None or self._closing:
            return
        present = {role for other in self._connections for role in other.written_as}
        for role in connection.written_as - present:
            if role is not None:
                self._on_departure(role)
