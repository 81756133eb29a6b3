"""The proxy between real sockets: a server of ours behind it, our client and a raw one in front."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import NamedTuple

import pytest

from coldloop.errors import PeerUnreachableError
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.modbus.settings import Endpoint, ServerSettings
from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import Grant
from coldloop.registers.declaration import Block
from coldloop_chaos.faults import Delay, Direction, FrameDamage, FrameLoss, LinkCut
from coldloop_chaos.proxy import MOST_FROZEN, LinkProxy
from tests.harness.records import CONTROL_MAP

COMMON = {"link": "optimizer", "duration_s": 1.0}
READ_THREE = bytes.fromhex("0001 0000 0006 ff 03 0000 0003")


class Line(NamedTuple):
    """A client, the proxy, and the grants that the server has taken."""

    proxy: LinkProxy
    client: RegisterClient
    grants: list[int]


@contextlib.asynccontextmanager
async def line(timeout_s: float = 60.0) -> AsyncIterator[Line]:
    bank = RegisterBank(CONTROL_MAP)
    bank.put(Identity(map_digest=CONTROL_MAP.digest, map_version=CONTROL_MAP.version))
    grants: list[int] = []

    def on_write(block: Block, _caller: Caller) -> None:
        if block.record is Grant:
            grants.append(bank.get(Grant).until_tick)

    server = ModbusServer(
        bank, settings=ServerSettings(port=0), on_write=on_write, identity=DeviceIdentity(product="x", revision="1")
    )
    await server.start()
    proxy = LinkProxy(0, Endpoint(port=server.port), "1")
    await proxy.start()
    client = RegisterClient(CONTROL_MAP, host="127.0.0.1", port=proxy.port, timeout_s=timeout_s)
    try:
        yield Line(proxy, client, grants)
    finally:
        client.close()
        await proxy.close()
        await server.close()


async def raw(proxy: LinkProxy) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.open_connection("127.0.0.1", proxy.port)


async def test_an_undisturbed_proxy_is_not_noticed() -> None:
    async with line() as it:
        for tick in range(100):
            await it.client.write(Grant(tick))
            assert await it.client.read(Grant) == Grant(tick)
        assert it.grants == list(range(100))


async def test_a_reset_is_noticed_at_once_and_new_connections_are_reset_too_until_it_ends() -> None:
    async with line() as it:
        await it.client.read(Grant)
        fault = LinkCut(kind="reset", **COMMON)
        it.proxy.begin(fault)
        for _ in range(2):
            with pytest.raises(PeerUnreachableError):
                await it.client.read(Grant)
        it.proxy.end(fault)
        assert await it.client.read(Grant) == Grant(0)


async def test_a_raw_client_sees_rst_and_not_an_ordinary_end() -> None:
    async with line() as it:
        reader, writer = await raw(it.proxy)
        writer.write(READ_THREE)
        await reader.readexactly(9 + 6)
        it.proxy.begin(LinkCut(kind="reset", **COMMON))
        with pytest.raises(ConnectionResetError):
            await reader.read()
        writer.close()


async def test_what_is_sent_into_a_frozen_link_arrives_when_it_thaws() -> None:
    async with line() as it:
        await it.client.read(Grant)
        fault = LinkCut(kind="freeze", **COMMON)
        it.proxy.begin(fault)
        writing = asyncio.create_task(it.client.write(Grant(7)))
        reader, writer = await raw(it.proxy)
        writer.write(READ_THREE)
        assert it.grants == []
        it.proxy.end(fault)
        await writing
        assert it.grants == [7]
        assert len(await reader.readexactly(9 + 6)) == 15
        writer.close()


@pytest.mark.usefixtures("realtime")
async def test_a_lost_answer_is_a_time_out_and_a_lost_request_is_never_served() -> None:
    async with line(timeout_s=1.0) as it:
        for direction, served in ((Direction.REQUESTS, set[int]()), (Direction.ANSWERS, {5})):
            fault = FrameLoss(kind="drop", share=1.0, direction=direction, **COMMON)
            it.proxy.begin(fault)
            async with asyncio.timeout(60.0):  # the client may have given up before a busy server has come to it
                while True:
                    with pytest.raises(PeerUnreachableError):
                        await it.client.write(Grant(5))
                    await asyncio.sleep(0.01)
                    if set(it.grants) == served:
                        break
            it.proxy.end(fault)


async def test_who_tries_again_and_again_while_nothing_passes_does_not_use_up_all_files() -> None:
    async with line() as it, asyncio.timeout(60.0):
        fault = LinkCut(kind="freeze", **COMMON)
        it.proxy.begin(fault)
        calls = [await raw(it.proxy) for _ in range(MOST_FROZEN + 40)]
        for reader, _ in calls[:40]:
            with contextlib.suppress(ConnectionError):
                assert await reader.read() == b"", "the oldest are let go"
        calls[-1][1].write(READ_THREE)
        it.proxy.end(fault)
        assert len(await calls[-1][0].readexactly(9 + 6)) == 15
        for _, writer in calls:
            writer.close()


async def test_a_client_takes_the_answer_to_its_request_though_all_arrive_twice() -> None:
    async with line() as it:
        it.proxy.begin(FrameLoss(kind="duplicate", share=1.0, direction=Direction.ANSWERS, **COMMON))
        for tick in range(20):
            await it.client.write(Grant(tick))
            assert await it.client.read(Grant) == Grant(tick)


async def test_requests_that_arrive_twice_are_served_twice() -> None:
    async with line() as it:
        it.proxy.begin(FrameLoss(kind="duplicate", share=1.0, direction=Direction.REQUESTS, **COMMON))
        await it.client.write(Grant(3))
        await it.client.read(Grant)
        assert it.grants == [3, 3]


async def test_half_a_frame_ends_the_connection() -> None:
    async with line() as it:
        it.proxy.begin(FrameDamage(kind="truncate", direction=Direction.ANSWERS, **COMMON))
        reader, writer = await raw(it.proxy)
        writer.write(READ_THREE)
        assert len(await reader.read()) == (9 + 6) // 2
        writer.close()


async def test_a_client_that_sends_no_more_gets_its_answers() -> None:
    async with line() as it:
        fault = Delay(**COMMON, at_s=0.0, kind="delay", direction=Direction.ANSWERS, delay_ms=1.0)
        it.proxy.begin(fault)
        reader, writer = await raw(it.proxy)
        writer.write(READ_THREE * 50)
        writer.write_eof()
        assert len(await reader.read()) == 50 * (9 + 6)
        writer.close()


async def test_pipelined_requests_are_delayed_and_stay_in_order() -> None:
    async with line() as it:
        it.proxy.begin(Delay(kind="delay", delay_ms=1.0, jitter_ms=1.0, **COMMON))
        reader, writer = await raw(it.proxy)
        writer.write(b"".join(number.to_bytes(2, "big") + READ_THREE[2:] for number in range(20)))
        answers = [await reader.readexactly(15) for _ in range(20)]
        assert [int.from_bytes(answer[:2], "big") for answer in answers] == list(range(20))
        writer.close()


async def test_without_a_server_behind_it_a_client_is_told_so() -> None:
    async with line() as it:
        dead = LinkProxy(0, Endpoint(port=1), "1")
        await dead.start()
        client = RegisterClient(CONTROL_MAP, host="127.0.0.1", port=dead.port, timeout_s=60.0)
        with pytest.raises(PeerUnreachableError):
            await client.read(Grant)
        client.close()
        await dead.close()
        assert await it.client.read(Grant) == Grant(0)
