"""The last thing between any decision and the actuators: bounds and rates."""

import math
from collections.abc import Sequence

from coldloop.kernels.single_precision import neighbour, single
from coldloop.process.limits import InputLimits
from coldloop.process.signals import TICKS_PER_SAMPLE
from coldloop.registers.control_plc import SequenceRow, Verdict
from control_plc.output_limits import (
    NEVER,
    admit,
    admits,
    beginning,
    copy_state,
    in_range,
    plain,
    rate_share,
)


class OutputGuard:
    """Keeps every output inside its bounds, its rate window and the slew limit, whatever is requested.

    Its time is that of the ticks, but never faster than the time that has really passed: it does not go back, and a
    leap of the tick ends no window.
    """

    def __init__(self, limits: InputLimits, applied: SequenceRow) -> None:
        self.limits = plain(limits)
        self.state = beginning(self.limits, list(map(_inside, applied, limits.low, limits.high)))
        self._twin = beginning(self.limits, applied)
        self.applied = SequenceRow(*self.state.applied)
        self._tick = self._lag = 0
        """The last tick, and by how much our time is behind it."""

    def begin_at(self, tick: int, applied: SequenceRow, passed: int | None = None) -> None:
        """Restart at `tick` from the outputs applied there; they count as having moved just then.

        An open window stays open: consecutive breaks would otherwise give a full rate each. A non-finite value is
        ignored: the last finite one stays. `passed`: ticks since the last scan by another clock, None without one.
        """
        leap = tick - self._tick
        self._lag += leap - max(0, leap if passed is None else min(leap, passed))
        self._tick, tick = tick, tick - self._lag
        state, rates = self.state, self.limits.rate
        finite = [value if math.isfinite(value) else last for value, last in zip(applied, self.applied, strict=True)]
        window_is_open = 0 <= tick - state.start < TICKS_PER_SAMPLE and _reaches(
            state.anchor, finite, [rate * state.share for rate in rates]
        )
        for slot, before in enumerate(state.before):  # what is further away limits nothing any more
            state.moves[slot] = min(state.moves[slot], tick) if _reaches(before, finite, rates) else NEVER
        state.applied[:] = finite
        state.out_of_bounds = not in_range(self.limits, finite)
        if not window_is_open:
            state.anchor[:] = finite
            state.start = state.moved = tick
            state.share = rate_share(self.limits, 0)
        self.applied = SequenceRow(*finite)

    def admit(self, tick: int, wanted: SequenceRow, *, update: bool) -> SequenceRow:
        """Return what may be applied at `tick`, and remember it as applied."""
        self._tick = tick
        admit(self.state, self.limits, tick - self._lag, wanted, update)
        self.applied = SequenceRow(*self.state.applied)
        return self.applied

    def judge(self, rows: Sequence[SequenceRow], first_tick: int, meanwhile: Sequence[SequenceRow | None]) -> Verdict:
        """Judge a sequence as it would be played: the guard would let all of it pass, or it is refused.

        Args:
            rows: One row a tick.
            first_tick: Tick of the first one.
            meanwhile: What will be played in the ticks before, where something will be.
        """
        twin, first_tick = self._twin, first_tick - self._lag
        copy_state(self.state, twin, self.limits)
        for tick, row in enumerate(meanwhile, first_tick - len(meanwhile)):
            admit(twin, self.limits, tick, twin.applied if row is None else row, update=False)
        passes = admits(twin, self.limits, first_tick, rows, len(rows))
        return Verdict.ACCEPTED if passes else Verdict.RATE_EXCEEDED

    def out_of_range(self, rows: Sequence[SequenceRow]) -> bool:
        """Return whether a row holds a value that is not finite or outside the bounds."""
        return not all(in_range(self.limits, row) for row in set(rows))


def _reaches(before: Sequence[float], after: Sequence[float], rates: Sequence[float]) -> bool:
    return all(abs(value - earlier) <= rate for value, earlier, rate in zip(after, before, rates, strict=True))


def _inside(value: float, low: float, high: float) -> float:
    """Return the single-precision value nearest to `value` that lies in low..high."""
    value = single(min(max(value, low), high))
    while not low <= value <= high:
        value = neighbour(value, (low + high) / 2)
    return value
