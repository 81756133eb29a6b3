"""A service whose standard error is a pipe that nobody reads: it goes on answering, and ends when it is told to."""

import contextlib
import os
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING

import pytest

from coldloop.errors import RequestRefusedError
from coldloop.modbus.client import RegisterClient
from coldloop.registers.common import Identity
from coldloop.registers.plant import LoadStep, PlantSession
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from tests.services.conftest import Start


@pytest.fixture
def unread_pipe() -> Iterator[tuple[int, int]]:
    """A pipe that is full, so that the first line written to it waits until somebody reads."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, b" " * 4096)
    os.set_blocking(writer, True)
    yield reader, writer
    os.close(reader)
    os.close(writer)


@contextlib.asynccontextmanager
async def client_of_plant(port: int) -> AsyncIterator[RegisterClient]:
    client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=port, timeout_s=60.0)
    try:
        await client.connect(60.0)
        yield client
    finally:
        client.close()


async def test_a_plant_whose_logs_nobody_reads_goes_on_answering_and_ends_in_good_order(
    start: "Start", free_port: int, unread_pipe: tuple[int, int]
) -> None:
    reader, writer = unread_pipe
    process = start("plant", port=free_port, level="info", stderr=writer)
    async with client_of_plant(free_port) as client:
        await client.write_rows([LoadStep(0, 385.0)])
        for session in range(1, 41):
            await client.write(PlantSession(session, 0, 1.0, 1, 1))
            with pytest.raises(RequestRefusedError):
                await client.write(Identity(0, 0, 0, 0, 0, 0, 0))
        assert (await client.read(Identity)).session == 40
    assert await process.terminated() == 0
    os.set_blocking(reader, False)
    assert b'"event": "session started"' not in os.read(reader, 1 << 20)
