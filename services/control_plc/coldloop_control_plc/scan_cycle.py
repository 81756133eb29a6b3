"""A scan with the rack: the outputs to send, and the program's reaction to the answer.

Pure: the runtime sends what `begin` returns (outputs, or a mere reading) and reports the result, and so does a test
with its own rack. Time is the rack's: after a break the program resumes at the rack's tick.
"""

from collections.abc import Callable

from coldloop.errors import BUSY, DamagedAnswerError, ImplausibleAnswerError, LinkError, RequestRefusedError
from coldloop.process.declaration import LAST_TICK
from coldloop.registers.control_plc import LinkCause, Update
from coldloop.registers.plant import Actuators, Measurement
from coldloop_control_plc.plant_link import PlantLink
from coldloop_control_plc.program import ControlProgram
from coldloop_control_plc.rack_clock import PHASE

Adopt = Callable[[Measurement], bool]
"""Takes a reading of a rack in another session; returns whether the program has changed to that session."""


def cause_of(error: LinkError) -> LinkCause:
    """Return why a request came to nothing."""
    if isinstance(error, ImplausibleAnswerError):
        return LinkCause.IMPLAUSIBLE
    if isinstance(error, DamagedAnswerError):
        return LinkCause.DAMAGED
    if isinstance(error, RequestRefusedError):
        return LinkCause.SECOND_MASTER if error.exception_code == BUSY else LinkCause.REFUSED
    return LinkCause.NO_ANSWER


class ScanCycle:
    """Program and link to the rack, put together.

    Args:
        program: Decides the outputs.
        link: Decides whether they may be written.
        adopt: Called with a reading of another session.
    """

    def __init__(self, program: ControlProgram, link: PlantLink, adopt: Adopt) -> None:
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

    def failed(self, error: LinkError) -> None:
        """Note that the request came to nothing."""
        self._sent = None
        self._program.interrupt()
        self._link.unanswered(cause_of(error))

    def answered(self, answer: Measurement, now: float | None) -> Update | None:
        """Process the rack's answer; return the update if one was latched.

        Args:
            answer: The measurement, its seal intact.
            now: Real time, in ticks from any beginning; None in lock-step.
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
        program.rejoin(min(reading.tick + begun, LAST_TICK), reading.u, self._passed(now))
        self._scanned_at = now
        link.joined()

    def _passed(self, now: float | None) -> int | None:
        """Return the whole ticks since the last scan by our own clock; None where it does not count."""
        if now is None:
            return None
        return 0 if self._scanned_at is None else max(0, int(now - self._scanned_at))
