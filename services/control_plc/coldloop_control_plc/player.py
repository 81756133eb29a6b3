"""The sequence player: updating instants, plans, the sequence contract, and the rows that are played.

Pure. `tick` is the tick of the scan in progress; `earliest` the first tick that can still be changed: the next scan's.
Scans can be missed and time can leap, so everything here goes by ticks, never by the number of calls.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from coldloop.process.declaration import LAST_NUMBER
from coldloop.registers.control_plc import SEQUENCE_ROWS, Acknowledgement, Plan, SequenceHeader, Update, Verdict
from coldloop.safety.writers import Inputs, InputSequence, checksum, with_checksum
from coldloop_control_plc.output_limits import OutputGuard

NONE, LATCHED, PLANNED, ANSWERED, REFUSED, ABANDONED = range(6)
"""How far the update under way has got.

    NONE      ->  LATCHED                                       at an updating instant (`latch`)
    LATCHED   ->  PLANNED                                       the optimiser has decided the period
    PLANNED   ->  ANSWERED or REFUSED                           its sequence was accepted, or not
    REFUSED   ->  ANSWERED                                      another one was accepted in time
    any       ->  ABANDONED                                     given up: its answer is no longer awaited
    any       ->  LATCHED                                       the next updating instant, or a load step
"""


@dataclass(slots=True)
class PlayerState:
    """State of the player; lists of two have one element per sequence, `slot` of the one that is played."""

    updates: int
    """Number of the next update."""
    update_number: int = 0
    """Number, tick and load of the last update, if there is one."""
    update_tick: int = 0
    update_load: float = 0.0
    has_update: bool = False
    phase: int = NONE
    next_update_tick: int = 0
    load_step: float = 0.0
    """Change of the load (W) that interrupts the update under way; 0 is never."""
    shortage: float = 0.0
    """Excess of the load over what can be held by the last plan, W; negative: below what is needed."""
    suspects: int = 0
    """Outputs that the last plan does without: bit i is output i; then inputs that have no effect."""
    missed: int = -1
    """Updating instant without a sequence that was counted last."""
    invited: bool = True
    late: bool = False
    """The updating instant of what is being played has passed without a new sequence."""
    broken_promise: bool = False
    """The sequence of an update that was planned is missing at its instant, which is now."""
    has_answer: bool = False
    """A sequence has been accepted that has not begun: that of the other slot."""
    slot: int = 0
    numbers: list[int] = field(default_factory=lambda: [0, 0])
    answers: list[int] = field(default_factory=lambda: [0, 0])
    """The update that each answers."""
    first_ticks: list[int] = field(default_factory=lambda: [0, 0])
    lengths: list[int] = field(default_factory=lambda: [0, 0])
    """Length of each sequence in ticks; 0 where there is none."""
    periods: list[int] = field(default_factory=lambda: [0, 0])
    """Updating period before each, in ticks."""
    accepted: int = 0
    rejected: int = 0
    deadline_misses: int = 0


def has_row(p: PlayerState, tick: int) -> bool:
    """Return whether a row is to be played at this tick."""
    return 0 <= tick - p.first_ticks[p.slot] < p.lengths[p.slot]


def awaits_sequence(p: PlayerState, tick: int) -> bool:
    """Return whether an updating instant has come without its sequence; one that a load may cut off is due at once."""
    is_due = tick == p.next_update_tick and tick > 0
    return p.invited and (
        (p.phase == PLANNED and (is_due or p.load_step > 0.0)) or (p.phase == LATCHED and is_due)
    )  # fmt: skip


def begin_sequence(p: PlayerState, tick: int) -> bool:
    """Return whether a sequence begins at this tick; an updating instant without one is a miss."""
    p.broken_promise = False
    other = 1 - p.slot
    if p.has_answer and p.first_ticks[other] <= tick:
        p.slot = other
        p.has_answer = False
        # Scans were missed: what is played so late is the rest of a sequence, not a new one.
        p.late = tick - p.first_ticks[other] >= max(1, p.periods[other])
        return True
    if p.invited and tick >= p.next_update_tick and tick > 0 and p.phase != ANSWERED:
        p.late = p.has_update or p.lengths[p.slot] > 0
        p.broken_promise = p.phase in (PLANNED, REFUSED)
        if p.has_update and p.missed != p.next_update_tick:  # once however often its scan is begun
            p.deadline_misses += 1
        p.missed = p.next_update_tick
    return False


def latches(p: PlayerState, tick: int, load: float) -> bool:
    """Return whether to latch an update at the end of this scan: its instant, or an interrupting load step."""
    if not p.invited:
        return False
    expected = p.has_update and p.phase in (PLANNED, REFUSED, ANSWERED)
    if expected and p.load_step != 0.0 and abs(load - p.update_load) > p.load_step:
        p.has_answer = False
        p.next_update_tick = tick
    return tick >= p.next_update_tick


def latch(p: PlayerState, tick: int, load: float, longest: int) -> None:
    """Begin an update; the next is due after the `longest` period, until the optimiser has planned another."""
    p.update_number = p.updates
    p.update_tick = tick
    p.update_load = load
    p.has_update = True
    p.updates = p.updates + 1 if p.updates < LAST_NUMBER else 0  # as at the start of a session
    p.next_update_tick = tick + longest
    p.phase = LATCHED


def promise(p: PlayerState, next_update_tick: int, load_step: float, shortage: float, suspects: int) -> None:
    """Take the plan of the update."""
    p.next_update_tick = next_update_tick
    p.load_step = load_step
    p.shortage = shortage
    p.suspects = suspects
    p.phase = PLANNED


def accept(p: PlayerState, number: int, first_tick: int, length: int) -> None:
    """Take the sequence that answers the update."""
    other = 1 - p.slot
    p.numbers[other] = number
    p.answers[other] = p.update_number
    p.first_ticks[other] = first_tick
    p.lengths[other] = length
    p.periods[other] = first_tick - p.update_tick
    p.has_answer = True
    p.phase = ANSWERED
    p.accepted += 1


class SequencePlayer(PlayerState):
    """Plays what the optimiser sends, and refuses what breaks the contract."""

    def __init__(self, guard: OutputGuard, model_digest: int, *, updates: int = 0) -> None:
        super().__init__(updates)
        self._guard = guard
        self._model_digest = model_digest
        self.update: Update | None = None
        self.sequences: list[InputSequence | None] = [None, None]
        self.acknowledgement = Acknowledgement(0, Verdict.NONE)

    @property
    def awaiting_plan(self) -> bool:
        """The last update has no updating period yet."""
        return self.invited and self.phase == LATCHED

    @property
    def rows(self) -> list[Sequence[Inputs]]:
        """Rows of the sequences, by slot."""
        return [() if each is None else each.rows for each in self.sequences]

    def row(self, tick: int) -> Inputs | None:
        """Return the row to be played at this tick, if any."""
        sequence = self.sequences[self.slot]
        if sequence is None or not has_row(self, tick):
            return None
        return sequence.rows[tick - self.first_ticks[self.slot]]

    def latch(self, update: Update) -> Update:
        """Begin an update; return it with its number."""
        latch(self, update.tick, update.load, self._guard.limits.ticks_per_sample)
        self.update = update._replace(update=self.update_number, playing=self.playing)
        return self.update

    def remaining(self, tick: int) -> int:
        """Ticks of the sequence that are still to be played, the present one included."""
        length = self.lengths[self.slot]
        return min(length, max(0, self.first_ticks[self.slot] + length - tick))

    @property
    def playing(self) -> int:
        """Number of the sequence being played; 0 is none."""
        return self.numbers[self.slot] if self.lengths[self.slot] else 0

    @property
    def sequence(self) -> InputSequence | None:
        """The sequence being played."""
        return self.sequences[self.slot] if self.lengths[self.slot] else None

    def dismiss(self) -> None:
        """Let nothing be played, and nothing be offered, until `invite`."""
        self.invited = self.late = False
        self.phase = NONE
        self._forget()

    def invite(self, tick: int) -> None:
        """Latch an update at the next scan, so that the optimiser may begin again."""
        self.invited = True
        self.phase = ABANDONED
        self.next_update_tick = tick

    def _forget(self) -> None:
        self.lengths[self.slot] = 0
        self.has_answer = self.has_update = False
        self.update = None

    def resume(self, sequence: InputSequence | None, tick: int) -> None:
        """Resume the rest of the sequence after a restart, and latch an update at the next scan."""
        self.sequences[self.slot] = sequence
        if sequence is not None:
            header = sequence.header
            self.numbers[self.slot], self.first_ticks[self.slot] = header.number, header.first_tick
            self.lengths[self.slot], self.periods[self.slot] = len(sequence.rows), header.tau_u
        self.late = sequence is not None
        self.invite(tick)

    def set_back(self, tick: int) -> None:
        """Start over at a tick long before the present one: all sequences were for a time that will come again."""
        self._forget()
        self.late = False
        if self.invited:
            self.invite(tick)

    def continue_from(self, rows: Any, update: Update | None) -> None:  # noqa: ANN401 an array of who has numpy
        """Continue after updates that were done with the state alone.

        `rows` are those of the sequences, a table a slot; `update` is the last update, if another than before.
        """
        self.update = update or self.update
        for slot, number in enumerate(self.numbers):
            known, length = self.sequences[slot], self.lengths[slot]
            if length and (known is None or known.header.number != number):
                times = self.answers[slot], self.first_ticks[slot], length, self.periods[slot]
                header = SequenceHeader(number, *times, self._model_digest, 0)
                table = [tuple(map(float, rows[slot][tick])) for tick in range(length)]
                self.sequences[slot] = with_checksum(header, table)
                self.acknowledgement = Acknowledgement(max(self.numbers), Verdict.ACCEPTED)

    def accept_plan(self, plan: Plan, earliest: int) -> bool:
        """Take the updating period of the last update; return whether it was acceptable."""
        expected = self.invited and self.has_update and self.phase == LATCHED and plan.update == self.update_number
        if not expected or not earliest <= plan.next_update_tick <= self.update_tick + SEQUENCE_ROWS:
            return False
        promise(self, plan.next_update_tick, plan.load_step, plan.shortage, plan.suspects)
        return True

    def abandon(self, earliest: int) -> None:
        """Give up the update under way: an optimiser that has lost the thread asks for a new one."""
        if self.has_update and not self.has_answer:
            self.phase = ABANDONED
            self.next_update_tick = earliest

    def offer(self, sequence: InputSequence, earliest: int, *, plant_lost: bool = False) -> Acknowledgement:
        """Check a committed sequence; accept it for its first tick, or reject it with a reason."""
        verdict = Verdict.PLANT_LOST if plant_lost else self._judge(sequence, earliest)
        if verdict is Verdict.ACCEPTED:
            self.sequences[1 - self.slot] = sequence
            accept(self, sequence.header.number, sequence.header.first_tick, sequence.header.length)
        else:
            self.rejected += 1
            if self.has_update and sequence.header.update == self.update_number and self.phase == PLANNED:
                self.phase = REFUSED
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
        if header.number <= max(self.playing, self.numbers[1 - self.slot] if self.has_answer else 0):
            return Verdict.REPEATED
        if header.first_tick < earliest:
            return Verdict.LATE
        expected = self.has_update and self.phase in (PLANNED, REFUSED, ANSWERED)
        if not expected or header.update != self.update_number:
            return Verdict.WRONG_UPDATE
        if header.first_tick != self.next_update_tick or header.first_tick - self.update_tick != header.tau_u:
            return Verdict.WRONG_TICK
        return self._judge_rows(rows, header.first_tick, earliest)

    def _judge_rows(self, rows: Sequence[Inputs], first_tick: int, earliest: int) -> Verdict:
        if not rows:
            return Verdict.NO_ANSWER
        if self._guard.out_of_range(rows):
            return Verdict.OUT_OF_RANGE
        meanwhile = [self.row(tick) for tick in range(earliest, first_tick)]
        return self._guard.judge(rows, first_tick, meanwhile)
