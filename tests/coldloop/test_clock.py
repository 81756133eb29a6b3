import asyncio

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coldloop.process.cold_box import TICK_S
from coldloop.session import BIN_S, BINS, LatenessRecord
from coldloop_plant.runtime import Pacer, Schedule

LONGEST_S = BINS * BIN_S
latenesses = st.lists(st.floats(0.0, LONGEST_S - BIN_S), min_size=1, max_size=200)


class FakeClock:
    """A clock that moves when somebody sleeps, and always wakes a sleeper a little late."""

    def __init__(self, oversleep_s: float) -> None:
        self.now = 1000.0
        self.slept: list[float] = []
        self._oversleep_s = oversleep_s

    def __call__(self) -> float:
        return self.now

    async def sleep(self, delay: float) -> None:
        self.slept.append(delay)
        self.now += delay + self._oversleep_s if delay else 0.0


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeClock:
    made = FakeClock(0.125)
    monkeypatch.setattr("asyncio.sleep", made.sleep)
    return made


@given(start=st.floats(0, 1e6), factor=st.floats(0.01, 1e4), tick=st.integers(0, 10**6))
def test_a_tick_is_due_a_quarter_of_a_second_over_the_factor_after_the_one_before(
    start: float, factor: float, tick: int
) -> None:
    schedule = Schedule(start, factor, TICK_S)
    assert schedule.due(0) == start
    assert schedule.due(tick) == pytest.approx(start + tick * 0.25 / factor)
    assert schedule.due(tick + 1) >= schedule.due(tick)


@settings(max_examples=2 * settings.default.max_examples)
@given(values=latenesses, share=st.floats(0.01, 1.0))
def test_a_percentile_is_numpys_rounded_up_to_its_bin(values: list[float], share: float) -> None:
    record = LatenessRecord()
    for value in values:
        record.add(value)
    exact = float(np.quantile(values, share, method="inverted_cdf"))
    assert exact - 1e-12 <= record.percentile_s(share) <= exact + BIN_S + 1e-12
    assert record.percentile_s(share) <= record.maximum_s == max(values)
    assert record.percentile_s(1.0) == max(values)
    assert record.count == len(values)


def test_what_is_early_counts_as_in_time() -> None:
    record = LatenessRecord()
    record.add(-3.0)
    assert (record.count, record.maximum_s, record.percentile_s(1.0)) == (1, 0.0, 0.0)


def test_what_is_later_than_the_last_bin_is_not_hidden() -> None:
    record = LatenessRecord()
    for value in (0.01, 0.3, 7.0):
        record.add(value)
    assert record.maximum_s == 7.0
    assert record.percentile_s(0.3) == pytest.approx(0.01, abs=BIN_S)
    assert record.percentile_s(0.99) == 7.0


def test_a_pacer_sleeps_until_the_tick_and_records_how_late_it_woke(fake: FakeClock) -> None:
    pacer = Pacer(Schedule(1000.0, 0.5, TICK_S), fake)

    async def story() -> list[float]:
        return [await pacer.until(tick) for tick in (0, 1, 2, 4)]

    assert asyncio.run(story()) == [0.0, 0.125, 0.125, 0.125]
    assert fake.slept == [0.0, 0.5, 0.375, 0.875], "the schedule does not slip with the one who is late"
    assert (pacer.record.count, pacer.record.maximum_s) == (4, 0.125)


def test_a_pacer_that_is_late_lets_others_run_and_does_not_stretch_time(fake: FakeClock) -> None:
    pacer = Pacer(Schedule(1000.0, 1.0, TICK_S), fake)
    fake.now = 1001.0

    async def story() -> list[float]:
        return [await pacer.until(tick) for tick in (1, 2, 4, 5)]

    assert asyncio.run(story()) == [0.75, 0.5, 0.0, 0.125]
    assert fake.slept == [0.0, 0.0, 0.0, 0.25]
    assert pacer.record.maximum_s == 0.75
