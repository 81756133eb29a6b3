"""Times that people write, in whole ticks."""

from coldloop.process.signals import TICK_S

TOLERANCE = 1e-9
"""Share of a tick: 0.3 s are three ticks of 0.1 s, although floats do not think so."""


def whole_ticks(seconds: float) -> int:
    """Return how many ticks a time is.

    Raises:
        ValueError: It is no multiple of a tick, or no number.
    """
    ticks = seconds / TICK_S
    if not abs(ticks - round(ticks)) <= TOLERANCE * max(1.0, abs(ticks)):
        raise ValueError(f"{seconds:g} s is not a multiple of {TICK_S:g} s")
    return round(ticks)
