"""Checks of every request (its connection, whose it is, where it comes from, how often), and what answers it.

Answers are files, compressed where it is worth it, one stream of changes for all browsers, and what long requests
compute, in turns.
"""

import asyncio
import gzip
import logging
import re
import time
import zlib
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import Final

from aiohttp import hdrs, web
from aiohttp.http_exceptions import HttpProcessingError

from coldloop.errors import printable
from coldloop_hmi.settings import HmiSection
from coldloop_hmi.users import Audit, ClientLimit, LoginLimit, LoginSession, LoginSessions, Party, User, Users

REQUESTS_A_BROWSER: Final = 3.0
"""In a second. Behind a proxy all browsers have one address, and each asks for two trends a second."""
REQUEST_BURST: Final = 150.0
REQUEST_S: Final = 10.0
"""A request that takes longer, because its client is slow to read the answer, keeps no place; a stream does."""
HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; frame-src 'self'; frame-ancestors 'self'; base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
LOCAL_NAMES: Final = frozenset({"localhost", "127.0.0.1", "::1"})
_HOST: Final = re.compile(r"(?:\[(?P<v6>[0-9a-fA-F:.]+)\]|(?P<name>[A-Za-z0-9._-]+))(?::(?P<port>[0-9]{1,5}))?")
"""A Host header: a name or an address, and nothing before or after it but a port."""
SAFE: Final = frozenset({hdrs.METH_GET, hdrs.METH_HEAD})
BY_ITSELF: Final = frozenset(
    {"/api/stream", "/api/trend", "/api/events", "/api/audit", "/api/me", "/api/explanation", "/api/replay"}
)
"""Requests that a page sends without its user's action: they are no sign of life of the user."""
OPEN: Final = frozenset({"/", "/healthz", "/metrics", "/api/catalog", "/api/login", "/api/me", "/favicon.ico"})
"""Paths that are served without a login; `/metrics` checks it itself."""
FILES: Final = frozenset({"/", "/api/catalog", "/favicon.ico"})
UNLIMITED: Final = frozenset({"/api/login", "/healthz"})
"""Attempts to log in have a limit of their own; the health check costs no more than a refusal."""
STREAM: Final = "/api/stream"
LARGEST_OF_STRANGERS: Final = 4096
"""Bytes of a request without a login: a name and a password, or a replay position."""
BODY_S: Final = 5.0
"""Within this time a request is here as a whole."""
PASSWORDS_AT_ONCE: Final = 2
"""Passwords that are checked at a time: each takes a core and 16 MB."""
_RUN: Final = re.compile(r"\A/run/\d+/")


@dataclass
class Use:
    """Use of a connection."""

    since: float
    """Time at which its last request began or ended; without one, when it was seen first. Monotonic clock, s."""
    is_busy: bool = False
    is_stream: bool = False
    has_session: bool = False
    """Its last request had a login."""

    def rank(self, now: float) -> int | None:
        """Return how soon it gives way, 0 first; None keeps its place."""
        if self.is_busy and (self.is_stream or now - self.since < REQUEST_S):
            return None
        return 2 * self.has_session + self.is_busy


@dataclass
class Connections:
    """Connections of one server, at most so many.

    A newcomer takes the place of a connection that only waits: strangers' first, and of these one from the address
    that has most of them. So idle connections or incomplete requests lock out no user.
    """

    most: int
    """Connections at a time."""
    now: Callable[[], float]
    """Monotonic clock, s."""
    _uses: dict[web.RequestHandler, Use] = field(default_factory=dict, init=False)
    """In the order of their arrival."""

    def newcomer(self, server: web.Server) -> asyncio.Protocol:
        """Return what serves a new connection of the server: its handler, or a refusal where none gives way."""
        now = self.now()
        connected = [one for one in server.connections if one.transport is not None]
        self._uses = {one: self._uses.get(one) or Use(now) for one in connected}
        if len(connected) < self.most:
            return server()
        addresses = {one: str(one.peername[0]) if isinstance(one.peername, tuple) else "" for one in self._uses}
        crowd = Counter(addresses.values())
        ranks = {one: rank for one, use in self._uses.items() if (rank := use.rank(now)) is not None}
        if not ranks:
            return _Refused()
        first = min(ranks, key=lambda one: (ranks[one], -crowd[addresses[one]], self._uses[one].since))
        if first.transport is not None:
            first.transport.abort()  # do not wait for unread data
        first.force_close()
        return server()

    @contextmanager
    def serving(self, request: web.Request, *, is_stream: bool, has_session: bool) -> Iterator[None]:
        """Keep the place of a connection while its request, received as a whole, is answered."""
        use = self._uses.setdefault(request.protocol, Use(self.now()))
        use.since, use.is_busy, use.is_stream, use.has_session = self.now(), True, is_stream, has_session
        try:
            yield
        finally:
            use.since, use.is_busy = self.now(), False


class _Refused(asyncio.Protocol):
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if isinstance(transport, asyncio.WriteTransport):
            transport.abort()


def told_in_a_line(record: logging.LogRecord) -> bool:
    """Take the traceback off what aiohttp logs of a malformed request (a filter of its logger)."""
    error = record.exc_info[1] if record.exc_info else None
    if isinstance(error, HttpProcessingError):
        record.msg, record.exc_info = f"{record.getMessage()}: {error.message.splitlines()[0]}", None
        record.args = ()
    return True


Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def refusal(status: int, message: str) -> web.Response:
    """Return a refusal, one line of JSON."""
    return web.json_response({"error": message}, status=status)


def host_header(request: web.Request) -> str:
    """Return what a request calls the page; empty without a name (`request.host` then asks the name service)."""
    return request.headers.get(hdrs.HOST, "")


def cookie_name(request: web.Request) -> str:
    """Return the name of a session's cookie: browsers send cookies to all ports of a host, so it names the port."""
    return f"coldloop_session_{port_of(host_header(request)) or 'default'}"


def path_in_site(request: web.Request) -> str:
    """Return what is asked for of one rig or run, without the number of the run among several."""
    return _RUN.sub("/", request.path, count=1)


def host_of(header: str) -> str:
    """Return the name in a Host header, without its port; empty when it is not one."""
    found = _HOST.fullmatch(header)
    return (found["v6"] or found["name"]).lower() if found else ""


def port_of(header: str) -> int | None:
    """Return the port in a Host header; None when there is none."""
    found = _HOST.fullmatch(header)
    return int(found["port"]) if found and found["port"] else None


def is_own_origin(origin: str | None, host: str) -> bool:
    """Return whether a request that changes something comes from the page itself: `Origin` names the address asked for.

    A request without `Origin` is not: browsers send it with every POST. A proxy in front may add HTTPS.
    """
    return origin in {f"http://{host}", f"https://{host}"}


class Guard:
    """Judges requests before anything is done."""

    def __init__(self, settings: HmiSection, audit: Audit, users: Users, connections: Connections) -> None:
        self._settings = settings
        self._audit = audit
        self._users = users
        self._connections = connections
        self._checking = asyncio.Semaphore(PASSWORDS_AT_ONCE)
        login = settings.login
        self.sessions = LoginSessions(time.monotonic, login.idle_minutes * 60, login.longest_minutes * 60)
        self.logins = LoginLimit(time.monotonic)
        self.scrapes = LoginLimit(time.monotonic)
        """Limit of the logins at `/metrics`: a scraper with an old password keeps nobody from logging in."""
        self._requests = ClientLimit(time.monotonic, REQUESTS_A_BROWSER * settings.browsers, REQUEST_BURST)
        self._files = ClientLimit(time.monotonic, REQUESTS_A_BROWSER * settings.browsers, REQUEST_BURST)
        self._hosts = LOCAL_NAMES | {settings.host, *map(str.lower, settings.allowed_hosts)}

    def session(self, request: web.Request) -> LoginSession | None:
        """Return the session of a request."""
        return self.sessions.find(
            request.cookies.get(cookie_name(request)), is_use=path_in_site(request) not in BY_ITSELF
        )

    def who(self, request: web.Request) -> str:
        """Return the user of a request; empty without a login."""
        session = self.sessions.find(request.cookies.get(cookie_name(request)), is_use=False)
        return session.user.name if session else ""

    def party(self, request: web.Request) -> Party:
        """Return who shares bounds with a request: its user, or strangers of its address."""
        who = self.who(request)
        return Party(who, has_session=True) if who else Party(request.remote or "", has_session=False)

    async def log_in(self, name: str, password: str, address: str, limit: LoginLimit) -> User:
        """Return the user with this password; a refusal takes as long.

        Raises:
            HTTPTooManyRequests, HTTPUnauthorized: Too many attempts; a wrong name or password.
        """
        refuse = partial(self._audit.refuse, "login", who=name[:40], address=address, has_session=False)
        if not limit.allows(address, name):
            refuse(reason="too many attempts")
            raise web.HTTPTooManyRequests(reason="too many attempts to log in: wait a minute")
        async with self._checking:
            user = await asyncio.to_thread(self._users.check, name, password)
        if user is None:
            refuse(reason="wrong name or password")
            raise web.HTTPUnauthorized(reason="wrong name or password")
        limit.succeeded(address, name)
        return user

    def _noted(self, request: web.Request, error: web.HTTPException, reason: str = "") -> web.HTTPException:
        """Return the refusal of a request, which the audit has by now."""
        who = self.who(request)
        self._audit.refuse(
            "request", who=who, address=request.remote or "", reason=reason or error.reason,
            detail=f"{request.method} {request.path} of {host_header(request)}", has_session=bool(who),
        )  # fmt: skip
        return error

    def _judge(self, request: web.Request) -> None:
        """Raise the refusal of a request that is not allowed."""
        path, host = path_in_site(request), host_header(request)
        is_file = path in FILES or path.startswith("/static/")
        limit = self._files if is_file else self._requests
        if path not in UNLIMITED and not limit.allows(self.party(request)):
            raise self._noted(request, web.HTTPTooManyRequests(reason="too many requests: wait a little"))
        if host_of(host) not in self._hosts:
            reason = f"host '{printable(host)}' is not allowed: add it to hmi.allowed_hosts"
            raise self._noted(request, web.HTTPMisdirectedRequest(reason=reason), "host name not allowed")
        if request.method not in SAFE and not is_own_origin(request.headers.get(hdrs.ORIGIN), host):
            reason = "commands are accepted from the page itself only, not from another site"
            raise self._noted(request, web.HTTPForbidden(reason=reason))
        is_open = path in OPEN or is_file
        if not is_open and not self._settings.login.anonymous_view and self.session(request) is None:
            raise web.HTTPUnauthorized(reason="log in first")

    async def _receive(self, request: web.Request) -> None:
        """Wait for the rest of a request; raise its refusal if it is not to be had."""
        length, most = request.content_length, LARGEST_OF_STRANGERS
        if not self.who(request) and request.can_read_body and (length is None or length > most):
            reason = f"a request has at most {most} bytes, and says how many: log in first"
            raise web.HTTPRequestEntityTooLarge(most, length or 0, reason=reason)
        try:
            async with asyncio.timeout(BODY_S):
                await request.read()
        except TimeoutError:
            raise web.HTTPRequestTimeout(reason=f"the request was not complete within {BODY_S:g} s") from None
        except web.RequestPayloadError:
            raise web.HTTPBadRequest(reason="the request is malformed") from None

    @web.middleware
    async def middleware(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Judge a request, answer it, and put the headers on the answer."""
        answer: web.StreamResponse
        try:
            self._judge(request)
            await self._receive(request)
            is_stream, has_session = path_in_site(request) == STREAM, bool(self.who(request))
            with self._connections.serving(request, is_stream=is_stream, has_session=has_session):
                answer = await handler(request)
        except web.HTTPException as error:
            answer = refusal(error.status, error.reason)
        if not answer.prepared:
            add_headers(answer)
        return answer


def add_headers(answer: web.StreamResponse) -> None:
    """Put the headers of every answer on it."""
    answer.headers.update(HEADERS)
    answer.headers.setdefault(hdrs.CACHE_CONTROL, "no-store")


STATIC: Final = Path(__file__).parent / "static"
JSON: Final = "application/json; charset=utf-8"
HTML: Final = "text/html; charset=utf-8"
WORTH_COMPRESSING: Final = 512
"""Bytes of an answer."""
FOR_A_YEAR: Final = "max-age=31536000, immutable"
_FILES: Final = {path.relative_to(STATIC).as_posix(): path for path in sorted(STATIC.rglob("*")) if path.is_file()}
WAITING: Final = 16
"""Messages that wait for one browser."""
MOST_WAITING: Final = 128


def _digest(*parts: bytes) -> str:
    return blake2b(b"\0".join(parts), digest_size=8).hexdigest()


VERSION: Final = _digest(*(part for name, path in _FILES.items() for part in (name.encode(), path.read_bytes())))
"""Digest of all files, in their addresses: a browser keeps them, and asks for others when one has changed."""


def static_files() -> list[web.RouteDef]:
    """Return a route for each file of the page, with and without the version: no other name is ever looked for."""
    kinds = (f"/static/{VERSION}", FOR_A_YEAR), ("/static", "no-cache")
    return [
        web.get(f"{folder}/{name}", partial(_file, path, caching))
        for folder, caching in kinds
        for name, path in _FILES.items()
    ]


async def _file(path: Path, caching: str, request: web.Request) -> web.StreamResponse:
    answer = web.FileResponse(path, headers={hdrs.CACHE_CONTROL: caching})
    if hdrs.IF_NONE_MATCH not in request.headers:  # otherwise the answer may have no body to compress
        answer.enable_compression()
    return answer


def html_file(name: str) -> web.RouteDef:
    """Return the route of a page, whose files have their version."""
    body = _FILES[name].read_text(encoding="utf-8").replace('"static/', f'"static/{VERSION}/').encode()

    async def page(request: web.Request) -> web.Response:
        return kept_answer(request, body, HTML)

    return web.get("/", page)


def kept_answer(request: web.Request, body: bytes, content_type: str) -> web.Response:
    """Return an answer that a browser keeps: asked for again, it is sent again only if it has changed."""
    tag = f'W/"{_digest(body)}"'
    if tag in request.headers.get(hdrs.IF_NONE_MATCH, ""):
        answer = web.Response(status=304)
    else:
        answer = compressed_answer(request, body, content_type)
    answer.headers.update({hdrs.CACHE_CONTROL: "no-cache", hdrs.ETAG: tag, hdrs.VARY: hdrs.ACCEPT_ENCODING})
    return answer


def compressed_answer(request: web.Request, body: bytes, content_type: str = JSON) -> web.Response:
    """Return an answer, compressed where this is worth it and the client can read it."""
    headers = {hdrs.CONTENT_TYPE: content_type}
    if len(body) >= WORTH_COMPRESSING and takes_gzip(request):
        body, headers[hdrs.CONTENT_ENCODING] = _compressed(body), "gzip"
    return web.Response(body=body, headers=headers)


def takes_gzip(request: web.Request) -> bool:
    """Return whether a client can read compressed answers."""
    return "gzip" in request.headers.get(hdrs.ACCEPT_ENCODING, "").lower()


@lru_cache(32)  # browsers that ask for the same share one answer
def _compressed(body: bytes) -> bytes:
    return gzip.compress(body, 6, mtime=0)


def stream_compression() -> Callable[[bytes], bytes]:
    """Return what compresses the messages of a stream with those before, in 160 kB; each waits for no later one."""
    stream = zlib.compressobj(wbits=16 + 15, memLevel=6)
    return lambda message: stream.compress(message) + stream.flush(zlib.Z_SYNC_FLUSH)


class Stream(asyncio.Queue[bytes | None]):
    """Messages to one browser of a party, None at their end."""

    def __init__(self, party: Party) -> None:
        super().__init__(WAITING)
        self.party = party
        self.is_behind = False
        """It has missed messages: it needs the whole state next."""

    def offer(self, message: bytes) -> None:
        """Add a message; a browser that is too slow loses all that wait."""
        if self.full():
            self.clear()
            self.is_behind = True
        else:
            self.put_nowait(message)

    def clear(self) -> None:
        """Drop what waits."""
        while not self.empty():
            self.get_nowait()


class Broadcast:
    """Fans messages out to `most` streams; `whole` returns the whole state as a message, for a browser that begins.

    When there are so many, a user who has logged in takes the place of a stranger, and within either group a party
    takes the place of one that has at least two more.
    """

    def __init__(self, whole: Callable[[], bytes], most: int) -> None:
        self._whole = whole
        self._most = most
        self._streams: dict[Stream, None] = {}  # the oldest first

    def __len__(self) -> int:
        return len(self._streams)

    def send(self, message: bytes) -> None:
        """Send a message to all browsers; those that are behind get the whole state in its place."""
        whole: bytes | None = None
        for stream in self._streams:
            if stream.is_behind:
                whole = whole or self._whole()
                stream.is_behind = False
                stream.offer(whole)
            else:
                stream.offer(message)

    def begin(self, party: Party) -> Stream | None:
        """Begin a stream with the whole state; return None where there is no room for it."""
        if len(self._streams) >= self._most:
            loser = self._giving_way(party)
            if loser is None:
                return None
            del self._streams[loser]
            loser.clear()
            loser.put_nowait(None)
        stream = Stream(party)
        stream.offer(self._whole())
        self._streams[stream] = None
        return stream

    def _giving_way(self, party: Party) -> Stream | None:
        """Return the stream that gives way to a newcomer: the oldest one of the party that has most."""
        group = [stream for stream in self._streams if stream.party.has_session == party.has_session]
        least = Counter(stream.party for stream in group)[party] + 2
        strangers = [stream for stream in self._streams if not stream.party.has_session]
        if party.has_session and strangers:
            group, least = strangers, 1
        counts = Counter(stream.party for stream in group)
        if not counts:
            return None
        largest, count = counts.most_common(1)[0]
        return next(stream for stream in group if stream.party == largest) if count >= least else None

    async def messages(self, stream: Stream) -> AsyncIterator[bytes]:
        """Yield the whole state, and then what changes, until the stream ends."""
        try:
            while (message := await stream.get()) is not None:
                yield message
        finally:
            self._streams.pop(stream, None)


@dataclass
class _Queue:
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    waiting: int = 0
    free_from: float = 0.0


@dataclass
class LongReads:
    """Turns of requests that compute for long; who has logged in does not wait for strangers.

    After a turn the event loop is free for as long as it took, before the next one of the same queue.
    """

    now: Callable[[], float]
    """Monotonic clock, s."""
    _queues: dict[bool, _Queue] = field(default_factory=lambda: {False: _Queue(), True: _Queue()}, init=False)

    @asynccontextmanager
    async def turn(self, *, has_session: bool) -> AsyncIterator[None]:
        """Wait for a turn; it ends with the context (HTTPServiceUnavailable: too many wait already)."""
        queue = self._queues[has_session]
        if queue.waiting >= MOST_WAITING:
            raise web.HTTPServiceUnavailable(reason="too many requests for trends and tables: wait a little")
        queue.waiting += 1
        try:
            async with queue.turn:
                await asyncio.sleep(queue.free_from - self.now())
                begun = self.now()
                yield
                queue.free_from = 2 * self.now() - begun
        finally:
            queue.waiting -= 1
