"""Whatever arrives, the server lives and goes on serving."""

import asyncio
import struct
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

if TYPE_CHECKING:
    from tests.modbus.conftest import Running, Serve


READ_MAGIC = bytes.fromhex("03 0000 0002")
FUNCTIONS = [1, 2, 3, 4, 5, 6, 15, 16, 22, 23, 43]
PATIENCE_S = 60.0
bounded = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])

words = st.sampled_from([0, 1, 2, 8, 100, 102, 104, 121, 125, 126, 200, 400, 0x7FFF, 0xFFFF]).map(
    lambda word: struct.pack(">H", word)
)
plausible_pdus = st.builds(
    lambda function, body, tail: (bytes((function,)) + b"".join(body) + tail)[:253],
    st.sampled_from(FUNCTIONS) | st.integers(0, 255),
    st.lists(words, max_size=5),
    st.binary(max_size=20),
)


async def still_serves(running: "Running") -> bool:
    wire = await running.connect()
    return await wire.ask(READ_MAGIC) == bytes.fromhex("03 04 42f6e979")


@bounded
@given(conversations=st.lists(st.lists(st.binary(max_size=300), max_size=8), max_size=8))
def test_random_bytes(serve: "Serve", conversations: list[list[bytes]]) -> None:
    async def story(complaints: list[Any]) -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: complaints.append(context))
        async with asyncio.timeout(PATIENCE_S), serve(connection_limit=4) as running:
            for segments in conversations:
                wire = await running.connect()
                for segment in segments:
                    wire.send(segment)
                wire.writer.write_eof()
                await wire.closed()
            assert await still_serves(running)
            assert running.server.statistics().server_failure == 0

    complaints: list[Any] = []
    asyncio.run(story(complaints))
    assert complaints == []


@bounded
@given(pdu=plausible_pdus, cut=st.integers(0, 20))
def test_a_client_may_go_away_at_any_byte(serve: "Serve", pdu: bytes, cut: int) -> None:
    async def story() -> None:
        async with asyncio.timeout(PATIENCE_S), serve() as running:
            wire = await running.connect()
            wire.send((struct.pack(">HHHB", 1, 0, len(pdu) + 1, 1) + pdu)[:cut])
            with suppress(ConnectionError):
                await wire.writer.drain()
            wire.writer.transport.abort()
            assert await still_serves(running)

    asyncio.run(story())
