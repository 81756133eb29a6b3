"""The last thing between any decision and the actuators: bounds and rates."""

import math
import struct
from collections.abc import Sequence
from typing import NamedTuple

from coldloop.limits import InputLimits
from coldloop.process import TICKS_PER_SAMPLE
from coldloop.registers.control_plc import SequenceRow

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
    """Keeps every output inside its bounds and inside its rate window, whatever is asked."""

    def __init__(self, limits: InputLimits, applied: SequenceRow) -> None:
        self._limits = limits
        self._slack = [TOLERANCE * (high - low) for low, high in zip(limits.low, limits.high, strict=True)]
        self.applied = SequenceRow(*map(_inside, applied, limits.low, limits.high))
        self._astray = False
        self._window = Window(self.applied, 0, 1.0, -TICKS_PER_SAMPLE)

    def begin_at(self, tick: int, applied: SequenceRow) -> None:
        """Go on from what is applied at `tick`, wherever that is; it counts as having moved just then.

        A window that is open stays open: breaks that follow one another would else give a full rate each.
        """
        window = self._window
        goes_on = 0 <= tick - window.start < TICKS_PER_SAMPLE and all(
            abs(value - anchor) <= rate * window.share
            for value, anchor, rate in zip(applied, window.anchor, self._limits.rate, strict=True)
        )
        self.applied = applied
        self._astray = self.out_of_range([applied])
        if not goes_on:
            self._window = Window(applied, tick, self._limits.rate_share(0), tick)

    def admit(self, tick: int, wanted: SequenceRow, *, update: bool) -> SequenceRow:
        """Return what may be applied at `tick`, and remember it as applied."""
        limits = self._limits
        window = self._window = self._window.at(tick, self.applied, limits, update=update)
        if wanted == self.applied and not self._astray:  # it was admitted before, and a new window begins with it
            return wanted
        applied = SequenceRow(
            *[
                _clamped(
                    wanted[i],
                    window.anchor[i],
                    self.applied[i],
                    limits.rate[i] * window.share,
                    limits.low[i],
                    limits.high[i],
                )
                for i in range(len(wanted))
            ]
        )
        if applied != self.applied:
            self._window = window._replace(moved=tick)
        self.applied = applied
        self._astray = self._astray and self.out_of_range([applied])
        return applied

    def exceeds(self, rows: Sequence[SequenceRow], first_tick: int, before: SequenceRow) -> bool:
        """Tell whether a sequence that begins at `first_tick`, after `before`, would break a rate."""
        limits, window = self._limits, self._window
        for tick, row in enumerate(rows, first_tick):
            window = window.at(tick, before, limits, update=tick == first_tick)
            if row == before:
                continue
            for value, anchor, last, rate, slack in zip(
                row, window.anchor, before, limits.rate, self._slack, strict=True
            ):
                if max(abs(value - anchor), abs(value - last)) > rate * window.share + slack:
                    return True
            window = window._replace(moved=tick)
            before = row
        return False

    def out_of_range(self, rows: Sequence[SequenceRow]) -> bool:
        """Tell whether a row holds a value that is not finite or outside the bounds."""
        for row in set(rows):
            for value, low, high, slack in zip(row, self._limits.low, self._limits.high, self._slack, strict=True):
                if not low - slack <= value <= high + slack:  # not true of NaN either
                    return True
        return False


def _clamped(wanted: float, anchor: float, applied: float, reach: float, low: float, high: float) -> float:
    """Return the single-precision value nearest to `wanted` in low..high, within `reach` of `anchor` and of `applied`.

    From an anchor outside low..high it goes towards them, as far as `reach` lets it.
    """
    if not math.isfinite(wanted):
        wanted = anchor
    down, up = max(anchor, applied) - reach, min(anchor, applied) + reach
    lowest, highest = min(max(low, down), up), max(min(high, up), down)
    inside = low <= anchor <= high
    value = _single(min(max(wanted, lowest), highest))
    for _ in range(ROUNDING_STEPS):
        reachable = abs(value - anchor) <= reach and abs(value - applied) <= reach
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
