"""The client's connection: several requests at a time, answers by their transaction id, and what belongs to none."""

import ast
import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest

from coldloop.modbus.client import NONSENSE, NoAnswerError, Transport

ROOT = Path(__file__).parents[2]
SOURCES = [file for folder in ("shared", "services", "rig", "benchmarks") for file in (ROOT / folder).rglob("*.py")]

Handle = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


def frame(transaction: int, pdu: bytes, unit: int = 1) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


async def requests_from(reader: asyncio.StreamReader, count: int) -> list[tuple[int, bytes]]:
    """Return the transaction ids and PDUs of so many requests."""
    found = []
    for _ in range(count):
        transaction, protocol, length, unit = struct.unpack(">HHHB", await reader.readexactly(7))
        assert (protocol, unit) == (0, 1)
        found.append((transaction, await reader.readexactly(length - 1)))
    return found


@contextlib.asynccontextmanager
async def connected_to(handle: Handle) -> AsyncIterator[Transport]:
    """A transport that is connected to a server made by hand."""
    finished = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError):  # the client has gone
            await handle(reader, writer)
        writer.close()
        finished.set()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    transport = Transport("somebody", "127.0.0.1", server.sockets[0].getsockname()[1], 60.0, None)
    await transport.open()
    try:
        yield transport
    finally:
        transport.close()
        await finished.wait()
        server.close()


async def test_answers_in_another_order_go_to_their_requests() -> None:
    async def backwards(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked = await requests_from(reader, 3)
        writer.write(b"".join(frame(number, pdu.upper()) for number, pdu in reversed(asked)))

    async with connected_to(backwards) as transport:
        assert await transport.transact([b"a", b"b", b"c"], 60.0) == [b"A", b"B", b"C"]


async def test_an_answer_in_single_bytes_is_one_answer() -> None:
    async def slowly(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        ((number, pdu),) = await requests_from(reader, 1)
        for byte in frame(number, pdu * 100):
            writer.write(bytes((byte,)))
            await writer.drain()
            await asyncio.sleep(0)

    async with connected_to(slowly) as transport:
        assert await transport.transact([b"xy"], 60.0) == [b"xy" * 100]


async def test_what_answers_no_request_is_passed_over() -> None:
    async def with_strangers(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for _ in range(2):
            ((number, pdu),) = await requests_from(reader, 1)
            stale, of_another_unit = frame(number - 1, b"stale"), frame(number, b"another", unit=9)
            writer.write(stale + of_another_unit + frame(number, pdu) + frame(number, b"twice"))

    async with connected_to(with_strangers) as transport:
        assert await transport.transact([b"one"], 60.0) == [b"one"]
        assert await transport.transact([b"two"], 60.0) == [b"two"]


async def test_silence_about_one_of_several_requests_ends_all_and_the_connection() -> None:
    async def one_short(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        (first, _) = await requests_from(reader, 2)
        writer.write(frame(*first))
        await reader.read()

    async with connected_to(one_short) as transport:
        with pytest.raises(NoAnswerError) as told:
            await transport.transact([b"a", b"b"], 0.05)
        assert not told.value.closed
        assert not transport.connected
        with pytest.raises(NoAnswerError):
            await transport.transact([b"a"], 60.0)


async def test_a_peer_that_closes_is_not_waited_for() -> None:
    async def leaves(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
        await requests_from(reader, 1)

    async with connected_to(leaves) as transport:
        with pytest.raises(NoAnswerError) as told:
            await transport.transact([b"a"], 60.0)
        assert told.value.closed


async def test_what_is_no_modbus_is_nonsense_at_once_and_ends_the_connection() -> None:
    async def web_server(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await requests_from(reader, 1)
        writer.write(b"HTTP/1.1 400 Bad Request\r\n")
        await reader.read()

    async with connected_to(web_server) as transport:
        assert await transport.transact([b"a"], 60.0) == [NONSENSE]
        assert not transport.connected


async def test_a_request_that_is_given_up_leaves_no_connection_for_its_answer() -> None:
    async def never(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
        await reader.read()

    async with connected_to(never) as transport:
        asking = asyncio.ensure_future(transport.transact([b"a"], 60.0))
        await asyncio.sleep(0)
        asking.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asking
        assert not transport.connected


async def test_transaction_ids_begin_again_after_the_last() -> None:
    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            ((number, pdu),) = await requests_from(reader, 1)
            writer.write(frame(number, pdu))

    async with connected_to(echo) as transport:
        assert transport._wire is not None  # noqa: SLF001
        transport._wire._last_id = 0xFFFE  # noqa: SLF001
        for pdu in (b"a", b"b", b"c"):
            assert await transport.transact([pdu], 60.0) == [pdu]


def test_pymodbus_makes_the_identity_by_its_public_names() -> None:
    """Its internals move with every minor version: what uses it stays small, and uses no private names."""
    users = {}
    for file in SOURCES:
        tree = ast.parse(file.read_text(encoding="utf-8"))
        names = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
        names |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
        if of_pymodbus := {name for name in names if name.split(".")[0] == "pymodbus"}:
            users[str(file.relative_to(ROOT))] = of_pymodbus
            assert not [name for name in of_pymodbus for part in name.split(".") if part.startswith("_")]
    assert users == {"shared/coldloop/modbus/requests.py": {"pymodbus.constants", "pymodbus.pdu.mei_message"}}


@pytest.mark.parametrize("garbage", [
    b"HTTP/1.1 400 Bad Request\r\n", b"\0\1\0\0\0\0\1\1", b"\0\1\0\0\0\1\1\1", b"\0\1\0\0" + b"\xff" * 300,
    b"\0\1\0\7\0\3",
])  # fmt: skip
async def test_every_kind_of_nonsense_ends_the_wait_at_once(garbage: bytes) -> None:
    async def babble(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await requests_from(reader, 1)
        writer.write(garbage)
        await reader.read()

    async with connected_to(babble) as transport:
        assert await transport.transact([b"a"], 60.0) == [NONSENSE]
