"""Means over hours with intervals, and the share of a gap that a rule closes."""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from rig.studies.request import Series

RESAMPLES: Final = 2000
LEVEL: Final = 0.95
SEED: Final = 20


class Interval(NamedTuple):
    """A value with its percentile interval."""

    value: float
    low: float
    high: float

    def text(self, digits: int = 3) -> str:
        """Write the value and the interval in brackets, which a single hour has not."""
        if np.isnan(self.low):
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} [{self.low:.{digits}f}, {self.high:.{digits}f}]"


def resampled(statistic: Callable[[Series], float], hours: Series) -> Interval:
    """Return a statistic of some hours, with its bootstrap percentile interval at `LEVEL` (Efron and Tibshirani, 1993).

    Args:
        statistic: Of rows of `hours`; whole rows are drawn, so what was measured in one hour stays together.
        hours: One row an hour, shape (n, k). Of one hour there is no interval: it is NaN.
    """
    value = statistic(hours)
    if len(hours) < 2:
        return Interval(value, np.nan, np.nan)
    picks = np.random.default_rng(SEED).integers(len(hours), size=(RESAMPLES, len(hours)))
    drawn = [statistic(hours[pick]) for pick in picks]
    low, high = np.nanquantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(value, float(low), float(high))


def geometric_mean(ratios: Series) -> float:
    """Return the geometric mean of positive numbers."""
    return float(np.exp(np.log(ratios).mean()))


def mean_ratio(costs: Series, reference: Series) -> Interval:
    """Return the geometric mean over the hours of costs over reference, shape (n,) each."""
    return resampled(lambda rows: geometric_mean(rows[:, 0] / rows[:, 1]), np.column_stack([costs, reference]))


def gap_closed(costs: Series, reference: Series, best: Series) -> Interval:
    """Return the share of the gap between a reference and the best that a rule closes.

    It is sum ln(reference / costs) over sum ln(reference / best), over the hours: 0 for the reference itself, 1 for the
    best, below 0 for what is worse than the reference. All have shape (n,). NaN where there is no gap.
    """

    def share(rows: Series) -> float:
        cost, usual, least = np.log(rows).T
        gap = float((usual - least).sum())
        return float((usual - cost).sum()) / gap if gap > 0 else np.nan

    return resampled(share, np.column_stack([costs, reference, best]))
