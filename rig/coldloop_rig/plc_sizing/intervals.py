"""Statistics of some hours or draws with their 95 % intervals."""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from coldloop_rig.plc_sizing.certification import failure_bound

Series = NDArray[np.float64]

TAIL: Final = 0.025
"""Probability on each side of an interval."""
MOST_CHANGE: Final = 2.0
"""Change of a logarithm when a draw is left out, up to which it is taken for smooth."""


class Interval(NamedTuple):
    """A value with its interval: NaN if there is none, infinite on a side where nothing is known."""

    value: float
    low: float
    high: float

    def text(self, digits: int = 3) -> str:
        """Write the value and the interval in brackets, which a single hour has not."""
        if np.isnan(self.low):
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} [{self.low:.{digits}f}, {self.high:.{digits}f}]"

    def in_words(self, below: str, above: str, without: str) -> str:
        """Return what it shows of a ratio: that it is below 1, above 1, neither, or that there is no interval."""
        if np.isnan(self.low):
            return without
        if self.high < 1.0:
            return below
        return above if self.low > 1.0 else "no difference is shown"

    def brief(self, digits: int = 3) -> str:
        """Write value and interval with so many significant digits."""
        value = f"{self.value:.{digits}g}" if np.isfinite(self.value) else "none"
        return value if np.isnan(self.low) else f"{value} [{self.low:.{digits}g} to {self.high:.{digits}g}]"


def jackknife(statistic: Callable[[list[int]], float], draws: int, above: float = -np.inf) -> Interval:
    """Return a statistic of draws with its interval by the jackknife and Student's t (Efron and Tibshirani, 1993).

    Its values without each draw in turn give its variance, with draws - 1 degrees of freedom. Of a mean this is
    Student's interval, and of a geometric mean that of the logarithms. With 3 to 12 log-normal draws it covers
    geometric means in 95 %, means and ratios of sums in 92 to 95 % if draws are alike, and in less if few decide
    (docs/studies.md); percentiles of a bootstrap cover 72 to 91 %.

    Args:
        statistic: Of the numbers of the draws it is computed from, 0 to `draws` - 1.
        draws: Of one draw there is no interval: it is NaN. Without limits if there is no value without some draw.
        above: The statistic cannot be less: the interval is one of the logarithm of the distance from it, unless a
            draw changes this by more than `MOST_CHANGE`; then it is cut off there.

    Raises:
        ValueError: The statistic is below `above`.
    """
    every = range(draws)
    value = statistic(list(every))
    if draws < 2 or not np.isfinite(value):
        return Interval(value, np.nan, np.nan)
    without = np.array([statistic([draw for draw in every if draw != left]) for left in every])
    if not np.isfinite(without).all():
        return Interval(value, above, np.inf)
    least = min(value, *without)
    if least < above:
        raise ValueError(f"a statistic of {least:g} that cannot be below {above:g}")
    changes = without - value
    logarithmic = -np.inf < above < least
    if logarithmic:
        logarithms = np.log((without - above) / (value - above))
        logarithmic = bool(np.abs(logarithms).max() < MOST_CHANGE)
        changes = logarithms if logarithmic else changes
    reach = float(stdtrit(draws - 1, 1.0 - TAIL) * np.sqrt((draws - 1) * changes.var()))
    if logarithmic:
        factor = float(np.exp(reach))
        return Interval(value, above + (value - above) / factor, above + (value - above) * factor)
    return Interval(value, max(value - reach, above), value + reach)


def interval_of_share(of_interest: int, hours: int) -> Interval:
    """Return a share of the hours with its Clopper-Pearson interval.

    It covers 95 to 100 %, with 3 hours 98 to 100 %: a count has few values, and no interval covers 95 % of each share.
    """
    low = 1.0 - failure_bound(hours - of_interest, hours, TAIL)
    return Interval(of_interest / hours, low, failure_bound(of_interest, hours, TAIL))


def geometric_mean(ratios: Series) -> float:
    """Return the geometric mean of positive numbers."""
    return float(np.exp(np.log(ratios).mean()))


def mean_ratio(costs: Series, reference: Series) -> Interval:
    """Return the geometric mean over the hours of costs over reference, shape (n,) each."""
    ratios = costs / reference
    return jackknife(lambda which: geometric_mean(ratios[which]), len(ratios), above=0.0)


def interval_of_mean(values: Sequence[float], above: float = -np.inf) -> Interval:
    """Return the mean of one value a draw, none less than `above`; draws without a value are left out."""
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return Interval(np.nan, np.nan, np.nan)
    return jackknife(lambda which: float(known[which].mean()), len(known), above)


def crossing(powers: Series, one: Series, other: Series) -> float:
    """Return the power from which on `one` is not above `other` any more; NaN if there is none."""
    above = np.log(one / other)
    if not np.isfinite(above).all():
        return float("nan")
    behind = np.flatnonzero(above > 0)
    if len(behind) == 0 or behind[-1] == len(powers) - 1:
        return float("nan") if len(behind) else float(powers[0])
    i = behind[-1]
    share = above[i] / (above[i] - above[i + 1])
    return float(np.exp(np.interp(share, [0, 1], np.log(powers[i : i + 2]))))
