"""The control PLC's program: scan cycle, sequence player, sequence contract and updating instants.

Pure: no sockets, no clock, no sleeping. A scan is `begin_scan` (decide the outputs), the exchange with the plant's
rack, `end_scan` (take the measurement, latch an update at an updating instant).

The fail-safe ladder begins here with its first two rungs: the sequence is played (MPC), and when it has run out its
last value holds (HOLD). Further rungs are further modes of `_wanted`. Or the classical loops drive (CLASSICAL), from
tick 0 to the end; then no update is latched.
"""

from coldloop.errors import ConfigurationError
from coldloop.limits import InputLimits
from coldloop.process import TICKS_PER_SAMPLE
from coldloop.registers.control_plc import (
    SEQUENCE_ROWS,
    Acknowledgement,
    Mode,
    Plan,
    Process,
    SequenceRow,
    Update,
    Verdict,
)
from coldloop.registers.plant import Actuators, Measurement
from coldloop.sequence import InputSequence, checksum
from control_plc.classical import ClassicalLoops
from control_plc.guard import OutputGuard


class ControlProgram:
    """One session of the control PLC, from tick 0 on.

    `tick` is the tick of the next scan, or of the one in progress. `classical`, when given, drives instead of
    sequences.
    """

    def __init__(
        self,
        *,
        limits: InputLimits,
        model_digest: int,
        initial_inputs: tuple[float, ...],
        classical: ClassicalLoops | None = None,
    ) -> None:
        self._limits = limits
        self._classical = classical
        self._model_digest = model_digest
        self._initial = SequenceRow(*initial_inputs)
        if OutputGuard(limits, self._initial).out_of_range([self._initial]):
            raise ConfigurationError(
                f"limits: the inputs {self._initial[:]} of the operating point are outside; widen low and high, or "
                "give another model.file"
            )
        self.restart(session=0)

    def restart(self, session: int) -> None:
        """Begin a session at tick 0 with the initial inputs applied."""
        self.session = session
        self.tick = 0
        self.mode = Mode.CLASSICAL if self._classical else Mode.HOLD
        self.update: Update | None = None
        self.process: Process | None = None
        self.next_update_tick = 0
        self.acknowledgement = Acknowledgement(0, Verdict.NONE)
        self.accepted = self.rejected = self.deadline_misses = 0
        self._guard = OutputGuard(self._limits, self._initial)
        self._before = self._initial
        self._playing: InputSequence | None = None
        self._spare: InputSequence | None = None
        self._load_step = 0.0
        self._planned = False
        self._abandoned = False
        self._refused = False
        self._in_scan = False
        if self._classical is not None:
            self._classical.restart()

    # -- what a lock-step runtime waits for ----------------------------------------------------------------------------

    @property
    def awaiting_plan(self) -> bool:
        """The last update has no updating period yet."""
        return self.update is not None and not self._planned and not self._abandoned

    @property
    def awaiting_sequence(self) -> bool:
        """An updating instant has come and its sequence has not; one that a load step may cut off is due at once."""
        due = self.tick == self.next_update_tick and self.tick > 0
        wanted = due or (self._planned and self._load_step > 0)
        return wanted and self._spare is None and not self._abandoned and not self._refused

    # -- scan ----------------------------------------------------------------------------------------------------------

    def begin_scan(self) -> Actuators:
        """Decide the outputs of this tick."""
        self._in_scan = True
        self._before = self._guard.applied
        update = False
        if self._spare is not None and self._spare.header.first_tick == self.tick:
            self._playing, self._spare, update = self._spare, None, True
        elif self.tick == self.next_update_tick and self.tick > 0:
            self.deadline_misses += 1
        applied = self._guard.admit(self.tick, self._wanted(self.tick), update=update)
        if self._classical is None:
            self.mode = Mode.MPC if self.remaining else Mode.HOLD
        return Actuators(self.tick, *applied, self.session)

    def end_scan(self, measurement: Measurement) -> Update | None:
        """Take the measurement of this tick; return the update if it was latched here."""
        applied = tuple(self._guard.applied)
        self.process = Process(self.tick, measurement.load, applied, measurement.y)
        if self._interrupted_by(measurement.load):
            self._spare = None
            self.next_update_tick = self.tick
        latched = None
        if self.tick == self.next_update_tick and self._classical is None:
            latched = self.update = Update(
                session=self.session,
                update=self.update.update + 1 if self.update else 0,
                tick=self.tick,
                playing=self._playing.header.number if self._playing else 0,
                load=measurement.load,
                u_before=tuple(self._before),
                u=applied,
                y=measurement.y,
                x=measurement.x,
            )
            self.next_update_tick = self.tick + TICKS_PER_SAMPLE  # until the optimiser has planned another
            self._planned = self._abandoned = self._refused = False
        self.tick += 1
        self._in_scan = False
        return latched

    def _interrupted_by(self, load: float) -> bool:
        """Tell whether the load has left the one that the update under way was latched with."""
        if self.update is None or not self._planned or not self._load_step:
            return False
        return abs(load - self.update.load) > self._load_step

    def _wanted(self, tick: int) -> SequenceRow:
        """Return what is asked for: by the loops when they drive, else by the player, else what is applied."""
        if self._classical is not None and self.process is not None:
            return self._classical.wanted(tick, self.process.y, self._guard.applied)
        playing = self._playing
        if playing is None or tick - playing.header.first_tick >= len(playing.rows):
            return self._guard.applied
        return playing.rows[tick - playing.header.first_tick]

    def _applied_before(self, tick: int) -> SequenceRow:
        """Return what will have been applied just before a tick to come, if nothing else arrives."""
        playing = self._playing
        if playing is None or not self.remaining:
            return self._guard.applied
        return playing.rows[min(tick - 1 - playing.header.first_tick, len(playing.rows) - 1)]

    @property
    def remaining(self) -> int:
        """Ticks of the sequence that are still to be played, the present one included."""
        if self._playing is None:
            return 0
        header = self._playing.header
        return max(0, header.first_tick + header.length - self.tick)

    @property
    def playing(self) -> int:
        """Number of the sequence being played; 0 is none."""
        return self._playing.header.number if self._playing else 0

    # -- the optimiser's side ------------------------------------------------------------------------------------------

    def accept_plan(self, plan: Plan) -> bool:
        """Take the updating period of the last update; tell whether it was acceptable."""
        earliest = self.tick + self._in_scan
        if self.update is None or self._planned or plan.update != self.update.update:
            return False
        if not earliest <= plan.next_update_tick <= self.update.tick + SEQUENCE_ROWS:
            return False
        self.next_update_tick = plan.next_update_tick
        self._load_step = plan.load_step
        self._planned = True
        return True

    def abandon(self) -> None:
        """Give up the update under way: an optimiser that has lost the thread asks for a new one."""
        if self.update is not None and self._spare is None:
            self._abandoned = True
            self.next_update_tick = self.tick + self._in_scan

    def offer(self, sequence: InputSequence) -> Acknowledgement:
        """Check a committed sequence; accept it for its first tick, or reject it with a reason."""
        verdict = self._judge(sequence)
        if verdict is Verdict.ACCEPTED:
            self._spare = sequence
            self.accepted += 1
        else:
            self.rejected += 1
            self._refused = self.update is not None and sequence.header.update == self.update.update
        self.acknowledgement = Acknowledgement(sequence.header.number, verdict)
        return self.acknowledgement

    def _judge(self, sequence: InputSequence) -> Verdict:  # noqa: PLR0911 one return for each clause of the contract
        header, rows = sequence
        if not 1 <= header.length == len(rows):
            return Verdict.WRONG_LENGTH
        if checksum(header, rows) != header.crc:
            return Verdict.BAD_CRC
        if header.model_digest != self._model_digest:
            return Verdict.WRONG_MODEL
        if header.number <= max(self.playing, self._spare.header.number if self._spare else 0):
            return Verdict.REPEATED
        if header.first_tick < self.tick + self._in_scan:
            return Verdict.LATE
        if self.update is None or not self._planned or header.update != self.update.update:
            return Verdict.WRONG_UPDATE
        if header.first_tick != self.next_update_tick or header.first_tick - self.update.tick != header.tau_u:
            return Verdict.WRONG_TICK
        if self._guard.out_of_range(rows):
            return Verdict.OUT_OF_RANGE
        if self._guard.exceeds(rows, header.first_tick, self._applied_before(header.first_tick)):
            return Verdict.RATE_EXCEEDED
        return Verdict.ACCEPTED
