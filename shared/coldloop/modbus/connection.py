"""One connection of a server: who it is, frames in, answers out, and the wait that a write may ask for.

Everything runs in the callbacks of the event loop. A request costs no task and no await unless `on_write` asks for a
wait; then requests that arrive behind it stay in the buffer until its answer is written. A request that comes alone is
answered at once; many are answered a few at a time (`Turns`).

A client is known by its address, or with TLS by the role in its certificate, in the X.509v3 extension of the Modbus/TCP
Security Protocol Specification (v21, section 8.2, "Role extension"): a UTF8String. One without a role, or with a role
that we do not know, may only read.
"""

import asyncio
import contextlib
import json
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from ipaddress import ip_address
from itertools import count
from time import monotonic
from typing import Final, Protocol, cast

from coldloop.modbus import requests
from coldloop.modbus.settings import AccessSettings, ServerSettings
from coldloop.registers.bank import ANYBODY, Caller, ForbiddenWriteError, RefusedAccessError
from coldloop.registers.common import ServerStatistics
from coldloop.registers.declaration import Block, Role

LOG_INTERVAL_S: Final = 10.0

_logger = logging.getLogger("coldloop.modbus")


REFUSALS: Final = ServerStatistics._fields[3:]
"""Kinds of refusals, which the registers count."""


class RefusalLog:
    """Counts each refusal of a service and logs at most one line of a kind in `LOG_INTERVAL_S`, against floods.

    `on_refusal` is called with the kind of every one.
    """

    def __init__(self, service: str, on_refusal: Callable[[str], None] | None = None) -> None:
        self.counts = dict.fromkeys(REFUSALS, 0)
        """Refusals so far, by kind."""
        self._service = service
        self._on_refusal = on_refusal
        self._next_line = dict.fromkeys(REFUSALS, 0.0)
        self._unlogged = dict.fromkeys(REFUSALS, 0)

    def note(self, kind: str, peer: str, reason: str) -> None:
        """Count a refusal of a kind, one of `REFUSALS`."""
        self.counts[kind] += 1
        if self._on_refusal is not None:
            self._on_refusal(kind)
        now = monotonic()
        if now < self._next_line[kind]:
            self._unlogged[kind] += 1
            return
        _logger.warning(
            "service=%s kind=%s peer=%s unlogged=%d reason=%s", self._service, kind, peer, self._unlogged[kind], reason
        )
        self._next_line[kind] = now + LOG_INTERVAL_S
        self._unlogged[kind] = 0


class RateLimit:
    """A token bucket: `rate` requests a second, and up to `burst` at once."""

    def __init__(self, rate: float, burst: int) -> None:
        self.rate = rate
        self._burst = float(burst)
        self._tokens = self._burst
        self._filled_at = monotonic()

    def take(self) -> float:
        """Take the right to one request; return 0, or in how many seconds there will be one."""
        now = monotonic()
        self._tokens = min(self._burst, self._tokens + (now - self._filled_at) * self.rate)
        self._filled_at = now
        if self._tokens < 1.0:
            return (1.0 - self._tokens) / self.rate
        self._tokens -= 1.0
        return 0.0


def rate_limit_of(settings: ServerSettings, *, has_role: bool) -> RateLimit | None:
    """Return the limit of a connection, None where it has none."""
    if has_role:
        return RateLimit(settings.request_rate, settings.request_burst) if settings.request_rate else None
    rates = [rate for rate in (settings.request_rate, settings.reader_request_rate) if rate]
    return RateLimit(min(rates), settings.request_burst) if rates else None


TURN_S: Final = 0.001
"""Time for requests in one turn. A request that is being served is finished."""
REQUESTS_AT_ONCE: Final = 16
"""Requests of one connection before it is the turn of the next one."""


class Client(Protocol):
    """Connection that is served in turns."""

    has_role: bool

    def serve_some(self, until: float) -> bool:
        """Serve a few requests, none after `until` (monotonic time, s); return whether there are more."""


class Turns:
    """Divides the turns of the event loop between connections and the control program; one for each server.

    Timers are looked at once in a turn, so a scan is as late as the turn in which it falls due is long. In one turn
    requests are served for about `TURN_S`, and a few of each connection; the rest waits for later turns.
    Clients with a role are served before those without, each kind in the order of arrival. Where clients with a role
    take all the time, one of the others is still served in each turn.
    """

    def __init__(self) -> None:
        self._with_role: deque[Client] = deque()
        self._without: deque[Client] = deque()
        self._until = 0.0
        self._begun = False

    def until(self) -> float:
        """Return until when requests may be served in this turn (monotonic time, s), or 0 when the time is used up."""
        now = monotonic()
        if not self._begun:
            self._begun = True
            self._until = now + TURN_S
            asyncio.get_running_loop().call_soon(self._next_turn)
        return self._until if now < self._until else 0.0

    def queue(self, client: Client) -> None:
        """Serve a client in a later turn; `until` has been called in this one."""
        (self._with_role if client.has_role else self._without).append(client)

    def _next_turn(self) -> None:
        if not self._with_role and not self._without:
            self._begun = False  # what arrives next begins a turn of its own
            return
        # Requests that arrive in this turn share its time with those that have waited for it.
        asyncio.get_running_loop().call_soon(self._next_turn)
        self._until = monotonic() + TURN_S
        self._serve(self._with_role)
        if self._without:
            self._serve_one(self._without)
        self._serve(self._without)

    def _serve(self, clients: deque[Client]) -> None:
        while clients and monotonic() < self._until:
            self._serve_one(clients)

    def _serve_one(self, clients: deque[Client]) -> None:
        client = clients.popleft()
        if client.serve_some(self._until):
            clients.append(client)


INPUT_LIMIT: Final = 64 * 1024
"""Bytes of unserved requests beyond which a connection is not read from."""

OUTPUT_CHUNK: Final = 16 * 1024
"""Bytes of answers that are written at once; a client that does not take them is not served further."""

OnWrite = Callable[[Block, Caller], Awaitable[None] | None]

_KINDS: Final = {1: "illegal_function", 2: "illegal_address", 3: "illegal_value", 6: "second_writer"}
_numbers = count(1)


class Connection(asyncio.Protocol):
    """Serves one client.

    `opened` reports the connection to the server, which may close it; `lost` reports its end.
    """

    _handle: Callable[[bytes], bytes | requests.Written]

    def __init__(
        self, *, handler_for: Callable[[Caller], requests.RequestHandler], settings: ServerSettings, on_write: OnWrite,
        refusals: RefusalLog, turns: Turns, opened: Callable[["Connection"], None],
        lost: Callable[["Connection"], None],
    ) -> None:  # fmt: skip
        self._handler_for = handler_for
        self._settings = settings
        self._on_write = on_write
        self._refusals = refusals
        self._turns = turns
        self._opened = opened
        self._lost = lost
        self._loop = asyncio.get_running_loop()
        self._buffer = bytearray()
        self._wait: asyncio.Future[None] | None = None
        self._output_blocked = False
        self._reading_paused = False
        self._queued = False
        self._ended = False  # the client sends no more
        self._rate: RateLimit | None = None
        self._held: asyncio.TimerHandle | None = None
        self.requests = 0
        self.written_as: set[Role | None] = set()
        self.last_request = monotonic()  # not the loop's time, which uvloop rounds to milliseconds
        self.peer = "?"
        self.caller = ANYBODY._replace(roles=frozenset())
        self.has_role = False
        """Whether it may write anything."""

    @property
    def idle(self) -> bool:
        """Whether no request is waiting for its answer."""
        return self._wait is None and self._held is None and not self._queued

    def close(self) -> None:
        """Close when what was answered has been sent."""
        self._transport.close()

    def abort(self) -> None:
        """Close now."""
        self._transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Find out who it is, and begin to serve (event loop callback)."""
        self._transport = cast("asyncio.Transport", transport)
        self._idle_timer = self._loop.call_later(self._settings.idle_timeout_s, self._check_idle)
        secure = transport.get_extra_info("ssl_object")
        self._secure = secure is not None
        address = transport.get_extra_info("peername")
        if not address:  # gone again
            self.abort()
            return
        self.peer = f"{address[0]}:{address[1]}"
        caller = (
            caller_at(address[0], self.peer, self._settings.access)
            if secure is None
            else caller_with(secure.getpeercert(binary_form=True), self.peer)
        )
        if caller is None:
            self._refusals.note("access_refused", self.peer, "this address has no role and may not read")
            self.close()
            return
        self.caller = caller = caller._replace(connection=next(_numbers))
        self.peer = caller.name
        self.has_role = bool(caller.roles)
        self._rate = rate_limit_of(self._settings, has_role=self.has_role)
        self._handle = self._handler_for(caller).handle
        self._opened(self)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - why it was lost changes nothing
        """Cancel what the client no longer waits for (event loop callback)."""
        self._idle_timer.cancel()
        if self._wait is not None:
            self._wait.cancel()
        if self._held is not None:
            self._held.cancel()
        self._lost(self)

    def data_received(self, data: bytes) -> None:
        """Answer all requests that are whole by now (event loop callback)."""
        if self._transport.is_closing():  # with TLS, what was under way still comes
            return
        self._buffer += data
        self._serve()

    def eof_received(self) -> bool:
        """Answer the requests that are there, and close then; a request that waits is dropped (event loop callback)."""
        self._ended = not self._secure  # TLS has no half of a connection
        self._regulate_reading()
        return self._ended

    def pause_writing(self) -> None:
        """Stop serving a client that does not read its answers (event loop callback)."""
        self._output_blocked = True

    def resume_writing(self) -> None:
        """Resume serving (event loop callback)."""
        self._output_blocked = False
        self.last_request = monotonic()
        self._serve()

    @property
    def _ready(self) -> bool:
        blocked = self._output_blocked or self._wait is not None or self._held is not None
        return not blocked and not self._transport.is_closing()

    def _serve(self) -> None:
        """Serve what this turn of the event loop has time for; the rest waits for later ones."""
        if self._queued:
            return
        if until := self._turns.until():
            self.serve_some(until)
        else:
            self._queued = self._ready and bool(self._buffer)
            self._regulate_reading()
        if self._queued:
            self._turns.queue(self)

    def serve_some(self, until: float) -> bool:
        """Answer a few requests, none after `until` (monotonic time, s); return whether there are more for now."""
        self._queued = self._ready and self._answer_some(until) and self._ready
        self._regulate_reading()
        return self._queued

    def _regulate_reading(self) -> None:
        if self._ended:
            if self._wait is not None or not (self._queued or self._held or self._output_blocked):
                self._transport.close()
            return
        pause = self._output_blocked or self._held is not None or len(self._buffer) > INPUT_LIMIT
        if pause is self._reading_paused or self._transport.is_closing():
            return
        self._reading_paused = pause
        if pause:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def _answer_some(self, until: float) -> bool:
        """Take whole requests out of the buffer and write their answers at once; return whether there may be more."""
        answers = b""
        position = 0
        last = self.requests + REQUESTS_AT_ONCE
        more = False
        try:
            while self._wait is None and not more and position < len(self._buffer):
                frame = requests.next_frame(self._buffer, position)
                if frame is None or (self._rate is not None and self._too_fast(self._rate)):
                    break
                position = frame.end
                answers += self._answer(frame)
                self.last_request = monotonic()
                more = self.requests >= last or len(answers) >= OUTPUT_CHUNK or self.last_request >= until
        except requests.MalformedFrameError as error:
            if answers:  # they are sent first, and the next call comes here again
                more = True
            else:
                self._refusals.note("malformed_frame", self.peer, str(error))
                position = len(self._buffer)
                self._transport.close()
        del self._buffer[:position]
        if answers:
            self._transport.write(answers)
        return more and bool(self._buffer)

    def _too_fast(self, limit: RateLimit) -> bool:
        """Return whether the next request comes too early; then it is served, and the client read from, later."""
        wait_s = limit.take()
        if wait_s:
            self._refusals.note("rate_limited", self.peer, f"more than {limit.rate:g} requests/s: read from later")
            self._held = self._loop.call_later(wait_s, self._release)
        return wait_s > 0.0

    def _release(self) -> None:
        self._held = None
        self._serve()

    def _answer(self, frame: requests.Frame) -> bytes:
        """Carry a request out; return its answer, or nothing when it waits or is to be ignored."""
        self.requests += 1
        if frame.unit not in self._settings.unit_ids:
            refusal = self._refuse(frame, "unknown_unit", f"unit id {frame.unit} is not served", requests.NO_SUCH_UNIT)
            return b"" if self._settings.unknown_unit == "silence" else refusal
        try:
            outcome = self._handle(frame.pdu)
        except RefusedAccessError as error:
            kind = "access_refused" if isinstance(error, ForbiddenWriteError) else _KINDS[error.exception_code]
            return self._refuse(frame, kind, f"function {frame.pdu[0]}: {error}", error.exception_code)
        except Exception as error:  # noqa: BLE001 - whatever goes wrong in here, the client gets an answer
            return self._failure(frame, error)
        if isinstance(outcome, requests.Written):
            self.written_as.update([block.writer for block in outcome.blocks])
            return self._answer_written(frame, outcome, iter(outcome.blocks))
        return requests.framed(frame.transaction, frame.unit, outcome)

    def _answer_written(self, frame: requests.Frame, written: requests.Written, blocks: Iterator[Block]) -> bytes:
        """Report the written blocks to the program; return the answer, or nothing if the program delays it."""
        try:
            for block in blocks:
                waiting = self._on_write(block, self.caller)
                if waiting is not None:
                    self._wait = asyncio.ensure_future(waiting)
                    self._wait.add_done_callback(partial(self._go_on, frame, written, blocks))
                    return b""
        except Exception as error:  # noqa: BLE001 - whatever the program does wrong, the client gets an answer
            return self._failure(frame, error)
        return requests.framed(frame.transaction, frame.unit, written.answer())

    def _go_on(
        self, frame: requests.Frame, written: requests.Written, blocks: Iterator[Block], wait: asyncio.Future[None]
    ) -> None:
        self._wait = None
        error = asyncio.CancelledError("wait cancelled") if wait.cancelled() else wait.exception()
        if self._transport.is_closing():
            return
        answer = self._answer_written(frame, written, blocks) if error is None else self._failure(frame, error)
        if answer:
            self.last_request = monotonic()
            self._transport.write(answer)
        self._serve()

    def _failure(self, frame: requests.Frame, error: BaseException) -> bytes:
        return self._refuse(frame, "server_failure", f"function {frame.pdu[0]}: {error!r}", requests.SERVER_FAILURE)

    def _refuse(self, frame: requests.Frame, kind: str, reason: str, exception_code: int) -> bytes:
        """Count and log a refusal; return the answer to the request."""
        self._refusals.note(kind, self.peer, reason)
        return requests.framed(frame.transaction, frame.unit, bytes((frame.pdu[0] | 0x80, exception_code)))

    def _check_idle(self) -> None:
        now = monotonic()
        if not self.idle:
            self.last_request = now
        remaining = self.last_request + self._settings.idle_timeout_s - now
        if remaining > 0:
            self._idle_timer = self._loop.call_later(remaining, self._check_idle)
            return
        self._refusals.note("idle_timeout", self.peer, f"no complete request for {self._settings.idle_timeout_s:g} s")
        self._transport.abort()


ROLE_EXTENSION: Final = "1.3.6.1.4.1.50316.802.1"
UTF8_STRING: Final = 0x0C
"""Tag of a UTF8String in DER."""
MAX_LENGTH: Final = 127
"""Longest role, in bytes: what DER says the length of in one byte."""


def caller_at(host: str, name: str, access: AccessSettings) -> Caller | None:
    """Return the caller at an address, or None if the address is not allowed."""
    address = ip_address(host)
    address = getattr(address, "ipv4_mapped", None) or address  # an IPv4 client of a dual-stack socket
    places = {Role.CONTROL: access.control, Role.OPTIMIZER: access.optimizer, Role.OPERATOR: access.operator}
    roles = frozenset(role for role, networks in places.items() if any(address in network for network in networks))
    return Caller(name, roles) if roles or any(address in network for network in access.readers) else None


def caller_with(certificate: bytes, name: str) -> Caller:
    """Return the caller with a verified certificate (DER)."""
    from cryptography import x509  # noqa: PLC0415 a service without TLS starts without it

    odd = (x509.DuplicateExtension, x509.UnsupportedGeneralNameType, x509.InvalidVersion)
    subject = role = ""
    with contextlib.suppress(x509.ExtensionNotFound, ValueError, *odd):  # OpenSSL takes some that cannot be read here
        parsed = x509.load_der_x509_certificate(certificate)
        subject = parsed.subject.rfc4514_string()
        extension = parsed.extensions.get_extension_for_oid(x509.ObjectIdentifier(ROLE_EXTENSION)).value
        role = decoded_role(extension.public_bytes())
    known = {each.value: each for each in Role}
    described = " ".join(f"{key}={json.dumps(text)}" for key, text in (("certificate", subject), ("role", role)))
    return Caller(f"{name} {described}", frozenset({known[role]} if role in known else ()))


def encoded_role(text: str) -> bytes:
    """Return a role as the extension's DER."""
    raw = text.encode()
    if len(raw) > MAX_LENGTH:
        raise ValueError(f"a role of more than {MAX_LENGTH} bytes")
    return bytes((UTF8_STRING, len(raw))) + raw


def decoded_role(der: bytes) -> str:
    """Return the role in an extension's DER, empty when it is not one."""
    if len(der) < 2 or der[0] != UTF8_STRING or der[1] > MAX_LENGTH or der[1] != len(der) - 2:
        return ""
    return der[2:].decode(errors="replace")
