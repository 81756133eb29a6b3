"""Answers of the page: files, compression, one stream of changes for all browsers, and turns of long requests."""

import asyncio
import gzip
import zlib
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import Final

from aiohttp import hdrs, web

from coldloop_hmi.users import Party

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


class StreamCompression:
    """Compresses messages one by one with what was sent before, the last message at least: 160 kB for each stream."""

    def __init__(self) -> None:
        self._stream = zlib.compressobj(wbits=16 + 15, memLevel=6)

    def message(self, message: bytes) -> bytes:
        """Return a message as it is sent: complete, so that it waits for no later one."""
        return self._stream.compress(message) + self._stream.flush(zlib.Z_SYNC_FLUSH)


class Stream:
    """Messages to one browser.

    Args:
        party: Whose browser it is.
    """

    def __init__(self, party: Party) -> None:
        self.party = party
        self._messages: asyncio.Queue[bytes | None] = asyncio.Queue(WAITING)
        self.is_behind = True
        """It has missed messages: it needs the whole state next."""

    def offer(self, message: bytes) -> None:
        """Add a message; a browser that is too slow loses all that wait."""
        try:
            self._messages.put_nowait(message)
        except asyncio.QueueFull:
            self._drop()
            self.is_behind = True

    def end(self) -> None:
        """End it: nothing follows."""
        self._drop()
        self._messages.put_nowait(None)

    def _drop(self) -> None:
        while not self._messages.empty():
            self._messages.get_nowait()

    async def next(self) -> bytes | None:
        """Return the next message; None at its end."""
        return await self._messages.get()


class Broadcast:
    """Fans messages out.

    Args:
        whole: Returns the whole state as a message, for a browser that begins.
        most: Streams at a time. When there are so many, a user who has logged in takes the place of a stranger, and
            within either group a party takes the place of one that has at least two more.
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
            loser.end()
        stream = Stream(party)
        stream.is_behind = False
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
            while (message := await stream.next()) is not None:
                yield message
        finally:
            self._streams.pop(stream, None)


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
