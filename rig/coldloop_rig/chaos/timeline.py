"""When faults begin and end: plant time decides, in real time the clock for the ends."""

from collections.abc import Iterable
from typing import NamedTuple

from coldloop_rig.chaos.faults import AnyFault


class Moment(NamedTuple):
    """The beginning or the end of a fault."""

    tick: int
    """Tick before which it is due."""
    is_begin: bool
    fault: AnyFault
    due_s: float | None = None
    """Real time since the start of the session at which it is due in any case."""


class Timeline:
    """What is still to come.

    Args:
        faults: In the order in which they begin.
        factor: In real time, seconds of plant time in a second; None in lock-step.
    """

    def __init__(self, faults: Iterable[AnyFault], factor: float | None) -> None:
        self._factor = factor
        self._begins = [Moment(fault.tick, True, fault) for fault in faults]  # noqa: FBT003 - a NamedTuple's field
        self.on: list[Moment] = []
        """Ends of the faults that are on, the next one first."""

    @property
    def next_tick(self) -> int | None:
        """The tick of the next moment; None when there is none."""
        return min((moment.tick for moment in [*self._begins[:1], *self.on[:1]]), default=None)

    def left_s(self, seconds: float) -> float | None:
        """Return the real time until an end is due by the clock; None when there is none."""
        due = [end.due_s for end in self.on if end.due_s is not None]
        return max(0.001, min(due) - seconds) if due else None

    def due(self, tick: int, seconds: float) -> Moment | None:
        """Take out and return a moment that is due; ends come before beginnings."""
        for end in self.on:
            if tick >= end.tick or (end.due_s is not None and seconds >= end.due_s):
                return self.take(end)
        if self._begins and tick >= self._begins[0].tick:
            return self._begins.pop(0)
        return None

    def take(self, end: Moment) -> Moment:
        """Take out the end of a fault."""
        self.on.remove(end)
        return end

    def begun(self, moment: Moment, seconds: float) -> None:
        """A fault has begun; its end is to come."""
        fault = moment.fault
        due_s = None if self._factor is None else seconds + fault.duration_s / self._factor
        self.on.append(Moment(moment.tick + fault.end_tick - fault.tick, False, fault, due_s))  # noqa: FBT003
        self.on.sort(key=lambda end: end.tick)
