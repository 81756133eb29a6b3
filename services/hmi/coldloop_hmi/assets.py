"""Files of the page, and answers that are compressed, or not sent again while they are the same."""

import gzip
import zlib
from functools import lru_cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import Final

from aiohttp import hdrs, web

STATIC: Final = Path(__file__).parent / "static"
JSON: Final = "application/json; charset=utf-8"
HTML: Final = "text/html; charset=utf-8"
WORTH_COMPRESSING: Final = 512
"""Bytes of an answer."""
FOR_A_YEAR: Final = "max-age=31536000, immutable"


def _digest(*parts: bytes) -> str:
    return blake2b(b"\0".join(parts), digest_size=8).hexdigest()


_FILES: Final = {path.relative_to(STATIC).as_posix(): path for path in sorted(STATIC.rglob("*")) if path.is_file()}
VERSION: Final = _digest(*(part for name, path in _FILES.items() for part in (name.encode(), path.read_bytes())))
"""Of all files, in their addresses: a browser keeps them, and asks for others when one has changed."""


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
