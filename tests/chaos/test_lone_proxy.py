"""`coldloop proxy`: a disturbed link to any server, seen by a client that we did not write."""

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from coldloop_chaos.faults import Direction, LinkPlan, find_link_plan
from coldloop_chaos.proxy import Mangler
from tests.harness.processes import Process, Processes

if TYPE_CHECKING:
    from tests.conftest import Coldloop

PATIENCE_S = 60.0
UNIT = 255


def fault_of(**content: object) -> LinkPlan:
    return LinkPlan.model_validate({"faults": [content]})


@given(
    number=st.binary(min_size=2, max_size=2), unit=st.integers(0, 255), function=st.integers(1, 127),
    data=st.binary(max_size=20), code=st.integers(1, 255),
)  # fmt: skip
def test_an_exception_is_that_of_the_request_it_answers(
    number: bytes, unit: int, function: int, data: bytes, code: int
) -> None:
    length = (2 + len(data)).to_bytes(2)
    answer = number + b"\0\0" + length + bytes([unit, function]) + data
    faults = fault_of(kind="exception", code=code).faults
    expected = number + b"\0\0" + b"\0\3" + bytes([unit, function | 0x80, code])
    assert Mangler(Direction.ANSWERS, "1").decide(answer, faults).data == expected
    assert Mangler(Direction.REQUESTS, "1").decide(answer, faults).data == answer


def test_another_unit_is_named_and_nothing_else_changes() -> None:
    answer = bytes.fromhex("0001 0000 0005 ff 03 02 1234")
    decided = Mangler(Direction.ANSWERS, "1").decide(answer, fault_of(kind="wrong_unit").faults)
    assert decided.data == bytes.fromhex("0001 0000 0005 00 03 02 1234")


def test_faults_begin_and_end_in_the_order_of_time() -> None:
    plan = LinkPlan.model_validate(
        {"faults": [{"kind": "drop", "share": 0.5, "at_s": 2, "duration_s": 3}, {"kind": "freeze", "duration_s": 4}]}
    )
    drop, freeze = plan.faults
    assert plan.changes() == [
        (0.0, True, freeze), (2.0, True, drop),
        (4.0, False, freeze), (5.0, False, drop),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "faults: Field required"),
        ("faults = []", "faults: Tuple should have at least 1 item"),
        ("faults = 3", "faults"),
        ("faults = [3]", "faults.0"),
        ('[[faults]]\nkind = "kill"\nprocess = "plant"', "faults.0: Input tag 'kill'"),
        ('[[faults]]\nkind = "drop"', "faults.0.drop.share: Field required"),
        ('[[faults]]\nkind = "drop"\nshare = nan', "faults.0.drop.share"),
        ('[[faults]]\nkind = "exception"\ndirection = "requests"', "faults.0.exception.direction"),
        ('[[faults]]\nkind = "exception"\ncode = 0', "faults.0.exception.code"),
        ('[[faults]]\nkind = "freeze"\nlink = "plant"', "a proxy has one link"),
        ('load = "a"\n[[faults]]\nkind = "freeze"', "this is a chaos plan"),
        ('seeds = 3\n[[faults]]\nkind = "freeze"', "seeds: no such key"),
        ("[[faults", "not TOML"),
    ],
)
def test_a_wrong_plan_is_one_line_that_names_the_file_and_the_key(
    text: str, words: str, tmp_path: Path, coldloop: "Coldloop"
) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(text)
    outcome = coldloop("proxy", file, "--listen", "15021", "--to", "127.0.0.1:502")
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert f"{file}: " in outcome.complaints[0]
    assert words in outcome.complaints[0]


@pytest.mark.parametrize("command", ["chaos", "proxy --listen 15021 --to 127.0.0.1:502"])
def test_a_plan_is_a_regular_file(command: str, tmp_path: Path, coldloop: "Coldloop") -> None:
    os.mkfifo(tmp_path / "fifo")
    name, *options = command.split()
    for path in (tmp_path, tmp_path / "fifo"):
        outcome = coldloop(name, path, *options)
        assert (outcome.code, outcome.complaints) == (
            2,
            [f"coldloop: {path}: not a regular file; name a readable TOML file"],
        )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nosuch.toml", "--listen", "1502", "--to", "host:502"), "nosuch.toml"),
        (("p.toml", "--listen", "0", "--to", "host:502"), "HOST:PORT"),
        (("p.toml", "--listen", "70000", "--to", "host:502"), "HOST:PORT"),
        (("p.toml", "--listen", "1502", "--to", "502"), "HOST:PORT"),
        (("p.toml", "--listen", "1502"), "--to"),
        (("p.toml", "--to", "host:502"), "--listen"),
        (("p.toml", "--listen", "1502", "--to", "127.0.0.1:1502"), "is the server itself"),
        (("p.toml", "--listen", "1502", "--to", "host:502", "--seed", "-1"), "seed"),
        (("p.toml", "--listen", "192.0.2.1:1502", "--to", "host:502"), "--listen 192.0.2.1:1502"),
    ],
)
def test_wrong_arguments_are_one_line(
    arguments: tuple[str, ...], words: str, tmp_path: Path, coldloop: "Coldloop", monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p.toml").write_text('[[faults]]\nkind = "freeze"\n')
    outcome = coldloop("proxy", *arguments)
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert words in outcome.complaints[0]


# -- before a server ---------------------------------------------------------------------------------------------------


def proxy(processes: Processes, folder: Path, plan: str, server: int) -> tuple[Process, int]:
    """Start the program before a server; return it and its port when it listens."""
    file = folder / "plan.toml"
    file.write_text(plan)
    port = processes.free_port()
    started = processes.coldloop("proxy", str(file), "--listen", str(port), "--to", f"127.0.0.1:{server}")
    while f"127.0.0.1:{port} -> 127.0.0.1:{server}\n" not in started.said:
        assert started.alive, started.said
        time.sleep(0.02)
    return started, port


def read(port: int, timeout_s: float) -> ModbusPDU | Exception:
    """Read a register with pymodbus's own client; return the answer, or why there is none."""
    client = ModbusTcpClient("127.0.0.1", port=port, timeout=timeout_s, retries=0)
    try:
        if not client.connect():  # a proxy with nobody behind it may have closed by then
            return ConnectionError("the connection was closed")
        return client.read_holding_registers(0, count=1, device_id=UNIT)
    except (ModbusException, OSError) as error:
        return error
    finally:
        client.close()


@pytest.fixture
def server(processes: Processes) -> int:
    """A Modbus/TCP server: a plant's."""
    port = processes.free_port()
    plant = processes.service("plant", port=port)
    while '"event": "serving"' not in plant.said:
        assert plant.alive, plant.said
        time.sleep(0.02)
    return port


def test_a_client_meets_the_exception_of_the_plan_and_then_the_server(
    processes: Processes, tmp_path: Path, server: int
) -> None:
    plan = '[[faults]]\nkind = "exception"\ncode = 6\nduration_s = 30\n'
    _, port = proxy(processes, tmp_path, plan, server)
    first = read(port, PATIENCE_S)
    assert isinstance(first, ModbusPDU)
    assert first.exception_code == 6
    deadline = time.monotonic() + PATIENCE_S
    while not isinstance(last := read(port, PATIENCE_S), ModbusPDU) or last.isError():
        assert time.monotonic() < deadline, last
    direct = read(server, PATIENCE_S)
    assert isinstance(direct, ModbusPDU)
    assert last.registers == direct.registers
    assert last.registers


def test_a_proxy_says_that_nobody_listens_behind_it_and_ends_at_ctrl_c(
    processes: Processes, tmp_path: Path, free_port: int
) -> None:
    started, port = proxy(processes, tmp_path, '[[faults]]\nkind = "delay"\ndelay_ms = 1\n', free_port)
    assert isinstance(read(port, PATIENCE_S), Exception)
    deadline = time.monotonic() + PATIENCE_S
    while f"127.0.0.1:{free_port}: " not in started.said:
        assert time.monotonic() < deadline, started.said
        time.sleep(0.02)
    assert started.interrupt() == 130
    assert "Traceback" not in started.said


def test_a_port_that_is_taken_is_one_line(tmp_path: Path, server: int, coldloop: "Coldloop") -> None:
    file = tmp_path / "plan.toml"
    file.write_text('[[faults]]\nkind = "freeze"\n')
    assert find_link_plan(str(file), {}).seed == 1
    outcome = coldloop("proxy", file, "--listen", server, "--to", "127.0.0.1:1")
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert f"--listen 127.0.0.1:{server}: " in outcome.complaints[0]
