"""Who may look, who may operate, and what becomes of those who may not: refused, and audited."""

import asyncio
import contextlib
import io
import json
import logging
from collections.abc import Callable
from http import HTTPStatus
from http.client import HTTPConnection
from pathlib import Path

import aiohttp
import pytest
from aiohttp import web
from aiohttp.http_exceptions import BadStatusLine
from aiohttp.test_utils import make_mocked_request

from coldloop.errors import ConfigurationError, UsageError
from coldloop.modbus.settings import Endpoint, TlsSettings
from coldloop.process.cold_box import COLD_BOX
from coldloop_hmi.guard import (
    REQUEST_BURST,
    REQUESTS_A_BROWSER,
    Connections,
    Guard,
    host_of,
    is_own_origin,
    port_of,
    told_in_a_line,
)
from coldloop_hmi.page_server import PageServer, PageSite
from coldloop_hmi.process_image import Model
from coldloop_hmi.settings import HmiSection, LoginSettings
from coldloop_hmi.users import (
    LOGIN_BURST,
    LOGINS_A_MINUTE,
    PASSWORD_BURST,
    Audit,
    ClientLimit,
    LoginLimit,
    LoginSessions,
    PageRole,
    User,
    Users,
    hash_password,
    write_user,
)
from coldloop_rig.cosim.wiring import RigEndpoints
from coldloop_rig.live.up import pointed_at
from tests.hmi.conftest import OPERATOR, VIEWER, Clock, Site

WHOLE_HASH = hash_password("a long password")
LOAD = {"kind": "load", "watts": 400.0}


def refusals(site: Site, what: str, who: str, part: str) -> list[dict[str, str]]:
    """Return what the audit has of refusals; what is repeated has one entry."""
    return [
        entry
        for entry in site.audited()
        if (entry["what"], entry["who"], entry["outcome"]) == (what, who, "refused") and part in entry["detail"]
    ]


def test_everybody_may_look_and_nobody_may_operate_without_a_login(site: Site) -> None:
    assert site.ask("/api/state").status == 200
    answer = site.ask("/api/commands", LOAD)
    assert answer.status == 401
    assert refusals(site, "command", "", "not logged in")


def test_a_wrong_password_is_refused_and_audited_without_the_password(site: Site) -> None:
    answer = site.ask("/api/login", {"user": OPERATOR[0], "password": "wrong"})
    assert answer.status == 401
    assert answer.document == {"error": "wrong name or password"}
    assert "Set-Cookie" not in answer.headers
    assert refusals(site, "login", OPERATOR[0], "wrong name or password")
    assert "password': 'wrong" not in str(site.audited())


def test_who_may_only_look_is_refused(site: Site) -> None:
    cookie = site.log_in(VIEWER)
    answer = site.ask("/api/commands", LOAD, cookie=cookie)
    assert answer.status == 403
    assert "may view" in answer.document["error"]
    assert refusals(site, "command", VIEWER[0], "may only view")


@pytest.mark.parametrize("origin", ["http://evil.example", "null", ""])
def test_a_command_from_another_site_is_refused_and_audited(site: Site, origin: str) -> None:
    cookie = site.log_in()
    answer = site.ask("/api/commands", LOAD, cookie=cookie, origin=origin)
    assert answer.status == 403
    assert refusals(site, "request", OPERATOR[0], "another site")


def test_a_name_that_is_not_the_pages_own_is_refused(site: Site) -> None:
    assert site.ask("/api/state", headers={"Host": "rebound.example"}).status == 421


def test_a_session_that_was_ended_operates_no_more(site: Site) -> None:
    cookie = site.log_in()
    assert site.ask("/api/me", cookie=cookie).document["operates"]
    assert site.ask("/api/logout", {}, cookie=cookie).status == 200
    assert site.ask("/api/commands", LOAD, cookie=cookie).status == 401


def test_the_cookie_is_out_of_reach_of_scripts_and_other_sites(site: Site) -> None:
    answer = site.ask("/api/login", {"user": OPERATOR[0], "password": OPERATOR[1]})
    parts = {part.strip() for part in answer.headers["Set-Cookie"].split(";")}
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= parts


def test_scripts_come_from_the_page_alone(site: Site) -> None:
    policy = site.ask("/").headers["Content-Security-Policy"]
    assert "script-src 'self'" in policy
    assert "unsafe" not in policy
    assert "default-src 'none'" in policy


@pytest.mark.parametrize(
    ("body", "part"),
    [
        ({"kind": "load", "watts": -1.0}, "greater than or equal to 0"),
        ({"kind": "nonsense"}, "kind"),
        ({"kind": "load_file", "content": "time_s,load_w\n0,400\n0.3,400\n"}, "multiple of 0.25"),
        ({"kind": "load_file", "content": "time_s,load_w\n" + "9" * 200_000}, "write a number in each column"),
        ({"kind": "alarm", "alarm": 999, "action": 1}, "unknown alarm 999"),
        ({"kind": "sensor_fault", "output": "T99", "fault": 1}, "unknown output T99"),
        ({"kind": "setpoint", "input": "CV155", "value": 99.0}, "not from 20 to 60"),
        ({"kind": "setpoint", "input": "CV155", "value": 45.0}, "take over in manual first"),
        ([], "JSON object"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(site: Site, body: object, part: str) -> None:
    answer = site.ask("/api/commands", body, cookie=site.log_in())
    assert answer.status in {400, 422}
    assert part in answer.document["error"]
    assert "\n" not in answer.document["error"]


def test_a_confirmation_counts_once_and_only_from_who_asked(site: Site) -> None:
    cookie = site.log_in()
    token = site.ask("/api/commands", {"kind": "alarm", "alarm": 11, "action": 1}, cookie=cookie).document["token"]
    assert site.ask(f"/api/commands/{token}", {}, cookie=site.log_in(VIEWER)).status == 403
    assert site.ask(f"/api/commands/{token}", {}, cookie=cookie).status == 200
    assert site.ask(f"/api/commands/{token}", {}, cookie=cookie).status == 409
    assert refusals(site, "command", OPERATOR[0], "nothing to confirm")


@pytest.mark.parametrize(
    ("headers", "body", "status"),
    [
        ({"Host": "["}, "{}", 421),
        ({"Host": "evil@127.0.0.1"}, "{}", 421),
        ({"Host": "127.0.0.1/evil"}, "{}", 421),
        ({"Host": "127.0.0.1?"}, "{}", 421),
        ({"Host": ""}, "{}", 421),
        ({"Host": "\xff"}, "{}", 421),
        ({"Content-Type": "application/json; charset=none"}, "{}", 400),
        ({}, "[" * 4_000, 400),
        ({}, '{"user":' + "[" * 2_000 + "]" * 2_000 + "}", 400),
        ({}, "[" * 50_000, 413),
        ({"Content-Encoding": "gzip"}, "no gzip", 400),
        ({"Content-Encoding": "br"}, "{}", 400),
        ({"Transfer-Encoding": "chunked"}, "2\r\n{}\r\n0\r\n\r\n", 413),
        ({}, '{"user": "\\ud800", "password": "\\ud800"}', 401),
        ({"Cookie": "coldloop_session_default=\xff"}, '{"user": "lena", "password": "wrong"}', 401),
    ],
)
def test_requests_that_no_browser_sends_are_refused_like_others(
    site: Site, headers: dict[str, str], body: str, status: int
) -> None:
    with contextlib.closing(HTTPConnection("127.0.0.1", site.ports["hmi"], timeout=60)) as connection:
        connection.request("POST", "/api/login", body, {"Origin": site.address, **headers})
        with connection.getresponse() as answer:
            assert answer.status == status
            assert "error" in json.loads(answer.read())
    site.log_in()
    assert site.audited()[-1]["outcome"] == "done", "the audit can still be written and read"


def test_who_logs_in_again_leaves_no_session_behind(site: Site) -> None:
    earlier = site.log_in()
    body = {"user": OPERATOR[0], "password": OPERATOR[1]}
    assert site.ask("/api/login", body, cookie=earlier).status == 200
    assert not site.ask("/api/me", cookie=earlier).document["operates"]


async def test_two_pages_on_one_host_do_not_log_each_other_out(tmp_path: Path) -> None:
    write_user(tmp_path / "users", OPERATOR[0], PageRole.OPERATE, OPERATOR[1])
    section = HmiSection(port=0, login=LoginSettings(users=tmp_path / "users"))
    pages = [PageServer(section, PageSite(Model(COLD_BOX, Clock(), 300))) for _ in range(2)]
    async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as browser:  # keeps cookies of an IP
        for page in pages:
            await page.start()
        addresses = [page.address for page in pages]
        for address in addresses:
            body, origin = {"user": OPERATOR[0], "password": OPERATOR[1]}, {"Origin": address.rstrip("/")}
            async with browser.post(f"{address}api/login", json=body, headers=origin) as answer:
                assert answer.status == HTTPStatus.OK
        for address in addresses:
            async with browser.get(f"{address}api/me") as answer:
                assert (await answer.json())["user"] == OPERATOR[0], address
    for page in pages:
        await page.close()


# -- the parts, by themselves ------------------------------------------------------------------------------------------


def test_a_session_ends_when_nobody_uses_it_and_after_its_longest_time() -> None:
    clock = Clock()
    sessions = LoginSessions(clock, idle_s=100, longest_s=250)
    token = sessions.begin(User("anna", PageRole.OPERATE, ""))
    for clock.time in (90.0, 180.0, 240.0):
        assert sessions.find(token)
    clock.time = 260.0
    assert sessions.find(token) is None, "it has lasted longer than any may"
    token = sessions.begin(User("anna", PageRole.OPERATE, ""))
    clock.time += 90
    assert sessions.find(token, is_use=False), "what a page asks for by itself is no sign of life"
    clock.time += 20
    assert sessions.find(token) is None
    assert sessions.find("guessed") is None


@pytest.fixture
def guard() -> Guard:
    section = HmiSection(login=LoginSettings(anonymous_view=False))
    return Guard(section, Audit(None), Users(None), Connections(section.connections, Clock()))


def test_an_open_list_of_alarms_is_no_sign_of_life(guard: Guard) -> None:
    clock = Clock()
    guard.sessions = LoginSessions(clock, idle_s=100, longest_s=1000)
    cookie = {"Cookie": f"coldloop_session_default={guard.sessions.begin(User('anna', PageRole.OPERATE, ''))}"}
    clock.time = 90.0
    for path in ("/api/events", "/api/audit", "/run/1/api/trend"):
        assert guard.session(make_mocked_request("GET", path, cookie)), path
    clock.time = 110.0
    assert guard.session(make_mocked_request("GET", "/api/audit", cookie)) is None


@pytest.mark.parametrize("run", ["", "/run/2"])
def test_a_page_that_wants_a_login_can_be_opened_to_log_in(guard: Guard, run: str) -> None:
    async def status(path: str) -> int:
        async def answered(_request: web.Request) -> web.Response:
            return web.Response()

        return (await guard.middleware(make_mocked_request("GET", run + path, {"Host": "localhost"}), answered)).status

    for path in ("/", "/static/page.css", "/api/me", "/api/catalog"):
        assert asyncio.run(status(path)) == HTTPStatus.OK, path
    for path in ("/api/state", "/api/trend", "/api/stream", "/api/audit"):
        assert asyncio.run(status(path)) == HTTPStatus.UNAUTHORIZED, path


def test_as_many_browsers_as_are_served_may_draw_trends_from_one_address() -> None:
    clock = Clock()
    browsers = HmiSection().browsers
    limit = ClientLimit(clock, REQUESTS_A_BROWSER * browsers, REQUEST_BURST)
    for second in range(60):
        clock.time = float(second)
        assert all(limit.allows("proxy") for _ in range(2 * browsers))


def test_requests_of_one_address_are_limited_and_others_not() -> None:
    clock = Clock()
    limit = ClientLimit(clock, per_second=1.0, burst=3.0)
    assert [limit.allows("here") for _ in range(5)] == [True, True, True, False, False]
    assert limit.allows("elsewhere")
    clock.time = 2.0
    assert [limit.allows("here") for _ in range(3)] == [True, True, False]
    clock.time = 3600.0
    assert [limit.allows("here") for _ in range(4)] == [True, True, True, False], "no more than its capacity"


def logins(limit: LoginLimit, clock: Clock, wrong: Callable[[int], str]) -> list[bool]:
    """Whether anna gets in, once a second, beside two wrong attempts a second from her address."""
    found = []
    for second in range(15):
        for half in range(2):
            clock.time += 0.5
            limit.allows("proxy", wrong(2 * second + half))
        found.append(limit.allows("proxy", "anna"))
        if found[-1]:
            limit.succeeded("proxy", "anna")
    return found


def test_a_malformed_request_is_one_line_in_the_log() -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.addFilter(told_in_a_line)
    log = logging.Logger("aiohttp.server")  # noqa: LOG001 of this test alone
    log.addHandler(handler)
    for error in (BadStatusLine("GET / HTTP/9.9\n"), ValueError("ours")):
        log.error("Error handling request from %s", "127.0.0.1", exc_info=error)
    malformed, *ours = stream.getvalue().splitlines()
    assert malformed.startswith("Error handling request from 127.0.0.1: ")
    assert ours[-1] == "ValueError: ours"


@pytest.mark.parametrize("wrong", [lambda _: "scraper", lambda i: f"guess {i}"], ids=["one name", "many names"])
def test_wrong_passwords_of_others_at_an_address_keep_nobody_out(wrong: Callable[[int], str]) -> None:
    clock = Clock()
    assert all(logins(LoginLimit(clock), clock, wrong))


def test_who_has_logged_in_from_an_address_comes_first_there() -> None:
    limit = LoginLimit(Clock())
    assert limit.allows("proxy", "anna")
    limit.succeeded("proxy", "anna")
    checked = sum(limit.allows("proxy", f"guess {i}") for i in range(100))
    assert checked == PASSWORD_BURST, "the processor is not theirs"
    assert limit.allows("proxy", "anna")
    assert not limit.allows("proxy", "berta"), "who has not been there waits with the others"
    assert limit.allows("elsewhere", "berta")


def test_who_is_known_gives_others_at_the_address_no_further_tries() -> None:
    limit, checked = LoginLimit(Clock()), 0
    for i in range(100):
        assert limit.allows("proxy", "anna")
        limit.succeeded("proxy", "anna")
        checked += limit.allows("proxy", f"guess {i}")
    assert checked == PASSWORD_BURST


def test_a_try_that_the_address_refuses_does_not_count_against_the_name() -> None:
    clock = Clock()
    limit = LoginLimit(clock)
    for i in range(int(PASSWORD_BURST + LOGINS_A_MINUTE)):
        assert limit.allows("proxy", f"guess {i}") == (i < PASSWORD_BURST)
        assert i < PASSWORD_BURST or not limit.allows("proxy", "berta")
    clock.time = 1.0
    assert limit.allows("proxy", "berta")


def test_one_name_is_guessed_six_times_a_minute() -> None:
    clock = Clock()
    limit = LoginLimit(clock)
    tried = 0
    for tenth in range(600):
        clock.time = tenth / 10
        tried += limit.allows("here", "anna")
    assert LOGIN_BURST <= tried <= LOGIN_BURST + LOGINS_A_MINUTE


def test_own_origin_and_host() -> None:
    assert is_own_origin("http://127.0.0.1:8020", "127.0.0.1:8020")
    assert not is_own_origin(None, "127.0.0.1:8020")
    assert not is_own_origin("http://127.0.0.1:8021", "127.0.0.1:8020")
    assert [port_of(name) for name in ("localhost:8020", "[::1]:8020", "a.b", "a:b", "[")] == [8020, 8020, *[None] * 3]
    names = ("localhost:8020", "LocalHost", "[::1]:8020", "a.b", "[", "", "evil@localhost", "localhost/", "a b", "a:b")
    assert [host_of(name) for name in names] == ["localhost", "localhost", "::1", "a.b", "", "", "", "", "", ""]


def test_passwords_are_kept_as_hashes_in_a_file_of_their_owner(tmp_path: Path) -> None:
    file = tmp_path / "users"
    write_user(file, "anna", PageRole.VIEW, "a long password")
    write_user(file, "anna", PageRole.OPERATE, "another password")
    assert "password" not in file.read_text(encoding="utf-8")
    assert file.stat().st_mode & 0o777 == 0o600
    users = Users(file)
    assert len(users) == 1
    found = users.check("anna", "another password")
    assert found is not None
    assert found.role is PageRole.OPERATE
    assert users.check("anna", "a long password") is None
    assert users.check("nobody", "another password") is None


@pytest.mark.parametrize(
    "line",
    [
        "anna", "anna:operate", "anna:root:scrypt$1$1$a$b", "anna:view:plain",
        f"anna:view:{WHOLE_HASH[:-5]}", f"anna:view:{WHOLE_HASH.replace('$16384$', '$16383$')}",
        f"anna:view:{WHOLE_HASH.replace('$16384$', '$much$')}", f"anna:view:{WHOLE_HASH.replace('$8$', '$80000$')}",
        f"anna:view:{WHOLE_HASH.replace('$16384$', '$-1$')}", f"anna:view:{WHOLE_HASH.replace('$16384$', '$2$')}",
        f"anna:view:{WHOLE_HASH.replace('$16384$', '$1048576$')}", f"anna:view:{WHOLE_HASH.replace('$16384$', '$²$')}",
    ],
    ids=["name", "no hash", "no such role", "no hash but a word", "cut", "cost", "cost is a word", "block size",
         "negative", "cheap", "dear", "no digit"],
)  # fmt: skip
def test_a_line_that_is_no_user_is_named(tmp_path: Path, line: str) -> None:
    file = tmp_path / "users"
    file.write_text(f"# users\n{line}\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="users:2: not name:role:hash"):
        Users(file)


def test_a_file_that_everybody_may_write_to_makes_nobody_an_operator(tmp_path: Path) -> None:
    file = tmp_path / "users"
    write_user(file, "anna", PageRole.OPERATE, "a long password")
    for path, mode in ((file, 0o606), (file, 0o660), (tmp_path, 0o770)):
        before = path.stat().st_mode
        path.chmod(mode)
        with pytest.raises(ConfigurationError, match=rf"{path}: others can write to it; `chmod go-w {path}`"):
            Users(file)
        path.chmod(before)
    tmp_path.chmod(0o1777)  # as /tmp: others cannot take the file away
    assert len(Users(file)) == 1


def test_a_name_that_stands_twice_is_nobody(tmp_path: Path) -> None:
    file = tmp_path / "users"
    file.write_text(f"anna:view:{WHOLE_HASH}\nanna:operate:{WHOLE_HASH}\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="users:2: a second line of anna"):
        Users(file)


def test_a_name_or_a_password_that_cannot_be_is_refused(tmp_path: Path) -> None:
    for name, password in (("", "long enough"), ("a:b", "long enough"), ("#anna", "long enough"), ("anna", "short")):
        with pytest.raises(UsageError):
            write_user(tmp_path / "users", name, PageRole.VIEW, password)


def test_other_machines_are_served_with_https_or_on_purpose() -> None:
    with pytest.raises(ValueError, match=r"https\.certificate"):
        HmiSection(host="0.0.0.0")  # noqa: S104
    assert HmiSection(host="0.0.0.0", insecure=True).insecure  # noqa: S104
    assert HmiSection(host="::1").is_local


def test_a_page_reads_as_a_reader_and_commands_as_an_operator(tmp_path: Path) -> None:
    for name in ("operator.crt", "operator.key", "reader.crt", "reader.key", "ca.crt"):
        (tmp_path / name).touch()
    tls = TlsSettings(certificate=tmp_path / "operator.crt", key=tmp_path / "operator.key", ca=tmp_path / "ca.crt")
    ends = RigEndpoints(*(Endpoint(port=port, tls=tls) for port in (1, 2, 3)))
    section = pointed_at(HmiSection(), ends)
    assert section.operator_tls == tls
    assert section.control_plc.tls is not None
    assert section.control_plc.tls.certificate == tmp_path / "reader.crt"
    (tmp_path / "reader.key").unlink()
    assert pointed_at(HmiSection(), ends).plant.tls == tls, "where there is none, the operator's"
