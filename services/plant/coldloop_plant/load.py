"""Heat loads by name (hours of the paper's kind, or a file), and the load of a session under way.

The paper does not print its load profiles. The six hours a to f are random telegraphs about the load of the operating
point, each of another family (below). `a@2` is a second draw of the family of hour a.

For a process that has no named loads of its own these are stretched: in time as its tick is longer, in size so that
200 W are the way from the operating point's load to the nearer end of its span.
"""

import random
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from coldloop.errors import LoadFileError
from coldloop.process import declaration, load_profile, sections
from coldloop.registers.plant import LOAD_ROWS, LoadStatus, LoadStep

SECOND_TICKS: Final = round(1.0 / declaration.REFERENCE_TICK_S)
"""Ticks of what is a second in the families below, of a process that is not stretched."""
HOUR_TICKS: Final = 3600 * SECOND_TICKS
LARGEST_STEP: Final = 200.0  # Largest load step of the six families, W


class LoadFamily(NamedTuple):
    """A family of random telegraphs: steps from the mean load (W), and how long they last (s)."""

    steps: tuple[float, ...]
    shortest_s: float
    longest_s: float
    seed: int
    in_turn: bool = False
    """A train of pulses instead: the first step for the longest time, then the second for the shortest, and so on."""


HOURS: Final = {
    "a": LoadFamily((0.0, 60.0, -60.0), 60.0, 400.0, 11),
    "b": LoadFamily((0.0, 75.0, -75.0, 100.0, -100.0), 40.0, 300.0, 12),
    "c": LoadFamily((0.0, 60.0, -60.0, 100.0, -150.0), 20.0, 200.0, 13),
    "d": LoadFamily((0.0, 150.0, -75.0, -75.0), 40.0, 240.0, 14),
    "e": LoadFamily((0.0, 200.0, -100.0, -100.0, -60.0), 20.0, 120.0, 15),
    "f": LoadFamily((0.0, 75.0, -75.0, 100.0, -60.0, 150.0, -200.0), 20.0, 160.0, 16),
    **{
        str(hour): LoadFamily((0.0, 60.0, -60.0, 100.0, -100.0, 150.0), 60.0, 400.0, 20 + hour) for hour in range(1, 9)
    },  # sustained loads, under which throttled qpOASES predicts violations as large as in the paper (c1 of 20)
    "pulses": LoadFamily((-45.0, 135.0), 150.0, 450.0, 30, in_turn=True),  # like the magnets of a tokamak
    "quench": LoadFamily((0.0, 5000.0), 30.0, 1800.0, 31, in_turn=True),  # their stored energy, into the bath
}

NAMED: Final = {
    **{name: (name,) for name in "abcdef"},
    "2h": ("a", "b"),
    "6h": tuple("abcdef"),
    "8h": tuple("12345678"),
    "pulses": ("pulses",),
    "quench": ("quench",),
}


DRAW_SEEDS: Final = 1000  # Between the seed of a family's draw and that of the next


def telegraph(family: LoadFamily, mean_w: float) -> load_profile.LoadProfile:
    """Return one hour of a family about `mean_w`, in whole ticks, starting at the mean."""
    draw = random.Random(family.seed).random  # noqa: S311 not for secrets; the one generator stable over versions
    times, watts = [0], [mean_w]
    tick = round(family.longest_s * SECOND_TICKS)
    if family.in_turn:  # it begins at the mean for a share of the longest time
        tick = 1 + round(draw() * family.longest_s * SECOND_TICKS)
    while tick < HOUR_TICKS:
        if family.in_turn:
            rising = watts[-1] == mean_w + family.steps[0]
            step, lasting = family.steps[rising], family.shortest_s if rising else family.longest_s
        else:
            step = family.steps[int(draw() * len(family.steps))]
            lasting = family.shortest_s + draw() * (family.longest_s - family.shortest_s)
        if mean_w + step != watts[-1]:
            times.append(tick)
            watts.append(mean_w + step)
        tick += round(lasting * SECOND_TICKS)
    return load_profile.LoadProfile(tuple(times), tuple(watts))


def concatenated(hours: list[load_profile.LoadProfile]) -> load_profile.LoadProfile:
    """Return one-hour profiles one after the other."""
    steps: list[tuple[int, float]] = []
    for hour, profile in enumerate(hours):
        for time, load in zip(profile.times, profile.watts, strict=True):
            if not steps or load != steps[-1][1]:
                steps.append((hour * HOUR_TICKS + time, load))
    return load_profile.LoadProfile(*zip(*steps, strict=True))


def named_families(name: str) -> list[LoadFamily] | None:
    """Return the family of each hour of a load's name, such as `2h` or `2h@3` for its third draw; None for others.

    Raises:
        LoadFileError: The draw is not a number from 1 on.
    """
    base, at, draw = name.partition("@")
    if base not in NAMED:
        return None
    if at and not (draw.isdecimal() and 1 <= int(draw) <= 10**6):
        raise LoadFileError(f"load {name}: '{draw}' is not a draw; write {base}@2 for the second one")
    seeds = DRAW_SEEDS * (int(draw) - 1 if at else 0)
    return [HOURS[hour]._replace(seed=HOURS[hour].seed + seeds) for hour in NAMED[base]]


def drawn(family: LoadFamily, name: str, mean: float, process: declaration.Process) -> load_profile.LoadProfile:
    """Return an hour of a family about the mean load of a process.

    Of one without named loads the largest step is the way from the mean to the nearer end of the load's span.

    Raises:
        LoadFileError: The steps of such a family are larger than those of the six hours.
    """
    if not process.load.has_named_loads:
        low, high = process.load.span
        if max(map(abs, family.steps)) > LARGEST_STEP:
            raise LoadFileError(f"load {name}: of a refrigerator; name another, or a CSV file with loads of this plant")
        scale = min(mean - low, high - mean) / LARGEST_STEP
        family = family._replace(steps=tuple(scale * step for step in family.steps))
    return telegraph(family, mean)


def find_load(name: str, mean_w: float, process: declaration.Process) -> load_profile.LoadProfile:
    """Return the load of a name or of a CSV file for a process.

    Raises:
        LoadFileError: There is neither such a name nor a file that can be read, or the mean is too low for its steps.
    """
    families = named_families(name)
    if families is not None:
        lowest = mean_w + min(step for family in families for step in family.steps)
        if process.load.has_named_loads and lowest < process.load.stored_span[0]:
            raise LoadFileError(
                f"load {name}: would go down to {lowest:.0f} W about {mean_w:.0f} W, the load of the model's operating"
                " point; name a CSV file with loads of this plant"
            )
        return concatenated([drawn(family, name, mean_w, process) for family in families])
    path = Path(name)
    if not path.exists():
        raise LoadFileError(f"load {name}: neither a file nor one of {', '.join(NAMED)}")
    return load_profile.read_load_file(path, process)


MOST_UPCOMING: Final = 2 * LOAD_ROWS  # Steps to come that are kept
FORGET_AT: Final = 256  # Steps that are past are forgotten when they are so many


class LoadSchedule:
    """The load of a session under way, by tick: what is held, and the steps that are known to come.

    It begins with the load table of the session, and can be changed from any tick on that is still to come. Steps that
    are past are forgotten, so that a load of any length passes through.

    Args:
        profile: What is known at first.
        load: What a load of the process may be.
    """

    def __init__(self, profile: load_profile.LoadProfile, load: sections.Load) -> None:
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

    def from_tick(self, now: int) -> load_profile.LoadProfile:
        """Return the load from tick `now` on; what was before is given as what is held now."""
        place = self._place(now)
        return load_profile.LoadProfile((0, *self._times[place + 1 :]), tuple(self._watts[place:]))
