"""What who tries Coldloop for the first time types wrongly: the message names the cause."""

import socket
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.errors import UsageError
from coldloop_rig import Simulation, simulate
from coldloop_rig.live.started_rigs import check_ports

if TYPE_CHECKING:
    from tests.conftest import Coldloop, Outcome


def assert_refused(outcome: "Outcome", *parts: str, code: int = 2) -> None:
    assert (outcome.code, len(outcome.complaints)) == (code, 1), outcome.complaints
    for part in parts:
        assert part in outcome.complaints[0]


@pytest.fixture(scope="module")
def result() -> Simulation:
    return simulate(load="a", duration_s=5)


# -- Python ------------------------------------------------------------------------------------------------------------


def test_a_result_and_its_tables_show_themselves_in_a_line(result: Simulation) -> None:
    assert repr(result).startswith("Simulation(load='a', solver='ode', updating_period='adaptive', 20 ticks, trace ")
    for text in (repr(result), repr(result.trace), repr(result.events)):
        assert len(text.splitlines()) == 1
        assert len(text) < 1500
    assert "20 rows of tick, time_s" in repr(result.trace)


@pytest.mark.parametrize(("duration", "ticks"), [("10s", 40), ("0.5min", 120), (10, 40), (2.5, 10), ("5", 20)])
def test_a_duration_is_seconds_or_a_text(duration: float | str, ticks: int) -> None:
    assert simulate(load="e", duration_s=duration).summary["ticks"] == ticks


@pytest.mark.parametrize(
    "duration", ["soon", "0.1s", "-5s", "", 0.1, 0, -1, float("nan"), float("inf"), "9" * 400, "9" * 400 + "h"]
)
def test_a_duration_that_is_none_is_told(duration: float | str) -> None:
    with pytest.raises(UsageError, match="duration_s"):
        simulate(load="e", duration_s=duration)


# -- the command line --------------------------------------------------------------------------------------------------


def test_rerun_names_what_it_cannot_repeat(coldloop: "Coldloop", tmp_path: Path) -> None:
    assert_refused(coldloop("rerun", tmp_path / "absent"), str(tmp_path / "absent" / "manifest.json"))
    assert_refused(coldloop("rerun", tmp_path / "absent" / "manifest.json"), str(tmp_path / "absent"))
    (tmp_path / "summary.json").write_text("{}")
    assert_refused(coldloop("rerun", tmp_path / "summary.json"), "not the manifest.json of a run")
    deep = '{"format":' * 5000 + "1" + "}" * 5000
    for text in ("[]", "5", "null", "{", "[" * 5000, deep, "9" * 5000, "{}"):
        (tmp_path / "manifest.json").write_text(text)
        assert_refused(coldloop("rerun", tmp_path), str(tmp_path))


@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize("key", ["plant.load", "model.file", "plant.retain.file", "plant.refrigerator.file"])
def test_an_empty_setting_is_named(key: str, coldloop: "Coldloop") -> None:
    name = "COLDLOOP__" + key.upper().replace(".", "__")
    outcome = coldloop("run", "--in-process", "--duration", "5s", environment={name: ""})
    assert_refused(outcome, name, key)
    assert_refused(coldloop("run", "--in-process", "--duration", "5s", "--set", f"{key}="), f"--set {key}")


@pytest.mark.usefixtures("compiles")
def test_a_model_that_is_not_there_ends_with_an_error(coldloop: "Coldloop", tmp_path: Path) -> None:
    outcome = coldloop("model", "--set", f"model.file={tmp_path / 'absent.json'}")
    assert_refused(outcome, "absent.json: no such model file", code=1)
    own = tmp_path / "own.json"
    outcome = coldloop("model", "--out", own)
    assert (outcome.code, own.is_file()) == (0, True), outcome.complaints


def test_a_host_has_no_effect_on_the_list_of_revoked_certificates(coldloop: "Coldloop", tmp_path: Path) -> None:
    assert coldloop("certificates", "--out", tmp_path / "site").code == 0
    for words in (("--renew-list",), ("--revoke", "operator")):
        outcome = coldloop("certificates", "--out", tmp_path / "site", *words, "--host", "plc.example")
        assert_refused(outcome, "--host plc.example: has no effect", "another folder")
    assert coldloop("certificates", "--out", tmp_path / "site", "--renew-list").code == 0


def test_a_port_of_the_administrator_is_named_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket.socket, "bind", refused)
    with pytest.raises(UsageError, match="port 102 of the plant: Permission denied; give a --port-base from 1024 on"):
        check_ports((102, 103, 104))


def test_a_page_on_a_rig_has_a_user(
    coldloop: "Coldloop", tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_port: int
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    served = []

    async def serve(settings: object) -> None:
        served.append(settings.hmi)  # type: ignore[attr-defined]

    monkeypatch.setattr("coldloop_hmi.runtime.serve", serve)
    ends = [f"127.0.0.1:{port}" for port in (1, 2, 3)]
    outcome = coldloop("page", "--rig", *ends, "--page-port", str(free_port))
    assert outcome.code == 0, outcome.complaints
    assert "to operate     user operator, password " in outcome.out
    (section,) = served
    assert section.login.users == tmp_path / "coldloop" / f"page-{free_port}" / "page-users"
    assert section.login.users.read_text().startswith("operator")
    assert section.audit.parent == section.login.users.parent
    users = tmp_path / "users"
    users.write_text("")
    outcome = coldloop("page", "--rig", *ends, "--page-port", str(free_port), "--set", f"hmi.login.users={users}")
    assert "password" not in outcome.out
    assert served[-1].login.users == users
