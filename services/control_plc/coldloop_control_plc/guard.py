"""The last thing between any decision and the actuators: bounds and rates."""

from collections.abc import Sequence

from coldloop.kernels.single_precision import neighbour, single
from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import Verdict
from coldloop.safety.sequence import Inputs
from coldloop_control_plc.output_limits import admit, beginning, in_range, judge, plain, resume


class OutputGuard:
    """Keeps every output inside its bounds, its rate window and the slew limit, whatever is requested.

    Its time is that of the ticks, but never faster than the time that has really passed, and it does not go back: a
    leap of the tick ends no window, and ticks that come again after a leap of a sampling period back do not count.
    """

    def __init__(self, limits: InputLimits, applied: Inputs) -> None:
        self.limits = plain(limits)
        self.state = beginning(self.limits, list(map(_inside, applied, limits.low, limits.high)))
        self._twin = beginning(self.limits, applied)
        self.applied = tuple(self.state.applied)
        self._newest = self._lag = 0
        """The latest tick, and by how much our time is behind it."""

    def begin_at(self, tick: int, applied: Inputs, passed: int | None = None) -> None:
        """Restart at `tick` from the outputs applied there (`output_limits.resume`).

        `passed`: ticks since the last scan by another clock, None without one.
        """
        leap = tick - self._newest
        if -self.limits.ticks_per_sample <= leap < 0:
            leap = 0
        self._lag += leap - max(0, leap if passed is None else min(leap, passed))
        self._newest += leap
        resume(self.state, self.limits, self._newest - self._lag, applied)
        self.applied = tuple(self.state.applied)

    def admit(self, tick: int, wanted: Inputs, *, update: bool) -> Inputs:
        """Return what may be applied at `tick`, and remember it as applied."""
        self._newest = max(self._newest, tick)
        admit(self.state, self.limits, self._newest - self._lag, wanted, update)
        self.applied = tuple(self.state.applied)
        return self.applied

    def judge(self, rows: Sequence[Inputs], first_tick: int, meanwhile: Sequence[Inputs | None]) -> Verdict:
        """Judge a sequence as it would be played: the guard would let all of it pass, or it is refused.

        Args:
            rows: One row a tick.
            first_tick: Tick of the first one.
            meanwhile: What will be played in the ticks before, where something will be: rows of one sequence in a row.
        """
        played = [row for row in meanwhile if row is not None]
        waiting = next((k for k, row in enumerate(meanwhile) if row is not None), 0)
        first_tick -= self._lag
        tick = first_tick - len(meanwhile)
        passes = judge(
            self.state, self._twin, self.limits, tick, played, waiting, len(played), first_tick, rows, len(rows)
        )
        return Verdict.ACCEPTED if passes else Verdict.RATE_EXCEEDED

    def out_of_range(self, rows: Sequence[Inputs]) -> bool:
        """Return whether a row holds a value that is not finite or outside the bounds."""
        return not all(in_range(self.limits, row) for row in set(rows))


def _inside(value: float, low: float, high: float) -> float:
    """Return the single-precision value nearest to `value` that lies in low..high."""
    value = single(min(max(value, low), high))
    while not low <= value <= high:
        value = neighbour(value, (low + high) / 2)
    return value
