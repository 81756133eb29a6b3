"""Where requests begin and end: fragments, pipelines, and streams that are not Modbus."""

import struct
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.modbus.conftest import Serve

READ_MAGIC = bytes.fromhex("0000 0006 01 03 0000 0002")
MAGIC_PDU = bytes.fromhex("03 04 42f6e979")


@pytest.fixture
def serve(serve_either: "Serve") -> "Serve":
    return serve_either


def numbered(transaction: int) -> bytes:
    return struct.pack(">H", transaction) + READ_MAGIC


async def test_several_requests_in_one_segment_are_all_answered_in_order(serve: "Serve") -> None:
    async with serve() as running:
        wire = await running.connect()
        wire.send(b"".join(numbered(transaction) for transaction in range(100, 140)))
        answers = [await wire.answer() for _ in range(40)]
        assert answers == [(transaction, 1, MAGIC_PDU) for transaction in range(100, 140)]


async def test_a_refused_request_in_a_pipeline_does_not_disturb_its_neighbours(serve: "Serve") -> None:
    async with serve() as running:
        wire = await running.connect()
        wire.send(numbered(1) + bytes.fromhex("0002 0000 0002 01 41") + numbered(3))
        assert [(await wire.answer())[::2] for _ in range(3)] == [(1, MAGIC_PDU), (2, b"\xc1\x01"), (3, MAGIC_PDU)]


async def test_a_request_sent_byte_by_byte_is_answered_once(serve: "Serve") -> None:
    async with serve() as running:
        wire, other = await running.connect(), await running.connect()
        for byte in numbered(9):
            wire.send(bytes((byte,)))
            await other.ask(b"\x03\x00\x00\x00\x01")
        assert await wire.answer() == (9, 1, MAGIC_PDU)


MALFORMED = {
    "protocol id 1": "0002 0001 0006 01 03 0000 0002",
    "protocol id 0x4854, as in HTTP": "4745 5420 2f20 48 54 5450 2f31",
    "length 0": "0002 0000 0000",
    "length 1": "0002 0000 0001 01",
    "length 255": "0002 0000 00ff 01 03",
    "length 65535": "0002 0000 ffff",
}


@pytest.mark.parametrize("garbage", MALFORMED.values(), ids=MALFORMED.keys())
async def test_a_malformed_header_closes_the_connection_after_the_answers_owed(serve: "Serve", garbage: str) -> None:
    async with serve() as running:
        wire, other = await running.connect(), await running.connect()
        wire.send(numbered(1) + bytes.fromhex(garbage))
        assert await wire.closed() == bytes.fromhex("0001 0000 0007 01") + MAGIC_PDU
        assert running.server.statistics().malformed_frame == 1
        assert await other.ask(b"\x03\x00\x00\x00\x02") == MAGIC_PDU


async def test_the_longest_legal_frame_is_taken(serve: "Serve") -> None:
    async with serve() as running:
        wire = await running.connect()
        assert await wire.ask(b"\x41" + bytes(252)) == b"\xc1\x01"
