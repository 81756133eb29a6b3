"""The sequence player: updating instants, plans, the sequence contract, and the rows that are played.

Pure. `tick` is the tick of the scan in progress; `earliest` the first tick that can still be changed: the next scan's.
Scans can be missed and time can leap, so everything here goes by ticks, never by the number of calls.
"""

from collections.abc import Sequence
from enum import IntEnum

from coldloop.process.declaration import LAST_NUMBER
from coldloop.registers.control_plc import SEQUENCE_ROWS, Acknowledgement, Plan, Update, Verdict
from coldloop.safety.sequence import Inputs, InputSequence, checksum
from coldloop_control_plc.guard import OutputGuard


class UpdatePhase(IntEnum):
    """How far the update under way has got.

    NONE      ->  LATCHED                                       at an updating instant (`latch`)
    LATCHED   ->  PLANNED                                       the optimiser has decided the period
    PLANNED   ->  ANSWERED or REFUSED                           its sequence was accepted, or not
    REFUSED   ->  ANSWERED                                      another one was accepted in time
    any       ->  ABANDONED                                     given up: its answer is no longer awaited
    any       ->  LATCHED                                       the next updating instant, or a load step
    """

    NONE = 0
    LATCHED = 1
    PLANNED = 2
    ANSWERED = 3
    REFUSED = 4
    ABANDONED = 5


EXPECTING = (UpdatePhase.LATCHED, UpdatePhase.PLANNED)
"""A lock-step runtime waits for what is missing."""
PROMISED = (UpdatePhase.PLANNED, UpdatePhase.REFUSED)
"""A sequence was to be expected."""


class SequencePlayer:
    """Plays what the optimiser sends, and refuses what breaks the contract."""

    def __init__(self, guard: OutputGuard, model_digest: int, *, updates: int = 0) -> None:
        self._guard = guard
        self._model_digest = model_digest
        self._updates = updates
        self._playing: InputSequence | None = None
        self._spare: InputSequence | None = None
        self._load_step = 0.0
        self._missed = -1
        self.phase = UpdatePhase.NONE
        self.update: Update | None = None
        self.next_update_tick = 0
        self.invited = True
        self.late = False
        """The updating instant of what is being played has passed without a new sequence."""
        self.broken_promise = False
        """The sequence of an update that was planned is missing at its instant, which is now."""
        self.acknowledgement = Acknowledgement(0, Verdict.NONE)
        self.accepted = self.rejected = self.deadline_misses = 0

    # -- what a lock-step runtime waits for ----------------------------------------------------------------------------

    @property
    def awaiting_plan(self) -> bool:
        """The last update has no updating period yet."""
        return self.invited and self.phase is UpdatePhase.LATCHED

    def awaiting_sequence(self, tick: int) -> bool:
        """An updating instant has come and its sequence has not; one that a load step may cut off is due at once."""
        due = tick == self.next_update_tick and tick > 0
        wanted = due or (self.phase is UpdatePhase.PLANNED and self._load_step > 0)
        return self.invited and wanted and self.phase in EXPECTING

    @property
    def has_answer(self) -> bool:
        """A sequence has been accepted that has not begun."""
        return self._spare is not None

    @property
    def answering(self) -> bool:
        """The optimiser has planned the current update: a sequence is expected."""
        return self.phase in (UpdatePhase.PLANNED, UpdatePhase.ANSWERED)

    @property
    def given_up(self) -> bool:
        """No sequence is expected for the last update: it was abandoned, or its sequence rejected."""
        return self.phase in (UpdatePhase.NONE, UpdatePhase.REFUSED, UpdatePhase.ABANDONED)

    # -- scan ----------------------------------------------------------------------------------------------------------

    def begin(self, tick: int) -> bool:
        """Return whether a sequence begins at this tick; an updating instant without one is a miss."""
        self.broken_promise = False
        spare = self._spare
        if spare is not None and spare.header.first_tick <= tick:
            self._playing, self._spare = spare, None
            # Scans were missed: what is played so late is the rest of a sequence, not a new one.
            self.late = tick - spare.header.first_tick >= max(1, spare.header.tau_u)
            return True
        if self.invited and tick >= self.next_update_tick and tick > 0 and self.phase is not UpdatePhase.ANSWERED:
            self._miss()
        return False

    def _miss(self) -> None:
        """Count an updating instant without a sequence, once however often its scan is begun."""
        self.late = self.update is not None or self._playing is not None
        self.broken_promise = self.phase in PROMISED
        if self.update is not None and self._missed != self.next_update_tick:
            self.deadline_misses += 1
        self._missed = self.next_update_tick

    def row(self, tick: int) -> Inputs | None:
        """Return the row to be played at this tick, if any."""
        playing = self._playing
        if playing is None or not 0 <= tick - playing.header.first_tick < len(playing.rows):
            return None
        return playing.rows[tick - playing.header.first_tick]

    def latches(self, tick: int, load: float) -> bool:
        """Return whether to latch an update at the end of this scan: its instant, or an interrupting load step."""
        if not self.invited:
            return False
        if self._interrupted_by(load):
            self._spare = None
            self.next_update_tick = tick
        return tick >= self.next_update_tick

    def latch(self, update: Update) -> Update:
        """Begin an update; return it with its number."""
        self.update = update._replace(update=self._updates, playing=self.playing)
        self._updates = self._updates + 1 if self._updates < LAST_NUMBER else 0  # as at the start of a session
        self.next_update_tick = (
            update.tick + self._guard.limits.ticks_per_sample
        )  # until the optimiser has planned another
        self.phase = UpdatePhase.LATCHED
        return self.update

    def _interrupted_by(self, load: float) -> bool:
        """Return whether the load has left the one that the update under way was latched with."""
        if self.update is None or self.phase not in (*PROMISED, UpdatePhase.ANSWERED) or not self._load_step:
            return False
        return abs(load - self.update.load) > self._load_step

    def remaining(self, tick: int) -> int:
        """Ticks of the sequence that are still to be played, the present one included."""
        if self._playing is None:
            return 0
        header = self._playing.header
        return min(header.length, max(0, header.first_tick + header.length - tick))

    @property
    def playing(self) -> int:
        """Number of the sequence being played; 0 is none."""
        return self._playing.header.number if self._playing else 0

    @property
    def sequence(self) -> InputSequence | None:
        """The sequence being played."""
        return self._playing

    @property
    def updates(self) -> int:
        """Number of the next update."""
        return self._updates

    def is_ordinary(self, tick: int) -> bool:
        """Return whether a sequence is being played in time, and the update under way is planned."""
        if self._playing is None or self.late or not self.invited or self.next_update_tick < tick:
            return False
        if self._spare is None:
            return self.phase is UpdatePhase.PLANNED
        return self.phase is UpdatePhase.ANSWERED

    @property
    def load_step(self) -> float:
        """Change of the load (W) that interrupts the update under way; 0 is never."""
        return self._load_step

    def take_over(self, playing: InputSequence, update: Update, next_update_tick: int, sequences: int) -> None:
        """Resume after so many more accepted sequences: the last one is being played, and its update is planned."""
        self._playing, self.update = playing, update
        self._updates = update.update + 1
        self.next_update_tick = next_update_tick
        self.phase, self.late = UpdatePhase.PLANNED, False
        self.accepted += sequences
        self.acknowledgement = Acknowledgement(playing.header.number, Verdict.ACCEPTED)

    # -- who else drives, and time that leaps --------------------------------------------------------------------------

    def dismiss(self) -> None:
        """Let nothing be played, and nothing be offered, until `invite`."""
        self.invited = self.late = False
        self.phase = UpdatePhase.NONE
        self._playing = self._spare = self.update = None

    def invite(self, tick: int) -> None:
        """Latch an update at the next scan, so that the optimiser may begin again."""
        self.invited = True
        self.phase = UpdatePhase.ABANDONED
        self.next_update_tick = tick

    def drop(self) -> None:
        """Drop the sequence that has been played to its end: another mode moves the inputs now."""
        self._playing = None

    def resume(self, sequence: InputSequence | None, tick: int) -> None:
        """Resume the rest of the sequence after a restart, and latch an update at the next scan."""
        self._playing = sequence
        self.late = sequence is not None
        self.invite(tick)

    def set_back(self, tick: int) -> None:
        """Start over at a tick long before the present one: all sequences were for a time that will come again."""
        self._playing = self._spare = self.update = None
        self.late = False
        if self.invited:
            self.invite(tick)

    # -- the optimiser's side ------------------------------------------------------------------------------------------

    def accept_plan(self, plan: Plan, earliest: int) -> bool:
        """Take the updating period of the last update; return whether it was acceptable."""
        update = self.update
        if not self.invited or update is None or self.phase is not UpdatePhase.LATCHED or plan.update != update.update:
            return False
        if not earliest <= plan.next_update_tick <= update.tick + SEQUENCE_ROWS:
            return False
        self.next_update_tick = plan.next_update_tick
        self._load_step = plan.load_step
        self.phase = UpdatePhase.PLANNED
        return True

    def abandon(self, earliest: int) -> None:
        """Give up the update under way: an optimiser that has lost the thread asks for a new one."""
        if self.update is not None and self._spare is None:
            self.phase = UpdatePhase.ABANDONED
            self.next_update_tick = earliest

    def offer(self, sequence: InputSequence, earliest: int, *, plant_lost: bool = False) -> Acknowledgement:
        """Check a committed sequence; accept it for its first tick, or reject it with a reason."""
        verdict = Verdict.PLANT_LOST if plant_lost else self._judge(sequence, earliest)
        if verdict is Verdict.ACCEPTED:
            self._spare = sequence
            self.phase = UpdatePhase.ANSWERED
            self.accepted += 1
        else:
            self.rejected += 1
            answers = self.update is not None and sequence.header.update == self.update.update
            if answers and self.phase is UpdatePhase.PLANNED:
                self.phase = UpdatePhase.REFUSED
        self.acknowledgement = Acknowledgement(sequence.header.number, verdict)
        return self.acknowledgement

    def _judge(self, sequence: InputSequence, earliest: int) -> Verdict:  # noqa: PLR0911 a return for each clause
        header, rows = sequence
        if not self.invited:
            return Verdict.NOT_INVITED
        if header.length != len(rows):
            return Verdict.WRONG_LENGTH
        if checksum(header, rows) != header.crc:
            return Verdict.BAD_CRC
        if header.model_digest != self._model_digest:
            return Verdict.WRONG_MODEL
        if header.number <= max(self.playing, self._spare.header.number if self._spare else 0):
            return Verdict.REPEATED
        if header.first_tick < earliest:
            return Verdict.LATE
        expected = self.phase in (*PROMISED, UpdatePhase.ANSWERED)
        if self.update is None or not expected or header.update != self.update.update:
            return Verdict.WRONG_UPDATE
        if header.first_tick != self.next_update_tick or header.first_tick - self.update.tick != header.tau_u:
            return Verdict.WRONG_TICK
        return self._judge_rows(rows, header.first_tick, earliest)

    def _judge_rows(self, rows: Sequence[Inputs], first_tick: int, earliest: int) -> Verdict:
        if not rows:
            return Verdict.NO_ANSWER
        if self._guard.out_of_range(rows):
            return Verdict.OUT_OF_RANGE
        meanwhile = [self.row(tick) for tick in range(earliest, first_tick)]
        return self._guard.judge(rows, first_tick, meanwhile)
