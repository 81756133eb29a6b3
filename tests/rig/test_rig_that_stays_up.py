"""`coldloop up`, `down`, `status`, `set` and `run --attach`: a rig that stays up, and what is done with it."""

import asyncio
import json
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from coldloop.errors import RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.control_plc import Operator, OperatorMode
from coldloop_chaos.proxy import LinkProxies
from coldloop_rig import cli
from coldloop_rig.live.started_rigs import running_rig, state_folder
from coldloop_rig.live.up import CUT_FILES, CuttableLinks
from tests.conftest import Coldloop
from tests.harness.processes import Processes
from tests.harness.records import CONTROL_MAP
from tests.harness.waiting import PATIENCE_S, eventually

pytestmark = pytest.mark.usefixtures("realtime", "undrawn")

FACTOR = "5"


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory, shared_processes: Processes) -> Iterator[str]:
    """The first port of a rig that is up."""
    os.environ["XDG_RUNTIME_DIR"] = str(tmp_path_factory.mktemp("runtime"))
    base = str(shared_processes.three_ports())
    words = (
        "up",
        "--port-base",
        base,
        "--load",
        "e",
        "--factor",
        FACTOR,
        "--set",
        "plant.sensors.level=0.01",
        "--set",
        f"control_plc.power_up_s={PATIENCE_S:g}",
        "--cuttable",
    )
    try:
        assert shared_processes.coldloop(*words, "--detach").popen.wait(PATIENCE_S) == 0
        yield base
        assert cli.main(["down", "--port-base", base]) == 0
        assert running_rig(int(base)) is None
    finally:
        del os.environ["XDG_RUNTIME_DIR"]


def shown(coldloop: Coldloop, base: str) -> dict[str, str]:
    """What `coldloop status` shows, by its first words."""

    def answered() -> str:  # on a busy machine it may answer too slowly
        outcome = coldloop("status", "--port-base", base)
        return "" if outcome.code or "\nabsent" in outcome.out else str(outcome.out)

    return dict(line.split(maxsplit=1) for line in eventually(answered, "a status").splitlines())


def until(coldloop: Coldloop, base: str, row: str, part: str) -> None:
    eventually(lambda: part in shown(coldloop, base)[row], f"{row} is {part}")


def until_plant_time_passes(coldloop: Coldloop, base: str) -> None:
    before = shown(coldloop, base)["session"]
    eventually(lambda: shown(coldloop, base)["session"] != before, "plant time goes on")


def test_status_shows_session_mode_load_outputs_and_alarms(coldloop: Coldloop, up: str) -> None:
    rows = shown(coldloop, up)
    assert set(rows) == {"session", "mode", "operator", "load", "L1", "T5", "tau_u", "alarms"}
    assert f"{FACTOR} x real time" in rows["session"]
    assert rows["L1"].endswith("%")


def test_commands_find_the_one_rig_that_is_up(coldloop: Coldloop, up: str) -> None:
    for words in (("status",), ("events",), ("events", "--service", "plant"), ("set", "resume")):
        outcome = coldloop(*words)
        assert outcome.code == 0, outcome.complaints
        assert outcome.out.split()[0] == coldloop(*words, "--port-base", up).out.split()[0]


def test_a_rig_that_is_started_has_lost_nothing(coldloop: Coldloop, up: str) -> None:
    """Its parts are powered up one after the other.

    On a busy machine a scan may be late, and the plant be lost later.
    """
    outcome = coldloop("events", f"127.0.0.1:{int(up) + 1}")
    assert outcome.code == 0, outcome.complaints
    start, found, _ = outcome.out.partition("plant link: synchronised")
    assert found
    assert "alarm raised: plant" not in start


def test_each_command_says_what_came_back(coldloop: Coldloop, up: str) -> None:
    def told(*words: str) -> str:
        outcome = coldloop("set", "--port-base", up, *words)
        assert outcome.code == 0, outcome.complaints
        return str(outcome.out)

    assert "(was " in told("load", "450")
    until(coldloop, up, "load", "450 W")
    eventually(lambda: "in manual (operator)" in told("mode", "manual"), "its effect, for which it does not wait long")
    assert "setpoint of CV155 45 %" in told("setpoint", "cv155", "45")
    assert "operator's mode auto" in told("mode", "auto")
    assert "paused" in told("pause")
    stood = shown(coldloop, up)["session"]
    assert shown(coldloop, up)["session"] == stood
    assert "factor 5" in told("resume")
    assert "acknowledged" in told("acknowledge")


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("setpoint", "cv155", "80"), "20 to 60"),
        (("setpoint", "cv155", "45"), "take over in manual first"),
        (("acknowledge", "everything"), "unknown alarm"),
    ],
)
def test_what_cannot_be_done_is_one_line(coldloop: Coldloop, up: str, words: tuple[str, ...], part: str) -> None:
    outcome = coldloop("set", "--port-base", up, *words)
    assert outcome.code == 2
    assert len(outcome.complaints) == 1
    assert part in outcome.complaints[0]


@pytest.mark.parametrize("mode", list(OperatorMode))
def test_a_setpoint_beyond_the_bounds_is_refused_by_the_control_plc_itself(up: str, mode: OperatorMode) -> None:
    async def write() -> None:
        control = RegisterClient(CONTROL_MAP, host="127.0.0.1", port=int(up) + 1, timeout_s=PATIENCE_S)
        before = await control.read(Operator)
        with pytest.raises(RequestRefusedError) as refusal:
            await control.write(Operator(mode, (80.0, *before.u[1:])))
        assert refusal.value.exception_code == 3
        assert (await control.read(Operator)).mode == before.mode
        control.close()

    asyncio.run(write())


def let_the_load_be(coldloop: Coldloop, base: str, watts: int) -> None:
    """Write a load, and wait until it is the present one and no other is to come."""
    assert coldloop("set", "--port-base", base, "load", str(watts)).code == 0
    eventually(lambda: shown(coldloop, base)["load"] == f"{watts} W", f"{watts} W and no other load")


def test_a_load_file_begins_now(coldloop: Coldloop, up: str, tmp_path: Path) -> None:
    let_the_load_be(coldloop, up, 385)
    file = tmp_path / "load.csv"
    file.write_text("time_s,load_w\n" + "".join(f"{second},{400 + second % 2}\n" for second in range(3000)))
    outcome = coldloop("set", "--port-base", up, "load", str(file), "--at", "90000")
    assert outcome.code == 0, outcome.complaints
    assert "load of 3000 steps from 90000 s to 92999 s" in outcome.out
    assert "400 W from 90000 s" in shown(coldloop, up)["load"]
    let_the_load_be(coldloop, up, 385)


def test_a_load_that_begins_later_is_told_as_it_was_written(coldloop: Coldloop, up: str) -> None:
    let_the_load_be(coldloop, up, 385)
    assert coldloop("set", "--port-base", up, "load", "444", "--at", "80000").out.startswith(
        "load 444 W from 80000 s on ("
    )
    outcome = coldloop("set", "--port-base", up, "load", "400", "--at", "90000.25")
    assert outcome.out.startswith("load 400 W from 90000.2 s on, before it 444 W from 80000 s on (was ")
    let_the_load_be(coldloop, up, 385)
    outcome = coldloop("set", "--port-base", up, "load", "400", "--at", "0.25")
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert "plant time is" in outcome.complaints[0]


@pytest.mark.parametrize("time", ["-1", "0.1", "nan", "9" * 5000, str(2**32)])
def test_a_time_that_no_session_has_is_one_line(coldloop: Coldloop, time: str) -> None:
    outcome = coldloop("set", "load", "400", "--at", time)
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert "not a number of seconds" in outcome.complaints[0]


def test_a_session_under_way_is_recorded_from_now_on(coldloop: Coldloop, up: str, tmp_path: Path) -> None:
    until(coldloop, up, "mode", "mpc")
    session = shown(coldloop, up)["session"].split(",")[0]
    out = tmp_path / "session"
    outcome = coldloop("record", "--port-base", up, "--duration", "30s", "--out", str(out))
    assert outcome.code == 0, outcome.complaints
    assert shown(coldloop, up)["session"].split(",")[0] == session, "nobody has begun another one"
    manifest, summary = (json.loads((out / name).read_text()) for name in ("manifest.json", "summary.json"))
    assert (manifest["way"], manifest["complete"], summary["ticks"]) == ("recorded", True, 120)
    trace = pq.read_table(out / "trace.parquet").to_pydict()
    assert trace["mode"][0] is not None, "what drove before the first tick is known"
    assert summary["missing_ticks"] == 0
    updates = pq.read_table(out / "updates.parquet").to_pydict()
    assert updates["tick"]
    assert 0 <= min(updates["tick"]) <= max(updates["tick"]) < 120
    again = coldloop("rerun", str(out))
    assert (again.code, len(again.complaints)) == (2, 1)
    assert "cannot be repeated" in again.complaints[0]


def test_a_fault_of_a_sensor_is_put_in_and_taken_out(coldloop: Coldloop, up: str) -> None:
    for words, shown_as in (("dead", "not a number"), ("11.5", "value"), ("none", "none")):
        outcome = coldloop("fault", "--port-base", up, "sensor", "T5", words)
        assert (outcome.code, outcome.out) == (0, f"sensor of T5: {shown_as}\n"), outcome.complaints


@pytest.mark.parametrize(("link", "alarm"), [("plant", "plant lost"), ("optimizer", "optimizer lost")])
def test_a_link_is_cut_for_a_while_and_the_rig_finds_back(coldloop: Coldloop, up: str, link: str, alarm: str) -> None:
    until(coldloop, up, "mode", "mpc")
    assert coldloop("set", "--port-base", up, "acknowledge").code == 0
    outcome = coldloop("fault", "--port-base", up, "cut", link, "6")
    assert outcome.out == f"the {link} link is cut for 6 s\n", outcome
    until(coldloop, up, "alarms", alarm)
    log = state_folder(int(up)) / "up.log"
    eventually(lambda: f"the {link} link is restored" in log.read_text(), "the link is restored")
    until(coldloop, up, "mode", "mpc")


@pytest.mark.parametrize(
    "text", ["", "[]", '["plant", NaN]', '["plant", 1e9]', '["pipe", 1]', "[" * 9000, f'["plant", 1{"0" * 400}]']
)
def test_a_cut_that_makes_no_sense_is_taken_away(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async def looked() -> None:
        proxies = LinkProxies("up")
        links = CuttableLinks(tmp_path, proxies)
        file = tmp_path / CUT_FILES.replace("*", "1")
        file.write_text(text)
        keeping = asyncio.create_task(links.keep())
        while file.exists():  # noqa: ASYNC110 it is a file
            await asyncio.sleep(0)
        assert not keeping.done()
        keeping.cancel()
        await proxies.close()

    asyncio.run(looked())
    assert capsys.readouterr().err.count("\n") == 1


def test_two_cuts_at_once_are_both_made(coldloop: Coldloop, up: str, processes: Processes) -> None:
    until(coldloop, up, "mode", "mpc")
    log = state_folder(int(up)) / "up.log"
    links = ("plant", "optimizer")

    def cuts() -> list[int]:
        return [log.read_text().count(f"the {link} link is cut") for link in links]

    before = cuts()
    asked = [processes.coldloop("fault", "--port-base", up, "cut", link, "1") for link in links]
    assert [each.popen.wait(PATIENCE_S) for each in asked] == [0, 0]
    eventually(lambda: cuts() == [1 + count for count in before], "both are cut")


def test_a_second_rig_on_the_same_ports_is_refused_and_the_holder_named(coldloop: Coldloop, up: str) -> None:
    outcome = coldloop("up", "--port-base", up)
    assert outcome.code == 2
    assert "a rig is up here" in outcome.complaints[0]
    assert "coldloop down" in outcome.complaints[0]


def test_a_port_of_another_program_is_named(coldloop: Coldloop, processes: Processes) -> None:
    base = processes.three_ports()
    with socket.socket() as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", base + 1))
        other.listen()
        outcome = coldloop("up", "--port-base", str(base))
    assert outcome.code == 2
    assert f"port {base + 1} of the control_plc" in outcome.complaints[0]


def attach(up: str) -> tuple[str, ...]:
    return ("run", "--attach", *(f"127.0.0.1:{int(up) + place}" for place in range(3)))


def test_the_manifest_of_an_attached_run_says_what_the_rig_runs(coldloop: Coldloop, up: str, tmp_path: Path) -> None:
    asked = ("--load", "e", "--duration", "30s", "--figures", "png", "--seed", "7", "--updating-period", "2.5")
    outcome = coldloop(*attach(up), *asked, "--out", tmp_path / "run")
    assert outcome.code == 0, outcome.complaints
    configuration = json.loads((tmp_path / "run" / "manifest.json").read_text())["configuration"]
    assert configuration["plant.sensors.level"] == 0.01, "of the rig, not of this command"
    assert (configuration["plant.seed"], configuration["optimizer_plc.program.updating_period_s"]) == (7, 2.5)
    until(coldloop, up, "session", f"{FACTOR} x real time")  # it runs on
    until_plant_time_passes(coldloop, up)
    again = coldloop("rerun", tmp_path / "run" / "manifest.json")
    assert again.code == 0, again.out


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("--solver", "osqp"), "--solver: the rig runs optimizer_plc.program.solver = ode"),
        (("--set", "plant.sensors.level=5"), "the rig runs plant.sensors.level = 0.01"),
        (("--set", "plant.sensors={level=5}"), "the rig runs plant.sensors.level = 0.01"),
        (("--set", "limits.high=[50,100,50]"), "the rig runs limits.high = [60.0, 150.0, 60.0]"),
        (("--set", "plant.server.port=1"), "has its own plant.server.port"),
    ],
)
def test_what_attach_cannot_set_is_refused(
    coldloop: Coldloop, up: str, words: tuple[str, ...], part: str, results: Path
) -> None:
    outcome = coldloop(*attach(up), "--load", "e", "--duration", "30s", *words, "--out", results)
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert part in outcome.complaints[0]
    assert not results.exists()


def test_what_a_rig_runs_may_be_named_again(coldloop: Coldloop, up: str, results: Path) -> None:
    same = ("--solver", "ode", "--set", "plant.sensors.level=0.01")
    run = (*attach(up), "--load", "e", "--duration", "5s", "--figures", "png", *same, "--out", results)
    assert coldloop(*run).code == 0


@pytest.mark.parametrize("service", ["optimizer_plc", "plant", "control_plc"])
def test_a_service_that_is_killed_is_started_again_and_the_session_goes_on(
    coldloop: Coldloop, up: str, service: str
) -> None:
    session = shown(coldloop, up)["session"].partition(",")[0]
    rig = running_rig(int(up))
    assert rig is not None
    log = state_folder(int(up)) / "up.log"
    before = log.read_text().count("started again")
    assert coldloop("fault", "--port-base", up, "kill", service).code == 0
    eventually(lambda: log.read_text().count("started again") > before, "it is started again")
    eventually(lambda: not coldloop("status", "--port-base", up).code, "it answers")
    assert f"the {service} service was ended by SIGKILL" in log.read_text().splitlines()[-1]
    assert " of 5)" in log.read_text().splitlines()[-1]
    until(coldloop, up, "mode", "mpc")
    assert shown(coldloop, up)["session"].partition(",")[0] == session
    now = running_rig(int(up))
    assert now is not None
    assert now._replace(services=rig.services) == rig
    assert [each for each in rig.services if now.services[each] != rig.services[each]] == [service]


def test_a_control_plc_that_comes_back_before_its_rack_can_be_reached_keeps_its_session(
    coldloop: Coldloop, up: str
) -> None:
    """It shows no session until it has found the rack in the one that it has retained: nobody begins another one."""
    until(coldloop, up, "mode", "mpc")
    session = shown(coldloop, up)["session"].partition(",")[0]
    log = state_folder(int(up)) / "up.log"
    restarts, whole = (log.read_text().count(words) for words in ("started again", "link is restored"))
    assert coldloop("fault", "--port-base", up, "cut", "plant", "15").code == 0
    assert coldloop("fault", "--port-base", up, "kill", "control_plc").code == 0
    eventually(lambda: log.read_text().count("started again") > restarts, "it is started again")
    eventually(lambda: log.read_text().count("link is restored") > whole, "the link is restored")
    eventually(lambda: not coldloop("status", "--port-base", up).code, "it answers")
    until(coldloop, up, "mode", "mpc")
    assert shown(coldloop, up)["session"].partition(",")[0] == session
    assert "had no state to resume" not in log.read_text()


def test_a_paused_session_goes_on_when_its_control_plc_was_started_again(coldloop: Coldloop, up: str) -> None:
    until(coldloop, up, "mode", "mpc")
    session = shown(coldloop, up)["session"].partition(",")[0]
    assert coldloop("set", "--port-base", up, "pause").code == 0
    assert coldloop("fault", "--port-base", up, "kill", "control_plc").code == 0

    def resumed() -> bool:
        outcome = coldloop("set", "--port-base", up, "resume")
        assert outcome.code == 0 or len(outcome.complaints) == 1, outcome
        return outcome.code == 0

    eventually(resumed, "it can be resumed")
    until(coldloop, up, "session", f"{FACTOR} x real time")
    until(coldloop, up, "mode", "mpc")
    until_plant_time_passes(coldloop, up)
    assert shown(coldloop, up)["session"].partition(",")[0] == session


def test_a_service_that_stands_still_runs_again_when_the_terminal_is_closed(
    coldloop: Coldloop, up: str, processes: Processes
) -> None:
    rig = running_rig(int(up))
    assert rig is not None
    state = Path(f"/proc/{rig.services['optimizer_plc'].pid}/stat")
    freezing = processes.coldloop("fault", "--port-base", up, "pause", "optimizer_plc", "3600")
    eventually(lambda: state.read_text().rpartition(")")[2].split()[0] == "T", "it is stopped")
    assert freezing.interrupt(signal.SIGHUP) == 130
    assert state.read_text().rpartition(")")[2].split()[0] != "T"
    until(coldloop, up, "mode", "mpc")


def test_ctrl_c_gives_an_attached_rig_back_too(
    coldloop: Coldloop, up: str, tmp_path: Path, processes: Processes
) -> None:
    run = processes.coldloop(*attach(up), "--load", "e", "--duration", "100h", "--out", tmp_path / "run")
    until(coldloop, up, "session", "lock-step")
    until_plant_time_passes(coldloop, up)
    assert run.interrupt() == 130
    until(coldloop, up, "session", f"{FACTOR} x real time")
