"""Means, intervals and shares of a gap, against cases done by hand."""

import math

import numpy as np
import pytest

from rig.studies.intervals import Interval, gap_closed, geometric_mean, mean_ratio, resampled


def test_the_geometric_mean_of_2_and_8_is_4() -> None:
    assert geometric_mean(np.array([2.0, 8.0])) == pytest.approx(4.0)


def test_a_ratio_that_is_the_same_in_all_hours_has_an_interval_of_no_width() -> None:
    found = mean_ratio(np.array([3.0, 30.0, 300.0]), np.array([2.0, 20.0, 200.0]))
    assert found == pytest.approx((1.5, 1.5, 1.5, 0.0))


def test_a_single_hour_has_no_interval() -> None:
    found = mean_ratio(np.array([3.0]), np.array([2.0]))
    assert found.value == 1.5
    assert math.isnan(found.low)
    assert math.isnan(found.high)
    assert found.text() == "1.500"
    assert Interval(1.5, 1.25, 2.0).text(1) == "1.5 [1.2, 2.0]"


def test_the_interval_of_two_hours_reaches_from_the_one_to_the_other() -> None:
    """Of two hours drawn twice, both are the first one in a quarter of all cases, and both the second in a quarter."""
    found = resampled(lambda rows: float(rows.mean()), np.array([[0.0], [1.0]]))
    assert found == (0.5, 0.0, 1.0, 0.0)


def test_the_interval_of_a_mean_is_that_of_the_normal_law_when_there_are_many_hours() -> None:
    """400 numbers of which half are 0 and half are 1: the mean is 0.5 with a deviation of 0.5 / 20 = 0.025."""
    found = resampled(lambda rows: float(rows.mean()), np.repeat([[0.0], [1.0]], 200, axis=0))
    assert found.low == pytest.approx(0.5 - 1.96 * 0.025, abs=0.005)
    assert found.high == pytest.approx(0.5 + 1.96 * 0.025, abs=0.005)


@pytest.mark.parametrize(
    ("costs", "share"),
    [
        ([16.0, 4.0], 0.0),  # the reference itself
        ([1.0, 1.0], 1.0),  # the best
        ([4.0, 2.0], 0.5),  # (ln 4 + ln 2) of (ln 16 + ln 4)
        ([32.0, 8.0], -1.0 / 3.0),  # worse: -(ln 2 + ln 2) of ln 64
        ([0.5, 1.0], 7.0 / 6.0),  # better than the best that was found
    ],
)
def test_shares_of_a_gap_of_two_hours(costs: list[float], share: float) -> None:
    found = gap_closed(np.array(costs), np.array([16.0, 4.0]), np.array([1.0, 1.0]))
    assert found.value == pytest.approx(share)


def test_where_there_is_no_gap_there_is_no_share() -> None:
    assert math.isnan(gap_closed(np.array([2.0]), np.array([1.0]), np.array([1.0])).value)
