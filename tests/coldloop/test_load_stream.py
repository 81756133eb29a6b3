"""A load of any length on its way to a plant that keeps so many steps, and knows another load already."""

from typing import Any, cast

import pytest

from coldloop.errors import LinkError, PeerUnreachableError
from coldloop.modbus.client import RegisterClient
from coldloop.operating.execution import LoadStream
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.load_profile import LoadProfile
from coldloop.registers import maps_of
from coldloop.registers.plant import LoadAhead, LoadStatus
from coldloop_plant.load import MOST_UPCOMING, LoadSchedule


class FakePlant:
    map, process = maps_of(COLD_BOX).plant, COLD_BOX

    """The plant's load behind a client; it refuses as the plant does."""

    def __init__(self) -> None:
        self.load = LoadSchedule(LoadProfile((0,), (400.0,)), COLD_BOX.load)
        self.tick = 0
        self.loses_answers = False

    async def write(self, record: LoadAhead) -> None:
        try:
            self.load.check(record.steps, self.tick)
        except ValueError as error:
            raise LinkError(str(error)) from None
        self.load.put(record.steps, self.tick)
        if self.loses_answers:
            raise PeerUnreachableError("plant did not answer in time")

    async def read(self, record: type[Any]) -> LoadStatus:
        assert record is LoadStatus
        return self.load.status(self.tick)

    def stream(self, steps: int, begin: int, watts: float) -> LoadStream:
        load = LoadProfile(tuple(range(steps)), tuple(watts + 0.5 * (step % 2) for step in range(steps)))
        return LoadStream(cast("RegisterClient", self), 1, load, begin=begin)


async def test_a_second_load_replaces_one_that_has_filled_the_plant() -> None:
    plant = FakePlant()
    first = plant.stream(6000, begin=8, watts=300.0)
    assert MOST_UPCOMING - 24 < await first.fill() <= MOST_UPCOMING
    assert not first.done
    second = plant.stream(5000, begin=16, watts=500.0)
    assert await second.fill() > MOST_UPCOMING - 48
    assert not await second.was_replaced()
    assert await first.was_replaced(), "who wrote the first one is told"
    assert plant.load.value(15) == 300.5
    assert plant.load.value(16) == 500.0


async def test_all_of_it_arrives_as_time_goes_on() -> None:
    plant = FakePlant()
    stream = plant.stream(12_000, begin=8, watts=300.0)
    while not stream.done:
        await stream.fill()
        plant.tick += 500
        assert plant.load.value(plant.tick) >= 300.0
    assert plant.load.value(12_007) == 300.5


async def test_steps_whose_answer_was_lost_are_not_taken_for_somebody_elses() -> None:
    plant = FakePlant()
    stream = plant.stream(3000, begin=8, watts=300.0)
    await stream.feed(0)
    plant.tick, plant.loses_answers = 1000, True
    with pytest.raises(PeerUnreachableError):
        await stream.feed(plant.tick)
    plant.loses_answers = False
    assert not await stream.was_replaced()
    await stream.feed(plant.tick)
    assert stream.done
    assert plant.load.value(3007) == 300.5
    await plant.write(LoadAhead.first_of(1, [2000], [444.0]))
    assert await stream.was_replaced()


async def test_a_load_beyond_a_plant_that_is_full_is_refused_in_words() -> None:
    plant = FakePlant()
    await plant.stream(6000, begin=8, watts=300.0).fill()
    with pytest.raises(LinkError, match="write these later"):
        await plant.stream(100, begin=90_000, watts=500.0).fill()
