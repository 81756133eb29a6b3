"""An optimiser as somebody else would write it for any process: pymodbus, and the register map that `coldloop` lists.

It is a PI controller per input, with a fixed updating period.
"""

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, Self

from pymodbus.client import ModbusTcpClient
from pymodbus.pdu import ModbusPDU

HOST: Final = "127.0.0.1"
ACCEPTED: Final = 1
BEGIN_AGAIN: Final = (2, 3)
"""Verdicts late and wrong update, which a busy machine may lead to."""
HOLDER: Final = 12345
LETTERS: Final = {"uint16": "H", "uint32": "I", "float32": "f"}
MOST_WORDS: Final = 120
"""Registers in a request, rounded down."""

FRESH: Final = (0, 0)
"""Session and number of an update that is latched for the question."""

Values = dict[str, Any]


class Block(NamedTuple):
    """A block of registers: where it is, and what the values of a row are called."""

    address: int
    rows: int
    row_words: int
    names: tuple[str, ...]
    letters: str
    """One per value, as in `struct`."""


Blocks = Mapping[str, Block]


def blocks_of(listing: str, service: str) -> Blocks:
    """Return the blocks of a service by name, from what `coldloop registers --format json` prints."""
    registers: dict[str, list[Any]] = {}
    for one in json.loads(listing):
        if one["service"] == service:
            registers.setdefault(one["block"], []).append(one)
    return {name: _block(found) for name, found in registers.items()}


def _block(registers: list[Any]) -> Block:
    first = registers[0]
    names = tuple(str(one["name"]) for one in registers)
    letters = "".join(LETTERS[one["type"]] for one in registers)
    return Block(first["address"], first["rows"], first["row_words"], names, letters)


class Service:
    """A service, by its registers."""

    def __init__(self, blocks: Blocks, port: int) -> None:
        self.blocks = blocks
        self.client = ModbusTcpClient(HOST, port=port, timeout=10.0, retries=0)

    def __enter__(self) -> Self:
        assert self.client.connect()  # type: ignore[no-untyped-call]
        return self

    def __exit__(self, *_: object) -> None:
        self.client.close()  # type: ignore[no-untyped-call]

    def read(self, name: str) -> Values:
        """Return the values of a block."""
        block = self.blocks[name]
        return self._values(block, _answered(self.client.read_holding_registers(block.address, count=block.row_words)))

    def read_rows(self, name: str, first: int, count: int) -> list[Values]:
        """Return rows of a block, as many at most as an answer holds."""
        block = self.blocks[name]
        size, count = block.row_words, min(count, MOST_WORDS // block.row_words, block.rows - first)
        words = _answered(self.client.read_holding_registers(block.address + first * size, count=count * size))
        return [self._values(block, words[row * size : (row + 1) * size]) for row in range(count)]

    def write(self, name: str, *values: float) -> None:
        """Write a block that ends with a CRC."""
        _answered(self.client.write_registers(self.blocks[name].address, self.sealed(name, *values)))

    def sealed(self, name: str, *values: float) -> list[int]:
        """Return the words of a block with its CRC."""
        raw = struct.pack(f">{self.blocks[name].letters[:-1]}", *values)
        return _words(raw + struct.pack(">I", zlib.crc32(raw) or 1))

    @staticmethod
    def _values(block: Block, words: list[int]) -> Values:
        size = struct.calcsize(f">{block.letters}")
        raw = struct.pack(f">{len(words)}H", *words)[:size]
        return dict(zip(block.names, struct.unpack(f">{block.letters}", raw), strict=True))


def _answered(answer: ModbusPDU) -> list[int]:
    assert not answer.isError(), answer
    return list(answer.registers)


def _words(raw: bytes) -> list[int]:
    return list(struct.unpack(f">{len(raw) // 2}H", raw))


class Loop(NamedTuple):
    """A PI controller; its input and its output by their names in the register map."""

    input: str
    output: str
    gain: float
    integral_time_s: float
    setpoint: float
    low: float
    high: float
    rate: float
    """Largest change in an updating period."""

    def next_input(self, u: float, y: float, y_before: float, period_s: float) -> float:
        """Return the input of the next period."""
        change = self.gain * (y_before - y + period_s / self.integral_time_s * (self.setpoint - y))
        return min(max(u + min(max(change, -self.rate), self.rate), self.low), self.high)


class Optimiser(Service):
    """The client of the control PLC: answers updates, or leaves off where a test says.

    Args:
        blocks: Of the control PLC.
        port: Of the control PLC.
        loops: One for each input, in the order of the process.
        tick_s: Length of a tick.
        period: The updating period, ticks.
    """

    def __init__(self, blocks: Blocks, port: int, loops: Sequence[Loop], tick_s: float, period: int) -> None:
        super().__init__(blocks, port)
        self._loops, self._period, self._period_s = loops, period, period * tick_s
        self._before: Values = {}
        self._wanted = FRESH
        self._model = 0

    def introduce(self) -> None:
        """Take the lease."""
        self._model = self.read("identity")["model_digest"]
        self.write("heartbeat", 0, self._model, HOLDER)

    def next_update(self) -> Values:
        """Wait for an update that is not answered yet."""
        while True:
            update = self._awaited(*self._wanted)
            if update["session"] and update["update"] >= self._wanted[1]:
                return update

    def _awaited(self, session: int, number: int) -> Values:
        asked, update = self.blocks["await update"], self.blocks["update"]
        words = self.client.readwrite_registers(
            read_address=update.address, read_count=update.row_words,
            write_address=asked.address, values=self.sealed("await update", session, number),
        )  # fmt: skip
        return self._values(update, _answered(words))

    def plan(self, update: Values) -> None:
        """Announce the next updating instant."""
        self.write("plan", update["update"], update["tick"] + self._period, 0.0, 0.0, 0)

    def answer(self) -> int:
        """Answer the next update by the sequence of the PI controllers; return the verdict."""
        update = self.next_update()
        self.plan(update)
        verdict = self._commit(update, self.send_rows(self._row(update)))
        self._before = update
        self._wanted = FRESH if verdict in BEGIN_AGAIN else (update["session"], update["update"] + 1)
        return verdict

    def _row(self, update: Values) -> list[float]:
        return [
            loop.next_input(
                update[f"u.{loop.input}"],
                update[f"y.{loop.output}"],
                self._before.get(f"y.{loop.output}", update[f"y.{loop.output}"]),
                self._period_s,
            )
            for loop in self._loops
        ]

    def send_rows(self, row: Sequence[float]) -> bytes:
        """Write the rows of a sequence of two periods, which are all the same; return them as one."""
        rows = struct.pack(f">{len(row)}f", *row) * (2 * self._period)
        words, first = _words(rows), self.blocks["sequence"].address
        for start in range(0, len(words), MOST_WORDS):
            _answered(self.client.write_registers(first + start, words[start : start + MOST_WORDS]))
        return rows

    def header(self, update: Values, rows: bytes) -> list[int]:
        """Return the header that makes a sequence of the rows that were written."""
        tick, number = update["tick"] + self._period, update["playing"] + 1
        fields = (number, update["update"], tick, 2 * self._period, self._period, self._model)
        raw = struct.pack(">IIIHHI", *fields)
        return _words(raw + struct.pack(">I", zlib.crc32(rows, zlib.crc32(raw))))

    def _commit(self, update: Values, rows: bytes) -> int:
        written, read = self.blocks["sequence header"], self.blocks["acknowledgement"]
        words = self.client.readwrite_registers(
            read_address=read.address, read_count=read.row_words,
            write_address=written.address, values=self.header(update, rows),
        )  # fmt: skip
        return int(self._values(read, _answered(words))["verdict"])

    def send_half_a_request(self, update: Values, rows: bytes) -> None:
        """Send the first bytes of a request that writes the header, and no more."""
        words = self.header(update, rows)
        values = struct.pack(f">{len(words)}H", *words)
        body = struct.pack(">BBHHB", 1, 16, self.blocks["sequence header"].address, len(words), len(values)) + values
        frame = struct.pack(">HHH", 99, 0, len(body)) + body
        self.client.send(frame[: len(frame) // 2])


class SideBySide(Optimiser):
    """The same as a master that has a connection for each block, and neither FC23 nor a request of two blocks."""

    def __init__(self, *arguments: Any) -> None:  # noqa: ANN401 of `Optimiser`
        super().__init__(*arguments)
        self._port, self.clients = arguments[1], dict[str, ModbusTcpClient]()

    def __exit__(self, *_: object) -> None:
        for client in (self.client, *self.clients.values()):
            client.close()  # type: ignore[no-untyped-call]

    def over(self, name: str) -> ModbusTcpClient:
        """Return the connection for a block; each introduces itself when it is made."""
        if name not in self.clients:
            self.clients[name] = made = ModbusTcpClient(HOST, port=self._port, timeout=10.0, retries=0)
            assert made.connect()  # type: ignore[no-untyped-call]
            beat = self.sealed("heartbeat", 0, self._model, HOLDER)
            _answered(made.write_registers(self.blocks["heartbeat"].address, beat))
        return self.clients[name]

    def write(self, name: str, *values: float) -> None:
        _answered(self.over(name).write_registers(self.blocks[name].address, self.sealed(name, *values)))

    def _awaited(self, session: int, number: int) -> Values:
        self.write("await update", session, number)
        return self.read("update")

    def send_rows(self, row: Sequence[float]) -> bytes:
        own, self.client = self.client, self.over("sequence")
        try:
            return super().send_rows(row)
        finally:
            self.client = own

    def _commit(self, update: Values, rows: bytes) -> int:
        block = self.blocks["sequence header"]
        _answered(self.over("sequence header").write_registers(block.address, self.header(update, rows)))
        return int(self.read("acknowledgement")["verdict"])


class Plant(Service):
    """The plant as its history shows it: what was applied at each tick."""

    def __init__(self, blocks: Blocks, port: int) -> None:
        super().__init__(blocks, port)
        self.applied: dict[int, tuple[float, ...]] = {}
        """Inputs by tick."""

    def look(self) -> None:
        """Read what has happened since the last look."""
        rows = self.blocks["history"].rows
        now = self.read("measurement")["tick"]
        tick = max(self.applied, default=-1) + 1
        while tick < now:
            for row in self.read_rows("history", tick % rows, now - tick):
                assert row["tick"] == tick, "the history does not keep it any more"
                self.applied[tick] = tuple(value for name, value in row.items() if name.startswith("u."))
                tick += 1
