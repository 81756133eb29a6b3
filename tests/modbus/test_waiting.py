"""A write may make its answer wait: the long poll that ends a step."""

import asyncio
import struct
from typing import TYPE_CHECKING

import pytest

from coldloop.registers.common import IDENTITY_BLOCK, Identity
from coldloop.registers.declaration import Block, RegisterMap, Role
from coldloop.registers.plant import Actuators, PlantSession

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from coldloop.registers.bank import Caller
    from tests.modbus.conftest import Serve

STEP = bytes.fromhex("17 000a 0002 0064 0002 04 00000001")  # writes the tick of the actuators, reads that of the plant
READ_TICK = bytes.fromhex("03 000a 0002")

ADJOINING_MAP = RegisterMap(
    "adjoining",
    1,
    (
        IDENTITY_BLOCK,
        Block("actuators", 100, Actuators, "", Role.CONTROL),
        Block("session", 116, PlantSession, "", Role.OPERATOR),
    ),
)


class Gate:
    """An `on_write` that makes every writer wait until it is opened."""

    def __init__(self) -> None:
        self.opened = asyncio.Event()
        self.waiting = asyncio.Event()
        self.cancelled = asyncio.Event()

    def on_write(self, _block: Block, _caller: "Caller") -> "Awaitable[None]":
        return self._pass()

    async def _pass(self) -> None:
        self.waiting.set()
        try:
            await self.opened.wait()
        except asyncio.CancelledError:
            self.cancelled.set()
            raise


def framed(pdu: bytes, transaction: int) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, 1) + pdu


async def test_the_read_half_of_an_fc23_sees_what_happened_during_the_wait(serve: "Serve") -> None:
    gate = Gate()
    async with serve(on_write=gate.on_write) as running:
        wire = await running.connect()
        wire.send(framed(STEP, 5))
        await gate.waiting.wait()
        assert running.bank.get(Actuators).tick == 1  # stored before the program is told
        running.bank.put(Identity(tick=77))
        gate.opened.set()
        assert await wire.answer() == (5, 1, bytes.fromhex("17 04 0000004d"))


async def test_other_connections_are_served_while_one_waits(serve: "Serve") -> None:
    gate = Gate()
    async with serve(on_write=gate.on_write) as running:
        waiting, other = await running.connect(), await running.connect()
        waiting.send(framed(STEP, 5))
        await gate.waiting.wait()
        for transaction in range(100):
            assert len(await other.ask(READ_TICK, transaction)) == 6
        gate.opened.set()
        assert (await waiting.answer())[0] == 5


async def test_requests_behind_a_waiting_one_are_answered_after_it_in_order(serve: "Serve") -> None:
    gate = Gate()
    async with serve(on_write=gate.on_write) as running:
        wire, other = await running.connect(), await running.connect()
        wire.send(framed(READ_TICK, 1) + framed(STEP, 2) + framed(READ_TICK, 3))
        assert (await wire.answer())[0] == 1
        await gate.waiting.wait()
        wire.send(framed(STEP, 4) + framed(READ_TICK, 5))
        await other.ask(READ_TICK)
        gate.opened.set()
        assert [(await wire.answer())[0] for _ in range(4)] == [2, 3, 4, 5]


async def test_more_requests_than_the_input_limit_wait_behind_one_and_none_is_lost(serve: "Serve") -> None:
    gate = Gate()
    count = 30_000
    async with serve(on_write=gate.on_write) as running:
        wire = await running.connect()
        wire.send(framed(STEP, 0))
        await gate.waiting.wait()
        wire.send(b"".join(framed(READ_TICK, transaction) for transaction in range(1, count)))
        gate.opened.set()
        assert [(await wire.answer())[0] for _ in range(count)] == list(range(count))


async def test_a_client_that_goes_away_cancels_its_wait(serve: "Serve") -> None:
    gate = Gate()
    async with serve(on_write=gate.on_write) as running:
        wire = await running.connect()
        wire.send(framed(STEP, 5))
        await gate.waiting.wait()
        wire.writer.close()
        await gate.cancelled.wait()


async def test_closing_the_server_cancels_waits(serve: "Serve") -> None:
    gate = Gate()
    async with serve(on_write=gate.on_write) as running:
        wire = await running.connect()
        wire.send(framed(STEP, 5))
        await gate.waiting.wait()
        await running.server.close()
        assert gate.cancelled.is_set()
        assert await wire.closed() == b""


async def test_a_waiting_connection_is_not_idle(serve: "Serve") -> None:
    gate = Gate()
    async with serve(on_write=gate.on_write, idle_timeout_s=0.5) as running:
        waiting, idle = await running.connect(), await running.connect()
        waiting.send(framed(STEP, 5))
        await gate.waiting.wait()
        assert await idle.closed() == b""
        later = await running.connect()
        assert await later.closed() == b""
        gate.opened.set()
        assert (await waiting.answer())[0] == 5


async def test_blocks_are_told_in_the_order_of_their_addresses_each_after_the_wait_of_the_one_before(
    serve: "Serve",
) -> None:
    story: list[str] = []

    async def take_in(block: Block, _caller: "Caller") -> None:
        story.append(f"{block.name} begins")
        await asyncio.sleep(0)
        story.append(f"{block.name} ends")

    async with serve(ADJOINING_MAP, on_write=take_in) as running:
        wire = await running.connect()
        both = struct.pack(">IfffIIIIIHfIH", 1, 2.0, 3.0, 4.0, 1, 0, 0, 0, 5, 1, 6.0, 7, 9)
        assert await wire.ask(bytes.fromhex("10 0064 0018 30") + both) == bytes.fromhex("10 0064 0018")
        assert running.bank.get(PlantSession) == PlantSession(5, 1, 6.0, 7, 9)
        assert story == ["actuators begins", "actuators ends", "session begins", "session ends"]


@pytest.mark.parametrize("moment", ["at once", "while waiting"])
async def test_a_program_that_fails_is_answered_with_exception_04(serve: "Serve", moment: str) -> None:
    async def fail_later() -> None:
        raise ValueError("no such tick")

    def fail(_block: Block, _caller: "Caller") -> "Awaitable[None]":
        if moment == "at once":
            raise ValueError("no such tick")
        return fail_later()

    async with serve(on_write=fail) as running:
        wire = await running.connect()
        assert (await wire.ask(STEP)).hex() == "9704"
        assert running.server.statistics().server_failure == 1
        assert len(await wire.ask(READ_TICK)) == 6
