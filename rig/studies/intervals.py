"""Percentile intervals of what is computed from several draws (bootstrap: Efron, 1979), the same every time."""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.intp]

LEVEL: Final = 0.95
RESAMPLES: Final = 2000
SEED: Final = 1


class Interval(NamedTuple):
    """A statistic of all draws, and the percentiles of what it is over draws drawn again with replacement."""

    value: float
    low: float
    high: float
    missing: float
    """Share of the resamples in which it does not exist; the percentiles are of the others."""

    def text(self) -> str:
        """Return value and interval, and how often there is none."""
        if not np.isfinite(self.low):
            return "none"
        absent = f"; none in {100 * self.missing:.0f} %" if self.missing else ""
        value = f"{self.value:.3g}" if np.isfinite(self.value) else "none"
        return f"{value} [{self.low:.3g} to {self.high:.3g}{absent}]"


def percentile_interval(statistic: Callable[[Indices], float], draws: int) -> Interval:
    """Return the interval of a statistic, which is a function of the numbers of the draws that it is computed from."""
    rng = np.random.default_rng(SEED)
    found = np.array([statistic(rng.integers(draws, size=draws)) for _ in range(RESAMPLES)])
    known = found[np.isfinite(found)]
    edges = 50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)
    low, high = np.percentile(known, edges) if len(known) else (np.nan, np.nan)
    return Interval(statistic(np.arange(draws)), float(low), float(high), 1.0 - len(known) / RESAMPLES)


def interval_of_mean(values: Sequence[float]) -> Interval:
    """Return the interval of the mean of one value a draw; draws without a value are left out."""
    known = np.array([value for value in values if np.isfinite(value)])
    if not len(known):
        return Interval(np.nan, np.nan, np.nan, 1.0)
    return percentile_interval(lambda which: float(known[which].mean()), len(known))
