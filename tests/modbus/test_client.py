"""The typed client: records in, records out, and one line that says what went wrong."""

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, cast

import pytest

from coldloop.errors import PeerUnreachableError, RequestRefusedError, UnfitValueError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.codec import WordOrder
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import Grant
from coldloop.registers.declaration import RegisterMap
from coldloop.registers.plant import Actuators, LoadStep, Measurement, PlantSample, PlantSession
from tests.harness.records import CONTROL_MAP, PLANT_MAP, as_transmitted, sealed

if TYPE_CHECKING:
    from coldloop.registers.bank import Caller
    from coldloop.registers.declaration import Block
    from tests.modbus.conftest import Running, Serve

PATIENCE_S = 60.0
ACTUATORS = sealed(Actuators(tick=7, u=(50.0, 100.0, 60.0), session=1))
MEASUREMENT = sealed(
    as_transmitted(
        Measurement(7, 40.5, tuple(float(i) for i in range(22)), tuple(i / 3 for i in range(28)), 1, (0.0,) * 3)
    )
)


@contextlib.asynccontextmanager
async def client_of(
    port: int,
    *,
    register_map: RegisterMap = PLANT_MAP,
    timeout_s: float = 60.0,
    order: WordOrder = WordOrder.HIGH_FIRST,
) -> AsyncIterator[RegisterClient]:
    client = RegisterClient(register_map, host="127.0.0.1", port=port, timeout_s=timeout_s, order=order)
    try:
        yield client
    finally:
        client.close()


@pytest.mark.parametrize("order", WordOrder)
async def test_records_travel_both_ways_in_either_word_order(serve: "Serve", order: WordOrder) -> None:
    async with serve(order=order) as running, client_of(running.server.port, order=order) as client:
        await client.connect(1.0)
        running.bank.put(MEASUREMENT)
        await client.write(ACTUATORS)
        assert running.bank.get(Actuators) == ACTUATORS
        assert await client.read(Actuators) == ACTUATORS
        assert await client.exchange(ACTUATORS._replace(tick=8), Measurement) == MEASUREMENT
        assert running.bank.get(Actuators).tick == 8


async def test_rows_beyond_one_request_are_written_and_read_in_several(serve: "Serve") -> None:
    steps = [LoadStep(tick, float(tick % 100)) for tick in range(200)]
    async with serve() as running, client_of(running.server.port) as client:
        await client.write_rows(steps, start=3)
        assert running.written == ["load table"] * 7  # 30 rows of 4 words in each
        assert [running.bank.get(LoadStep, row) for row in range(3, 203)] == steps
        assert await client.read_rows(LoadStep, 3, 200) == steps
        assert await client.read_rows(LoadStep, 100, 1) == [steps[97]]
        assert await client.read_rows(LoadStep, 0, 0) == []
        assert len(await client.read_rows(PlantSample, 250, 6)) == 6
        await client.write_rows([])
        assert len(running.written) == 7


async def test_requests_of_several_tasks_do_not_mix(serve: "Serve") -> None:
    async with serve() as running, client_of(running.server.port) as client:
        for row in range(50):
            running.bank.put(LoadStep(row, 0.0), row)
        rows = await asyncio.gather(*[client.read_rows(LoadStep, row, 1) for row in range(50)])
        assert [row.tick for (row,) in rows] == list(range(50))


async def test_a_refusal_says_who_refused_what(serve: "Serve") -> None:
    async with serve() as running, client_of(running.server.port) as client:
        with pytest.raises(RequestRefusedError) as refusal:
            await client.write(ACTUATORS._replace(u=(101.0, 100.0, 60.0)))
        assert refusal.value.exception_code == 3
        assert str(refusal.value) == (
            f"plant at 127.0.0.1:{running.server.port} refused function 16 on block 'actuators': "
            "exception 3, illegal value"
        )
        with pytest.raises(RequestRefusedError, match="exception 2"):
            await client.write(MEASUREMENT)
        assert running.bank.get(Actuators) == Actuators(0, (0.0, 0.0, 0.0), 0)


async def test_nobody_listens(free_port: int) -> None:
    async with client_of(free_port) as client:
        message = rf"^nothing listens as plant at 127.0.0.1:{free_port}: start it"
        with pytest.raises(PeerUnreachableError, match=message):
            await client.connect(0.0)


async def test_patience_outlasts_a_server_that_starts_late(serve: "Serve", free_port: int) -> None:
    async with client_of(free_port) as client:
        connecting = asyncio.ensure_future(client.connect(15.0))
        await asyncio.sleep(0)
        async with serve(port=free_port):
            await connecting
            assert (await client.read(Identity)).map_digest == PLANT_MAP.digest


async def test_the_wrong_word_order_is_told_apart(serve: "Serve") -> None:
    async with serve(order=WordOrder.LOW_FIRST) as running, client_of(running.server.port) as client:
        with pytest.raises(
            PeerUnreachableError, match="other word order: set it to low-first here, or high-first there"
        ):
            await client.connect(0.0)


async def test_another_register_map_is_told_apart(serve: "Serve") -> None:
    async with (
        serve(CONTROL_MAP) as running,
        client_of(running.server.port) as client,
    ):
        with pytest.raises(PeerUnreachableError, match=f"another register map .*{CONTROL_MAP.digest:08x}"):
            await client.connect(0.0)


class Impostor(asyncio.Protocol):
    """Answers every request with `answer`, with silence, or by hanging up (None)."""

    def __init__(self, answer: bytes | None) -> None:
        self._answer = answer

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        if self._answer is None:
            self._transport.close()
        elif self._answer:
            self._transport.write(data[:2] + self._answer)


@contextlib.asynccontextmanager
async def impostor(answer: bytes | None) -> AsyncIterator[int]:
    server = await asyncio.get_running_loop().create_server(lambda: Impostor(answer), "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()


IMPOSTORS = {
    "silence": (b"", "did not answer in time"),
    "hangs up": (None, "closed the connection"),
    "HTTP": (b"TP/1.1 400 Bad Request\r\n\r\n", "with something invalid: check host and port"),
    "no identity block": (bytes.fromhex("0000 0003 01 83 02"), "another program answers there .*no identity block"),
    "other registers": (
        bytes.fromhex("0000 001d 01 03 1a") + bytes(26),
        r"another program .*not 123.456",
    ),
    "too few registers": (bytes.fromhex("0000 0005 01 03 02 0000"), "with something invalid"),
    "another function": (bytes.fromhex("0000 0005 01 04 02 0000"), "with something invalid"),
}


@pytest.mark.parametrize(("answer", "message"), IMPOSTORS.values(), ids=IMPOSTORS.keys())
async def test_something_else_answers(answer: bytes | None, message: str) -> None:
    timeout_s = 1.0 if answer == b"" else PATIENCE_S
    async with impostor(answer) as port, client_of(port, timeout_s=timeout_s) as client:
        with pytest.raises(PeerUnreachableError, match=message) as failure:
            await client.connect(0.0)
        assert f"plant at 127.0.0.1:{port}" in str(failure.value)
        assert "\n" not in str(failure.value)


async def test_a_silent_peer_is_noticed_within_the_timeout(serve: "Serve") -> None:
    never = asyncio.Event()

    async def wait(_block: "Block", _caller: "Caller") -> None:
        await never.wait()

    async with serve(on_write=wait) as running, client_of(running.server.port, timeout_s=1.0) as client:
        await client.connect(PATIENCE_S)
        with pytest.raises(PeerUnreachableError, match="did not answer in time at a request for block 'actuators'"):
            await client.write(ACTUATORS)
        await client.connect(PATIENCE_S)
        assert await client.read(Actuators) == ACTUATORS  # on a new connection


async def test_an_exchange_may_be_given_more_patience_than_other_requests(serve: "Serve") -> None:
    async def wait(_block: "Block", _caller: "Caller") -> None:
        await asyncio.sleep(0.4)

    async with serve(on_write=wait) as running, client_of(running.server.port, timeout_s=0.1) as client:
        await client.connect(PATIENCE_S)
        running.bank.put(MEASUREMENT)
        assert (await client.exchange(ACTUATORS, Measurement, patience_s=PATIENCE_S)) == MEASUREMENT
        with pytest.raises(PeerUnreachableError):
            await client.exchange(ACTUATORS, Measurement)


async def test_a_cancelled_exchange_cancels_the_wait_and_leaves_a_usable_client(serve: "Serve") -> None:
    waiting, cancelled = asyncio.Event(), asyncio.Event()

    async def wait(_block: "Block", _caller: "Caller") -> None:
        waiting.set()
        try:
            await asyncio.Event().wait()
        finally:
            cancelled.set()

    async with serve(on_write=wait) as running, client_of(running.server.port) as client:
        exchange = asyncio.ensure_future(client.exchange(ACTUATORS, Measurement))
        await waiting.wait()
        exchange.cancel()
        await cancelled.wait()
        assert await client.read(Actuators) == ACTUATORS


async def test_a_server_that_goes_away_is_noticed_at_once_and_found_again(serve: "Serve") -> None:
    waiting = asyncio.Event()

    async def wait(_block: "Block", _caller: "Caller") -> None:
        waiting.set()
        await asyncio.Event().wait()

    async with contextlib.AsyncExitStack() as stack:
        first: Running = await stack.enter_async_context(serve(on_write=wait))
        port = first.server.port
        client = await stack.enter_async_context(client_of(port, timeout_s=60.0))
        exchange = asyncio.ensure_future(client.exchange(ACTUATORS, Measurement))
        await waiting.wait()
        await first.server.close()
        with pytest.raises(PeerUnreachableError, match="closed the connection"):
            await exchange
        with pytest.raises(PeerUnreachableError, match="nothing listens"):
            await client.read(LoadStep)
        async with serve(port=port):
            assert await client.read(LoadStep) == LoadStep(0, 0.0)


async def test_both_ends_send_small_packets_without_delay(serve: "Serve") -> None:
    async with serve() as running, client_of(running.server.port) as client:
        await client.connect(1.0)
        wire = client._transport._wire  # noqa: SLF001
        assert wire is not None
        assert wire.transport.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


async def test_a_value_that_fits_no_register_is_not_sent(serve: "Serve") -> None:
    async with serve(CONTROL_MAP) as running, client_of(running.server.port, register_map=CONTROL_MAP) as client:
        with pytest.raises(UnfitValueError, match="block 'grant' cannot hold"):
            await client.write(Grant(until_tick=-1))
        assert running.written == []


async def test_sessions_with_every_type_of_register_arrive_whole(serve: "Serve") -> None:
    session = PlantSession(session=0xFFFF_FFFF, realtime=1, factor=60.0, seed=0x1234_5678, load_steps=2048)
    async with serve(order=WordOrder.LOW_FIRST) as running:
        async with client_of(running.server.port, order=WordOrder.LOW_FIRST) as client:
            await client.write(session)
            assert await client.read(PlantSession) == session
        wire = await running.connect()
        words = struct.unpack(">8H", (await wire.ask(bytes.fromhex("03 0190 0008")))[2:])
        assert words == (0xFFFF, 0xFFFF, 1, 0x0000, 0x4270, 0x5678, 0x1234, 2048)
