"""What one client may take from the others: places and time."""

import struct
import time
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.modbus.conftest import Serve, Wire

READ_MAGIC = bytes.fromhex("03 0000 0002")
MAGIC = bytes.fromhex("03 04 42f6e979")


def numbered(transaction: int) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(READ_MAGIC) + 1, 1) + READ_MAGIC


async def test_where_two_hundred_are_at_work_the_next_one_is_refused_politely(
    serve: "Serve", caplog: pytest.LogCaptureFixture
) -> None:
    async with serve(connection_limit=200, replaceable_after_s=600) as running:
        wires: list[Wire] = [await running.connect() for _ in range(200)]
        assert [await wire.ask(READ_MAGIC) for wire in wires] == [MAGIC] * 200
        newcomer = await running.connect()
        assert await newcomer.reader.read() == b""  # the end of the stream, not a reset
        assert [await wire.ask(READ_MAGIC) for wire in wires] == [MAGIC] * 200
        assert running.server.statistics().connection_refused == 1
        assert running.server.statistics().connection_evicted == 0
        assert "kind=connection_refused peer=127.0.0.1:" in caplog.messages[0]


async def test_one_that_never_asked_gives_way_before_one_that_has(serve: "Serve") -> None:
    async with serve(connection_limit=2, replaceable_after_s=0) as running:
        worker, silent = await running.connect(), await running.connect()
        await worker.ask(READ_MAGIC)
        newcomer = await running.connect()
        assert await silent.closed() == b""
        assert await newcomer.ask(READ_MAGIC) == await worker.ask(READ_MAGIC) == MAGIC


async def test_beyond_its_rate_a_connection_is_read_from_later_and_gets_every_answer(serve: "Serve") -> None:
    async with serve(request_rate=200, request_burst=20) as running:
        hasty, other = await running.connect(), await running.connect()
        began = time.monotonic()
        hasty.send(b"".join(numbered(transaction) for transaction in range(60)))
        assert [(await hasty.answer())[0] for _ in range(20)] == list(range(20))
        assert await other.ask(READ_MAGIC) == MAGIC
        assert [(await hasty.answer())[0] for _ in range(40)] == list(range(20, 60))
        assert time.monotonic() - began >= 0.19  # forty requests beyond the burst
        assert running.server.statistics().rate_limited >= 1


async def test_a_client_that_keeps_its_rate_is_not_limited(serve: "Serve") -> None:
    async with serve(request_rate=1_000_000, request_burst=1) as running:
        wire = await running.connect()
        for _ in range(20):
            await wire.ask(READ_MAGIC)
        wire.send(numbered(1))
        assert (await wire.answer())[0] == 1
        assert running.server.statistics().idle_timeout == 0


async def test_one_that_is_made_to_wait_costs_bounded_memory_and_is_not_idle(serve: "Serve") -> None:
    requests = numbered(1) * 2_000_000  # 24 MB
    async with serve(request_rate=0.1, request_burst=1, idle_timeout_s=1.0) as running:
        hasty, other = await running.connect(), await running.connect()
        hasty.send(requests)
        await hasty.answer()
        assert await other.closed() == b""  # idle
        assert hasty.writer.transport.get_write_buffer_size() > 8e6
        assert running.server.connections == 1
        hasty.writer.transport.abort()


async def test_a_server_closes_while_a_connection_is_made_to_wait(serve: "Serve") -> None:
    async with serve(request_rate=0.01, request_burst=1) as running:
        wire = await running.connect()
        wire.send(numbered(1) + numbered(2))
        assert (await wire.answer())[0] == 1
        await running.server.close()
        assert await wire.closed() == b""
