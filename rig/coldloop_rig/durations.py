"""Durations of plant time as people write them."""

import re
from argparse import ArgumentTypeError
from typing import Final, NamedTuple

from coldloop.errors import UsageError
from coldloop.process.updating_periods import whole_ticks

LONGEST_TICKS: Final = 2**32 - 1
"""Ticks are 32-bit numbers on the bus."""
_UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


class Duration(NamedTuple):
    """A duration of any process, as it was written."""

    text: str
    seconds: float

    def __str__(self) -> str:
        """Return it as it was written."""
        return self.text

    def ticks(self, tick_s: float, what: str = "argument --duration") -> int:
        """Return it in ticks; `what` names it in messages.

        Raises:
            UsageError: It is longer than a session can be, or no multiple of a tick.
        """
        if not self.seconds < LONGEST_TICKS * tick_s:
            raise UsageError(f"{what}: '{self.text}' is longer than a session can be, {LONGEST_TICKS * tick_s:g} s")
        ticks = whole_ticks(self.seconds, tick_s)
        if ticks is None:
            raise UsageError(f"{what}: '{self.text}' is not a multiple of {tick_s} s")
        return ticks


def duration(text: str) -> Duration:
    """Return a duration such as 90, 90s, 15min or 2h."""
    match = re.fullmatch(r"([+-]?\d+(?:\.\d+)?)\s*([a-z]*)", text.strip().lower())
    if match is None or match[2] not in _UNITS:
        raise ArgumentTypeError(f"'{text}' is not a duration; write 90s, 15min or 2h")
    seconds = float(match[1]) * _UNITS[match[2]]
    if seconds <= 0:
        raise ArgumentTypeError(f"'{text}' is not positive; write 90s, 15min or 2h")
    return Duration(text, seconds)
