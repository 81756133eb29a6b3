"""Scans follow the clock of the rack, at whatever rate it runs; and no clock keeps a service from answering."""

import asyncio
import contextlib
from statistics import median
from typing import TYPE_CHECKING

from coldloop.process.cold_box import TICK_S
from coldloop.registers.common import AlarmKind, Identity
from coldloop.registers.plant import Actuators
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.harness.processes import Processes
    from tests.link.conftest import Control, FieldAt, Rack, Wire, WireTo

OPERATING_POINT = (43.0, 75.0, 36.0)
START_S = 90.0
PATIENCE_S = 60.0
FAST_PPM = 50_000
SLOW = 2.0
"""Factor at which a tick, 125 ms, is longer than a busy machine lets a process wait."""
LOOKS = 30


async def test_the_same_session_written_again_in_real_time_goes_on_where_the_rack_is(field: "FieldAt") -> None:
    async with field() as site:
        control, rack = await site.joined(), site.rack
        await control.drive(44.0, 85.0, 36.2)
        await rack.passes(100)
        for _ in range(2):
            await control.begin(rack.session)
            await site.follows(control)
            await rack.passes(40)
        await site.follows(control)
        assert rack.tick > 150
        assert rack.violations() == []


async def test_a_rack_whose_clock_is_fast_is_followed_and_its_skew_is_told(
    field: "FieldAt", processes: "Processes"
) -> None:
    fast = processes.service("plant", f"plant.clock_error_ppm={FAST_PPM}")
    async with field(fast) as site:
        control, rack = await site.joined(factor=SLOW), site.rack
        offsets_ms = []
        for _ in range(LOOKS):
            await rack.passes(2)
            offsets_ms.append(abs((await control.link()).offset))
        tick_ms = 1000.0 * TICK_S / SLOW
        assert median(offsets_ms) < tick_ms / 4, "a rack that is not followed gains a tick in 20: offsets up to a tick"
        await site.follows(control)
        await rack.until(lambda: told(control))
        assert rack.violations() == []


async def told(control: "Control") -> bool:
    """Whether the skew is shown, and the alarm is raised."""
    link, alarm = await control.link(), await control.alarm(AlarmKind.CLOCK_SKEW)
    return abs(link.skew - FAST_PPM) < 1000.0 and bool(alarm.active)


async def test_at_a_rate_that_nobody_can_follow_rack_and_control_plc_answer_and_end_in_good_order(
    field: "FieldAt", processes: "Processes", wire: "WireTo"
) -> None:
    racing = processes.service("plant")
    async with field(racing) as site, wire_when_up(site.rack, wire) as simple:
        control, rack = site.control(), site.rack
        await rack.begin(factor=10_000.0)
        await simple.write(PLANT_MAP, Actuators(0, tuple(OPERATING_POINT), rack.session))
        await control.begin(rack.session, factor=10_000.0)
        async with asyncio.timeout(PATIENCE_S):
            for client in (rack.client, control.client):
                for _ in range(20):
                    shown = await client.read(Identity)
                assert shown.session == rack.session
            while (await rack.client.read(Identity)).tick <= 100:
                pass
        assert await control.service.terminated() == 0
        assert await racing.terminated() == 0


@contextlib.asynccontextmanager
async def wire_when_up(rack: "Rack", wire: "WireTo") -> "AsyncIterator[Wire]":
    await rack.client.connect(START_S)
    async with wire(rack.port) as simple:
        yield simple
