"""Frames that are lost, cut and damaged: the control PLC stays in the session, at the tick of the rack."""

import random
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from coldloop.registers.common import EventKind, Identity
from coldloop.registers.control_plc import LinkCause
from coldloop_chaos.faults import Direction

if TYPE_CHECKING:
    from tests.link.conftest import Control, Field, FieldAt

HEAD_BYTES = 9
"""Of an answer to a read: MBAP header, function, count of bytes."""
LOSSY_TICKS = 300
SEED = 20


def flipped(frame: bytes, bit: int) -> bytes:
    damaged = bytearray(frame)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


def reset_and_then_flip_a_bit_of_an_answer(bit: int) -> "Callable[[Direction, bytes], bytes | None]":
    """Reset the connection at the next frame, and flip a bit of the first answer that is long enough to have it."""
    done: list[str] = []

    def treat(way: Direction, frame: bytes) -> bytes | None:
        if not done:
            done.append("reset")
            return None
        if len(done) == 1 and way is Direction.ANSWERS and bit < 8 * len(frame):
            done.append("flipped")
            return flipped(frame, bit)
        return frame

    return treat


async def assert_goes_on(site: "Field", control: "Control") -> None:
    """Check that the control PLC drives the rack, in its session and at its tick, and that no output has leapt."""
    await site.rack.passes(40)
    await site.follows(control)
    assert (await control.client.read(Identity)).session == site.rack.session
    assert site.rack.violations() == []


@pytest.mark.parametrize(
    "field_bytes",
    [
        *(pytest.param(each, marks=pytest.mark.night) for each in ((2, 6), (8, 12), (20, 24))),
        (12, 14), (16, 20),
    ],
    ids=["map", "state", "tick", "model", "session"],
)  # fmt: skip
async def test_a_reset_and_a_flipped_bit_in_the_first_answer_cost_the_session_nothing(
    field_bytes: tuple[int, int], field: "FieldAt"
) -> None:
    async with field() as site:
        control = await site.joined()
        await control.drive(44.0, 85.0, 36.2)
        bit = 8 * HEAD_BYTES + random.Random(SEED).randrange(8 * field_bytes[0], 8 * field_bytes[1])  # noqa: S311
        site.link.treat = reset_and_then_flip_a_bit_of_an_answer(bit)
        await assert_goes_on(site, control)


async def test_a_flipped_bit_in_the_tick_of_a_measurement_is_noticed_and_not_followed(field: "FieldAt") -> None:
    async with field() as site:
        control = await site.joined()
        flips: list[bytes] = []

        def treat(way: Direction, frame: bytes) -> bytes:
            if way is Direction.ANSWERS and len(frame) > 200 and len(flips) < 3:
                flips.append(frame)
                return flipped(frame, 8 * HEAD_BYTES + 2)  # tick + 2^26 or so
            return frame

        async def causes() -> set[int]:
            return {event.cause for event in await control.events(EventKind.PLANT_LINK)}

        site.link.treat = treat
        await assert_goes_on(site, control)
        while LinkCause.DAMAGED not in await causes():  # a busy machine had lost the rack before: that was the cause
            flips.clear()
            await assert_goes_on(site, control)
        assert len(flips) == 3
        assert all(event.tick < 10_000 for event in await control.events(EventKind.PLANT_LINK))


async def test_a_link_that_loses_cuts_and_damages_frames_both_ways_moves_no_output_beyond_its_rate(
    field: "FieldAt",
) -> None:
    draw = random.Random(SEED)  # noqa: S311 - not for secrets

    def treat(_way: Direction, frame: bytes) -> bytes | None:
        if draw.random() >= 0.02:
            return frame
        return draw.choice((None, b"", frame[: len(frame) // 2], flipped(frame, draw.randrange(8 * len(frame)))))

    async with field() as site:
        control = await site.joined(factor=25.0)
        await control.drive(46.0, 100.0, 36.5)
        site.link.treat = treat
        await site.rack.passes(LOSSY_TICKS)
        await control.drive(42.0, 70.0, 35.8)
        await site.rack.passes(LOSSY_TICKS)
        site.link.treat = lambda _way, frame: frame
        await assert_goes_on(site, control)
        assert (await control.link()).breaks > 2, "the link was lossy"
