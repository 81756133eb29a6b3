"""What Coldloop needs of pymodbus' client: connection, transaction ids, framing and time-outs, for PDUs of bytes.

This is the one module that knows pymodbus' client, and the only one that uses its insides: those in `INSIDES`, which
may move with every minor version.
"""

import asyncio
import logging
import ssl
from functools import cached_property, partial
from typing import Any, Final, cast

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException

from coldloop.errors import PeerUnreachableError, UntrustedPeerError
from coldloop.modbus.raw_pdu import RawDecoder, RawPdu

BUFFER_BYTES: Final = 4096
"""pymodbus throws away what is received when more than two frames' length of it has come, stale answers included."""

INSIDES: Final = {
    "comm_params": "time-out of a single request: a server may let one wait for longer than others",
    "framer": "its decoder, as ours takes any response as bytes",
    "max_buffer_size": "what may be received before pymodbus throws it away",
    "response_future": "ended when the peer closes: pymodbus only notices by the time-out",
    "call_create": "makes a TLS connection: pymodbus' own TLS client takes each TLS record for a whole answer",
    "handle_new_connection": "the protocol for that connection",
    "transport": "aborted when a TLS connection is closed",
}
"""Attributes of pymodbus' transaction manager (`client.ctx`) that are used, and what for."""

# pymodbus logs each failure besides reporting it; here every one becomes an error of Coldloop's that says more.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


class NoAnswerError(Exception):
    """A request was not answered; `closed` tells whether the peer closed the connection."""

    def __init__(self, *, closed: bool) -> None:
        super().__init__("closed by the peer" if closed else "no answer in time")
        self.closed = closed


class Transport:
    """A connection to one server.

    Args:
        service: Name of the peer's service.
        host: Where it is.
        port: Its TCP port.
        timeout_s: How long connecting may take.
        tls: For Modbus/TCP Security; plain Modbus/TCP without.

    Neither retries nor reconnects in the background: a request fails within its time.
    """

    def __init__(self, service: str, host: str, port: int, timeout_s: float, tls: ssl.SSLContext | None) -> None:
        self._service = service
        self._host = host
        self._port = port
        self._timeout_s = timeout_s
        self._tls = tls

    @property
    def peer(self) -> str:
        """The server, as messages name it."""
        return f"{self._service} at {self._host}:{self._port}"

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return bool(self._client.connected)

    async def open(self) -> None:
        """Connect.

        Raises:
            PeerUnreachableError: Nobody listens, or not with TLS.
            UntrustedPeerError: The certificate of the peer does not hold.
        """
        self._client.ctx.comm_params.timeout_connect = self._timeout_s
        connected = await self._client.connect()
        _raise_lost_cancellation()
        if not connected:
            raise PeerUnreachableError(f"nobody listens as {self.peer}: start it, or check host and port")

    async def transact(self, request: RawPdu, timeout_s: float) -> object:
        """Send a request, and return the answer's PDU; whatever goes wrong closes the connection.

        Raises:
            NoAnswerError: The peer is silent for `timeout_s`, or has closed the connection.
        """
        client = self._client
        client.ctx.comm_params.timeout_connect = timeout_s
        try:
            response = await client.execute(False, request)  # noqa: FBT003 - pymodbus takes it by position only
        except (ModbusException, RuntimeError) as error:  # uvloop's, when the transport has just been closed
            client.close()  # a late answer must not meet a later request
            raise NoAnswerError(closed=isinstance(error, ConnectionException | RuntimeError)) from error
        except asyncio.CancelledError:
            client.close()
            raise
        _raise_lost_cancellation()
        return response

    def close(self) -> None:
        """Close the connection."""
        transport = cast("asyncio.WriteTransport | None", self._client.ctx.transport)
        self._client.close()
        if transport is not None and self._tls is not None:
            transport.abort()  # the farewell of TLS takes a round trip, and may outlast the event loop

    @cached_property
    def _client(self) -> AsyncModbusTcpClient:
        client = AsyncModbusTcpClient(
            self._host,
            port=self._port,
            name=self._service,
            timeout=self._timeout_s,
            retries=0,
            reconnect_delay=0,
            trace_connect=self._connection_changed,
        )
        client.ctx.framer.decoder = RawDecoder(is_server=False)
        client.ctx.max_buffer_size = BUFFER_BYTES
        if self._tls is not None:
            client.ctx.call_create = partial(self._create_secured, client, self._tls)
        return client

    async def _create_secured(self, client: AsyncModbusTcpClient, tls: ssl.SSLContext) -> Any:  # noqa: ANN401 - pymodbus' signature
        try:
            return await asyncio.get_running_loop().create_connection(
                client.ctx.handle_new_connection, self._host, self._port, ssl=tls
            )
        except ssl.SSLCertVerificationError as error:
            raise UntrustedPeerError(
                f"{self.peer} cannot be trusted: {error.verify_message}: check the host name, and tls.ca here"
            ) from None
        except (ssl.SSLError, ConnectionResetError, ConnectionAbortedError):
            raise PeerUnreachableError(f"{self.peer} does not speak TLS 1.3: check server.tls there") from None

    def _connection_changed(self, connected: bool) -> None:  # noqa: FBT001 - pymodbus' signature
        answer = self._client.ctx.response_future
        if not connected and not answer.done():
            answer.set_exception(ConnectionException("closed by the peer"))


def _raise_lost_cancellation() -> None:
    """Raise the cancellation that `asyncio.wait_for` loses before Python 3.12 when it meets what is waited for."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
