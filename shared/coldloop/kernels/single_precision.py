"""Single precision, in which everything crosses the link, computed with Python's doubles."""

import math
import struct

SMALLEST = float(struct.unpack(">f", b"\0\0\0\1")[0])


def single(value: float) -> float:
    """Return the single-precision number nearest to `value` (OverflowError beyond the largest one)."""
    return float(struct.unpack(">f", struct.pack(">f", value))[0])


def neighbour(value: float, target: float) -> float:
    """Return the next single-precision number from `value`, which is one, on the way to `target`."""
    if value == 0.0:
        return math.copysign(SMALLEST, target)
    bits: int = struct.unpack(">i", struct.pack(">f", value))[0]
    away_from_zero = (target > value) == (value > 0.0)
    return float(struct.unpack(">f", struct.pack(">i", bits + (1 if away_from_zero else -1)))[0])
