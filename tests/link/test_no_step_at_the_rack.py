"""Whatever came between them, a control PLC goes on from what the rack applies: judged at the rack, tick by tick."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop.registers.common import AlarmKind, EventKind, WatchdogTime
from coldloop.registers.control_plc import Cause, CoolDownStep, LadderStatus, LinkCause, Mode, PlantLinkState
from coldloop.registers.plant import Actuators
from coldloop.safety.retained import RetainedFile
from coldloop_chaos.faults import Direction
from coldloop_control_plc.sessions import OWNER
from tests.harness.records import PLANT_MAP

if TYPE_CHECKING:
    from tests.harness.processes import Process
    from tests.link.conftest import FieldAt, Rack, WireTo

HEADER = read_header(DEFAULT_MODEL_FILE)
PATIENCE_S = 100.0
POLL_S = 0.02
SAFE_STATE = (30.0, 50.0, 40.0)
SETPOINTS = (44.0, 85.0, 36.2)
MOVED = (25.0, 20.0, 30.0)
"""Where a simple client brings the outputs, in one step."""


def reset_once() -> "Callable[[Direction, bytes], bytes | None]":
    """Reset the connection at the next frame, and let all others pass."""
    frames: list[bytes] = []

    def treat(_way: Direction, frame: bytes) -> bytes | None:
        frames.append(frame)
        return None if len(frames) == 1 else frame

    return treat


async def drives_again(rack: "Rack") -> bool:
    return rack.last != SAFE_STATE


async def test_a_control_plc_that_was_stopped_goes_on_from_the_safe_state_though_its_first_packet_is_reset(
    field: "FieldAt",
) -> None:
    async with field() as site:
        control, rack = await site.joined(), site.rack
        await control.drive(*SETPOINTS)

        async def applied(u: tuple[float, ...]) -> bool:
            return (await rack.measurement()).u == pytest.approx(u)

        await rack.until(lambda: applied(SETPOINTS))
        control.service.pause()
        await rack.until(lambda: applied(SAFE_STATE))
        await rack.passes(4)
        site.link.treat = reset_once()
        control.service.resume()
        await site.follows(control)
        await rack.passes(60)
        await rack.until(lambda: drives_again(rack))
        assert rack.violations() == []
        assert SAFE_STATE in rack.applied.values()
        raised = {(event.subject, event.cause) for event in await control.events(EventKind.ALARM_RAISED)}
        assert (AlarmKind.PLANT_LOST, LinkCause.CHANGED) in raised
        states = [event.subject for event in await control.events(EventKind.PLANT_LINK)]
        assert PlantLinkState.SEARCHING in states


@pytest.mark.parametrize("goes_on_by", ["retained state", "autostart", "the same session"])
async def test_a_control_plc_that_was_restarted_goes_on_from_where_a_simple_client_has_moved_the_outputs(
    goes_on_by: str, field: "FieldAt", wire: "WireTo", tmp_path: Path
) -> None:
    settings = {
        "retained state": f'control_plc.retain.file="{tmp_path}/control"',
        "autostart": "session.autostart=true",
        "the same session": "session.autostart=false",
    }[goes_on_by]
    pace = ("session.mode=realtime", "session.factor=10")
    async with field() as site:
        control, rack = await site.joined(settings, *pace), site.rack
        await control.drive(*SETPOINTS)
        await rack.passes(40)
        control.service.kill()
        async with wire(rack.port) as simple:

            async def moved() -> bool:
                present = await rack.measurement()
                await simple.write(PLANT_MAP, Actuators(present.tick, tuple(MOVED), rack.session))
                await simple.write(PLANT_MAP, WatchdogTime(0))  # they are to stay there
                return present.u == MOVED

            await rack.until(moved)
        await rack.passes(2)
        moved_at = rack.tick
        again = site.control(settings, *pace, port=control.service.port)
        if goes_on_by == "the same session":
            await rack.until(again.answers)
            await again.begin(rack.session)
        await site.follows(again)
        await again.drive(*SETPOINTS)
        await rack.passes(60)

        async def drives() -> bool:
            return rack.last > MOVED

        await rack.until(drives)
        assert rack.violations(since=moved_at) == []
        assert rack.applied[moved_at - 1] == MOVED


async def test_a_control_plc_that_was_killed_in_a_cool_down_goes_on_with_it(field: "FieldAt", tmp_path: Path) -> None:
    settings = f'control_plc.retain.file="{tmp_path}/control"'
    async with field() as site:
        control, rack = await site.joined(settings), site.rack
        await rack.passes(40)
        control.service.kill()
        kept = RetainedFile(tmp_path / "control", OWNER, HEADER.short_digest)
        state = kept.load()
        assert state is not None
        assert state["cool_down"] == CoolDownStep.FINISHED
        kept.save(state | {"cool_down": CoolDownStep.FILLING})  # as of a plant that was warm some hours ago
        again = site.control(settings, port=control.service.port)
        await site.follows(again)

        async def cools_down() -> bool:
            ladder = await again.client.read(LadderStatus)  # the first tick holds what the rack applies
            return (ladder.mode, ladder.cause) == (Mode.CLASSICAL, Cause.COOL_DOWN)

        await rack.until(cools_down)
        await rack.passes(1)
        steps = [event.subject for event in await again.events(EventKind.COOL_DOWN)]
        assert steps == [CoolDownStep.SETTLING], "the bath of this rack is full"
        assert rack.violations() == []


async def test_a_rack_that_stood_still_is_gone_on_with_from_what_it_applies(
    field: "FieldAt", shared_rack: "Process"
) -> None:
    async with field() as site:
        control, rack = await site.joined(), site.rack
        await control.drive(*SETPOINTS)
        await rack.passes(30)
        shared_rack.pause()
        try:
            async with asyncio.timeout(PATIENCE_S):
                while (await control.link()).state != PlantLinkState.SEARCHING:  # noqa: ASYNC110 - a process
                    await asyncio.sleep(POLL_S)
        finally:
            shared_rack.resume()
        await site.follows(control)
        await rack.passes(60)
        await rack.until(lambda: drives_again(rack))
        await site.follows(control)
        assert rack.violations() == []
