"""An optimiser that is not ours, of a process that is not the cold box: it knows what `coldloop registers` prints."""

import csv
import struct
import subprocess
import time
import zlib
from collections.abc import Callable, Iterator
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
from pymodbus.client import ModbusTcpClient

from coldloop.registers.control_plc import Mode, Verdict
from tests.harness.processes import PROGRAM_S, Processes

TANK: Final = Path(__file__).parents[2] / "examples" / "processes" / "quadruple_tank.toml"
FACTOR: Final = 5
PATIENCE_S: Final = 120.0
PERIOD: Final = 20
"""The updating period in ticks: 5 s. A sequence has rows for two."""
RATE: Final = 0.5
"""Largest change of a pump's voltage in 5 s, and in any 0.5 s (examples/processes/quadruple_tank.toml)."""
SLEW_TICKS: Final = 2
LETTERS: Final = {"uint16": "H", "uint32": "I", "float32": "f"}

Row = tuple[float, float]
"""Voltages of both pumps, V."""


class Block(NamedTuple):
    """A block of the control PLC's registers."""

    address: int
    letters: str
    names: tuple[str, ...]


class ControlPlc:
    """The control PLC of the quadruple tank, by the addresses and types that were printed."""

    def __init__(self, blocks: dict[str, Block], port: int) -> None:
        self._blocks = blocks
        self._client = ModbusTcpClient("127.0.0.1", port=port, timeout=5.0, retries=0)
        assert self._client.connect()  # type: ignore[no-untyped-call]
        self.model = self.read("identity")["model_digest"]

    def close(self) -> None:
        """Close the connection, whatever has been sent."""
        self._client.close()  # type: ignore[no-untyped-call]

    def read(self, name: str) -> dict[str, Any]:
        """Return the values of a block."""
        block = self._blocks[name]
        count = struct.calcsize(f">{block.letters}") // 2
        return self._valued(block, self._client.read_holding_registers(block.address, count=count))

    def write(self, name: str, *values: float) -> None:
        """Write a block."""
        answer = self._client.write_registers(self._blocks[name].address, self._words(name, *values))
        assert not answer.isError(), answer

    def exchange(self, name: str, *values: float, more: list[int] | None = None, answer: str) -> dict[str, Any]:
        """Write a block, and `more` registers behind it, and return the values of another one."""
        written, read = self._blocks[name], self._blocks[answer]
        words = self._words(name, *values) + (more or [])
        count = struct.calcsize(f">{read.letters}") // 2
        return self._valued(
            read,
            self._client.readwrite_registers(
                read_address=read.address, read_count=count, write_address=written.address, values=words
            ),
        )

    def sent(self, update: dict[str, Any], rows: list[Row]) -> int:
        """Send a sequence that answers an update; return the verdict."""
        numbers = (update["playing"] + 1, update["update"], update["tick"] + PERIOD, len(rows), PERIOD, self.model)
        packed = struct.pack(">IIIHHI", *numbers) + b"".join(struct.pack(">ff", *row) for row in rows)
        self.write_rows(rows[PERIOD:], PERIOD)
        first = [word for row in rows[:PERIOD] for word in words_of("ff", *row)]
        header = (*numbers, zlib.crc32(packed))
        return int(self.exchange("sequence header", *header, more=first, answer="acknowledgement")["verdict"])

    def write_rows(self, rows: list[Row], first: int) -> None:
        """Write rows of a sequence without its header."""
        words = [word for row in rows for word in words_of("ff", *row)]
        answer = self._client.write_registers(self._blocks["sequence"].address + 4 * first, words)
        assert not answer.isError(), answer

    def _words(self, name: str, *values: float) -> list[int]:
        """Return a block as registers; its CRC is added where it is left out."""
        letters = self._blocks[name].letters
        if len(values) < len(letters):
            values += (zlib.crc32(struct.pack(f">{letters[:-1]}", *values)) or 1,)
        return words_of(letters, *values)

    @staticmethod
    def _valued(block: Block, answer: Any) -> dict[str, Any]:  # noqa: ANN401 whatever pymodbus has for it
        assert not answer.isError(), answer
        raw = struct.pack(f">{len(answer.registers)}H", *answer.registers)
        return dict(zip(block.names, struct.unpack(f">{block.letters}", raw), strict=True))


def words_of(letters: str, *values: float) -> list[int]:
    raw = struct.pack(f">{letters}", *values)
    return list(struct.unpack(f">{len(raw) // 2}H", raw))


def printed_blocks(processes: Processes) -> dict[str, Block]:
    """Return the blocks of the control PLC as `coldloop registers` prints them."""
    words = ("--process", TANK, "registers", "--service", "control_plc", "--format", "csv")
    code, out, complaints = processes.coldloop(*words, stdout=subprocess.PIPE, stderr=subprocess.PIPE).ended(PROGRAM_S)
    assert code == 0, complaints
    lines = groupby(csv.DictReader(out.splitlines()), key=lambda line: line["block"])
    blocks = {}
    for name, group in lines:
        values = list(group)
        letters = "".join(LETTERS.get(value["type"], "H") for value in values)
        blocks[name] = Block(int(values[0]["address"]), letters, tuple(value["name"] for value in values))
    return blocks


@pytest.fixture
def plc(processes: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], ControlPlc]]:
    """Connects to the control PLC of a tank that is up without an optimiser."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    base, blocks = processes.three_ports(), printed_blocks(processes)
    up = ("up", "--without", "optimizer", "--load", "a", "--factor", FACTOR, "--detach", "--port-base", base)
    started = processes.coldloop("--process", TANK, *up)
    assert started.popen.wait(PROGRAM_S) == 0, started.said
    clients: list[ControlPlc] = []

    def connected() -> ControlPlc:
        clients.append(ControlPlc(blocks, base + 1))
        return clients[-1]

    yield connected
    for client in clients:
        client.close()
    assert processes.coldloop("--process", TANK, "down", "--port-base", base).popen.wait(PROGRAM_S) == 0


def updates(plc: ControlPlc) -> Iterator[dict[str, Any]]:
    """Yield each new update, planned: the next one is a period later."""
    plc.write("heartbeat", 0, plc.model, 4711)
    session = number = 0
    while True:
        update = plc.exchange("await update", session, number, answer="update")
        if update["session"] and (not session or update["update"] >= number):
            plc.write("plan", update["update"], update["tick"] + PERIOD, 0.0, 0.0, 0)
            yield update
            session, number = update["session"], update["update"] + 1


def rising(update: dict[str, Any]) -> list[Row]:
    """Return a sequence: in each period both voltages rise by as much as they may."""
    now = (update["u.v1"], update["u.v2"])
    one, two = (tuple(u + RATE * periods for u in now) for periods in (1, 2))
    return [one] * PERIOD + [two] * PERIOD


def constant(update: dict[str, Any]) -> list[Row]:
    return [(update["u.v1"], update["u.v2"])] * (2 * PERIOD)


@pytest.mark.usefixtures("realtime")
def test_its_sequences_are_accepted_and_played(plc: Callable[[], ControlPlc]) -> None:
    client = plc()
    verdicts = [client.sent(update, constant(update)) for update, _ in zip(updates(client), range(6), strict=False)]
    assert verdicts == [Verdict.ACCEPTED] * 6
    status = client.read("status")
    assert (status["mode"], status["accepted"], status["rejected"]) == (Mode.MPC, 6, 0)


@pytest.mark.usefixtures("realtime")
def test_one_that_is_lost_in_the_middle_of_a_sequence_leaves_the_ladder_and_no_step(
    plc: Callable[[], ControlPlc],
) -> None:
    observer, client = plc(), plc()
    for number, update in enumerate(updates(client)):
        if number == 3:
            break
        assert client.sent(update, rising(update)) == Verdict.ACCEPTED
    client.write_rows([(0.0, 10.0)] * PERIOD, PERIOD)  # the second half of a sequence that never gets its header
    client.close()
    modes, applied = followed(observer, Mode.CLASSICAL, 8 * PERIOD)
    assert [mode for mode, _ in groupby(modes)] == [Mode.MPC, Mode.REST, Mode.HOLD, Mode.CLASSICAL]
    assert observer.read("status")["rejected"] == 0
    for (tick, before), (later, after) in pairwise(applied):
        most = RATE * max(1.0, (later - tick) / SLEW_TICKS) + 1e-4
        assert all(abs(u - v) <= most for u, v in zip(before, after, strict=True)), (tick, before, later, after)


def followed(plc: ControlPlc, last: Mode, ticks: int) -> tuple[list[int], list[tuple[int, Row]]]:
    """Look at the control PLC until a mode has lasted for so many ticks; return modes, and inputs with their tick."""
    modes: list[int] = []
    applied: list[tuple[int, Row]] = []
    since: int | None = None
    deadline = time.monotonic() + PATIENCE_S
    while since is None or applied[-1][0] < since + ticks:
        assert time.monotonic() < deadline, modes[-1]
        process = plc.read("process")
        modes.append(plc.read("ladder")["mode"])
        applied.append((process["tick"], (process["u.v1"], process["u.v2"])))
        if since is None and modes[-1] == last:
            since = process["tick"]
        time.sleep(0.02)
    return modes, applied
