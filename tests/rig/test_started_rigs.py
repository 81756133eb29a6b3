"""What is kept of rigs that are up: in a private folder, by processes that are still the same."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from coldloop.errors import UsageError
from coldloop_rig.cosim.wiring import RigEndpoints
from coldloop_rig.live.started_rigs import (
    LOCK_FILE,
    STATE_FILE,
    RunningRig,
    ServiceProcess,
    base_folder,
    identity_of,
    lock_rig,
    make_private,
    new_own,
    pause,
    read_own,
    rigs_up,
    running_rig,
    state_folder,
    write_own,
)
from tests.harness.processes import END_S

if TYPE_CHECKING:
    from tests.conftest import Coldloop
    from tests.harness.processes import Processes

FIRST, SECOND = 23020, 23120
COMMANDS = (("status",), ("events",), ("set", "pause"), ("page",), ("down",), ("fault", "kill", "plant"))
"""Commands to a rig that is up."""

Process = subprocess.Popen[bytes]


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's runtime folder."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


@pytest.fixture
def other() -> Iterator[Process]:
    """A program in a session of its own, as a rig would be."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, start_new_session=True) as process:
        yield process
        process.kill()


def keep(first_port: int, content: object) -> Path:
    """Write what is kept of a rig, or something else in its place."""
    make_private(base_folder())
    file = make_private(state_folder(first_port)) / STATE_FILE
    write_own(file, content if isinstance(content, str) else json.dumps(content))
    return file


def state_of(process: Process, first_port: int = FIRST, **changes: object) -> dict[str, object]:
    ports = (first_port, first_port + 1, first_port + 2)
    services = dict.fromkeys(RigEndpoints._fields, ServiceProcess.of(process.pid))
    return (
        RunningRig(process.pid, identity_of(process.pid) or "", ports, "", services, cuttable=False)._asdict() | changes
    )


# -- the process -------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("programs")
def test_down_ends_the_process_of_the_rig(coldloop: "Coldloop", other: Process) -> None:
    keep(FIRST, state_of(other))
    outcome = coldloop("down")
    assert (outcome.code, other.wait(END_S)) == (0, -signal.SIGTERM), outcome.complaints
    assert str(other.pid) in outcome.out


@pytest.mark.usefixtures("programs")
def test_down_never_ends_another_program_that_has_the_number(coldloop: "Coldloop", other: Process) -> None:
    keep(FIRST, state_of(other, identity="of a process before it"))
    for words in ((), ("--port-base", str(FIRST))):
        outcome = coldloop("down", *words)
        assert (outcome.code, len(outcome.complaints)) == (2, 1)
        assert "no rig" in outcome.complaints[0]
    assert other.poll() is None


@pytest.mark.usefixtures("programs")
def test_a_process_that_has_ended_and_was_not_waited_for_is_none(other: Process) -> None:
    keep(FIRST, state_of(other))
    assert [rig.pid for rig in rigs_up()] == [other.pid]
    other.kill()
    os.waitid(os.P_PID, other.pid, os.WEXITED | os.WNOWAIT)
    assert rigs_up() == []


ODD: list[Any] = [
    "", "{", "[]", "7", "[" * 50_000, "9" * 5000, "\0\0", "{}" + " " * 100_000,
    {"pid": -1}, {"pid": 0}, {"pid": 1}, {"pid": True}, {"pid": 2**31}, {"pid": 10**400}, {"pid": "12"}, {"pid": 1.5},
    {"pid": None}, {"ports": []}, {"ports": [1, 2]}, {"ports": [0, 1, 2]}, {"ports": [1, 2, 65536]}, {"ports": "abc"},
    {"ports": 5}, {"ports": [1, 2, "3"]}, {"tls": 5}, {"tls": "\0"}, {"identity": None}, {"identity": ["a"]},
    {"services": None}, {"services": {}}, {"services": {"plant": [1, "a"]}}, {"services": {"plant": [5]}},
    {"services": {service: [-1, "a"] for service in RigEndpoints._fields}},
]  # fmt: skip


@pytest.mark.usefixtures("programs")
def test_odd_content_is_one_line_and_ends_nothing(coldloop: "Coldloop", other: Process) -> None:
    for odd in ODD:
        file = keep(FIRST, odd if isinstance(odd, str) else state_of(other, **odd))
        for command in COMMANDS if odd == "{" else COMMANDS[-2:]:
            for words in ((), ("--port-base", str(FIRST))):
                outcome = coldloop(*command, *words)
                assert (outcome.code, len(outcome.complaints)) == (2, 1), (odd, outcome.complaints)
                assert str(file) in outcome.complaints[0]
                assert len(outcome.complaints[0]) < 500
        assert other.poll() is None, odd


@pytest.mark.usefixtures("programs")
def test_a_damaged_file_does_not_hide_a_rig_that_is_up(other: Process) -> None:
    keep(FIRST, "{")
    keep(SECOND, state_of(other, SECOND))
    assert [rig.ports[0] for rig in rigs_up()] == [SECOND]


# -- faults of its services --------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("programs")
def test_a_service_is_killed(coldloop: "Coldloop", other: Process) -> None:
    keep(FIRST, state_of(other))
    outcome = coldloop("fault", "kill", "control_plc")
    assert (outcome.code, other.wait(END_S)) == (0, -signal.SIGKILL), outcome.complaints
    again = coldloop("fault", "kill", "control_plc")
    assert (again.code, len(again.complaints)) == (2, 1)


@pytest.mark.usefixtures("programs")
def test_no_fault_is_put_into_another_program_that_has_the_number(coldloop: "Coldloop", other: Process) -> None:
    services = dict.fromkeys(RigEndpoints._fields, ServiceProcess(other.pid, "of a process before it"))
    keep(FIRST, state_of(other, services=services))
    for words in (("kill", "plant"), ("pause", "plant", "1")):
        outcome = coldloop("fault", *words)
        assert (outcome.code, len(outcome.complaints)) == (2, 1)
        assert "the plant service does not run" in outcome.complaints[0]
    assert other.poll() is None


@pytest.mark.usefixtures("programs")
async def test_a_service_that_was_frozen_runs_again_when_the_command_is_ended(other: Process) -> None:
    def until(what: int) -> None:
        deadline = time.monotonic() + 60
        while os.waitid(os.P_PID, other.pid, what | os.WNOHANG) is None:
            assert time.monotonic() < deadline
            time.sleep(0.005)

    task = asyncio.create_task(pause(ServiceProcess.of(other.pid), 600.0))
    await asyncio.to_thread(until, os.WSTOPPED)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    await asyncio.to_thread(until, os.WCONTINUED)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("pause", "plant", "0"), "not a number of seconds"), (("pause", "plant", "1e9"), "not a number of seconds"),
        (("sensor", "T99", "dead"), "unknown output 'T99'"), (("sensor", "T5", "broken"), "a sensor shows"),
        (("sensor", "T5", "nan"), "finite number"), (("sensor", "T5"), "required"), ((), "required"),
    ],
)  # fmt: skip
def test_a_fault_that_cannot_be_is_one_line(words: tuple[str, ...], part: str, coldloop: "Coldloop") -> None:
    outcome = coldloop("fault", *words)
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert part in outcome.complaints[0]


# -- which rig ---------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("programs")
def test_several_rigs_are_listed(coldloop: "Coldloop", other: Process) -> None:
    for first_port in (FIRST, SECOND):
        keep(first_port, state_of(other, first_port))
    for command in COMMANDS:
        outcome = coldloop(*command)
        assert (outcome.code, len(outcome.complaints)) == (2, 1)
        assert "2 rigs are up" in outcome.complaints[0]
        assert f"--port-base {FIRST} (process {other.pid})" in outcome.complaints[0]
        assert f"--port-base {SECOND}" in outcome.complaints[0]
    assert other.poll() is None


def test_without_a_rig_every_command_says_so(coldloop: "Coldloop", processes: "Processes") -> None:
    base = str(processes.three_ports())
    for command in COMMANDS:
        outcome = coldloop(*command, "--port-base", base)
        assert (outcome.code, len(outcome.complaints)) == (2, 1)
        assert "no rig" in outcome.complaints[0]
        assert "coldloop up" in outcome.complaints[0]


@pytest.mark.usefixtures("programs")
def test_every_command_takes_the_same_options(coldloop: "Coldloop", other: Process) -> None:
    keep(FIRST, state_of(other))
    for command in COMMANDS:
        outcome = coldloop(*command, "--rig", "a:1", "b:2", "c:3", "--port-base", str(FIRST))
        assert (outcome.code, len(outcome.complaints)) == (2, 1)
        assert "--rig and --port-base" in outcome.complaints[0]
    outcome = coldloop("down", "--rig", "elsewhere:23020", "elsewhere:23021", "elsewhere:23022")
    assert "on their own machine" in outcome.complaints[0]
    assert other.poll() is None
    keep(FIRST, state_of(other, identity="another"))
    assert "no rig" in coldloop("down", "--rig", *(f"127.0.0.1:{FIRST + place}" for place in range(3))).complaints[0]


# -- the folder --------------------------------------------------------------------------------------------------------


def test_the_folder_is_closed_to_others(runtime: Path) -> None:
    os.close(lock_rig(FIRST))
    for folder in (runtime / "coldloop", runtime / "coldloop" / str(FIRST)):
        assert folder.stat().st_mode & 0o777 == 0o700


def test_without_a_runtime_folder_of_ones_own_it_is_among_the_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in ("", "relative", str(tmp_path / "absent")):
        monkeypatch.setenv("XDG_RUNTIME_DIR", place)
        assert base_folder().name == f"coldloop-{os.getuid()}"


@pytest.mark.usefixtures("programs")
@pytest.mark.parametrize("which", ["coldloop", f"coldloop/{FIRST}"])
@pytest.mark.parametrize("what", ["link", "open", "file", "fifo"])
def test_a_folder_that_is_not_ours_alone_is_not_used(
    which: str, what: str, coldloop: "Coldloop", runtime: Path, other: Process
) -> None:
    place, target = runtime / which, runtime / "target"
    if "/" in which:
        make_private(place.parent)
    target.mkdir(mode=0o700)
    if what == "link":
        place.symlink_to(target)
    elif what == "open":
        place.mkdir()
        place.chmod(0o777)
    elif what == "file":
        place.touch()
    else:
        os.mkfifo(place)
    if what in ("link", "open"):
        (target if what == "link" else place).joinpath(STATE_FILE).write_text(json.dumps(state_of(other)))
    outcome = coldloop("up", "--detach", "--port-base", str(FIRST))
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert f"{place}: not a folder of this user alone" in outcome.complaints[0]
    assert coldloop("down", "--port-base", str(FIRST)).code == 2
    assert other.poll() is None
    assert {path.name for path in target.iterdir()} <= {STATE_FILE}


def test_nothing_is_followed(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("{}")
    link = tmp_path / "link"
    link.symlink_to(precious)
    with pytest.raises(OSError, match="symbolic links"):
        read_own(link)
    with new_own(link) as file:
        file.write(b"other")
    assert (precious.read_text(), link.read_text(), link.is_symlink()) == ("{}", "other", False)
    link.unlink()
    link.symlink_to(precious)
    write_own(link, "other")
    assert (precious.read_text(), link.is_symlink()) == ("{}", False)
    make_private(base_folder())
    make_private(state_folder(FIRST)).joinpath(LOCK_FILE).symlink_to(precious)
    with pytest.raises(UsageError, match="remove it"):
        lock_rig(FIRST)


@pytest.mark.parametrize("kind", ["fifo", "folder", "socket"])
def test_what_is_no_file_is_not_waited_for(kind: str, coldloop: "Coldloop", monkeypatch: pytest.MonkeyPatch) -> None:
    file = keep(FIRST, "{}")
    file.unlink()
    if kind == "socket":
        monkeypatch.chdir(file.parent)  # a socket's path is short
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(STATE_FILE)
    elif kind == "fifo":
        os.mkfifo(file)
    else:
        file.mkdir()
    outcome = coldloop("down")
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert str(file) in outcome.complaints[0]


# -- one rig on its ports ----------------------------------------------------------------------------------------------


def test_a_second_rig_that_is_started_at_the_same_time_is_refused(coldloop: "Coldloop") -> None:
    first = lock_rig(FIRST)
    for words in (("--detach",), ()):
        outcome = coldloop("up", "--port-base", str(FIRST), *words)
        assert (outcome.code, len(outcome.complaints)) == (2, 1)
        assert f"is being started here: wait for it, or end it (process {os.getpid()})" in outcome.complaints[0]
    os.close(first)
    os.close(lock_rig(FIRST))


@pytest.mark.usefixtures("realtime")
def test_ctrl_c_while_a_detached_rig_starts_ends_that(processes: "Processes") -> None:
    base = str(processes.three_ports())
    starting = processes.coldloop("up", "--detach", "--port-base", base, "--load", "e")
    lock, deadline = state_folder(int(base)) / LOCK_FILE, time.monotonic() + 120.0
    number = 0
    while number in (0, starting.popen.pid):  # it is locked by the command, and then by the process of the rig
        assert time.monotonic() < deadline
        with suppress(OSError, ValueError):
            number = int(lock.read_text())
    assert starting.interrupt() == 130
    assert identity_of(number) is None
    assert rigs_up() == []


@pytest.mark.usefixtures("realtime")
def test_of_two_that_are_started_together_one_is_up(processes: "Processes") -> None:
    base = str(processes.three_ports())
    command = [sys.executable, "-m", "coldloop_rig", "up", "--detach", "--port-base", base, "--load", "e"]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    ends = [(process.communicate(timeout=120), process.returncode) for process in both]
    try:
        assert sorted(code for _, code in ends) == [0, 2], ends
        ((_, refusal),) = [texts for texts, code in ends if code]
        assert len(refusal.splitlines()) == 1
        assert rigs_up() == [running_rig(int(base))]
    finally:
        subprocess.run(
            [sys.executable, "-m", "coldloop_rig", "down", "--port-base", base], check=True, capture_output=True
        )
    assert rigs_up() == []
