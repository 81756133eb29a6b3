"""The schedule of the scans follows the clock of the rack, and tells how far the two differ."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.cold_box import TICK_S
from coldloop_control_plc.rack import MAX_CORRECTION, PHASE, RackClock


def follow(ppm: float, factor: float, ticks: int, *, jitter_s: float = 0.0, seed: int = 1) -> tuple[RackClock, float]:
    """Scan for so many ticks beside a rack whose clock is off; return the clock and the last phase errors' largest."""
    rng = random.Random(seed)  # noqa: S311 - noise
    clock, worst = RackClock(factor, 0.0, 0.25), 0.0
    for tick in range(ticks):
        at = clock.due(tick)
        position = PHASE + at / clock.tick_s * (1.0 + ppm * 1e-6)
        clock.observe(position, at + rng.gauss(0.0, jitter_s))
        if tick > ticks // 2:
            worst = max(worst, abs(position - tick - PHASE))
    return clock, worst


@pytest.mark.parametrize("ppm", [200.0, -200.0, 25_000.0, -25_000.0])
def test_scans_stay_half_way_between_the_ticks_of_a_rack_whose_clock_is_off(ppm: float) -> None:
    _, worst = follow(ppm, 20.0, 4000)
    assert worst < 0.01


@pytest.mark.parametrize("ppm", [200.0, -200.0, 0.0])
def test_the_skew_is_found_within_ten_ppm_in_six_hours_at_factor_50(ppm: float) -> None:
    clock, _ = follow(ppm, 50.0, 6 * 3600 * 4, jitter_s=3e-4)
    skew = clock.skew.estimate()
    assert skew.ppm == pytest.approx(ppm, abs=1.0)
    assert skew.error_ppm < 1.0


def test_nothing_is_claimed_of_the_skew_before_there_are_measurements() -> None:
    clock = RackClock(1.0, 0.0, 0.25)
    assert clock.skew.estimate().error_ppm == float("inf")


@given(errors=st.lists(st.floats(-1.5, 1.5), min_size=1, max_size=200))
def test_no_single_measurement_moves_the_schedule_by_more_than_the_bound(errors: list[float]) -> None:
    clock = RackClock(1.0, 0.0, 0.25)
    at = 0.0
    for error in errors:
        at += clock.tick_s
        before = clock.position_at(at)
        clock.observe(before + error, at)
        assert abs(clock.position_at(at) - before) <= MAX_CORRECTION + 1e-12


def test_one_position_that_cannot_be_teaches_nothing_about_the_rate() -> None:
    clock, _ = follow(200.0, 20.0, 4000)
    before, at = clock.skew.estimate(), clock.due(4000)
    clock.observe(clock.position_at(at) + 1000.0, at)
    assert clock.skew.estimate() == before
    assert clock.offset == pytest.approx(1000.0)


def test_after_a_break_the_next_scan_is_the_first_one_that_is_still_due() -> None:
    clock = RackClock(2.0, 0.0, 0.25)
    clock.synchronise(117.2, at=50.0)
    assert clock.due(117) == pytest.approx(50.0 + 0.3 * TICK_S / 2.0)
    assert clock.tick_at(50.0) == 117
    clock.synchronise(117.7, at=60.0)
    assert clock.tick_at(60.0) == 118
