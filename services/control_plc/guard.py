"""The last thing between any decision and the actuators: bounds and rates."""

import math
import struct
from collections import deque
from collections.abc import Sequence
from copy import copy
from typing import NamedTuple, Self

from coldloop.limits import InputLimits
from coldloop.process import TICKS_PER_SAMPLE
from coldloop.registers.control_plc import SequenceRow, Verdict

TOLERANCE = 1e-5
"""Share of an input's range by which a sequence may miss a limit: single precision cannot tell it apart. The guard
itself allows nothing."""


ROUNDING_STEPS = 4
"""Neighbours that are tried when rounding to single precision has crossed a limit; one or two will do."""


class Window(NamedTuple):
    """The rate window: the inputs may stray from `anchor` by `share` of the rate until the window ends.

    A window lasts one sampling period of 5 s, or until the next sequence begins. Its share depends on how long ago the
    inputs last moved.
    """

    anchor: SequenceRow
    """Input applied before the window began."""
    start: int
    share: float
    moved: int
    """Tick of the last change of an input."""

    def at(self, tick: int, applied: SequenceRow, limits: InputLimits, *, update: bool) -> "Window":
        """Return the window that holds at `tick`, where `update` tells that a sequence begins there."""
        if update or tick - self.start >= TICKS_PER_SAMPLE:
            return Window(applied, tick, limits.rate_share(tick - self.moved), self.moved)
        return self


class OutputGuard:
    """Keeps every output inside its bounds, its rate window and the slew limit, whatever is asked."""

    def __init__(self, limits: InputLimits, applied: SequenceRow) -> None:
        self._limits = limits
        self._slack = [TOLERANCE * (high - low) for low, high in zip(limits.low, limits.high, strict=True)]
        self.applied = SequenceRow(*map(_inside, applied, limits.low, limits.high))
        self._astray = False
        self._window = Window(self.applied, 0, 1.0, -TICKS_PER_SAMPLE)
        self._moves: deque[tuple[int, SequenceRow]] = deque(maxlen=limits.slew_ticks)
        """Tick of each of the last changes, and what was applied before it."""

    def copy(self) -> Self:
        """Return a guard that goes on from the same state."""
        twin = copy(self)
        twin._moves = self._moves.copy()  # noqa: SLF001 - its own class
        return twin

    def begin_at(self, tick: int, applied: SequenceRow) -> None:
        """Go on from what is applied at `tick`, wherever that is; it counts as having moved just then.

        A window that is open stays open: breaks that follow one another would else give a full rate each. A value that
        is not finite is not taken over: the last finite one stays.
        """
        applied = SequenceRow(
            *[value if math.isfinite(value) else last for value, last in zip(applied, self.applied, strict=True)]
        )
        window = self._window
        goes_on = 0 <= tick - window.start < TICKS_PER_SAMPLE and all(
            abs(value - anchor) <= rate * window.share
            for value, anchor, rate in zip(applied, window.anchor, self._limits.rate, strict=True)
        )
        self._moves = deque(
            [(min(moved, tick), before) for moved, before in self._moves if self._reaches(before, applied)],
            maxlen=self._moves.maxlen,
        )
        self.applied = applied
        self._astray = self.out_of_range([applied])
        if not goes_on:
            self._window = Window(applied, tick, self._limits.rate_share(0), tick)

    def _reaches(self, before: SequenceRow, applied: SequenceRow) -> bool:
        """Whether what is applied is within the rate of an earlier value: else it limits nothing any more."""
        return all(
            abs(value - earlier) <= rate
            for value, earlier, rate in zip(applied, before, self._limits.rate, strict=True)
        )

    def admit(self, tick: int, wanted: SequenceRow, *, update: bool) -> SequenceRow:
        """Return what may be applied at `tick`, and remember it as applied."""
        limits = self._limits
        window = self._window = self._window.at(tick, self.applied, limits, update=update)
        if wanted == self.applied and not self._astray:  # it was admitted before, and a new window begins with it
            return wanted
        recent = [before for moved, before in self._moves if tick - moved < limits.slew_ticks]
        applied = SequenceRow(
            *[
                _clamped(
                    wanted[i],
                    self.applied[i],
                    window.anchor[i],
                    limits.rate[i] * window.share,
                    [(before[i], limits.rate[i]) for before in recent],
                    (limits.low[i], limits.high[i]),
                )
                for i in range(len(wanted))
            ]
        )
        if applied != self.applied:
            self._window = window._replace(moved=tick)
            self._moves.append((tick, self.applied))
        self.applied = applied
        self._astray = self._astray and self.out_of_range([applied])
        return applied

    def judge(self, rows: Sequence[SequenceRow], first_tick: int, meanwhile: Sequence[SequenceRow | None]) -> Verdict:
        """Judge a sequence as it would be played: the guard would let all of it pass, or it is refused.

        Args:
            rows: One row a tick.
            first_tick: Tick of the first one.
            meanwhile: What will be played in the ticks before, where something will be.
        """
        twin = self.copy()
        for tick, row in enumerate(meanwhile, first_tick - len(meanwhile)):
            twin.admit(tick, twin.applied if row is None else row, update=False)
        for tick, row in enumerate(rows, first_tick):
            admitted = twin.admit(tick, row, update=tick == first_tick)
            if any(abs(value - asked) > slack for value, asked, slack in zip(admitted, row, self._slack, strict=True)):
                return Verdict.RATE_EXCEEDED
        return Verdict.ACCEPTED

    def out_of_range(self, rows: Sequence[SequenceRow]) -> bool:
        """Tell whether a row holds a value that is not finite or outside the bounds."""
        for row in set(rows):
            for value, low, high, slack in zip(row, self._limits.low, self._limits.high, self._slack, strict=True):
                if not low - slack <= value <= high + slack:  # not true of NaN either
                    return True
        return False


def _clamped(
    wanted: float,
    applied: float,
    anchor: float,
    reach: float,
    recent: Sequence[tuple[float, float]],
    bounds: tuple[float, float],
) -> float:
    """Return the single-precision value nearest to `wanted` inside the bounds and within reach.

    Args:
        wanted: Value asked for; one that is not finite asks for the anchor.
        applied: Value applied now.
        anchor: Value at the window's beginning.
        reach: How far the value may be from both.
        recent: Earlier values that count for the slew limit, and how far it may be from each.
        bounds: Lowest and highest value. From an anchor outside it goes towards them, as far as it may.
    """
    if not math.isfinite(wanted):
        wanted = anchor
    low, high = bounds
    references = [(anchor, reach), (applied, reach), *recent]
    down, up = max(value - far for value, far in references), min(value + far for value, far in references)
    lowest, highest = min(max(low, down), up), max(min(high, up), down)
    inside = low <= anchor <= high
    value = _single(min(max(wanted, lowest), highest))
    for _ in range(ROUNDING_STEPS):
        reachable = all(abs(value - reference) <= far for reference, far in references)
        if reachable and (low <= value <= high or not inside):
            return value
        value = _neighbour(value, anchor)  # rounding has crossed a limit
    return applied


def _inside(value: float, low: float, high: float) -> float:
    """Return the single-precision value nearest to `value` that lies in low..high."""
    value = _single(min(max(value, low), high))
    while not low <= value <= high:
        value = _neighbour(value, (low + high) / 2)
    return value


def _single(value: float) -> float:
    return float(struct.unpack(">f", struct.pack(">f", value))[0])


def _neighbour(value: float, target: float) -> float:
    """Return the next single-precision value from `value` on the way to `target`."""
    if value == 0.0:
        return math.copysign(float(struct.unpack(">f", b"\0\0\0\1")[0]), target)
    bits: int = struct.unpack(">i", struct.pack(">f", value))[0]
    away_from_zero = (target > value) == (value > 0.0)
    return float(struct.unpack(">f", struct.pack(">i", bits + (1 if away_from_zero else -1)))[0])
