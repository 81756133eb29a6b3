"""A typed client of one server: records in, records out."""

import asyncio
import math
import ssl
import struct
from collections.abc import Sequence
from typing import Any, Final, Self, TypeVar, cast

from coldloop import errors
from coldloop.errors import PeerUnreachableError, UntrustedPeerError
from coldloop.modbus import requests as protocol
from coldloop.modbus.settings import Endpoint, TlsSettings
from coldloop.process.declaration import Process
from coldloop.registers.codec import DomainError, RecordCodec, Seal, WordOrder, codec_of
from coldloop.registers.common import IDENTITY_BLOCK, MAGIC, Identity
from coldloop.registers.declaration import Block, RegisterMap


def check_peer(raw: bytes, register_map: RegisterMap, order: WordOrder, peer: str) -> None:
    """Check the bytes of a peer's identity block.

    Raises:
        PeerUnreachableError: It is something else, uses the other word order, or has another register map.
    """
    other = WordOrder.LOW_FIRST if order is WordOrder.HIGH_FIRST else WordOrder.HIGH_FIRST
    identity, swapped = (Identity(*codec_of(IDENTITY_BLOCK, each).decode(raw)) for each in (order, other))
    if not math.isclose(identity.magic, MAGIC, rel_tol=1e-6):
        if math.isclose(swapped.magic, MAGIC, rel_tol=1e-6):
            raise PeerUnreachableError(f"{peer} has the other word order: set it to {other} here, or {order} there")
        raise PeerUnreachableError(
            f"{peer}: another program answers there (register 0 is not {MAGIC}): check host and port"
        )
    if identity.map_digest != register_map.digest:
        raise PeerUnreachableError(
            f"{peer} has another register map (version {identity.map_version}, digest {identity.map_digest:08x}, "
            f"not version {register_map.version}, {register_map.digest:08x}): "
            "check the port, and run the same release, of the same process, on both sides"
        )


UNIT: Final = 1
REQUESTS_AT_ONCE: Final = 16
"""Requests that may be under way."""
NONSENSE: Final = b"\0"
"""Placeholder of an answer that is not Modbus: it answers no function."""


class NoAnswerError(Exception):
    """A request was not answered; `closed`: the peer closed the connection."""

    def __init__(self, *, closed: bool) -> None:
        super().__init__("closed by the peer" if closed else "no answer in time")
        self.closed = closed


class Transport:
    """A connection to one server: requests out, answers in, several at a time.

    A server tells by the transaction id which request an answer is for, so a client need not wait for one answer before
    it sends the next request (Modbus Messaging on TCP/IP V1.0b, section 4.4.1.3; 1 to 16 transactions at a time are
    usual). pymodbus' client has one request under way at a time.

    Connecting may take `timeout_s`; `tls` is for Modbus/TCP Security, plain Modbus/TCP without. Neither retries nor
    reconnects in the background: a request fails within its time.
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
        try:
            return await self._wire.send(requests, timeout_s)
        except (NoAnswerError, asyncio.CancelledError):
            self.close()  # a late answer must not meet a later request
            raise

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
        self._loop = asyncio.get_running_loop()
        self._buffer = bytearray()
        self._last_id = 0
        self._awaited: dict[int, int] = {}
        """Indices of the requests that are not answered yet, by transaction id."""
        self._answers: list[bytes] = []
        self._done: asyncio.Future[list[bytes]] | None = None
        self._deadline = 0.0
        """Deadline of the answers, by the clock of the event loop."""
        self._timer: asyncio.TimerHandle | None = None
        """Looks at the deadline: one timer for many requests, as hardly any answer is late."""

    def send(self, requests: Sequence[bytes], timeout_s: float) -> asyncio.Future[list[bytes]]:
        """Send PDUs in one piece; return their answers when all are there."""
        frames = b""
        self._awaited.clear()
        self._answers = [b""] * len(requests)
        for place, pdu in enumerate(requests):
            self._last_id = transaction = self._last_id + 1 & 0xFFFF
            self._awaited[transaction] = place
            frames += protocol.framed(transaction, UNIT, pdu)
        self._done = done = self._loop.create_future()
        if self.transport.is_closing():  # uvloop raises RuntimeError when it is written to
            self._fail(closed=True)
            return done
        self.transport.write(frames)
        self._deadline = self._loop.time() + timeout_s
        if self._timer is None or self._timer.when() > self._deadline:
            self._look_at(self._deadline)
        return done

    def _look_at(self, when: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(when, self._look)

    def _look(self) -> None:
        """Wait no longer than the deadline."""
        self._timer = None
        if self._done is None or self._done.done():
            return
        if self._loop.time() < self._deadline:
            self._look_at(self._deadline)
        else:
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
        position = 0
        try:
            while position < len(self._buffer) and (frame := protocol.next_frame(self._buffer, position)) is not None:
                transaction, unit, pdu, position = frame
                place = self._awaited.pop(transaction, None) if unit == UNIT else None
                if place is not None:  # else it is an answer that nobody waits for any more, or a second one
                    self._answers[place] = pdu
        except protocol.MalformedFrameError:
            self.transport.abort()
            self._answers = [NONSENSE] * len(self._answers)
            self._awaited.clear()
        del self._buffer[:position]
        if not self._awaited and self._done is not None and not self._done.done():
            self._done.set_result(self._answers)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - why it was lost changes nothing
        """Fail the waiting requests (event loop callback)."""
        if self._timer is not None:
            self._timer.cancel()
        self._fail(closed=True)


R = TypeVar("R", bound=tuple[Any, ...])
S = TypeVar("S", bound=tuple[Any, ...])

CONNECT_PAUSE_S: Final = 0.1
_READ: Final = struct.Struct(">BHH")
_WRITE: Final = struct.Struct(">BHHB")
_READ_WRITE: Final = struct.Struct(">BHHHHB")
_WRITTEN: Final = slice(1, _READ.size)
"""Part of a write that its answer repeats behind the function code: address and count."""
_EXCEPTIONS: Final = {
    1: "no such function, or not for the role of this client",
    2: "no such register, or read-only",
    3: "illegal value",
    4: "failure in the server",
    6: "another client holds the lease of this role",
    11: "no such unit id",
}


class RegisterClient:
    """Reads and writes the records of one server.

    Args:
        register_map: What the server serves.
        host: Where it is.
        port: Its TCP port.
        timeout_s: How long connecting, and each answer, may take.
        order: Word order of 32-bit values.
        tls: Files for Modbus/TCP Security; plain Modbus/TCP without.

    Requests of several tasks are sent one after the other. After a lost connection the next request connects again.

    Records of sealed blocks are sealed when they are written, and their seals are checked when they are read. Values
    that are read are checked by the declarations of their registers.

    All requests raise `PeerUnreachableError` when there is no answer in time, `RequestRefusedError` when the answer is
    a Modbus exception, `DamagedAnswerError` when a record that should be sealed is not, or its seal is broken,
    `ImplausibleAnswerError` when a value is out of its range, and `UnfitValueError` when one that is to be written does
    not fit.
    """

    def __init__(
        self, register_map: RegisterMap, *, host: str, port: int, timeout_s: float,
        order: WordOrder = WordOrder.HIGH_FIRST, tls: TlsSettings | None = None,
    ) -> None:  # fmt: skip
        self.map = register_map
        self._order = order
        self._timeout_s = timeout_s
        context: ssl.SSLContext | None = None
        if tls is not None:
            from coldloop.modbus.tls import tls_context  # noqa: PLC0415 without TLS, nothing needs cryptography

            context = tls_context(tls, f"tls of the client of {register_map.service} at {host}:{port}")
        self._secure = context is not None
        self._transport = Transport(register_map.service, host, port, timeout_s, context)
        self._turn = asyncio.Lock()
        self._places: dict[type[tuple[Any, ...]], tuple[Block, RecordCodec]] = {
            block.record: (block, codec_of(block, order)) for block in register_map.blocks
        }

    @classmethod
    def at(cls, register_map: RegisterMap, endpoint: Endpoint) -> Self:
        """Return a client of the server at an endpoint.

        Raises:
            ConfigurationError: The files for TLS cannot be used.
        """
        return cls(
            register_map, host=endpoint.host, port=endpoint.port, timeout_s=endpoint.timeout_s,
            order=endpoint.word_order, tls=endpoint.tls,
        )  # fmt: skip

    @property
    def process(self) -> Process:
        """The process whose registers it reads."""
        return self.map.process

    @property
    def peer(self) -> str:
        """The server, as messages name it."""
        return self._transport.peer

    @property
    def connected(self) -> bool:
        """Whether there is a connection; without one the next request makes one."""
        return self._transport.connected

    async def connect(self, patience_s: float) -> None:
        """Connect, and make sure that the peer speaks this register map in this word order.

        Args:
            patience_s: How long to keep trying without an answer.

        Raises:
            PeerUnreachableError: No answer, or not as the register map says.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + patience_s
        while True:
            try:
                block, codec = self._places[Identity]
                (raw,) = await self._read_words(block, [(block.address, codec.size // 2)])
            except UntrustedPeerError:
                raise
            except PeerUnreachableError:
                if loop.time() >= deadline:
                    raise
                await asyncio.sleep(min(CONNECT_PAUSE_S, patience_s))
            except errors.RequestRefusedError as error:
                raise PeerUnreachableError(
                    f"{self.peer}: another program answers there (no identity block): check host and port"
                ) from error
            else:
                check_peer(raw, self.map, self._order, self.peer)
                return

    async def read(self, record: type[R]) -> R:
        """Return the record (its first row)."""
        return (await self.read_rows(record, 0, 1))[0]

    async def read_rows(self, record: type[R], start: int, count: int) -> list[R]:
        """Return `count` rows from row `start` on.

        Rows that need several requests are read in several, which are sent together, up to `REQUESTS_AT_ONCE`. A row
        that is longer than a request is read in pieces: the seal of a record tells torn ones.
        """
        block, codec = self._places[record]
        row_words, end = codec.size // 2, start + count
        rows: list[R] = []
        if row_words > protocol.MAX_READ_WORDS:
            for first in range(block.address + start * row_words, block.address + end * row_words, row_words):
                pieces = range(0, row_words, protocol.MAX_READ_WORDS)
                words = [(first + done, min(protocol.MAX_READ_WORDS, row_words - done)) for done in pieces]
                rows.append(self._decoded(block, codec, b"".join(await self._read_words(block, words))))
            return rows
        rows_at_once = protocol.MAX_READ_WORDS // row_words
        parts = [(first, min(rows_at_once, end - first)) for first in range(start, end, rows_at_once)]
        for place in range(0, len(parts), REQUESTS_AT_ONCE):
            words = [
                (block.address + first * row_words, here * row_words)
                for first, here in parts[place : place + REQUESTS_AT_ONCE]
            ]
            for raw in await self._read_words(block, words):
                rows += [self._decoded(block, codec, raw, offset) for offset in range(0, len(raw), codec.size)]
        return rows

    async def write(self, record: tuple[Any, ...]) -> None:
        """Write the record (its first row)."""
        await self.write_rows([record])

    async def write_rows(self, records: Sequence[tuple[Any, ...]], start: int = 0) -> None:
        """Write rows of one block from row `start` on; rows that need several requests are written in several."""
        if not records:
            return
        block, codec = self._places[type(records[0])]
        rows_at_once = protocol.MAX_WRITE_WORDS // (codec.size // 2)
        for first in range(0, len(records), rows_at_once):
            request = self._writing(records[first : first + rows_at_once], start + first)
            self._check_written(request, (await self._transact([request], block))[0], block)

    def _writing(self, records: Sequence[tuple[Any, ...]], start: int = 0) -> bytes:
        block, codec = self._places[type(records[0])]
        data = _encoded(block, codec, *records)
        address = block.address + start * codec.size // 2
        return _WRITE.pack(protocol.WRITE_MULTIPLE_REGISTERS, address, len(data) // 2, len(data)) + data

    def _check_written(self, request: bytes, answer: bytes, block: Block) -> None:
        if answer != request[_WRITTEN]:
            raise self._nonsense(block)

    async def exchange(
        self, record: tuple[Any, ...], answer: type[R], *, rows: Sequence[tuple[Any, ...]] = (),
        before: tuple[Any, ...] | None = None, patience_s: float | None = None,
    ) -> R:  # fmt: skip
        """Write `record`, then read `answer`, in one request.

        Args:
            record: What to write.
            answer: What to read.
            rows: First rows of the block that follows the record's in the map, written with it.
            before: A record that is written before, by a request of its own that is sent together with this one.
            patience_s: How long the answer may take when the server lets it wait; `timeout_s` by default.
        """
        block, codec = self._places[type(record)]
        answer_block, answer_codec = self._places[answer]
        data = _encoded(block, codec, record)
        if rows:
            data += _encoded(*self._places[type(rows[0])], *rows)
        head = _READ_WRITE.pack(
            protocol.READ_WRITE_REGISTERS,
            answer_block.address,
            answer_codec.size // 2,
            block.address,
            len(data) // 2,
            len(data),
        )
        requests = [head + data] if before is None else [self._writing([before]), head + data]
        *written, raw = await self._transact(requests, block, patience_s)
        if before is not None:
            self._check_written(requests[0], written[0], block)
        words = self._checked(raw, answer_codec.size, answer_block)
        return cast("R", self._decoded(answer_block, answer_codec, words))

    async def query(self, record: tuple[Any, ...], answer: type[R], rows: type[S], count: int) -> tuple[R, list[S]]:
        """Write `record`, then read `answer` and the first `count` rows of the block that adjoins it, in one request.

        One request, so that no other client's query comes between. The blocks that are read are not sealed.
        """
        written, own_codec = self._places[type(record)]
        block, codec = self._places[answer]
        row_block, row_codec = self._places[rows]
        size = codec.size + count * row_codec.size
        data = _encoded(written, own_codec, record)
        head = _READ_WRITE.pack(
            protocol.READ_WRITE_REGISTERS, block.address, size // 2, written.address, len(data) // 2, len(data)
        )
        (raw,) = await self._transact([head + data], written)
        raw = self._checked(raw, size, block)
        places = range(codec.size, size, row_codec.size)
        found = [cast("S", self._decoded(row_block, row_codec, raw, place)) for place in places]
        return cast("R", self._decoded(block, codec, raw)), found

    def close(self) -> None:
        """Close the connection."""
        self._transport.close()

    async def _read_words(self, block: Block, parts: Sequence[tuple[int, int]]) -> list[bytes]:
        """Return the words of parts of a block, each given by its address and the number of words."""
        requests = [_READ.pack(protocol.READ_HOLDING_REGISTERS, address, count) for address, count in parts]
        answers = await self._transact(requests, block)
        return [self._checked(raw, 2 * count, block) for raw, (_, count) in zip(answers, parts, strict=True)]

    def _checked(self, raw: bytes, size: int, block: Block) -> bytes:
        if len(raw) != size + 1 or raw[0] != size:
            raise self._nonsense(block)
        return raw[1:]

    def _decoded(self, block: Block, codec: RecordCodec, raw: bytes, offset: int = 0) -> Any:  # noqa: ANN401 - a record
        """Return a record of an answer, its seal and its values checked."""
        if block.sealed and codec.seal_of(raw, offset) is not Seal.INTACT:
            raise errors.DamagedAnswerError(
                f"{self.peer}: block '{block.name}' arrived damaged, or is not sealed there"
            )
        try:
            return codec.decode_checked(raw, offset)
        except DomainError as error:
            raise errors.ImplausibleAnswerError(
                f"{self.peer}: block '{block.name}' is not plausible: {error}"
            ) from None

    async def _transact(self, requests: Sequence[bytes], block: Block, patience_s: float | None = None) -> list[bytes]:
        """Send PDUs, connecting first where needed; return the bytes behind the function codes of the answers."""
        async with self._turn:
            if not self._transport.connected:
                await self._transport.open()
            try:
                answers = await self._transport.transact(requests, patience_s or self._timeout_s)
            except NoAnswerError as error:
                what = "closed the connection" if error.closed else "did not answer in time"
                raise PeerUnreachableError(
                    f"{self.peer} {what} at a request for block '{block.name}': check that it runs and is what listens "
                    f"there{', and that it accepts our certificate' if self._secure else ''}"
                ) from error
        for request, answer in zip(requests, answers, strict=True):
            if answer[0] == request[0]:
                continue
            if answer[0] & 0x7F != request[0]:
                raise self._nonsense(block)
            code = int.from_bytes(answer[1:], "big")
            meaning = _EXCEPTIONS.get(code, "not a code that Coldloop uses")
            raise errors.RequestRefusedError(
                f"{self.peer} refused function {request[0]} on block '{block.name}': exception {code}, {meaning}", code
            )
        return [answer[1:] for answer in answers]

    def _nonsense(self, block: Block) -> PeerUnreachableError:
        return PeerUnreachableError(
            f"{self.peer} answered a request for block '{block.name}' with something invalid: check host and port"
        )


def _encoded(block: Block, codec: RecordCodec, *records: tuple[Any, ...]) -> bytes:
    try:
        return b"".join(map(codec.encode_sealed, records)) if block.sealed else codec.encode_rows(records)
    except (struct.error, OverflowError) as error:
        raise errors.UnfitValueError(f"block '{block.name}' cannot hold the values to be written: {error}") from None
