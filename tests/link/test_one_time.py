"""Scans follow the clock of the rack, at whatever rate it runs; and no clock keeps a service from answering."""

import asyncio
import contextlib
from typing import TYPE_CHECKING

from coldloop.registers.audit import EventKind
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import LinkCause
from coldloop.registers.plant import PLANT_MAP, Actuators
from coldloop.registers.safety import AlarmKind

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.link.conftest import Control, FieldAt, Rack, Services, Wire, WireTo

OPERATING_POINT = (43.0, 75.0, 36.0)
START_S = 90.0
FAST_PPM = 25_000


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
    field: "FieldAt", services: "Services"
) -> None:
    fast = services.start("plant", f"plant.clock_error_ppm={FAST_PPM}")
    async with field(fast) as site:
        control, rack = await site.joined(factor=30.0), site.rack
        await rack.passes(700)
        await site.follows(control)
        leaps = [
            event
            for event in await control.events(EventKind.PLANT_LINK)
            if event.cause in {LinkCause.LEAPT, LinkCause.UNTIMELY}
        ]
        assert len(leaps) < 4, "a rack that is not followed leaps every 40 ticks"
        await rack.until(lambda: told(control))
        assert rack.violations() == []


async def told(control: "Control") -> bool:
    """Whether the skew is shown, and the alarm is raised."""
    link, alarm = await control.link(), await control.alarm(AlarmKind.CLOCK_SKEW)
    return abs(link.skew - FAST_PPM) < 1000.0 and bool(alarm.active)


async def test_at_a_rate_that_nobody_can_follow_rack_and_control_plc_answer_and_end_in_good_order(
    field: "FieldAt", services: "Services", wire: "WireTo"
) -> None:
    racing = services.start("plant")
    async with field(racing) as site, wire_when_up(site.rack, wire) as simple:
        control, rack = site.control(), site.rack
        await rack.begin(factor=10_000.0)
        await simple.write(PLANT_MAP, Actuators(0, *OPERATING_POINT, rack.session))
        await control.begin(rack.session, factor=10_000.0)
        async with asyncio.timeout(10.0):
            for client in (rack.client, control.client):
                for _ in range(20):
                    shown = await client.read(Identity)
                assert shown.session == rack.session
            assert (await rack.client.read(Identity)).tick > 100
        assert await control.service.terminated(10.0) == 0
        assert await racing.terminated(10.0) == 0


@contextlib.asynccontextmanager
async def wire_when_up(rack: "Rack", wire: "WireTo") -> "AsyncIterator[Wire]":
    await rack.client.connect(START_S)
    async with wire(rack.port) as simple:
        yield simple
