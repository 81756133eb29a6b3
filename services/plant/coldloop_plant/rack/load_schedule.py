"""The heat load of a session under way: what is held, and the steps that are known to come.

It begins with the load table of the session, and can be changed from any tick on that is still to come. Steps that are
past are forgotten, so that a load of any length passes through.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from coldloop.process.load_profile import LoadProfile
from coldloop.process.sections import Load
from coldloop.registers.plant import LOAD_ROWS, LoadStatus, LoadStep

MOST_UPCOMING: Final = 2 * LOAD_ROWS
"""Steps to come that are kept."""
FORGET_AT: Final = 256
"""Steps that are past are forgotten when they are so many."""


class LoadSchedule:
    """Steps of the load by tick, each held until the next one.

    Args:
        profile: What is known at first.
        load: What a load of the process may be.
    """

    def __init__(self, profile: LoadProfile, load: Load) -> None:
        self._load = load
        self._times = list(profile.times)
        self._watts = list(profile.watts)

    def value(self, tick: int) -> float:
        """Return the load (W) at `tick`, which is not long past."""
        return self._watts[self._place(tick)]

    def _place(self, tick: int) -> int:
        return max(0, bisect_right(self._times, tick) - 1)

    def check(self, steps: Sequence[LoadStep], now: int) -> None:
        """Judge steps that `put` is to take at tick `now`.

        Raises:
            ValueError: They are not to come, do not follow each other, are no loads, or are too many.
        """
        if not steps:
            raise ValueError("no steps")
        if steps[0].tick <= now:
            raise ValueError(f"tick {steps[0].tick} is past: the plant is at tick {now}")
        for before, step in pairwise(steps):
            if step.tick <= before.tick:
                raise ValueError(f"tick {step.tick} does not come after {before.tick}")
        (low, high), unit = self._load.stored_span, self._load.unit
        for step in steps:
            if not low <= step.watts <= high:
                raise ValueError(f"{step.watts:g} {unit} is outside {low:g} to {high:g} {unit}")
        kept = max(0, bisect_left(self._times, steps[0].tick) - 1 - self._place(now))
        if kept + len(steps) > MOST_UPCOMING:
            raise ValueError(f"{kept} of at most {MOST_UPCOMING} steps are scheduled already: write these later")

    def put(self, steps: Sequence[LoadStep], now: int) -> None:
        """Take steps that `check` has found good; what was known from the first of them on is dropped."""
        keep = bisect_left(self._times, steps[0].tick)
        self._times[keep:] = [step.tick for step in steps]
        self._watts[keep:] = [step.watts for step in steps]
        past = self._place(now)
        if past >= FORGET_AT:
            del self._times[:past], self._watts[:past]

    def status(self, now: int) -> LoadStatus:
        """Return what is known at tick `now`."""
        place = self._place(now)
        upcoming = len(self._times) - 1 - place
        coming = (self._times[place + 1], self._watts[place + 1]) if upcoming else (0, 0.0)
        free = max(0, MOST_UPCOMING - upcoming)
        return LoadStatus(self._watts[place], *coming, self._times[-1], min(upcoming, 0xFFFF), free)

    def from_tick(self, now: int) -> LoadProfile:
        """Return the load from tick `now` on; what was before is given as what is held now."""
        place = self._place(now)
        return LoadProfile((0, *self._times[place + 1 :]), tuple(self._watts[place:]))
