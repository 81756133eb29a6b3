"""Scans with the rack: what is sent and how the answer is taken, in the rack's time, which is found and followed.

A scan sends what `ScanCycle.begin` returns (outputs, or a mere reading) and reports the result; so does a test with its
own rack. After a break the program resumes at the rack's tick. In real time each counts ticks by its own clock, and two
clocks never agree: 50 ppm are a whole tick after an hour and a half. Each measurement has the rack's tick and age, and
corrects the schedule of the scans a little (`RackClock`, a second-order tracking loop with a bounded correction), and
the skew of the clocks is estimated as well. While the link is out of step, `RackFinder` reads what the rack applies.
"""

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Callable
from typing import Final, NamedTuple

from coldloop import errors
from coldloop.modbus.client import RegisterClient
from coldloop.process.declaration import LAST_TICK
from coldloop.registers.common import LeaseState, LeaseStatus
from coldloop.registers.control_plc import LinkCause, PlantLinkState, Update
from coldloop.registers.plant import Actuators, Measurement
from coldloop_control_plc.plant_link import PlantLink
from coldloop_control_plc.program import ControlProgram

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

    `factor` is the seconds of plant time in a second of real time, nominally; `now` the present time, s, when tick 0 is
    due until the rack is heard of; `tick_s` the length of a tick, s of plant time.
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
        self.skew = SkewEstimator()
        """How much faster the rack's clock is than ours."""
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
            self.skew = SkewEstimator()
            self._begun = at
        self._position, self._at, self.offset = position, at, 0.0

    def observe(self, position: float, at: float, uncertainty_s: float = SUREST_S) -> None:
        """Take where the rack was, its tick and the share of it that had passed, at `at` by our clock, s.

        `uncertainty_s` is half the time that the exchange took. Further than `LEAP` from the expected tick its clock
        has jumped, or it is wrong: the schedule follows by no more than the bound, and learns nothing about the rate.
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
        self.skew.observe(at - self._begun, position * self.tick_s - at + self._begun, uncertainty_s)


def cause_of(error: errors.LinkError) -> LinkCause:
    """Return why a request came to nothing."""
    if isinstance(error, errors.ImplausibleAnswerError):
        return LinkCause.IMPLAUSIBLE
    if isinstance(error, errors.DamagedAnswerError):
        return LinkCause.DAMAGED
    if isinstance(error, errors.RequestRefusedError):
        return LinkCause.SECOND_MASTER if error.exception_code == errors.BUSY else LinkCause.REFUSED
    return LinkCause.NO_ANSWER


class ScanCycle:
    """Program, which decides the outputs, and link to the rack, which decides whether they may be written.

    `adopt` takes a reading of a rack in another session; returns whether the program has changed to that session.
    """

    def __init__(self, program: ControlProgram, link: PlantLink, adopt: Callable[[Measurement], bool]) -> None:
        self._program = program
        self._link = link
        self._adopt = adopt
        self._sent: Actuators | None = None
        self._scanned_at: float | None = None
        """Real time of the last scan, or of the last reading resumed from, in ticks."""

    def begin_time(self) -> None:
        """Reset the count of real time: a session begins, or the duration of a tick changes."""
        self._scanned_at = None

    def begin(self) -> Actuators | None:
        """Return the outputs to be written now, or None to read the rack only."""
        self._sent = None
        if self._link.synchronised:
            self._sent = self._link.addressed(self._program.begin_scan())
        return self._sent

    def failed(self, error: errors.LinkError) -> None:
        """Note that the request came to nothing."""
        self._sent = None
        self._program.interrupt()
        self._link.unanswered(cause_of(error))

    def answered(self, answer: Measurement, now: float | None) -> Update | None:
        """Process the rack's answer, its seal intact; return the update if one was latched.

        `now` is real time, in ticks from any beginning; None in lock-step.
        """
        sent, self._sent = self._sent, None
        if sent is None:
            self._read_back(answer, now)
            return None
        if self._link.exchanged(sent, answer, now):
            self._scanned_at = now
            self._link.settled()
            return self._program.end_scan(answer)
        self._program.interrupt()
        return None

    def _read_back(self, reading: Measurement, now: float | None) -> None:
        program, link = self._program, self._link
        link.compare(reading, program.session, now)
        if reading.session != program.session and link.is_confirmed and self._adopt(reading):
            link.begin()
            link.compare(reading, program.session, now)
        if not link.read_back(reading, program.session, now):
            return
        begun = now is not None and reading.age >= PHASE  # in lock-step a tick lasts until the scan was made
        passed = None  # ticks since the last scan by our own clock
        if now is not None:
            passed = 0 if self._scanned_at is None else max(0, int(now - self._scanned_at))
        program.rejoin(min(reading.tick + begun, LAST_TICK), reading.u, passed)
        self._scanned_at = now
        link.joined()


log = logging.getLogger("coldloop.control_plc")

SEARCH_S: Final = 0.5
"""How long one attempt to reach a lost rack may take, at least."""
LOOK_PAUSE_S: Final = 0.1
"""Between two reads of a rack that is not synchronised."""
AT_ONCE: Final = 2
"""Looks after a break without a pause: the second confirms what the first has shown."""


class RackFinder:
    """Looks at the rack; the clock goes by it from the reading on that brings the link into step.

    `power_up_s`: a rack that has not answered since our start counts as lost after so long, in real time.
    """

    def __init__(
        self, rack: RegisterClient, link: PlantLink, cycle: ScanCycle, clock: RackClock, *, power_up_s: float
    ) -> None:
        self._rack = rack
        self._link = link
        self._cycle = cycle
        self._clock = clock
        self._looks = 0
        self._lost_from = time.monotonic() + power_up_s
        self.reached = False
        """The rack has answered at least once since the start."""

    def read_soon(self) -> None:
        """Make the next looks without a pause before them."""
        self._looks = 0

    async def reach(self) -> bool:
        """Try once to reach the rack, without a session; return whether it answers."""
        try:
            await self._rack.connect(SEARCH_S)
        except errors.LinkError as error:
            self.failed(error)
            return False
        self.reached = True
        return True

    async def look(self, changed: asyncio.Event, patience_s: float | None) -> bool:
        """Read what the rack applies, once; return whether it has answered and has no other master.

        `changed` ends the pause between two looks. It may take `patience_s` in real time; None in lock-step.
        """
        if self._looks >= AT_ONCE:
            await self.pause(changed)
        self._looks += 1
        limit = None if patience_s is None else max(SEARCH_S, patience_s)
        try:
            async with asyncio.timeout(limit):
                reading, at = await self._read_back()
        except TimeoutError:
            self.failed(errors.PeerUnreachableError(f"{self._rack.peer} has not answered within {limit:g} s"))
        except errors.LinkError as error:
            self.failed(error)
        else:
            self.reached = True
            if reading is None:
                return False
            self._cycle.answered(reading, None if patience_s is None else at / self._clock.tick_s)
            if self._link.synchronised:
                # at tick 0 the rack's clock waits for the first outputs
                self._clock.synchronise(reading.tick + (reading.age or (0.0 if reading.tick else PHASE)), at)
            return True
        return False

    async def _read_back(self) -> tuple[Measurement | None, float]:
        """Return what the rack applies, None while another control PLC holds it, and when it was read, s.

        Raises:
            LinkError: The rack does not answer.
        """
        if self._link.state is PlantLinkState.SEARCHING or not self._rack.connected:
            await self._rack.connect(SEARCH_S)
        lease = await self._rack.read(LeaseStatus) if self._link.cause is LinkCause.SECOND_MASTER else None
        asked_at = time.monotonic()
        reading = await self._rack.read(Measurement)
        at = (asked_at + time.monotonic()) / 2
        if lease is None:
            return reading, at
        held = lease.state in (LeaseState.HELD, LeaseState.LINGERING)
        if lease.holder == self._link.holder:  # it has our number: another one, if the rack counts that it refused us
            held = lease.state == LeaseState.HELD and reading.refused != self._link.refused
        return None if held else reading, at

    async def pause(self, changed: asyncio.Event) -> None:
        """Wait before the next look, unless something changes."""
        changed.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(min(LOOK_PAUSE_S, max(0.005, self._clock.tick_s))):
                await changed.wait()

    def failed(self, error: errors.LinkError) -> None:
        """Note that a request came to nothing; a rack that is being powered up with us is not lost yet."""
        if not self.reached and time.monotonic() < self._lost_from:
            self._link.starting()
            return
        self._cycle.failed(error)
        log.warning("plant not synchronised", extra={"reason": str(error), "tick": self._link.tick})
