"""A rack whose answers are whole and make no sense: nobody ends, nothing moves beyond the rate, all goes on after."""

import math
from typing import TYPE_CHECKING

import pytest

from coldloop.registers.common import AlarmKind, EventKind
from coldloop.registers.control_plc import LinkCause
from coldloop.registers.plant import Measurement
from coldloop_chaos.faults import Direction
from tests.harness.records import PLANT_MAP
from tests.link.poison import Change, changed, poisons

if TYPE_CHECKING:
    from tests.link.conftest import Control, Field, FieldAt

BLOCK = PLANT_MAP.block_of(Measurement)
SETPOINTS = (46.0, 100.0, 36.9)


class Poisoner:
    """Changes the measurement in some answers of the rack, and counts requests."""

    def __init__(self) -> None:
        self.changes: list[Change] = []
        """Those to come, one an answer."""
        self.always: Change | None = None
        self.requests = 0

    def __call__(self, way: Direction, frame: bytes) -> bytes:
        if way is Direction.REQUESTS:
            self.requests += 1
            return frame
        change = self.always or (self.changes.pop(0) if self.changes else None)
        return frame if change is None else changed(frame, BLOCK, change)


def aged(age: float) -> Change:
    return lambda record: record._replace(age=age)  # type: ignore[attr-defined] # a measurement


def applying(cv155: float) -> Change:
    return lambda record: record._replace(u=(cv155, *record.u[1:]))  # type: ignore[attr-defined] # a measurement


async def is_still_itself(site: "Field", control: "Control", poisoner: Poisoner) -> None:
    """Wait until the control PLC drives again; it asks no more often than it scans, and makes no step."""
    await site.follows(control)
    await site.rack.passes(4)
    before, tick = poisoner.requests, site.rack.tick
    await site.rack.passes(100)
    assert control.service.alive
    assert poisoner.requests - before <= 2 * (site.rack.tick - tick)
    assert site.rack.violations() == []


async def losses(control: "Control") -> list[int]:
    """Return why the control PLC has raised the alarm that the rack is lost, each time."""
    return [
        event.cause for event in await control.events(EventKind.ALARM_RAISED) if event.subject == AlarmKind.PLANT_LOST
    ]


async def test_an_age_that_makes_no_sense_is_one_bad_answer(field: "FieldAt") -> None:
    async with field() as site:
        control, poisoner = await site.joined(), Poisoner()
        site.link.treat = poisoner
        await control.drive(*SETPOINTS)
        for age in (math.nan, math.inf, 3.4e38, -1e9):
            lost = [LinkCause.NO_ANSWER]
            while lost and LinkCause.IMPLAUSIBLE not in lost:  # a busy machine lost it: the alarm was up already
                await site.follows(control)
                before = len(await losses(control))
                poisoner.changes = [aged(age)]
                await is_still_itself(site, control, poisoner)
                lost = (await losses(control))[before:]
            assert lost.count(LinkCause.IMPLAUSIBLE) == 1


async def test_a_lie_about_the_outputs_right_after_a_break_moves_nothing(field: "FieldAt") -> None:
    """The reading that would be gone on from says what a valve may well be at: nobody has told it so."""
    async with field() as site:
        control, poisoner = await site.joined(), Poisoner()
        site.link.treat = poisoner
        await control.drive(*SETPOINTS)
        await is_still_itself(site, control, poisoner)
        for cv155 in (0.0, 45.0, 100.0):
            poisoner.changes = [applying(math.nan), applying(cv155)]
            await is_still_itself(site, control, poisoner)
        assert (await control.link()).breaks >= 3


async def test_an_age_that_goes_on_to_make_no_sense_is_alarmed(field: "FieldAt") -> None:
    """A rack that says in every answer to be late by far keeps the control PLC from scanning: each scan is past."""
    async with field() as site:
        control, poisoner = await site.joined(), Poisoner()
        site.link.treat = poisoner
        poisoner.always = aged(5e4)

        async def alarmed() -> bool:
            kinds = (AlarmKind.SCANS_STOPPED, AlarmKind.PLANT_LOST)
            return any([(await control.alarm(kind)).active for kind in kinds])

        async def quiet() -> bool:
            return not await alarmed()

        await site.rack.until(alarmed)
        poisoner.always = None
        await is_still_itself(site, control, poisoner)
        await site.rack.until(quiet)


@pytest.mark.night
async def test_every_field_of_a_measurement_may_be_nonsense_for_once(field: "FieldAt") -> None:
    async with field() as site:
        control, poisoner = await site.joined(), Poisoner()
        site.link.treat = poisoner
        await control.drive(*SETPOINTS)
        for _, change in poisons(Measurement):
            poisoner.changes = [change]
            await site.rack.passes(6)
        await is_still_itself(site, control, poisoner)
