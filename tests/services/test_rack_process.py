"""The plant as a process: it answers and ends whatever its clock is asked for, and says why when it cannot go on."""

import asyncio
import json
import signal
import subprocess
from typing import TYPE_CHECKING

from coldloop.modbus.client import RegisterClient
from coldloop.registers.common import Identity
from coldloop.registers.plant import PLANT_MAP, Actuators, LoadStep, Measurement, OutputVerdict, PlantSession

if TYPE_CHECKING:
    from tests.services.conftest import Start

STARTS_WITHIN_S = 60.0
U = (43.0, 75.0, 36.0)


async def port_of(process: "subprocess.Popen[str]") -> int:
    """Return the port that the system has chosen for a service."""
    assert process.stderr is not None
    while True:
        line = json.loads(await asyncio.to_thread(process.stderr.readline))
        if line["event"] == "serving":
            return int(line["port"])


async def connected(process: "subprocess.Popen[str]") -> RegisterClient:
    client = RegisterClient(PLANT_MAP, host="127.0.0.1", port=await port_of(process), timeout_s=1.0)
    await client.connect(STARTS_WITHIN_S)
    return client


async def test_a_clock_that_cannot_be_followed_keeps_nobody_waiting(start: "Start") -> None:
    process = start(
        "plant", "plant.server.port=0", "session.autostart=true", "session.mode=realtime", "session.factor=10000",
        level="info",
    )  # fmt: skip
    rack = await connected(process)
    begun = await rack.exchange(Actuators(0, *U, session=1), Measurement)
    assert begun.verdict == OutputVerdict.TAKEN
    for _ in range(20):
        async with asyncio.timeout(1.0):
            measured = await rack.read(Measurement)
    assert measured.tick > begun.tick
    rack.close()
    process.send_signal(signal.SIGTERM)
    assert await asyncio.to_thread(process.wait, 2.0) == 0


async def test_sessions_in_real_time_begin_again_and_again(start: "Start") -> None:
    """Same number, other number, refused in between: the plant never stands."""
    process = start("plant", "plant.server.port=0", level="info")
    rack = await connected(process)
    await rack.write_rows([LoadStep(0, 385.0)])
    for session in (1, 1, 2, 2):
        await rack.write(PlantSession(session, 1, 400.0, 1, 1))
        await rack.exchange(Actuators(0, *U, session=session), Measurement)
        while (await rack.read(Measurement)).tick < 20:
            pass
    assert (await rack.read(Identity)).session == 2
    rack.close()
    process.send_signal(signal.SIGTERM)
    assert await asyncio.to_thread(process.wait, 2.0) == 0
