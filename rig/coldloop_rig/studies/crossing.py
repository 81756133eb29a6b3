"""Where one curve against power comes down to another."""

import numpy as np
from numpy.typing import NDArray

Series = NDArray[np.float64]


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
