"""Who may look, who may operate, and what becomes of those who may not: refused, and audited."""

from pathlib import Path

import pytest

from coldloop.endpoints import Endpoint
from coldloop.errors import ConfigurationError, UsageError
from coldloop.modbus.settings import TlsSettings
from hmi.access import RateLimit, Sessions, host_of, is_own_origin
from hmi.settings import HmiSection
from hmi.users import PageRole, User, Users, write_user
from rig.page_process import pointed_at
from rig.rig_endpoints import RigEndpoints
from tests.hmi.conftest import OPERATOR, VIEWER, Site

LOAD = {"kind": "load", "watts": 400.0}


def test_everybody_may_look_and_nobody_may_operate_without_a_login(site: Site) -> None:
    assert site.ask("/api/state").status == 200
    answer = site.ask("/api/commands", LOAD)
    assert answer.status == 401
    assert site.audited()[-1]["outcome"] == "refused"


def test_a_wrong_password_is_refused_and_audited_without_the_password(site: Site) -> None:
    answer = site.ask("/api/login", {"user": OPERATOR[0], "password": "wrong"})
    assert answer.status == 401
    assert answer.document == {"error": "wrong name or password"}
    assert "Set-Cookie" not in answer.headers
    last = site.audited()[-1]
    assert (last["what"], last["who"], last["outcome"]) == ("login", OPERATOR[0], "refused")
    assert "password': 'wrong" not in str(last)


def test_who_may_only_look_is_refused(site: Site) -> None:
    cookie = site.log_in(VIEWER)
    answer = site.ask("/api/commands", LOAD, cookie=cookie)
    assert answer.status == 403
    assert "may look" in answer.document["error"]
    assert site.audited()[-1]["who"] == VIEWER[0]


@pytest.mark.parametrize("origin", ["http://evil.example", "null", ""])
def test_a_command_from_another_site_is_refused_and_audited(site: Site, origin: str) -> None:
    cookie = site.log_in()
    answer = site.ask("/api/commands", LOAD, cookie=cookie, origin=origin)
    assert answer.status == 403
    assert "another site" in site.audited()[-1]["detail"]


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
        ({"kind": "load", "watts": "400"}, "valid number"),
        ({"kind": "mode", "mode": "off"}, "'auto', 'classical' or 'manual'"),
        ({"kind": "nonsense"}, "kind"),
        ({"kind": "load_file", "content": "time_s,load_w\n0,400\n0.3,400\n"}, "multiple of 0.25"),
        ({"kind": "load_file", "content": "nothing"}, "row 1"),
        ({"kind": "alarm", "alarm": 999, "action": 1}, "no alarm 999"),
        ({"kind": "sensor_fault", "output": "T99", "fault": 1}, "no output T99"),
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


# -- the parts, by themselves ------------------------------------------------------------------------------------------


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.time = 0.0

    def __call__(self) -> float:
        return self.time


def test_a_session_ends_when_nobody_uses_it_and_after_its_longest_time() -> None:
    clock = Clock()
    sessions = Sessions(clock, idle_s=100, longest_s=250)
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


def test_requests_of_one_address_are_limited_and_others_not() -> None:
    clock = Clock()
    limit = RateLimit(clock, per_second=1.0, burst=3.0)
    assert [limit.allows("here") for _ in range(5)] == [True, True, True, False, False]
    assert limit.allows("elsewhere")
    clock.time = 2.0
    assert [limit.allows("here") for _ in range(3)] == [True, True, False]


def test_own_origin_and_host() -> None:
    assert is_own_origin("http://127.0.0.1:8020", "127.0.0.1:8020")
    assert not is_own_origin(None, "127.0.0.1:8020")
    assert not is_own_origin("http://127.0.0.1:8021", "127.0.0.1:8020")
    assert [host_of(name) for name in ("localhost:8020", "[::1]:8020", "a.b", "")] == ["localhost", "::1", "a.b", ""]


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


@pytest.mark.parametrize("line", ["anna", "anna:operate", "anna:root:scrypt$1$1$a$b", "anna:view:plain"])
def test_a_line_that_is_no_user_is_named(tmp_path: Path, line: str) -> None:
    file = tmp_path / "users"
    file.write_text(f"# users\n{line}\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match="users:2: not name:role:hash"):
        Users(file)


def test_a_name_or_a_password_that_cannot_be_is_refused(tmp_path: Path) -> None:
    for name, password in (("", "long enough"), ("a:b", "long enough"), ("anna", "short")):
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
