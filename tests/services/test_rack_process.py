"""The plant as a process: it answers and ends whatever its clock is asked for, and says why when it cannot go on."""

import asyncio
from typing import TYPE_CHECKING

from coldloop.modbus.client import RegisterClient
from coldloop.registers.common import Identity
from coldloop.registers.plant import Actuators, LoadStep, Measurement, OutputVerdict, PlantSession
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from tests.harness.processes import Process
    from tests.services.conftest import Start

PATIENCE_S = 60.0
U = (43.0, 75.0, 36.0)


async def connected(process: "Process") -> RegisterClient:
    client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=process.port, timeout_s=PATIENCE_S)
    await client.connect(PATIENCE_S)
    return client


async def test_a_clock_that_cannot_be_followed_keeps_nobody_waiting(start: "Start") -> None:
    process = start("plant", "session.autostart=true", "session.mode=realtime", "session.factor=10000")
    rack = await connected(process)
    begun = await rack.exchange(Actuators(0, tuple(U), session=1), Measurement)
    assert begun.verdict == OutputVerdict.ACCEPTED
    async with asyncio.timeout(PATIENCE_S):
        for _ in range(20):
            measured = await rack.read(Measurement)
        while measured.tick <= begun.tick:
            measured = await rack.read(Measurement)
    rack.close()
    assert await process.terminated() == 0


async def test_sessions_in_real_time_begin_again_and_again(start: "Start") -> None:
    """Same number, other number, refused in between: the plant never stands."""
    process = start("plant")
    rack = await connected(process)
    await rack.write_rows([LoadStep(0, 385.0)])
    for session in (1, 1, 2, 2):
        await rack.write(PlantSession(session, 1, 400.0, 1, 1))
        await rack.exchange(Actuators(0, tuple(U), session=session), Measurement)
        while (await rack.read(Measurement)).tick < 20:
            pass
    assert (await rack.read(Identity)).session == 2
    rack.close()
    assert await process.terminated() == 0
