"""One time: the control PLC's scans follow the clock of the rack.

In real time each counts ticks by its own clock, and two clocks never agree: 50 ppm are a whole tick after an hour
and a half. Each measurement has the rack's tick and age, and corrects the schedule of the scans a little
(a second-order tracking loop, whose correction is bounded), and the skew of the clocks is estimated as well.
"""

import math
from typing import Final, NamedTuple

PHASE: Final = 0.5
"""Scans are half-way between two ticks of the rack: where neither side's jitter can confuse two ticks."""
GAIN: Final = 0.1
RATE_GAIN: Final = 0.005
"""Share of a phase error that corrects the phase, and the rate, with one measurement: critically damped within some ten
ticks, and deaf to the jitter of a single measurement."""
MAX_CORRECTION: Final = 0.1
"""Largest correction of the phase with one measurement, in ticks: the slew of our time."""
MAX_RATE: Final = 0.1
"""Largest difference of rates that is followed."""
SUREST_S: Final = 5e-5
"""No measurement counts as surer than this."""
LEAP: Final = 1.0
"""Ticks by which a rack whose clock runs on can be away from where it should be after a break."""
MEMORY_S: Final = 600.0
"""Real time over which the skew is estimated."""


class Skew(NamedTuple):
    """How much faster one clock is than another, with the standard error, both in ppm."""

    ppm: float
    error_ppm: float


class SkewEstimator:
    """Slope of the rack's time over ours: least squares, weighted by how sure each measurement is.

    Old measurements are forgotten with `MEMORY_S`.
    """

    def __init__(self) -> None:
        self._count = self._weight = 0.0
        self._x = self._y = self._xx = self._xy = self._yy = 0.0
        self._first: float | None = None
        self._at = 0.0

    def observe(self, ours: float, gained: float, uncertainty_s: float) -> None:
        """Take how much the rack's clock has gained (s) at `ours` (s), known within `uncertainty_s`."""
        if self._first is None:
            self._first, self._at = gained, ours
        step, self._at = ours - self._at, ours
        gained -= self._first
        # Times are kept relative to the newest one, where the numbers stay small: shift the sums by the step.
        self._xx += step * (step * self._weight - 2 * self._x)
        self._xy -= step * self._y
        self._x -= step * self._weight
        keep, weight = math.exp(-step / MEMORY_S), max(uncertainty_s, SUREST_S) ** -2
        self._count = keep * self._count + 1.0
        self._weight, self._x = keep * self._weight + weight, keep * self._x
        self._y, self._yy = keep * self._y + weight * gained, keep * self._yy + weight * gained * gained
        self._xx, self._xy = keep * self._xx, keep * self._xy

    def estimate(self) -> Skew:
        """Return the skew; its error is infinite while nothing is known."""
        n = self._weight
        spread = self._xx - self._x * self._x / n if self._count > 3.0 else 0.0
        if spread <= 0.0:
            return Skew(0.0, math.inf)
        covariance = self._xy - self._x * self._y / n
        slope = covariance / spread
        residual = max(0.0, self._yy - self._y * self._y / n - slope * covariance)
        return Skew(slope * 1e6, math.sqrt(residual / ((self._count - 2.0) * spread)) * 1e6)


class RackClock:
    """Schedule of our scans, which follows the rack.

    Args:
        factor: Seconds of plant time in a second of real time, nominally.
        now: The present time, s: tick 0 is due then, until the rack is heard of.
        tick_s: Length of a tick, s of plant time.
    """

    def __init__(self, factor: float, now: float, tick_s: float) -> None:
        self._plant_tick_s = tick_s
        self.begin(factor, now)

    def begin(self, factor: float, now: float) -> None:
        """Reset with another factor: nothing is known of the rack."""
        self.tick_s = self._plant_tick_s / factor
        self.offset = 0.0
        """Last phase error, in ticks: positive when the rack is ahead of our schedule."""
        self._rate = 0.0
        self._skew = SkewEstimator()
        self._at = now
        self._position = PHASE
        self._begun = now

    def due(self, tick: int) -> float:
        """Return when the scan of `tick` is due, s."""
        return self._at + (tick + PHASE - self._position) * self.tick_s / (1.0 + self._rate)

    def tick_at(self, now: float) -> int:
        """Return the tick whose scan is the next one due, or is due, at `now`."""
        return max(0, math.ceil(self.position_at(now) - PHASE))

    def position_at(self, now: float) -> float:
        """Return where the rack should be at `now`: its tick and the share of it that has passed."""
        return self._position + (now - self._at) * (1.0 + self._rate) / self.tick_s

    def synchronise(self, position: float, at: float) -> None:
        """Resynchronise with the rack: the link was broken, or time has jumped. The estimated rate is kept.

        So is the skew, unless the rack is not where its clock would have taken it: then it has jumped.
        """
        if abs(position - self.position_at(at)) > LEAP:
            self._skew = SkewEstimator()
            self._begun = at
        self._position, self._at, self.offset = position, at, 0.0

    def observe(self, position: float, at: float, uncertainty_s: float = SUREST_S) -> None:
        """Take where the rack was.

        Further than `LEAP` from the expected tick its clock has jumped, or it is wrong: the schedule follows by
        no more than the bound, and nothing is learnt about the rate.

        Args:
            position: Its tick, and the share of it that had passed.
            at: When, by our clock, s.
            uncertainty_s: How well that is known: half the time that the exchange took.
        """
        step_s = at - self._at
        expected = self.position_at(at)
        self.offset = error = position - expected
        correction = min(max(GAIN * error, -MAX_CORRECTION), MAX_CORRECTION)
        self._position, self._at = expected + correction, at
        if abs(error) > LEAP + uncertainty_s / self.tick_s:
            return
        if step_s > 0.0:
            change = RATE_GAIN * min(max(error, -1.0), 1.0) * min(1.0, self.tick_s / step_s)
            self._rate = min(max(self._rate + change, -MAX_RATE), MAX_RATE)
        self._skew.observe(at - self._begun, position * self.tick_s - at + self._begun, uncertainty_s)

    def skew(self) -> Skew:
        """Return how much faster the rack's clock is than ours."""
        return self._skew.estimate()
