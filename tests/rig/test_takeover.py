"""One rig, several operators: a run that is taken over says so, and the services live on."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from coldloop.errors import LinkError
from coldloop.modbus.client import RegisterClient
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.common import Identity
from coldloop.registers.plant import PlantSession
from coldloop_rig.cosim.scenario import Scenario
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from tests.rig.conftest import Bus, OnTheBus, Simulate


async def test_a_run_that_takes_over_a_running_rig_gets_its_own_trace(
    load_a: LoadProfile, simulate: "Simulate", on_the_bus: "OnTheBus"
) -> None:
    scenario = Scenario(ticks=120, load=load_a, updating_period_s=0.0, seed=1)
    async with on_the_bus() as bus:
        running = asyncio.create_task(bus.record(Scenario(14400, load_a, 0.0, 1)))
        async with plant_under_way(bus) as rack:
            await rack.write(PlantSession(2, 0, 1.0, 1, 1))  # the first thing that any run does
        taking_over = await bus.record(scenario, patience_s=1.0)
        with pytest.raises(LinkError, match="taken over by session"):
            await running
    assert taking_over.trace_sha256 == simulate(scenario).trace_sha256


@asynccontextmanager
async def plant_under_way(bus: "Bus") -> AsyncIterator[RegisterClient]:
    """Wait until the plant is in the middle of a session."""
    end = bus.endpoints.plant
    rack = RegisterClient(PLANT_MAP, host=end.host, port=end.port, timeout_s=60)
    await rack.connect(90)
    try:
        while True:
            if (await rack.read(Identity)).tick >= 100:
                break
            await asyncio.sleep(0.002)
        yield rack
    finally:
        rack.close()


async def test_a_rig_whose_run_was_broken_off_does_the_next_one(
    load_a: LoadProfile, simulate: "Simulate", on_the_bus: "OnTheBus"
) -> None:
    scenario = Scenario(ticks=120, load=load_a, updating_period_s=0.0, seed=1)
    async with on_the_bus() as bus:
        broken_off = asyncio.create_task(bus.record(Scenario(14400, load_a, 0.0, 1)))
        async with plant_under_way(bus):
            broken_off.cancel()
            await asyncio.wait({broken_off})
        assert (await bus.record(scenario)).trace_sha256 == simulate(scenario).trace_sha256
