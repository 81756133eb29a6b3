"""Durations of plant time as people write them."""

import re
from argparse import ArgumentTypeError
from typing import Final

from coldloop.process.signals import TICK_S
from coldloop.process.whole_ticks import whole_ticks

LONGEST_TICKS: Final = 2**32 - 1
"""Ticks are 32-bit numbers on the bus."""
_UNITS = {"": 1.0, "s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


def duration(text: str) -> int:
    """Return a duration such as 90, 90s, 15min or 2h as ticks."""
    match = re.fullmatch(r"([+-]?\d+(?:\.\d+)?)\s*([a-z]*)", text.strip().lower())
    if match is None or match[2] not in _UNITS:
        raise ArgumentTypeError(f"'{text}' is not a duration; write 90s, 15min or 2h")
    seconds = float(match[1]) * _UNITS[match[2]]
    if seconds <= 0:
        raise ArgumentTypeError(f"'{text}' is not positive; write 90s, 15min or 2h")
    if not seconds < LONGEST_TICKS * TICK_S:
        raise ArgumentTypeError(f"'{text}' is longer than a session can be, {LONGEST_TICKS * TICK_S:g} s")
    ticks = whole_ticks(seconds)
    if ticks is None:
        raise ArgumentTypeError(f"'{text}' is not a multiple of {TICK_S} s")
    return ticks
