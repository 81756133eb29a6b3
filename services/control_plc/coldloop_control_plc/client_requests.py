"""Requests of optimisers and operators to the control PLC, and their effects."""

import asyncio
from collections.abc import Awaitable
from typing import Final

from coldloop.process.settings import InputLimits
from coldloop.registers.audit import EventKind, JournalQuery
from coldloop.registers.bank import BusyError, Caller, IllegalValueError, RegisterBank
from coldloop.registers.common import SessionPace, pace_subject
from coldloop.registers.control_plc import (
    AwaitUpdate,
    ControlSession,
    Grant,
    Heartbeat,
    LatchedUpdate,
    Operator,
    Plan,
    SequenceHeader,
    SequenceRow,
    Update,
    Verdict,
)
from coldloop.registers.declaration import Block, Role
from coldloop.registers.safety import AlarmCommand, AlarmKind, LeaseEvent, WatchdogTime
from coldloop.safety.writers import InputSequence, WriterLease
from coldloop.session import TimeBase
from coldloop_control_plc.program import ControlProgram
from coldloop_control_plc.publication import ControlPublication
from coldloop_control_plc.sessions import Sessions

LONGEST_WAIT_S: Final = 1.0
"""Longest time that a read of the latch waits for an update; the optimiser then asks again."""
UNWATCHED_S: Final = 10.0
"""Silence that ends the lease of the optimiser where its watchdog is off, in real time."""
SECOND_OPTIMIZER: Final = 1
"""Cause of the alarm SECOND_WRITER."""
TRACKED: Final = 1e-4
"""Setpoints that an operator writes back as they were read have not been changed."""


class Clients:
    """Takes what clients write; `changed` is set with everything that a scan may have waited for.

    Args:
        program: What is written to.
        limits: What setpoints may be.
        bank: The registers.
        publication: Shows what has changed.
        sessions: The session under way, and its time base.
    """

    def __init__(
        self,
        program: ControlProgram,
        limits: InputLimits,
        bank: RegisterBank,
        publication: ControlPublication,
        sessions: Sessions,
    ) -> None:
        self._program = program
        self._limits, self._tick_s = limits, limits.process.tick_s
        self._bank = bank
        self._publication = publication
        self._sessions = sessions
        self._waiting: dict[asyncio.Future[None], tuple[int, int]] = {}
        """Requests that wait for an update: the update, and the session in which they were made."""
        self._begun = 0
        """Sessions that have begun."""
        self.lease = WriterLease("the optimiser's registers", self._silence_s, self._note_lease, shared=True)
        self.changed = asyncio.Event()
        self.granted = 0
        """Lock-step scans every tick before this one."""
        self.asked: ControlSession | None = None
        """A session that is to begin."""
        self.pending_time_base: TimeBase | None = None
        """A time base that the session under way is to have."""
        publication.lease = self.lease
        bank.judged_by(self._judge_optimizer, AwaitUpdate, Plan, Heartbeat, SequenceHeader)
        bank.judged_by(self._judge_optimizer, SequenceRow, every_row=False)
        bank.judged_by(self._judge_operator, Operator)
        bank.put_sealed(Plan(0, 0))
        bank.judged_by(self._judge_pace, SessionPace)

    # -- judged before anything is stored ------------------------------------------------------------------------------

    def _silence_s(self) -> float:
        """Return the silence, in real time, after which another optimiser may write."""
        pace, watchdog = self._sessions.pace, self._program.watchdog
        if not watchdog.time:
            return UNWATCHED_S
        return watchdog.time * self._tick_s / (pace.factor if pace.realtime else 1.0)

    def _judge_optimizer(self, record: tuple[object, ...], _row: int, caller: Caller) -> None:
        try:
            self.lease.check(caller, record.holder if isinstance(record, Heartbeat) else None)
        except BusyError:
            self._program.alarms.pulse(AlarmKind.SECOND_WRITER, SECOND_OPTIMIZER)
            raise
        if isinstance(record, Plan) and not record.crc:
            raise IllegalValueError("a plan needs a CRC: it decides when inputs change")

    def _judge_operator(self, record: Operator, _row: int, _caller: Caller) -> None:
        names = self._limits.process.input_names
        for name, value, low, high in zip(names, record.u, self._limits.low, self._limits.high, strict=True):
            if not low <= value <= high:
                raise IllegalValueError(f"setpoint of {name} = {value:g} is outside {low:g}..{high:g}")

    def _judge_pace(self, asked: SessionPace, _row: int, _caller: Caller) -> None:
        if self.asked is not None:
            raise IllegalValueError("pace: a session is about to begin")
        try:
            asked.of(self._program.session if self._sessions.running else 0)
        except ValueError as error:
            raise IllegalValueError(f"pace: {error}") from None

    # -- done ----------------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Show nothing of the session before: a session begins."""
        self._begun += 1
        self._bank.put_sealed(self._bank.get(Update)._replace(session=0))
        self._bank.put_sealed(LatchedUpdate())
        self._bank.put_sealed(self._program.player.acknowledgement)
        self._bank.put(self._program.operator)

    @property
    def optimizer_waits(self) -> bool:
        """An optimiser waits for an update: its silence is no failure."""
        return bool(self._waiting)

    def tell(self, update: Update) -> None:
        """Show a new update, and answer who waits for it."""
        self._bank.put_sealed(update)
        self._bank.put_sealed(LatchedUpdate(update.session, update.update, update.tick))
        for answer, (wanted, begun) in self._waiting.items():
            # one of a session that has begun since, which counts from 0 again, will do
            if not answer.done() and (update.update >= wanted or begun != self._begun):
                answer.set_result(None)

    def on_write(self, block: Block, caller: Caller) -> Awaitable[None] | None:
        """Take what a client has written; an awaitable lets its answer wait."""
        present = self._program.optimizer_present
        if block.writer is Role.OPTIMIZER:
            wait = self._take(block, caller)
        else:
            wait = None
            self._command(block, caller)
        if self._program.optimizer_present is not present:
            self._publication.safety()
        return wait

    def _take(self, block: Block, caller: Caller) -> Awaitable[None] | None:
        """Take what the optimiser has written."""
        record, program = block.record, self._program
        beat = self._bank.get(Heartbeat) if record is Heartbeat else None
        self.lease.take(caller, beat.holder if beat else None)
        if record is SequenceRow:
            return None
        self.changed.set()
        if record is AwaitUpdate:
            return self._await_update(self._bank.get(AwaitUpdate))
        if record is Plan:
            program.accept_plan(self._bank.get(Plan))
        elif record is SequenceHeader:
            self._offer(self._bank.get(SequenceHeader))
        elif beat is not None:
            program.heartbeat(beat)
        return None

    def _command(self, block: Block, caller: Caller) -> None:
        """Do what an operator has written, and note who it was."""
        record, program = block.record, self._program
        if record is Grant:
            self.granted = self._bank.get(Grant).until_tick
        elif record is ControlSession:
            self.asked = asked = self._bank.get(ControlSession)
            self.pending_time_base = None
            self.granted = 0
            self._note(EventKind.SESSION, asked.realtime, caller.name, value=asked.factor)
        elif record is SessionPace:
            self._ask_for_pace(caller.name)
        elif record is Operator:
            self._operate(self._bank.get(Operator), caller.name)
        elif record is AlarmCommand:
            program.alarms.command(self._bank.get(AlarmCommand), caller.name)
        elif record is WatchdogTime:
            self._set_watchdog(self._bank.get(WatchdogTime).time, caller.name)
        elif record is JournalQuery:
            self._publication.journal.answer(self._bank.get(JournalQuery))
            return
        self.changed.set()
        if record is not Grant:
            self._publication.safety()

    def _ask_for_pace(self, who: str) -> None:
        pace = self._bank.get(SessionPace).of(self._program.session)
        self._bank.put(SessionPace.shown(self._program.session, pace))
        if pace != (self.pending_time_base or self._sessions.pace):
            self.pending_time_base = pace
            self._note(EventKind.PACE, pace_subject(pace), who, value=pace.factor)

    def _set_watchdog(self, time: int, who: str) -> None:
        watchdog = self._program.watchdog
        if time != watchdog.time:
            self._note(EventKind.WATCHDOG_TIME, time, who, cause=watchdog.time)
            watchdog.set(time, self._program.tick)

    def _operate(self, operator: Operator, who: str) -> None:
        before = self._program.operator
        if operator.mode != before.mode:
            self._note(EventKind.OPERATOR_MODE, operator.mode, who)
        for place, (value, last) in enumerate(zip(operator.u, before.u, strict=True)):
            if abs(value - last) > TRACKED:
                self._note(EventKind.SETPOINT, place, who, value=value)
        self._program.operate(operator)

    def _note_lease(self, event: LeaseEvent, who: str) -> None:
        self._note(EventKind.LEASE, event, who)

    def _note(self, kind: EventKind, subject: int, who: str, *, cause: int = 0, value: float = 0.0) -> None:
        now = max(self._program.tick, self._program.alarms.now)
        self._program.journal.note(now, kind, subject, cause, value=value, who=who)

    def _offer(self, header: SequenceHeader) -> None:
        rows = [row.u for row in self._bank.get_rows(SequenceRow, header.length)]
        answer = self._program.offer(InputSequence(header, rows))
        self._bank.put_sealed(answer)
        if answer.verdict != Verdict.ACCEPTED:
            self._publication.safety()

    def _await_update(self, asked: AwaitUpdate) -> Awaitable[None] | None:
        """Let the answer wait for the update asked for; one who asks out of session gets the next fresh one."""
        program = self._program
        program.optimizer_seen()
        wanted = asked.update
        if asked.session != program.session or not self._sessions.running:
            latched = program.player.update
            if latched is not None and not (program.awaiting_plan and latched.tick == program.tick - 1):
                program.abandon()
                self._bank.put_sealed(latched._replace(session=0))  # not for a request of another session
                wanted = latched.update + 1
            else:
                wanted = latched.update if latched else 0
        elif program.awaiting_plan and not self._latched(wanted):
            program.abandon()  # it has seen this number before our restart, and will not plan it: latch another
        return None if self._latched(wanted) else self._wait_for(wanted)

    def _latched(self, wanted: int) -> bool:
        latched = self._program.player.update
        return latched is not None and latched.update >= wanted

    def _wait_for(self, wanted: int) -> asyncio.Future[None]:
        """Return what is done when an update is latched, or has been waited for long enough."""
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[None] = loop.create_future()
        self._waiting[answer] = wanted, self._begun
        timer = loop.call_later(LONGEST_WAIT_S, _answer_anyway, answer)

        def end(_: asyncio.Future[None]) -> None:
            timer.cancel()
            del self._waiting[answer]

        answer.add_done_callback(end)
        return answer

    def on_departure(self, role: Role) -> None:
        """The last client of this role has disconnected: do not wait for an optimiser."""
        if role is Role.OPTIMIZER:
            self._program.optimizer_lost()
            self._publication.safety()
            self.changed.set()

    def on_close(self, caller: Caller) -> None:
        """Note that a connection has closed."""
        self.lease.closed(caller)

    def on_refusal(self, kind: str) -> None:
        """A server has refused a client's request."""
        if kind == "access_refused":
            self._program.alarms.pulse(AlarmKind.ACCESS_REFUSED)


def _answer_anyway(waiting: asyncio.Future[None]) -> None:
    if not waiting.done():
        waiting.set_result(None)
