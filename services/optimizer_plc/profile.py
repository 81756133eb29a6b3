"""The parametrised input profile U_pwc(p): piecewise affine between the decision instants, constant before the first.

Instants count sampling periods: u_j holds during the j-th one, from (j - 1) to j periods ahead.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def interpolation(knots: tuple[int, ...], at: Array) -> Array:
    """Return the matrix (len(at), len(knots)) whose product with the knots' values is the profile at `at`."""
    positions = np.asarray(knots, dtype=float)
    clamped = np.clip(np.asarray(at, dtype=float), positions[0], positions[-1])
    weights = np.zeros((len(clamped), len(positions)))
    for row, position in enumerate(clamped):
        right = min(int(np.searchsorted(positions, position, side="right")), len(positions) - 1)
        left = max(right - 1, 0)
        span = positions[right] - positions[left]
        share = (position - positions[left]) / span if span > 0 else 0.0
        weights[row, left] += 1.0 - share
        weights[row, right] += share
    return weights


def shift(knots: tuple[int, ...], periods: float) -> Array:
    """Return the matrix that shifts a profile by `periods` sampling periods: the standard hot start.

    The value behind the horizon is the last knot's.
    """
    return interpolation(knots, np.asarray(knots, dtype=float) + periods)
