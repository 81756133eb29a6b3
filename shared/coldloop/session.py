"""A session: one run of the rig from tick 0, in lock-step or in real time, its time base and how late scans are.

Plant time is an integer, the tick. Lock-step uses no clock. In real time with factor F a tick lasts its time in the
plant over F, and all services follow the monotonic clock. Time is never stretched: what is late is late, and recorded.
"""

from enum import StrEnum
from typing import Annotated, NamedTuple

from pydantic import BaseModel, Field


class TimeMode(StrEnum):
    """Mode in which plant time advances."""

    LOCKSTEP = "lockstep"
    """The control PLC, as fast as the optimiser answers."""
    REALTIME = "realtime"
    """The clock."""


class SessionSettings(BaseModel, frozen=True, extra="forbid"):
    """Settings of the session that a service begins when it starts, before the first command."""

    autostart: bool = False
    """Begin session 1 at once instead of waiting for an operator."""
    mode: TimeMode = TimeMode.LOCKSTEP
    factor: Annotated[float, Field(ge=0.01, le=10_000)] = 1.0
    """Seconds of plant time in one second of real time, in real time."""


class TimeBase(NamedTuple):
    """Time base of a session; in lock-step the factor has no meaning."""

    realtime: bool
    factor: float
    """Seconds of plant time in one second of real time."""
    paused: bool = False
    """In real time: plant time is stopped until it is resumed."""


BIN_S = 5e-5
BINS = 4000


class LatenessRecord:
    """Maximum and percentiles of latenesses, in bounded memory (bins of 50 us up to 0.2 s)."""

    def __init__(self) -> None:
        self._bins = [0] * (BINS + 1)
        self.count = 0
        self.maximum_s = 0.0

    def add(self, lateness_s: float) -> None:
        """Record a lateness; negative ones count as 0."""
        self._bins[min(BINS, max(0, int(lateness_s / BIN_S)))] += 1
        self.count += 1
        self.maximum_s = max(self.maximum_s, lateness_s)

    def percentile_s(self, share: float) -> float:
        """Return the smallest bin edge that at least `share` (0..1) of the latenesses do not exceed."""
        if not self.count:
            return 0.0
        wanted = share * self.count
        seen = 0
        for position, number in enumerate(self._bins[:-1]):
            seen += number
            if seen >= wanted:
                return min((position + 1) * BIN_S, self.maximum_s)
        return self.maximum_s
