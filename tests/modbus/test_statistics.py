"""What a server has done stands in its registers."""

from typing import TYPE_CHECKING

import pytest

from coldloop.modbus.client import RegisterClient
from coldloop.modbus.connection import REFUSALS, RefusalLog
from coldloop.registers.bank import RegisterBank
from coldloop.registers.common import STATISTICS_BLOCK, Identity, ServerStatistics
from coldloop.registers.declaration import RegisterMap
from tests.harness.records import MAPS

if TYPE_CHECKING:
    from tests.modbus.conftest import Serve


@pytest.mark.parametrize("register_map", MAPS.values(), ids=MAPS.keys())
async def test_every_map_has_the_statistics_of_its_server(serve: "Serve", register_map: RegisterMap) -> None:
    async with serve(register_map) as running:
        wire, gone = await running.connect(), await running.connect()
        for pdu in ("41", "03 ffff 0001", "03 ffff 0001", "03 0000 0000", "06 0000 0000"):
            await gone.ask(bytes.fromhex(pdu))
        gone.send(bytes.fromhex("ffff ffff ffff"))
        assert await gone.closed() == b""
        await wire.ask(bytes.fromhex("03 0000 0001"), unit=9)
        client = RegisterClient(register_map, host="127.0.0.1", port=running.server.port, timeout_s=60.0)
        statistics = await client.read(ServerStatistics)
        client.close()
        assert statistics == ServerStatistics(
            connections=2, accepted=3, requests=7, illegal_function=1, illegal_address=3, illegal_value=1,
            unknown_unit=1, malformed_frame=1,
        )  # fmt: skip


async def test_the_block_is_made_anew_for_any_read_that_touches_it_and_for_no_other() -> None:
    made: list[int] = []

    def present() -> ServerStatistics:
        made.append(1)
        return ServerStatistics(requests=len(made))

    bank = RegisterBank(MAPS["plant"])
    bank.keep_fresh(ServerStatistics, present)
    bank.read(0, 2)
    bank.read(100, 8)
    bank.put(Identity())
    assert made == []
    last = STATISTICS_BLOCK.end - 1
    for address, count in ((60, 1), (60, STATISTICS_BLOCK.row_words), (last, 1)):
        bank.read(address, count)
    assert len(made) == 3


def test_there_is_a_register_for_every_kind_of_error() -> None:
    refusals = RefusalLog("test")
    for kind in REFUSALS:
        refusals.note(kind, "somebody", "a test")
    assert ServerStatistics(1, 2, 3, **refusals.counts)[3:] == (1,) * len(REFUSALS)
    assert STATISTICS_BLOCK.end <= 100


async def test_counts_wrap_as_their_registers_do(serve: "Serve") -> None:
    async with serve() as running:
        running.server.refusals.counts["illegal_value"] = 2**32 + 5
        wire = await running.connect()
        assert (await wire.ask(bytes.fromhex("03 003c 001d")))[0] == 3
        assert running.bank.get(ServerStatistics).illegal_value == 5
