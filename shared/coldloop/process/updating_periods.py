"""Times of any process: in ticks, as people write them; updating periods, and what a PLC computes in each."""

import math
import re
from argparse import ArgumentTypeError
from typing import Final, NamedTuple

from coldloop.errors import UsageError

SHORTEST_TICKS: Final = 2
TOLERANCE: Final = 1e-9
"""Share of a tick: 0.3 s are three ticks of 0.1 s, although floats do not think so."""
ROUNDING: Final = 1e-5
"""Share of an iteration that may be missing: times come through registers in single precision."""


MOST_ITERATIONS: Final = 0xFFFF
"""In an updating period, however fast the PLC: what their register holds; solvers have converged long before."""


class ComputingTimes(NamedTuple):
    """Times of one solver on its PLC, s, and what updating periods are made of."""

    slots: float
    """Kept free in an updating period for the preparation."""
    preparation: float
    iteration: float
    tick_s: float
    longest_ticks: int
    """Longest updating period: a sampling period."""

    def iterations(self, ticks: int) -> int:
        """Return the iterations that fit into an updating period; at least one is always done."""
        fitting = (ticks * self.tick_s - self.slots) / self.iteration + ROUNDING
        return max(1, math.floor(min(fitting, MOST_ITERATIONS)))

    def holds(self, ticks: int) -> bool:
        """Return whether one iteration fits into an updating period."""
        return ticks * self.tick_s - self.slots >= self.iteration * (1.0 - ROUNDING)

    def ladder(self) -> tuple[int, ...]:
        """Return the updating periods, in ticks, that hold more iterations than any shorter one.

        A rule's q is the number of a period in it, from 1. Where an iteration takes a slot of 0.25 s, as in the paper,
        or longer, it is the number of iterations as well; a faster solver does more in the same period.
        """
        found: list[int] = []
        for ticks in range(SHORTEST_TICKS, self.longest_ticks + 1):
            if self.holds(ticks) and not (found and self.iterations(ticks) == self.iterations(found[-1])):
                found.append(ticks)
        return tuple(found) or (self.longest_ticks,)

    def period(self, q: int) -> int:
        """Return the updating period of a q, in ticks; of one beyond the ladder its longest."""
        ladder = self.ladder()
        return ladder[min(q, len(ladder)) - 1]


def whole_ticks(seconds: float, tick_s: float) -> int | None:
    """Return how many ticks a time is; None if it is no multiple of a tick, or not finite."""
    ticks = seconds / tick_s
    if not math.isfinite(ticks) or abs(ticks - round(ticks)) > TOLERANCE * max(1.0, abs(ticks)):
        return None
    return round(ticks)


LONGEST_TICKS: Final = 2**32 - 1
"""Ticks are 32-bit numbers on the bus."""
UNITS: Final = {"": 1.0, "s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


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
    if match is None or match[2] not in UNITS:
        raise ArgumentTypeError(f"'{text}' is not a duration; write 90s, 15min or 2h")
    seconds = float(match[1]) * UNITS[match[2]]
    if seconds <= 0:
        raise ArgumentTypeError(f"'{text}' is not positive; write 90s, 15min or 2h")
    return Duration(text, seconds)
