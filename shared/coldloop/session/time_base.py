"""The time base of a session under way."""

from typing import NamedTuple


class TimeBase(NamedTuple):
    """In lock-step the factor has no meaning."""

    realtime: bool
    factor: float
    """Seconds of plant time in one second of real time."""
    paused: bool = False
    """In real time: plant time is stopped until it is resumed."""
