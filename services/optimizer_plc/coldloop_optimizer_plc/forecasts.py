"""What is forecast of the load and of other disturbances, as the problem takes it: changes from what is, by parts."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coldloop.process.declaration import Process

Array = NDArray[np.float64]


class Forecasts:
    """Forecasts over plant time. Only their changes count: how large a disturbance is now is measured or estimated.

    Args:
        process: With its forecasts.
        ends: Last samples of the parts of the horizon, rising.
    """

    def __init__(self, process: Process, ends: Sequence[int]) -> None:
        self._edges = process.ticks_per_sample * np.array([0, *ends])
        self._courses = []
        for one in process.forecasts:
            ticks, values = np.array(one.ticks, dtype=np.float64), np.array(one.values)
            until = np.concatenate([[0.0], np.cumsum(np.diff(ticks) * values[:-1])])
            self._courses.append((ticks, values, until))

    def __len__(self) -> int:
        return len(self._courses) * (len(self._edges) - 1)

    def changes(self, tick: int) -> Array:
        """Return for each forecast its mean over each part of a horizon that begins at `tick`, less what it is there.

        Shape (forecasts x parts,), in the units of the disturbances.
        """
        parts = []
        for ticks, values, until in self._courses:
            at = tick + self._edges
            step = np.searchsorted(ticks, at, side="right") - 1
            integral = until[step] + values[step] * (at - ticks[step])
            parts.append(np.diff(integral) / np.diff(self._edges) - values[step[0]])
        return np.concatenate(parts)
