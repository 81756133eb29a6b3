"""Single precision, in which everything crosses the link, computed with Python's doubles."""

import struct
from typing import Final

# A number plus 0.625 to 1.25 of the distance to its neighbour is nearest to that neighbour, up and down a power of two.
STEP: Final = 0.625 * 2.0**-23
"""Such a share of the number itself."""
SMALLEST_STEP: Final = 0.625 * 2.0**-149
"""Step of the smallest numbers, which are all as far apart."""


def single(value: float) -> float:
    """Return the single-precision number nearest to `value` (OverflowError beyond the largest one)."""
    return float(struct.unpack(">f", struct.pack(">f", value))[0])


def neighbour(value: float, target: float) -> float:
    """Return the next single-precision number from `value`, which is one, on the way to `target`."""
    step = max(abs(value) * STEP, SMALLEST_STEP)
    return single(value + step if target > value else value - step)
