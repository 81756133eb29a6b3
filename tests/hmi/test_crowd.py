"""A page that everybody reaches: crowds and junk keep no operator out, and the audit keeps who did what."""

import contextlib
import json
import socket
from collections.abc import Callable, Iterator
from http import HTTPStatus
from itertools import pairwise
from pathlib import Path

import aiohttp
import pytest

from coldloop.process.cold_box import COLD_BOX
from coldloop.registers.control_plc import ProcessNow
from coldloop_hmi.page_server import PENS, ROWS_AT_ONCE, PageServer, PageSite
from coldloop_hmi.process_image import Model
from coldloop_hmi.settings import HmiSection
from coldloop_hmi.users import KEPT, LARGEST_FILE, MOST_KINDS, OLDER_FILES, REPEATS_S, Audit
from tests.harness.waiting import eventually
from tests.hmi.conftest import OPERATOR, Clock, Site

BROWSERS = 4
CONNECTIONS = 24
ACKNOWLEDGE = {"kind": "alarm", "alarm": 11, "action": 1}


@pytest.fixture(scope="module")
def small_site(start_site: Callable[..., Site]) -> Site:
    """A site with room for few, so that few are a crowd."""
    return start_site(browsers=BROWSERS, connections=CONNECTIONS)


@contextlib.contextmanager
def crowd(site: Site, count: int, *texts: str) -> Iterator[list[socket.socket]]:
    """Hold connections on which each of the texts was sent, in turn, and nothing was read."""
    with contextlib.ExitStack() as held:
        sockets = []
        for number in range(count):
            one = held.enter_context(socket.create_connection(("127.0.0.1", site.ports["hmi"]), 20))
            text = texts[number % len(texts)].replace("HOST", f"Host: 127.0.0.1:{site.ports['hmi']}")
            with contextlib.suppress(ConnectionError):  # it has given way already
                one.sendall(text.encode())
            sockets.append(one)
        yield sockets


def is_operated(site: Site, cookie: str) -> bool:
    """Tell whether an operator's command is carried out and can be read in the audit."""
    prepared = site.ask("/api/commands", ACKNOWLEDGE, cookie=cookie)
    assert prepared.status == HTTPStatus.OK, prepared.document
    assert site.ask(f"/api/commands/{prepared.document['token']}", {}, cookie=cookie).status == HTTPStatus.OK
    entries = site.ask("/api/audit", cookie=cookie).document["entries"]
    done = [entry for entry in entries if entry["what"] == "command" and entry["outcome"] == "done"]
    return bool(done) and done[0]["who"] == OPERATOR[0]


IDLE = ""
HALF_A_HEAD = "POST /api/login HTTP/1.1\r\nHOST\r\nContent-Le"
HALF_A_BODY = "POST /api/login HTTP/1.1\r\nHOST\r\nOrigin: http://127.0.0.1\r\nContent-Length: 9\r\n\r\n{"
KEPT_ALIVE = "GET /healthz HTTP/1.1\r\nHOST\r\n\r\n"
ALWAYS = "GET /api/stream HTTP/1.1\r\nHOST\r\n\r\n"
NO_HTTP = "\x16\x03\x01\x02\x00 nothing of the kind\r\n\r\n"


@pytest.mark.parametrize(
    "texts",
    [
        (IDLE, HALF_A_HEAD, HALF_A_BODY, KEPT_ALIVE, ALWAYS, NO_HTTP),
        *(pytest.param((one,), marks=pytest.mark.night) for one in (IDLE, HALF_A_HEAD, HALF_A_BODY, KEPT_ALIVE)),
    ],
)
def test_a_crowd_keeps_nobody_out(small_site: Site, texts: tuple[str, ...]) -> None:
    with crowd(small_site, 3 * CONNECTIONS, *texts):
        eventually(small_site.is_live, "/healthz")
        assert small_site.ask("/").status == HTTPStatus.OK
        cookie = small_site.log_in()
        with crowd(small_site, 3 * CONNECTIONS, *texts):
            assert is_operated(small_site, cookie)


def open_stream(site: Site, cookie: str = "") -> socket.socket:
    one = socket.create_connection(("127.0.0.1", site.ports["hmi"]), 20)
    head = ALWAYS.replace("HOST", f"Host: 127.0.0.1:{site.ports['hmi']}" + (f"\r\nCookie: {cookie}" if cookie else ""))
    one.sendall(head.encode())
    return one


def test_streams_of_strangers_leave_room_for_an_operators(small_site: Site) -> None:
    cookie = small_site.log_in()
    eventually(
        lambda: "coldloop_page_browsers 0" in small_site.ask("/metrics").document, "streams of others have ended"
    )
    with contextlib.ExitStack() as held:
        strangers = [held.enter_context(open_stream(small_site)) for _ in range(5 * BROWSERS)]
        statuses = [one.recv(12)[-3:] for one in strangers]
        assert statuses.count(b"503") == 4 * BROWSERS
        own = held.enter_context(open_stream(small_site, cookie))
        assert own.recv(12).endswith(b"200")
        assert is_operated(small_site, cookie)


def test_junk_neither_fills_the_audit_nor_keeps_an_operator_from_work(small_site: Site) -> None:
    cookie = small_site.log_in()
    assert is_operated(small_site, cookie)
    evil = "GET /{} HTTP/1.1\r\nHost: evil{}.example\r\n\r\n"
    before, sent = len(small_site.audited()), 0

    def strangers_are_refused() -> bool:
        """Send junk, ten pieces on a connection, and look as a stranger; a slow machine takes several times."""
        nonlocal sent
        for number in range(60):
            with crowd(small_site, 1, "".join(evil.format(number, n) for n in range(10))) as (one,):
                assert one.recv(12).endswith((b"421", b"429"))
        sent += 600
        return small_site.ask("/api/state").status == HTTPStatus.TOO_MANY_REQUESTS

    eventually(strangers_are_refused, "strangers of this address are refused")
    assert is_operated(small_site, cookie)
    assert is_operated(small_site, small_site.log_in())
    added = small_site.audited()[before:]
    refused = [entry for entry in added if entry["outcome"] == "refused"]
    assert len(refused) <= 2 * sent / 600, "one that the name is wrong, one that there are too many"
    assert [entry["what"] for entry in added if entry["outcome"] == "done"] == ["command", "login", "command"]
    eventually(lambda: small_site.ask("/api/state").status == HTTPStatus.OK, "strangers are served again")


# -- the parts, by themselves ------------------------------------------------------------------------------------------


def test_refusals_that_are_alike_are_one_entry_and_a_count() -> None:
    clock = Clock()
    audit = Audit(None, clock)
    for number in range(1000):
        audit.refuse("request", who="", address="10.0.0.9", reason="a name", detail=f"GET /{number}", has_session=False)
    audit.note("command", who="anna", address="10.0.0.1", outcome="done", detail="heat load 400 W")
    assert sorted(entry["detail"] for entry in audit.entries) == ["GET /0: a name", "heat load 400 W"]
    clock.time = REPEATS_S
    audit.note("logout", who="anna", address="10.0.0.1", outcome="done")
    assert {entry["detail"].partition(" since")[0] for entry in audit.entries[2:]} == {"a name: 1000 times", ""}
    audit.refuse("request", who="", address="10.0.0.9", reason="a name", detail="GET /x", has_session=False)
    assert "GET /x: a name" in {entry["detail"] for entry in audit.entries}, "another minute, another entry"


def test_refusals_of_strangers_push_nothing_of_users_out_of_the_audit() -> None:
    clock = Clock()
    audit = Audit(None, clock)
    audit.note("command", who="anna", address="10.0.0.1", outcome="done", detail="heat load 400 W")
    for clock.time in range(0, 20 * 60, 60):
        for address in range(1000):
            audit.refuse("request", who="", address=f"10.1.{address}", reason="a name", has_session=False)
    assert audit.entries[0]["who"] == "anna"
    assert len(audit.entries) < KEPT
    last = [entry for entry in audit.entries if entry["utc"] == audit.entries[-1]["utc"]]
    assert len(last) <= 2 * MOST_KINDS + 2, "from however many addresses they come"


def test_a_full_audit_is_set_aside_and_a_few_are_kept(tmp_path: Path) -> None:
    file = tmp_path / "audit.jsonl"
    audit = Audit(file)
    text = "x" * (LARGEST_FILE // 4)
    count = 4 * (OLDER_FILES + 3) + 1
    for number in range(count):
        audit.note("command", who="anna", address="", outcome="done", detail=f"{number} {text}")
    kept = [file, *(tmp_path / f"audit.jsonl.{number}" for number in range(1, OLDER_FILES + 1))]
    assert sorted(tmp_path.iterdir()) == sorted(kept)
    assert all(one.stat().st_mode & 0o777 == 0o600 and one.stat().st_size < 1.5 * LARGEST_FILE for one in kept)
    numbers = [
        int(json.loads(line)["detail"].partition(" ")[0])
        for one in reversed(kept)
        for line in one.read_text(encoding="utf-8").splitlines()
    ]
    assert all(after == before + 1 for before, after in pairwise(numbers)), "none is lost between the files"
    assert numbers[-1] == count - 1


async def test_a_table_has_each_signal_once_and_all_its_rows() -> None:
    model = Model(COLD_BOX, Clock(), 7200)
    rows = 3 * ROWS_AT_ONCE + 1
    for tick in range(rows):
        model.trends.add(ProcessNow(tick, 400.0, (43.0, 75.0, 36.0), (1.5,) * 22), 1)
        model.put("control_plc", ProcessNow(tick, 400.0, (43.0, 75.0, 36.0), (1.5,) * 22))
    page = PageServer(HmiSection(port=0), PageSite(model))
    await page.start()
    async with aiohttp.ClientSession() as browser:
        names = ",".join(["L1", "T5"] * 800)
        async with browser.get(f"{page.address}api/trend.csv?seconds=7200&names={names}") as answer:
            lines = (await answer.text()).splitlines()
        too_many = ",".join(model.trends.names[: PENS + 9])
        async with browser.get(f"{page.address}api/trend?names={too_many}") as answer:
            assert answer.status == HTTPStatus.BAD_REQUEST
        for name in ("a" * 300, "%00", "..%2Fpage_server.py", "vendor"):
            async with browser.get(f"{page.address}static/{name}") as answer:
                assert answer.status == HTTPStatus.NOT_FOUND, name
    await page.close()
    assert lines[0] == "time_s,L1,T5,quality"
    assert [float(line.partition(",")[0]) for line in lines[1:]] == [tick * 0.25 for tick in range(rows)]
