"""How many connections, for how long, and how much memory each may take."""

import asyncio
import struct
import tracemalloc
from typing import TYPE_CHECKING

import pytest

from coldloop.errors import PortInUseError
from coldloop.modbus.server import DeviceIdentity, ModbusServer, ServerSettings
from coldloop.registers.bank import RegisterBank
from coldloop.registers.plant import PlantSession
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from coldloop.registers.bank import Caller
    from coldloop.registers.declaration import Block
    from tests.modbus.conftest import Serve

SESSION = PlantSession(session=1, realtime=0, factor=1.0, seed=2, load_steps=3)
READ_MAGIC = bytes.fromhex("03 0000 0002")
READ_MUCH = bytes.fromhex("03 4000 007d")


def framed(pdu: bytes, transaction: int = 1) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, 1) + pdu


async def test_when_full_the_connection_that_has_been_idle_longest_makes_room(serve: "Serve") -> None:
    async with serve(connection_limit=3, replaceable_after_s=0) as running:
        wires = [await running.connect() for _ in range(3)]
        for wire in (wires[1], wires[0], wires[2]):
            await wire.ask(READ_MAGIC)
        newcomer = await running.connect()
        assert await wires[1].closed() == b""
        for wire in (wires[0], wires[2], newcomer):
            assert len(await wire.ask(READ_MAGIC)) == 6
        assert running.server.statistics().connection_evicted == 1
        assert running.server.connections == 3


async def test_readers_without_a_role_do_not_take_the_place_of_one_with_a_role(serve: "Serve") -> None:
    """Where a tick lasts long, a control PLC asks seldom."""
    access = {"control": ["127.0.0.2"], "operator": [], "optimizer": []}
    async with serve(connection_limit=2, replaceable_after_s=0, access=access) as running:
        control = await running.connect("127.0.0.2")
        await control.ask(READ_MAGIC)
        for _ in range(4):
            reader = await running.connect("127.0.0.3")
            assert len(await reader.ask(READ_MAGIC)) == 6
        assert len(await control.ask(READ_MAGIC)) == 6
        assert running.server.statistics().connection_evicted == 3


async def test_a_crowd_leaves_as_many_connections_as_the_limit_says(serve: "Serve") -> None:
    async with serve(connection_limit=4) as running:
        wires = [await running.connect() for _ in range(20)]
        await asyncio.gather(*[wire.closed() for wire in wires[:16]])
        assert all([len(await wire.ask(READ_MAGIC)) == 6 for wire in wires[16:]])
        assert running.server.connections == 4


async def test_a_connection_with_a_request_in_flight_is_not_the_one_that_makes_room(serve: "Serve") -> None:
    waiting, release = asyncio.Event(), asyncio.Event()

    async def wait(_block: "Block", _caller: "Caller") -> None:
        waiting.set()
        await release.wait()

    async with serve(connection_limit=2, replaceable_after_s=0, on_write=wait) as running:
        running.bank.put(SESSION)
        oldest, idle = await running.connect(), await running.connect()
        await idle.ask(READ_MAGIC)
        oldest.send(framed(bytes.fromhex("06 0192 0001")))
        await waiting.wait()
        newcomer = await running.connect()
        assert await idle.closed() == b""
        assert len(await newcomer.ask(READ_MAGIC)) == 6
        release.set()
        assert await oldest.answer() == (1, 1, bytes.fromhex("06 0192 0001"))


async def test_when_all_have_a_request_in_flight_the_newcomer_is_refused(serve: "Serve") -> None:
    waiting = asyncio.Event()

    async def wait(_block: "Block", _caller: "Caller") -> None:
        waiting.set()
        await asyncio.Event().wait()

    async with serve(connection_limit=1, on_write=wait) as running:
        running.bank.put(SESSION)
        first = await running.connect()
        first.send(framed(bytes.fromhex("06 0192 0001")))
        await waiting.wait()
        newcomer = await running.connect()
        assert await newcomer.closed() == b""
        assert running.server.statistics().connection_refused == 1


async def test_an_idle_connection_is_closed_after_the_timeout(serve: "Serve") -> None:
    async with serve(idle_timeout_s=0.5) as running:
        wire = await running.connect()
        await wire.ask(READ_MAGIC)
        assert await wire.closed() == b""
        assert running.server.statistics().idle_timeout == 1


async def test_half_a_request_does_not_keep_a_connection(serve: "Serve") -> None:
    async with serve(idle_timeout_s=0.5) as running:
        wire = await running.connect()
        wire.send(framed(READ_MAGIC)[:9])
        assert await wire.closed() == b""


async def test_a_client_that_does_not_read_costs_bounded_memory_and_is_dropped(serve: "Serve") -> None:
    async with serve(idle_timeout_s=2.0) as running:
        greedy, other = await running.connect(), await running.connect()
        requests = framed(READ_MUCH) * 100_000  # 26 MB of answers
        tracemalloc.start()
        greedy.send(requests)
        dropped = asyncio.ensure_future(greedy.writer.wait_closed())
        while not dropped.done() and not running.server.statistics().idle_timeout:
            assert len(await other.ask(READ_MAGIC)) == 6
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        dropped.cancel()
        assert running.server.statistics().idle_timeout == 1
        assert peak < 8e6


async def test_a_client_that_reads_late_gets_every_answer(serve: "Serve") -> None:
    count = 20_000
    async with serve() as running:
        wire = await running.connect()
        wire.send(b"".join(framed(READ_MUCH, transaction) for transaction in range(count)))
        other = await running.connect()
        for _ in range(100):
            await other.ask(READ_MAGIC)
        assert [(await wire.answer())[0] for _ in range(count)] == list(range(count))


async def test_closing_closes_every_connection_and_frees_the_port(serve: "Serve") -> None:
    async with serve() as running:
        wires = [await running.connect() for _ in range(3)]
        await wires[0].ask(READ_MAGIC)
        port = running.server.port
        await running.server.close()
        for wire in wires:
            assert await wire.closed() == b""
        assert running.server.connections == 0
        async with serve(port=port) as successor:
            assert len(await (await successor.connect()).ask(READ_MAGIC)) == 6


def plant_server(settings: ServerSettings) -> ModbusServer:
    return ModbusServer(
        RegisterBank(PLANT_MAP),
        settings=settings,
        on_write=lambda _block, _caller: None,
        identity=DeviceIdentity(product="plant", revision="0.1"),
    )


async def test_a_port_in_use_is_named_with_its_remedy(serve: "Serve") -> None:
    async with serve() as running:
        rival = plant_server(ServerSettings(port=running.server.port))
        with pytest.raises(PortInUseError, match=rf"^plant cannot listen on 127.0.0.1:{running.server.port}: .*choose"):
            await rival.start()
        await rival.close()


async def test_a_host_that_is_not_ours_is_named_with_its_remedy() -> None:
    with pytest.raises(PortInUseError, match=r"^plant cannot listen on 192.0.2.1:0: .*choose"):
        await plant_server(ServerSettings(host="192.0.2.1", port=0)).start()


async def test_a_client_that_sends_no_more_is_answered_all_it_has_asked(serve: "Serve") -> None:
    """Through more than one turn of the event loop; then the server closes its half, too."""
    async with serve() as running:
        wire = await running.connect()
        wire.send(b"".join(framed(READ_MAGIC, number) for number in range(200)) + b"\0")
        wire.writer.write_eof()
        answer = bytes.fromhex("03 04 42f6e979")
        assert await wire.closed() == b"".join(framed(answer, number) for number in range(200))


async def test_a_request_that_waits_ends_with_the_half_of_its_client(serve: "Serve") -> None:
    """Whether it has closed one half or is gone cannot be told, and a lease must not outlive its holder."""
    waiting = asyncio.Event()

    async def wait(_block: "Block", _caller: "Caller") -> None:
        waiting.set()
        await asyncio.Event().wait()

    async with serve(on_write=wait) as running:
        running.bank.put(SESSION)
        wire = await running.connect()
        wire.send(framed(bytes.fromhex("06 0192 0001")))
        await waiting.wait()
        wire.writer.write_eof()
        assert await wire.closed() == b""
