"""Means over hours with intervals, and the share of a gap that a rule closes."""

from collections.abc import Callable, Sequence
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
    missing: float = 0.0
    """Share of the resamples in which there is no such value; the interval is of the others."""

    def text(self, digits: int = 3) -> str:
        """Write the value and the interval in brackets, which a single hour has not."""
        if np.isnan(self.low):
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} [{self.low:.{digits}f}, {self.high:.{digits}f}]"

    def brief(self, digits: int = 3) -> str:
        """Write value and interval with so many significant digits, and how often there is none."""
        value = f"{self.value:.{digits}g}" if np.isfinite(self.value) else "none"
        if not np.isfinite(self.low):
            return value
        absent = f"; none in {100 * self.missing:.0f} %" if self.missing >= 0.005 else ""
        return f"{value} [{self.low:.{digits}g} to {self.high:.{digits}g}{absent}]"


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
    drawn = np.array([statistic(hours[pick]) for pick in picks])
    known = drawn[np.isfinite(drawn)]
    low, high = np.quantile(known, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]) if len(known) else (np.nan, np.nan)
    return Interval(value, float(low), float(high), 1.0 - len(known) / RESAMPLES)


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


def over_draws(statistic: Callable[[list[int]], float], draws: int) -> Interval:
    """Return the interval of a statistic that is a function of the numbers of the draws it is computed from."""
    return resampled(lambda rows: statistic([int(number) for number in rows[:, 0]]), np.arange(float(draws))[:, None])


def interval_of_mean(values: Sequence[float]) -> Interval:
    """Return the interval of the mean of one value a draw; draws without a value are left out."""
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return Interval(np.nan, np.nan, np.nan, 1.0)
    return resampled(lambda rows: float(rows.mean()), known[:, None])
