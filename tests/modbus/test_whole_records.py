"""A write that changes a part of a command record is judged as the record that results: all of it is right, or nothing.

What the server does is compared with a second opinion that knows the declarations and nothing of the server.
"""

import asyncio
import math
import struct
import zlib
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.errors import DamagedAnswerError, RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.connection import RefusalLog
from coldloop.registers.bank import BusyError, Caller, IllegalValueError, RegisterBank
from coldloop.registers.codec import Seal, WordOrder, codec_of
from coldloop.registers.control_plc import Heartbeat
from coldloop.registers.declaration import Block, Field, Kind, Register, RegisterMap
from coldloop.registers.plant import Actuators, Measurement, PlantSession
from tests.harness.records import CONTROL_MAP, MAPS, PLANT_MAP, sealed

if TYPE_CHECKING:
    from tests.modbus.conftest import Plug, Serve

COMMANDS = {
    f"{service}: {block.name}": (register_map, block)
    for service, register_map in MAPS.items()
    for block in register_map.blocks
    if block.writer is not None
}
BANKS = {service: RegisterBank(register_map) for service, register_map in MAPS.items()}
ODD_WORDS = (0, 1, 2, 3, 20, 2048, 2049, 0x3F80, 0x42C8, 0x42C9, 0x7F80, 0x7FA0, 0x7FC0, 0x8000, 0xBF80, 0xFF80, 0xFFFF)
BEFORE = ("zeros", "valid", "sealed")
words = st.sampled_from(ODD_WORDS) | st.integers(0, 0xFFFF)


def single(bound: float) -> float:
    return float(struct.unpack(">f", struct.pack(">f", bound))[0])


def within(value: float, field: Field) -> bool:
    low, high = field.low, field.high
    if field.kind is Kind.F32:
        low, high = (None if bound is None else single(bound) for bound in (low, high))
    return math.isfinite(value) and (low is None or value >= low) and (high is None or value <= high)


def is_right(block: Block, raw: bytes) -> bool:
    """Tell whether these bytes are a record that may be stored."""
    codec = codec_of(block)
    values = dict(zip(block.fields, codec.decode(raw), strict=True))
    ranges = all(
        within(value, one)
        for name, field in block.fields.items()
        for value, (_, one) in zip(values[name] if field.elements else (values[name],), field.registers, strict=True)
    )
    return ranges and not (block.sealed and codec.seal_of(raw) is Seal.BROKEN)


def starting_record(block: Block, kind: str) -> tuple[Any, ...]:
    """Return what is there before the write: what a server starts with, or a valid record."""
    if kind == "zeros":
        return block.record(*[spread(0, field) for field in block.fields.values()])
    low = block.record(*[spread(field.low or 0, field) for field in block.fields.values()])
    return sealed(low) if kind == "sealed" and block.sealed else low


def spread(value: float, field: Field) -> Any:  # noqa: ANN401 - what a field of a record may be
    """Return a value for a field: for each of its elements, where it is an array."""
    return (value,) * len(field.elements) if field.elements else value


def memory(bank: RegisterBank) -> bytes:
    return bytes(bank._memory)  # noqa: SLF001 - all of it


class Write(NamedTuple):
    """A request: its first address, its PDU, the words that it results in, and whether it halves a 32-bit value."""

    address: int
    pdu: bytes
    result: bytes
    halves: bool


def a_word(function: int, register: Register, half: int, word: int) -> Write:
    """Return FC6, or FC22 that replaces the word."""
    at, raw = register.address + half, struct.pack(">H", word)
    pdu = struct.pack(">BHH", 22, at, 0) + raw if function == 22 else struct.pack(">BH", 6, at) + raw
    return Write(at, pdu, raw, register.kind.words == 2)


def some_words(function: int, first: Register, last: Register, values: list[int]) -> Write:
    """Return FC16 or FC23 of the registers from one to another."""
    count = last.address + last.kind.words - first.address
    raw = struct.pack(f">{count}H", *(values * (count // len(values) + 1))[:count])
    write = struct.pack(">HHB", first.address, count, len(raw)) + raw
    head = b"\x10" if function == 16 else bytes.fromhex("17 0000 0002")
    return Write(first.address, head + write, raw, halves=False)


def any_write(registers: list[Register], data: st.DataObject) -> Write:
    """Draw a request to one or more of a row's registers."""
    function = data.draw(st.sampled_from((6, 16, 22, 23)))
    chosen = data.draw(st.integers(0, len(registers) - 1))
    first = registers[chosen]
    if function in (6, 22):
        return a_word(function, first, data.draw(st.integers(0, first.kind.words - 1)), data.draw(words))
    last = registers[data.draw(st.integers(chosen, len(registers) - 1))]
    return some_words(function, first, last, data.draw(st.lists(words, min_size=20, max_size=20)))


each_command = pytest.mark.parametrize(("register_map", "block"), COMMANDS.values(), ids=COMMANDS.keys())


def check(plug: "Plug", bank: RegisterBank, block: Block, row: int, write: Write) -> None:
    """Send a write, and compare what becomes of it with what should."""
    told: list[str] = []
    refusals = RefusalLog("test")
    connection, transport = plug(bank, refusals, on_write=lambda written, _: told.append(written.name))
    first, was = block.address + row * block.row_words, memory(bank)
    result = bytearray(bank.read(first, block.row_words))
    offset = 2 * (write.address - first)
    result[offset : offset + len(write.result)] = write.result
    connection.data_received(struct.pack(">HHHB", 1, 0, len(write.pdu) + 1, 1) + write.pdu)
    answer = transport.written[7:]
    if is_right(block, bytes(result)) and not write.halves:
        assert answer[0] == write.pdu[0]
        assert bank.read(first, block.row_words) == result
        assert told == [block.name]
    else:
        assert answer == bytes((write.pdu[0] | 0x80, 3))
        assert memory(bank) == was
        assert told == []
    assert refusals.counts["server_failure"] == 0
    connection.connection_lost(None)


def bank_with(register_map: RegisterMap, block: Block, before: str, row: int) -> RegisterBank:
    bank = BANKS[register_map.service]
    bank._memory[:] = bytes(2 * 0x10000)  # noqa: SLF001 - as at boot
    bank.put(starting_record(block, before), row)
    return bank


@each_command
@given(data=st.data(), before=st.sampled_from(BEFORE))
def test_a_part_of_a_command_makes_a_valid_record_or_is_refused_and_nothing_has_happened(
    plug: "Plug", register_map: RegisterMap, block: Block, data: st.DataObject, before: str
) -> None:
    async def story() -> None:
        row = data.draw(st.integers(0, block.rows - 1))
        bank = bank_with(register_map, block, before, row)
        check(plug, bank, block, row, any_write(list(block.registers(row)), data))

    asyncio.run(story())


@each_command
@pytest.mark.parametrize("before", BEFORE)
async def test_so_does_each_of_its_registers_alone_with_each_function(
    plug: "Plug", register_map: RegisterMap, block: Block, before: str
) -> None:
    row = block.rows - 1
    for register in block.registers(row):
        for word in (0, 1, 3, 0x42C8, 0x7F80, 0xFFFF):
            writes = [some_words(function, register, register, [word, 0]) for function in (16, 23)]
            writes += [a_word(function, register, 0, word) for function in (6, 22)]
            for write in writes:
                check(plug, bank_with(register_map, block, before, row), block, row, write)


async def test_at_boot_a_part_of_a_session_does_not_start_one(serve: "Serve") -> None:
    """FC6 writing 1 to `session.realtime` once stopped the rack: factor 0, and a division by zero."""
    address = PLANT_MAP.block_of(PlantSession).address
    async with serve() as running:
        wire = await running.connect()
        for offset, word in ((2, 1), (7, 0), (7, 2000)):
            assert (await wire.ask(struct.pack(">BHH", 6, address + offset, word))).hex() == "8603"
        assert running.bank.get(PlantSession).session == 0
        assert running.written == []
        assert running.server.statistics().server_failure == 0


def requests_with(function: int, block: Block, raw: bytes) -> bytes:
    write = struct.pack(">HHB", block.address, len(raw) // 2, len(raw)) + raw
    return b"\x10" + write if function == 16 else bytes.fromhex("17 0000 0002") + write


@pytest.mark.parametrize("function", [16, 23])
@pytest.mark.parametrize("order", WordOrder)
async def test_a_broken_seal_is_refused_with_03_and_an_absent_one_is_a_simple_client_s(
    serve: "Serve", order: WordOrder, function: int
) -> None:
    block = PLANT_MAP.block_of(Actuators)
    good = sealed(Actuators(5, (43.0, 75.0, 36.0), session=1))
    codec = codec_of(block, order)
    async with serve(order=order) as running:
        wire = await running.connect()
        raw = codec.encode(good)
        for bit in range(len(raw) * 8 - 32):
            flipped = bytearray(raw)
            flipped[bit // 8] ^= 1 << bit % 8
            assert await wire.ask(requests_with(function, block, bytes(flipped))) == bytes((function | 0x80, 3))
        assert running.written == []
        assert running.bank.get(Actuators) == Actuators(0, (0.0, 0.0, 0.0), 0)
        for record in (good, good._replace(tick=6, crc=0)):
            assert (await wire.ask(requests_with(function, block, codec.encode(record))))[0] == function
            assert running.bank.get(Actuators) == record
        # What it wrote last was not sealed, so parts of it may be written.
        assert (await wire.ask(struct.pack(">BHHBf", 16, block.address + 2, 2, 4, 9.0)))[0] == 16


@pytest.mark.parametrize("order", WordOrder)
async def test_a_signalling_nan_in_a_sealed_record_is_a_bad_sensor_and_no_damage(
    serve: "Serve", order: WordOrder
) -> None:
    block = PLANT_MAP.block_of(Measurement)
    record = Measurement(7, 40.5, (1.5,) * 22, (2.5,) * 28, 1, (0.0,) * 3, verdict=1)
    high = codec_of(block).encode(record)
    signalling = bytes.fromhex("7fa00001")
    raw = sealed_raw(high.replace(struct.pack(">f", 1.5), signalling, 1))
    async with serve(order=order) as running:
        in_order = codec_of(block, order).canonical(raw)  # swapping words is its own inverse
        running.bank._memory[2 * block.address : 2 * block.end] = in_order  # noqa: SLF001 - bits that no float keeps
        client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=running.server.port, timeout_s=60.0, order=order)
        arrived = await client.read(Measurement)
        assert math.isnan(arrived.y[0])
        assert arrived.y[1:] == record.y[1:]
        exchanged = await client.exchange(Actuators(7, (43.0, 75.0, 36.0), session=1), Measurement)
        assert math.isnan(exchanged.y[0])
        running.bank._memory[2 * block.address + 3] ^= 1  # noqa: SLF001
        with pytest.raises(DamagedAnswerError, match="block 'measurement' arrived damaged, or is not sealed there"):
            await client.read(Measurement)
        client.close()


def sealed_raw(raw: bytes) -> bytes:
    """Return the bytes of a record with the seal of these very bits."""
    return raw[:-4] + struct.pack(">I", zlib.crc32(raw[:-4]))


async def test_an_unsealed_answer_of_a_sealed_block_is_damage(serve: "Serve") -> None:
    async with serve() as running:
        running.bank.put(running.bank.get(Measurement)._replace(crc=0))
        client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=running.server.port, timeout_s=60.0)
        with pytest.raises(DamagedAnswerError):
            await client.read(Measurement)
        client.close()


def busy(_record: object, _row: int, _caller: Caller) -> None:
    raise BusyError("plc-a holds the lease of the rack")


async def test_a_second_writer_is_refused_with_06_counted_as_such_and_stores_nothing(
    serve: "Serve", caplog: pytest.LogCaptureFixture
) -> None:
    kinds: list[str] = []
    async with serve(on_refusal=kinds.append) as running:
        running.bank.judged_by(busy, Actuators)
        client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=running.server.port, timeout_s=60.0)
        for refused in range(1, 4):
            with pytest.raises(RequestRefusedError, match="exception 6, another client holds the lease") as refusal:
                await client.exchange(Actuators(7, (43.0, 75.0, 36.0), session=1), Measurement)
            assert refusal.value.exception_code == 6
            assert running.server.statistics().second_writer == refused
        assert kinds == ["second_writer"] * 3
        assert running.written == []
        assert running.bank.get(Actuators).tick == 0
        assert "plc-a holds the lease of the rack" in caplog.messages[0]
        client.close()


async def test_a_judge_sees_the_record_that_would_result_its_row_and_who_writes(serve: "Serve") -> None:
    seen: list[tuple[object, int, str]] = []

    def judge(record: object, row: int, caller: Caller) -> None:
        seen.append((record, row, caller.name))
        if len(seen) > 1:
            raise IllegalValueError("not now")

    block = CONTROL_MAP.block_of(Heartbeat)
    async with serve(CONTROL_MAP) as running:
        running.bank.judged_by(judge, Heartbeat)
        running.bank.put(Heartbeat(1, 2, 3))
        wire = await running.connect()
        name = "{}:{}".format(*wire.writer.get_extra_info("sockname"))
        assert (await wire.ask(struct.pack(">BHH", 6, block.address, 9)))[0] == 6
        assert (await wire.ask(struct.pack(">BHH", 6, block.address, 10))).hex() == "8603"
        assert seen == [(Heartbeat(9, 2, 3), 0, name), (Heartbeat(10, 2, 3), 0, name)]
        assert running.bank.get(Heartbeat) == Heartbeat(9, 2, 3)
        assert running.written == ["heartbeat"]


async def test_on_write_is_told_who_and_by_which_connection(serve: "Serve") -> None:
    callers: list[Caller] = []
    async with serve(CONTROL_MAP, on_write=lambda _, caller: callers.append(caller)) as running:
        wires = [await running.connect() for _ in range(2)]
        for wire in wires:
            await wire.ask(struct.pack(">BHH", 6, CONTROL_MAP.block_of(Heartbeat).address, 9))
        assert len({caller.connection for caller in callers}) == 2
        assert all(caller.connection and caller.name.startswith("127.0.0.1:") for caller in callers)
