"""What a browser is sent once, what it is sent compressed, and what it keeps."""

import asyncio
import gzip
import json
import re
import zlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import aiohttp

from coldloop.process.cold_box import COLD_BOX
from coldloop_hmi.page_server import PageServer, PageSite
from coldloop_hmi.process_image import Model
from coldloop_hmi.settings import HmiSection
from tests.hmi.conftest import Clock

PLAIN, GZIP = {"Accept-Encoding": "identity"}, {"Accept-Encoding": "gzip, br"}


@asynccontextmanager
async def served() -> AsyncIterator[aiohttp.ClientSession]:
    """Yield a client of a page of its own that decompresses nothing."""
    page = PageServer(HmiSection(port=0), PageSite(Model(COLD_BOX, Clock(), 7200)))
    await page.start()
    async with aiohttp.ClientSession(page.address, auto_decompress=False) as client:
        yield client
    await page.close()


async def test_what_a_browser_has_is_not_sent_again() -> None:
    async with served() as client:
        async with client.get("/", headers=PLAIN) as answer:
            addresses = re.findall(r'"(static/[^"]+)"', await answer.text())
        assert len(addresses) == 5
        for address in addresses:
            async with client.get(f"/{address}") as answer:
                assert (answer.status, answer.headers["Cache-Control"]) == (200, "max-age=31536000, immutable")
        async with client.get("/static/0123456789abcdef/js/page.js") as answer:
            assert answer.status == 404, "files of another version"
        async with client.get("/static/js/page.js") as answer:
            assert answer.headers["Cache-Control"] == "no-cache", "without its version it may change"
        for path in ("/", "/api/catalog"):
            async with client.get(path, headers=GZIP) as answer:
                first, tag = await answer.read(), answer.headers["ETag"]
            for sent, expected in ((tag, (304, b"")), ('W/"0"', (200, first))):
                async with client.get(path, headers={**GZIP, "If-None-Match": sent}) as answer:
                    assert (answer.status, await answer.read()) == expected
                    assert (answer.headers["ETag"], answer.headers["Cache-Control"]) == (tag, "no-cache")


async def test_answers_are_compressed_for_those_who_ask() -> None:
    async with served() as client:
        for path, is_worth_it in {"/": True, "/api/state": True, "/metrics": True, "/api/alarms": False}.items():
            async with client.get(path, headers=PLAIN) as answer:
                plain = await answer.read()
                assert "Content-Encoding" not in answer.headers
            async with client.get(path, headers=GZIP) as answer:
                found = await answer.read()
                assert answer.headers.get("Content-Encoding") == ("gzip" if is_worth_it else None)
            assert (gzip.decompress(found) if is_worth_it else found)[:80] == plain[:80]
            assert len(found) < 0.7 * len(plain) or not is_worth_it


async def test_a_compressed_message_waits_for_no_later_one() -> None:
    async with served() as client, client.get("/api/stream", headers=GZIP) as answer, asyncio.timeout(10):
        reader, text = zlib.decompressobj(wbits=31), b""
        while not text.endswith(b"\n\n"):  # nothing changes, and no further message is sent
            text += reader.decompress(await answer.content.readany())
    assert json.loads(text.removeprefix(b"data: "))["whole"]
