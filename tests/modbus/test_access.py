"""Who may write and read, by the address of the client."""

import struct
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from pydantic import ValidationError

from coldloop.modbus.connection import caller_at
from coldloop.modbus.settings import AccessSettings
from coldloop.registers.codec import codec_of
from coldloop.registers.control_plc import Grant, Operator, Plan, SequenceHeader, SequenceRow
from coldloop.registers.declaration import Role
from tests.harness.records import CONTROL_MAP

if TYPE_CHECKING:
    from tests.modbus.conftest import Running, Serve, Wire

OPTIMIZER, OPERATOR, READER, STRANGER = "127.0.0.2", "127.0.0.3", "127.0.0.4", "127.0.0.5"
ACCESS = {"control": [], "optimizer": [OPTIMIZER], "operator": [OPERATOR], "readers": [READER]}
READ_MAGIC = bytes.fromhex("03 0000 0002")
MAGIC = bytes.fromhex("03 04 42f6e979")

WRITE_GRANT = bytes.fromhex("10 01cc 0002 04 00000009")


def write_of(record: tuple[object, ...]) -> bytes:
    block = CONTROL_MAP.block_of(type(record))
    data = codec_of(block).encode(record)
    return struct.pack(">BHHB", 16, block.address, len(data) // 2, len(data)) + data


def a_plan(update: int) -> Plan:
    fields = Plan._fields
    return Plan(*[update if name == "update" else 0 for name in fields])


async def test_on_the_loopback_everybody_may_do_everything_without_configuration(serve: "Serve") -> None:
    async with serve(CONTROL_MAP) as running:
        wire = await running.connect()
        for pdu in (write_of(a_plan(3)), WRITE_GRANT):
            assert (await wire.ask(pdu))[0] == 16
        assert running.written == ["plan", "grant"]


async def test_each_role_writes_its_own_blocks_and_no_others(serve: "Serve") -> None:
    async with serve(CONTROL_MAP, access=ACCESS) as running:
        optimizer, operator = await running.connect(OPTIMIZER), await running.connect(OPERATOR)
        assert (await optimizer.ask(write_of(a_plan(3))))[0] == 16
        assert (await operator.ask(WRITE_GRANT))[0] == 16
        assert await optimizer.ask(WRITE_GRANT) == b"\x90\x01"
        assert await operator.ask(write_of(a_plan(4))) == b"\x90\x01"
        assert running.bank.get(Plan).update == 3
        assert running.written == ["plan", "grant"]
        assert running.server.statistics().access_refused == 2
        assert running.server.statistics().illegal_function == running.server.statistics().illegal_address == 0


@pytest.mark.parametrize(
    "request_hex",
    [
        "06 01cc 0001",
        "06 01d6 0001",
        "10 01cc 0002 04 00000009",
        "10 01cc 0001 02 0000",
        "10 01d6 0001 02 ffff",
        "16 01d6 ffff 0001",
        "17 0000 0002 01cc 0002 04 00000009",
    ],
)
async def test_a_reader_reads_and_whatever_it_writes_is_refused_and_not_stored(
    serve: "Serve", request_hex: str
) -> None:
    kinds: list[str] = []
    async with serve(CONTROL_MAP, access=ACCESS, on_refusal=kinds.append) as running:
        wire = await running.connect(READER)
        pdu = bytes.fromhex(request_hex)
        assert await wire.ask(pdu) == bytes((pdu[0] | 0x80, 1))
        assert running.bank.get(Grant) == Grant(0)
        assert running.bank.get(Operator) == Operator(0, (0.0, 0.0, 0.0))
        assert running.written == []
        assert running.server.statistics().access_refused == 1
        assert kinds == ["access_refused"]
        assert await wire.ask(READ_MAGIC) == MAGIC


async def test_a_range_that_another_client_has_written_is_still_refused(serve: "Serve") -> None:
    async with serve(CONTROL_MAP, access=ACCESS) as running:
        operator, reader = await running.connect(OPERATOR), await running.connect(READER)
        assert (await operator.ask(WRITE_GRANT))[0] == 16
        assert await reader.ask(WRITE_GRANT) == b"\x90\x01"


async def test_a_write_across_blocks_needs_the_right_to_each(serve: "Serve") -> None:
    header, row = CONTROL_MAP.block_of(SequenceHeader), CONTROL_MAP.block_of(SequenceRow)
    blocks = [replace(block, writer=Role.OPERATOR) if block is row else block for block in CONTROL_MAP.blocks]
    words = header.row_words + row.row_words
    pdu = struct.pack(">BHHB", 16, header.address, words, 2 * words) + bytes(2 * words)
    async with serve(replace(CONTROL_MAP, blocks=tuple(blocks)), access=ACCESS) as running:
        for source in (OPTIMIZER, OPERATOR):
            assert await (await running.connect(source)).ask(pdu) == b"\x90\x01"
        assert running.written == []


async def test_a_refused_write_is_logged_with_who_and_what(serve: "Serve", caplog: pytest.LogCaptureFixture) -> None:
    async with serve(CONTROL_MAP, access=ACCESS) as running:
        wire = await running.connect(OPTIMIZER)
        await wire.ask(WRITE_GRANT)
        (line,) = caplog.messages
        assert f"kind=access_refused peer={OPTIMIZER}:" in line
        assert "block 'grant' is written by the operator; roles of this client: optimizer" in line


async def test_who_may_not_even_read_is_turned_away(serve: "Serve", caplog: pytest.LogCaptureFixture) -> None:
    async with serve(CONTROL_MAP, access=ACCESS) as running:
        wire = await running.connect(STRANGER)
        assert await wire.closed() == b""
        assert running.server.statistics().access_refused == 1
        assert f"peer={STRANGER}:" in caplog.messages[0]
        assert await still_serves(running)


async def still_serves(running: "Running") -> bool:
    return await (await running.connect(READER)).ask(READ_MAGIC) == MAGIC


@pytest.mark.parametrize(
    ("host", "roles"),
    [
        ("10.1.2.3", {Role.CONTROL}),
        ("::ffff:10.1.2.3", {Role.CONTROL}),
        ("10.2.0.1", set()),
        ("fd00::7", {Role.OPERATOR}),
        ("fe80::1%eth0", {Role.OPTIMIZER}),
    ],
)
def test_networks_of_both_versions_count(host: str, roles: set[Role]) -> None:
    access = AccessSettings.model_validate(
        {"control": ["10.1.0.0/16"], "operator": ["fd00::/8"], "optimizer": ["fe80::/10"]}
    )
    caller = caller_at(host, host, access)
    assert caller is not None
    assert caller.roles == roles


def test_what_is_no_network_is_refused() -> None:
    with pytest.raises(ValidationError, match="not a valid IPv4 or IPv6 network"):
        AccessSettings.model_validate({"control": ["plant"]})


async def until(running: "Running", observer: "Wire", connections: int) -> None:
    while running.server.connections > connections:
        await observer.ask(READ_MAGIC)


async def test_a_departure_is_told_when_the_last_who_wrote_with_a_role_is_gone(serve: "Serve") -> None:
    departed: list[Role] = []
    async with serve(CONTROL_MAP, on_departure=departed.append) as running:
        first, second, observer = [await running.connect() for _ in range(3)]
        for wire in (first, second):
            await wire.ask(write_of(a_plan(1)))
        await second.ask(WRITE_GRANT)
        first.writer.close()
        await until(running, observer, 2)
        assert departed == []
        second.writer.close()
        await until(running, observer, 1)
        assert sorted(departed) == [Role.OPERATOR, Role.OPTIMIZER]
        observer.writer.close()
        await until(running, await running.connect(), 1)
        assert len(departed) == 2


async def test_closing_the_server_is_no_departure(serve: "Serve") -> None:
    departed: list[Role] = []
    async with serve(CONTROL_MAP, on_departure=departed.append) as running:
        wire = await running.connect()
        await wire.ask(WRITE_GRANT)
        await running.server.close()
        assert await wire.closed() == b""
        assert departed == []
