"""The last thing between any decision and the actuators: bounds and rates."""

import math
import struct
from collections.abc import Sequence

from coldloop.limits import InputLimits
from coldloop.process import TICKS_PER_SAMPLE
from coldloop.registers.control_plc import SequenceRow

TOLERANCE = 1e-5
"""Share of an input's range by which a sequence may miss a limit: single precision cannot tell it apart. The guard
itself allows nothing."""


class Window:
    """The rate window: the inputs may stray from `anchor` by `share` of the rate until the window ends.

    A window lasts one sampling period of 5 s, or until the next sequence begins. `anchor` is the input applied before
    it began.
    """

    def __init__(self, anchor: SequenceRow, start: int, share: float) -> None:
        self.anchor = anchor
        self.start = start
        self.share = share

    def next(self, tick: int, applied: SequenceRow, limits: InputLimits, *, update: bool) -> "Window":
        """Return the window that holds at `tick`, where `update` tells that a sequence begins there."""
        elapsed = tick - self.start
        if update or elapsed >= TICKS_PER_SAMPLE:
            return Window(applied, tick, limits.rate_share(elapsed))
        return self


class OutputGuard:
    """Keeps every output inside its bounds and inside its rate window, whatever is asked."""

    def __init__(self, limits: InputLimits, applied: SequenceRow) -> None:
        self._limits = limits
        self._slack = [TOLERANCE * (high - low) for low, high in zip(limits.low, limits.high, strict=True)]
        self._window = Window(applied, 0, 1.0)
        self.applied = applied

    @property
    def window(self) -> Window:
        """The rate window at the last scan."""
        return self._window

    def admit(self, tick: int, wanted: SequenceRow, *, update: bool) -> SequenceRow:
        """Return what may be applied at `tick`, and remember it as applied."""
        self._window = self._window.next(tick, self.applied, self._limits, update=update)
        limits, window = self._limits, self._window
        self.applied = SequenceRow(
            *[
                _clamped(wanted[i], window.anchor[i], limits.rate[i] * window.share, limits.low[i], limits.high[i])
                for i in range(len(wanted))
            ]
        )
        return self.applied

    def exceeds(self, rows: Sequence[SequenceRow], first_tick: int, before: SequenceRow) -> bool:
        """Tell whether a sequence that begins at `first_tick`, after `before`, would break a rate."""
        limits = self._limits
        window = self._window.next(first_tick, before, limits, update=True)
        for offset, row in enumerate(rows):
            if offset and offset % TICKS_PER_SAMPLE == 0:
                window = window.next(first_tick + offset, before, limits, update=False)
            elif offset and row == before:
                continue
            for value, anchor, rate, slack in zip(row, window.anchor, limits.rate, self._slack, strict=True):
                if abs(value - anchor) > rate * window.share + slack:
                    return True
            before = row
        return False

    def out_of_range(self, rows: Sequence[SequenceRow]) -> bool:
        """Tell whether a row holds a value that is not finite or outside the bounds."""
        for row in set(rows):
            for value, low, high, slack in zip(row, self._limits.low, self._limits.high, self._slack, strict=True):
                if not low - slack <= value <= high + slack:  # not true of NaN either
                    return True
        return False


def _clamped(wanted: float, anchor: float, reach: float, low: float, high: float) -> float:
    """Return the single-precision value nearest to `wanted` that lies in low..high and within `reach` of `anchor`."""
    if not math.isfinite(wanted):
        wanted = anchor
    value = _single(min(max(wanted, low, anchor - reach), high, anchor + reach))
    while abs(value - anchor) > reach:
        value = _towards(value, anchor)
    return value


def _single(value: float) -> float:
    return float(struct.unpack(">f", struct.pack(">f", value))[0])


def _towards(value: float, target: float) -> float:
    """Return the single-precision neighbour of `value` on the side of `target`; both are >= 0, so bits count up."""
    bits: int = struct.unpack(">i", struct.pack(">f", value))[0]
    return float(struct.unpack(">f", struct.pack(">i", bits + (1 if target > value else -1)))[0])
