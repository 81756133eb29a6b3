"""Times that people write, in whole ticks."""

import math

from coldloop.process.signals import TICK_S

TOLERANCE = 1e-9
"""Share of a tick: 0.3 s are three ticks of 0.1 s, although floats do not think so."""


def whole_ticks(seconds: float) -> int | None:
    """Return how many ticks a time is; None if it is no multiple of a tick, or not finite."""
    ticks = seconds / TICK_S
    if not math.isfinite(ticks) or abs(ticks - round(ticks)) > TOLERANCE * max(1.0, abs(ticks)):
        return None
    return round(ticks)
