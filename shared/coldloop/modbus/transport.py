"""A client's connection to one server: requests out, answers in, several at a time.

A server tells by the transaction id which request an answer is for, so a client need not wait for one answer before it
sends the next request (Modbus Messaging on TCP/IP V1.0b, section 4.4.1.3; 1 to 16 transactions at a time are usual).
Frames are made and taken apart by pymodbus; its own client has one request under way at a time.
"""

import asyncio
import ssl
from collections.abc import Sequence
from typing import Final, cast

from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU

from coldloop.errors import PeerUnreachableError, UntrustedPeerError

UNIT: Final = 1
REQUESTS_AT_ONCE: Final = 16
"""Requests that may be under way."""
NONSENSE: Final = b"\0"
"""Placeholder of an answer that is not Modbus: it answers no function."""
_FRAMER: Final = FramerSocket(DecodePDU(is_server=False))
_PROTOCOL: Final = slice(2, 4)
"""Where a frame says which protocol it is of: 0 is Modbus."""
_LARGEST_FRAME: Final = 260


class NoAnswerError(Exception):
    """A request was not answered; `closed`: the peer closed the connection."""

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
        self._wire: _Wire | None = None

    @property
    def peer(self) -> str:
        """The server, as messages name it."""
        return f"{self._service} at {self._host}:{self._port}"

    @property
    def connected(self) -> bool:
        """Whether there is a connection."""
        return self._wire is not None and not self._wire.transport.is_closing()

    async def open(self) -> None:
        """Connect.

        Raises:
            PeerUnreachableError: No server listens, or none answers in time with TLS.
            UntrustedPeerError: The certificate of the peer does not hold.
        """
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(self._timeout_s):
                _, self._wire = await loop.create_connection(_Wire, self._host, self._port, ssl=self._tls)
        except ssl.SSLCertVerificationError as error:
            raise UntrustedPeerError(
                f"{self.peer} cannot be trusted: {error.verify_message}: check the host name, and tls.ca here"
            ) from None
        except UnicodeError:
            raise PeerUnreachableError(f"{self.peer}: the host name is invalid") from None
        except TimeoutError:
            raise PeerUnreachableError(
                f"{self.peer} did not accept the connection in time: check host, port and the network between"
            ) from None
        except OSError as error:
            if self._tls is not None and isinstance(
                error, ssl.SSLError | ConnectionResetError | ConnectionAbortedError
            ):
                raise PeerUnreachableError(f"{self.peer} does not speak TLS 1.3: check server.tls there") from None
            raise PeerUnreachableError(f"nothing listens as {self.peer}: start it, or check host and port") from None

    async def transact(self, requests: Sequence[bytes], timeout_s: float) -> list[bytes]:
        """Send up to `REQUESTS_AT_ONCE` PDUs, and return the answers' PDUs; whatever goes wrong closes the connection.

        One call at a time.

        Raises:
            NoAnswerError: The peer is silent for `timeout_s`, or has closed the connection.
        """
        if self._wire is None:
            raise NoAnswerError(closed=True)
        answers = self._wire.send(requests)
        timer = asyncio.get_running_loop().call_later(timeout_s, self._wire.give_up)
        try:
            return await answers
        except (NoAnswerError, asyncio.CancelledError):
            self.close()  # a late answer must not meet a later request
            raise
        finally:
            timer.cancel()

    def close(self) -> None:
        """Close the connection."""
        wire, self._wire = self._wire, None
        if wire is None:
            return
        if self._tls is None:
            wire.transport.close()
        else:
            wire.transport.abort()  # the farewell of TLS takes a round trip, and may outlast the event loop


class _Wire(asyncio.Protocol):
    """The frames of one connection."""

    def __init__(self) -> None:
        self.transport: asyncio.Transport
        self._buffer = bytearray()
        self._last_id = 0
        self._awaited: dict[int, int] = {}
        """By transaction id: which of the requests is not answered yet."""
        self._answers: list[bytes] = []
        self._done: asyncio.Future[list[bytes]] | None = None

    def send(self, requests: Sequence[bytes]) -> asyncio.Future[list[bytes]]:
        """Send PDUs; return their answers when all are there."""
        frames = []
        self._awaited.clear()
        self._answers = [b""] * len(requests)
        for place, pdu in enumerate(requests):
            self._last_id = transaction = self._last_id + 1 & 0xFFFF
            self._awaited[transaction] = place
            frames.append(_FRAMER.encode(pdu, UNIT, transaction))
        self._done = done = asyncio.get_running_loop().create_future()
        if self.transport.is_closing():  # uvloop raises RuntimeError when it is written to
            self._fail(closed=True)
        else:
            self.transport.write(b"".join(frames))
        return done

    def give_up(self) -> None:
        """Wait no longer."""
        self._fail(closed=False)

    def _fail(self, *, closed: bool) -> None:
        if self._done is not None and not self._done.done():
            self._done.set_exception(NoAnswerError(closed=closed))

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the transport (event loop callback)."""
        self.transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        """Take the answers that are whole by now (event loop callback)."""
        self._buffer += data
        size, unit, transaction, pdu = _FRAMER.decode(bytes(self._buffer))
        while size and pdu:
            del self._buffer[:size]
            place = self._awaited.pop(transaction, None) if unit == UNIT else None
            if place is not None:  # else it is an answer that nobody waits for any more, or a second one
                self._answers[place] = pdu
            size, unit, transaction, pdu = _FRAMER.decode(bytes(self._buffer))
        if size or any(self._buffer[_PROTOCOL]) or len(self._buffer) > _LARGEST_FRAME:  # no beginning of a frame
            self.transport.abort()
            self._answers = [NONSENSE] * len(self._answers)
            self._awaited.clear()
        if not self._awaited and self._done is not None and not self._done.done():
            self._done.set_result(self._answers)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - why it was lost changes nothing
        """Fail the waiting requests (event loop callback)."""
        self._fail(closed=True)
