"""Means, intervals and shares of a gap, against cases done by hand; and how often intervals cover."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop_rig.plc_sizing.intervals import (
    Interval,
    interval_of_mean,
    interval_of_share,
    jackknife,
    mean_ratio,
)

Array = NDArray[np.float64]

T_1, T_2 = 12.7062, 4.30265
"""97.5 % of Student's t with one and with two degrees of freedom, from a table."""


def test_a_ratio_that_is_the_same_in_all_hours_has_an_interval_of_no_width() -> None:
    assert mean_ratio(np.array([3.0, 30.0, 300.0]), np.array([2.0, 20.0, 200.0])) == (1.5, 1.5, 1.5)


def test_a_single_hour_has_no_interval() -> None:
    found = mean_ratio(np.array([3.0]), np.array([2.0]))
    assert found.value == 1.5
    assert math.isnan(found.low)
    assert math.isnan(found.high)
    assert (found.text(), found.brief()) == ("1.500", "1.5")
    assert Interval(1.5, 1.25, 2.0).text(1) == "1.5 [1.2, 2.0]"


def test_the_interval_of_a_mean_is_students() -> None:
    """Of 1, 2 and 6 the mean is 3 and the variance (4 + 1 + 9) / 2 = 7."""
    reach = T_2 * math.sqrt(7 / 3)
    assert interval_of_mean([1.0, 2.0, 6.0]) == pytest.approx((3.0, 3.0 - reach, 3.0 + reach), rel=1e-5)


def test_the_interval_of_a_geometric_mean_is_students_of_the_logarithms() -> None:
    found = mean_ratio(np.exp([1.0, 2.0, 6.0]), np.ones(3))
    reach = T_2 * math.sqrt(7 / 3)
    assert np.log(found) == pytest.approx((3.0, 3.0 - reach, 3.0 + reach), rel=1e-5)


def test_the_interval_of_a_ratio_of_sums_by_hand() -> None:
    """(3 + 6) / (1 + 3) is 1.25 above 1; without the first draw it is 1, without the second 2: a factor of 2 apart."""
    above, below = np.array([3.0, 6.0]), np.array([1.0, 3.0])
    found = jackknife(lambda which: float(above[which].sum() / below[which].sum()), 2, above=1.0)
    factor = math.exp(T_1 * math.log(2) / 2)
    assert found == pytest.approx((2.25, 1 + 1.25 / factor, 1 + 1.25 * factor), rel=1e-4)


def test_what_reaches_its_limit_has_no_logarithm_and_is_cut_there() -> None:
    assert interval_of_mean([0.0, 0.0, 3.0], above=0.0) == pytest.approx((1.0, 0.0, 1.0 + T_2), rel=1e-5)
    assert interval_of_mean([0.0, 0.0, 0.0], above=0.0) == (0.0, 0.0, 0.0)


def test_draws_without_a_value_are_left_out_of_a_mean() -> None:
    assert interval_of_mean([3.0, math.nan, 3.0]).brief() == "3 [3 to 3]"
    assert interval_of_mean([4.0]).brief() == "4"
    assert interval_of_mean([math.nan]).brief() == "none"


def test_a_value_that_one_draw_decides_on_has_an_interval_without_limits() -> None:
    found = jackknife(lambda which: 7.0 if 0 in which else math.nan, 3, above=0.0)
    assert found == (7.0, 0.0, math.inf)
    assert found.brief() == "7 [0 to inf]"
    assert jackknife(lambda which: math.nan if len(which) == 3 else 7.0, 3).brief() == "none"


def test_the_interval_of_a_share_is_that_of_clopper_and_pearson() -> None:
    """If none of three hours had it, a share p would have done so with (1 - p)^3."""
    assert interval_of_share(0, 3) == pytest.approx((0.0, 0.0, 1 - 0.025 ** (1 / 3)))
    assert interval_of_share(3, 3) == pytest.approx((1.0, 0.025 ** (1 / 3), 1.0))
    assert interval_of_share(5, 10) == pytest.approx((0.5, 0.187086, 0.812914), abs=1e-6), "from a table"


@pytest.mark.parametrize(("hours", "least"), [(3, 0.975), (6, 0.965), (12, 0.954)])
def test_a_share_is_covered_more_often_than_needed(hours: int, least: float) -> None:
    found = [interval_of_share(number, hours) for number in range(hours + 1)]

    def coverage(share: float) -> float:
        return sum(
            math.comb(hours, number) * share**number * (1 - share) ** (hours - number)
            for number, (_, low, high) in enumerate(found) if low <= share <= high
        )  # fmt: skip

    coverages = [coverage(share) for share in np.linspace(0.001, 0.999, 999)]
    assert least < min(coverages) < least + 0.004
    assert max(coverages) > 0.999


SPREAD = 0.4
"""Standard deviation of the logarithm of an hour's cost, the largest of a family of loads in the report."""
RATIO_SPREAD = 0.2


def draw(rng: np.random.Generator, hours: int) -> tuple[Array, Array]:
    """Return log-normal costs, and as large references times ratios that do not depend on them."""
    reference, ratio = np.exp(rng.normal(size=(2, hours)) * [[SPREAD], [RATIO_SPREAD]])
    return ratio * reference, reference


def ratio_of_sums(costs: Array, reference: Array) -> Interval:
    return jackknife(lambda which: float(costs[which].sum() / reference[which].sum()), len(costs), above=0.0)


STATISTICS: dict[str, tuple[Callable[[Array, Array], Interval], float]] = {
    "geometric mean": (mean_ratio, 1.0),
    "mean": (lambda _, reference: interval_of_mean(reference.tolist(), above=0.0), math.exp(SPREAD**2 / 2)),
    "ratio of sums": (ratio_of_sums, math.exp(RATIO_SPREAD**2 / 2)),
}


@pytest.mark.parametrize("statistic", STATISTICS)
@pytest.mark.parametrize("hours", [3, 6, 12])
def test_intervals_cover_what_they_should(statistic: str, hours: int) -> None:
    interval, truth = STATISTICS[statistic]
    rng = np.random.default_rng(20)
    found = [interval(*draw(rng, hours)) for _ in range(1000)]
    assert 0.93 <= np.mean([low <= truth <= high for _, low, high in found]) <= 0.97


def test_where_one_draw_has_nearly_all_of_the_excess_the_interval_stays_of_its_size() -> None:
    low, high = interval_of_mean([1.07, *[1.000001] * 9], above=1.0)[1:]
    assert low == 1.0
    assert 1.01 < high < 1.05


def test_values_below_what_they_cannot_be_below_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot be below 0"):
        interval_of_mean([-1.0, -2.0, -1.5], above=0.0)
