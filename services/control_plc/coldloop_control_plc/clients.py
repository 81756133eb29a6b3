"""Registers, log and telemetry made from the program's state, and what optimisers and operators write there."""

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Mapping
from typing import Final

from coldloop.process.settings import InputLimits
from coldloop.registers import common, declaration
from coldloop.registers import control_plc as registers
from coldloop.registers.bank import BusyError, Caller, IllegalValueError, RegisterBank
from coldloop.safety.writers import InputSequence, WriterLease
from coldloop.service.journal import JournalPublication, alarm_word, log_event
from coldloop.session import LatenessRecord, TimeBase
from coldloop_control_plc import plant_link, rack
from coldloop_control_plc.program import ControlProgram
from coldloop_control_plc.sessions import Sessions

log = logging.getLogger("coldloop.control_plc")


class ControlPublication:
    """Shows the program's state in the registers: what changes in each scan when it is read, the rest with its events.

    `keep` is called with new events, so that no number of an event is given out twice, and what an operator has said
    is retained also while no scans are made.
    """

    def __init__(
        self,
        program: ControlProgram,
        sessions: Sessions,
        link: plant_link.PlantLink,
        bank: RegisterBank,
        keep: Callable[[], None],
    ) -> None:
        self._program = program
        self._sessions = sessions
        self._link = link
        self.bank = bank
        self._keep = keep
        self.journal = JournalPublication(program.journal, bank)
        self._told_alarms = -1
        self.begin()
        self.lease: WriterLease | None = None
        """Lease of the optimiser."""
        bank.keep_fresh(common.Identity, self._identity)
        bank.keep_fresh(registers.ProcessNow, lambda: program.process)
        bank.keep_fresh(registers.Status, self._status)

    def begin(self) -> None:
        """Reset the counters: a session begins."""
        self.overruns = 0
        """Scans that began too late."""
        self.lateness = LatenessRecord()
        """Lateness of all scans of this session in real time."""
        self.skew, self.offset_ms = rack.Skew(0.0, math.inf), 0.0
        """How much faster the rack's clock is than ours, and its phase error."""

    def _identity(self) -> common.Identity:
        program = self._program
        return common.Identity(
            map_digest=self.bank.map.digest,
            map_version=self.bank.map.version,
            state=common.ServiceState.RUNNING if self._sessions.running else common.ServiceState.READY,
            model_digest=program.model_digest,
            session=program.session,
            tick=program.tick,
            heartbeat=program.tick & 0xFFFF,
        )

    def _status(self) -> registers.Status:
        program, lateness = self._program, self.lateness
        player = program.player
        return registers.Status(
            mode=program.mode,
            update=player.update.update if player.update else 0,
            next_update_tick=player.next_update_tick,
            playing=player.playing,
            remaining=program.remaining,
            accepted=player.accepted & 0xFFFFFFFF,
            rejected=player.rejected & 0xFFFFFFFF,
            deadline_misses=player.deadline_misses & 0xFFFFFFFF,
            overruns=self.overruns & 0xFFFFFFFF,
            lateness_max=lateness.maximum_s * 1000,
            lateness_p99=lateness.percentile_s(0.99) * 1000,
        )

    def safety(self) -> None:
        """Show ladder, watchdog, links, alarms and events, which agree with each other, and log the events."""
        program, link, ladder = self._program, self._link, self._program.ladder
        if self.lease is not None:
            self.lease.note_end()
        shown = self.journal.show()
        for event in shown:
            log_event(log, event, self.bank.map.process)
        if shown:
            self._keep()
        if program.alarms.changes != self._told_alarms:
            self._told_alarms = program.alarms.changes
            for row, alarm in enumerate(program.alarms.rows):
                self.bank.put(alarm, row)
        present, bad, events = int(program.optimizer_present), program.bad_sensors, program.journal.count
        self.bank.put(registers.LadderStatus(program.mode, ladder.cause, ladder.since, present, bad, events))
        self.bank.put(program.watchdog.registers(program.tick))
        self.bank.put(
            link.registers()._replace(offset=self.offset_ms, skew=self.skew.ppm, skew_error=self.skew.error_ppm)
        )
        if self.lease is not None:
            self.bank.put(self.lease.registers())

    def snapshot(self) -> Mapping[str, object]:
        """Return what telemetry publishes."""
        status, process = self.bank.get(registers.Status), self.bank.get(registers.ProcessNow)
        alarms = {
            alarm_word(kind, self.bank.map.process).replace(" ", "_"): common.AlarmState(alarm.state).name.lower()
            for kind, alarm in enumerate(self._program.alarms.rows)
            if alarm.state != common.AlarmState.NORMAL
        }
        return {
            "session": self._program.session,
            "tick": process.tick,
            **status._asdict(),
            "mode": self._program.mode.name.lower(),
            "cause": registers.Cause(self._program.ladder.cause).name.lower(),
            "alarms": alarms,
            "load_w": process.load,
            "inputs": dict(zip(self.bank.map.process.input_names, process.u, strict=True)),
            "outputs": dict(zip(self.bank.map.process.output_names, process.y, strict=True)),
        }


LONGEST_WAIT_S: Final = 1.0
"""Longest time that a read of the latch waits for an update; the optimiser then asks again."""
SECOND_OPTIMIZER: Final = 1
"""Cause of the alarm SECOND_WRITER."""


class Clients:
    """Takes what clients write; `changed` is set with everything that a scan may have waited for.

    Setpoints have to be within `limits`; the publication shows what has changed in the registers.
    """

    def __init__(
        self, program: ControlProgram, limits: InputLimits, publication: ControlPublication, sessions: Sessions
    ) -> None:
        self._program = program
        self._limits, self._tick_s = limits, limits.process.tick_s
        self._bank = bank = publication.bank
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
        self.asked: registers.ControlSession | None = None
        """A session that is to begin."""
        self.pending_time_base: TimeBase | None = None
        """A time base that the session under way is to have."""
        publication.lease = self.lease
        for record in (registers.AwaitUpdate, registers.Plan, registers.Heartbeat, registers.SequenceHeader):
            bank.judged_by(self._judge_optimizer, record)
        bank.judged_by(self._judge_optimizer, registers.SequenceRow, every_row=False)
        bank.judged_by(self._judge_operator, registers.Operator)
        bank.put_sealed(registers.Plan(0, 0))
        bank.judged_by(self._judge_pace, common.SessionPace)

    def _silence_s(self) -> float:
        """Return the silence, in real time, after which another optimiser may write."""
        pace, watchdog = self._sessions.pace, self._program.watchdog
        if not watchdog.time:
            return 10.0  # where its watchdog is off
        return watchdog.time * self._tick_s / (pace.factor if pace.realtime else 1.0)

    def _judge_optimizer(self, record: tuple[object, ...], _row: int, caller: Caller) -> None:
        try:
            self.lease.check(caller, record.holder if isinstance(record, registers.Heartbeat) else None)
        except BusyError:
            self._program.alarms.pulse(common.AlarmKind.SECOND_WRITER, SECOND_OPTIMIZER)
            raise
        if isinstance(record, registers.Plan) and not record.crc:
            raise IllegalValueError("a plan needs a CRC: it decides when inputs change")

    def _judge_operator(self, record: registers.Operator, _row: int, _caller: Caller) -> None:
        names = self._limits.process.input_names
        for name, value, low, high in zip(names, record.u, self._limits.low, self._limits.high, strict=True):
            if not low <= value <= high:
                raise IllegalValueError(f"setpoint of {name} = {value:g} is outside {low:g}..{high:g}")

    def _judge_pace(self, asked: common.SessionPace, _row: int, _caller: Caller) -> None:
        if self.asked is not None:
            raise IllegalValueError("pace: a session is about to begin")
        try:
            asked.of(self._program.session if self._sessions.running else 0)
        except ValueError as error:
            raise IllegalValueError(f"pace: {error}") from None

    def begin(self) -> None:
        """Show nothing of the session before: a session begins."""
        self._begun += 1
        self._bank.put_sealed(self._bank.get(registers.Update)._replace(session=0))
        self._bank.put_sealed(registers.LatchedUpdate())
        self._bank.put_sealed(self._program.player.acknowledgement)
        self._bank.put(self._program.operator)

    @property
    def optimizer_waits(self) -> bool:
        """An optimiser waits for an update: its silence is no failure."""
        return bool(self._waiting)

    def tell(self, update: registers.Update) -> None:
        """Show a new update, and answer who waits for it."""
        self._bank.put_sealed(update)
        self._bank.put_sealed(registers.LatchedUpdate(update.session, update.update, update.tick))
        for answer, (wanted, begun) in self._waiting.items():
            # one of a session that has begun since, which counts from 0 again, will do
            if update.update >= wanted or begun != self._begun:
                _answer(answer)

    def on_write(self, block: declaration.Block, caller: Caller) -> Awaitable[None] | None:
        """Take what a client has written; an awaitable lets its answer wait."""
        present = self._program.optimizer_present
        if block.writer is declaration.Role.OPTIMIZER:
            wait = self._take(block, caller)
        else:
            wait = None
            self._command(block, caller)
        if self._program.optimizer_present is not present:
            self._publication.safety()
        return wait

    def _take(self, block: declaration.Block, caller: Caller) -> Awaitable[None] | None:
        record, program = block.record, self._program
        beat = self._bank.get(registers.Heartbeat) if record is registers.Heartbeat else None
        self.lease.take(caller, beat.holder if beat else None)
        if record is registers.SequenceRow:
            return None
        self.changed.set()
        if record is registers.AwaitUpdate:
            return self._await_update(self._bank.get(registers.AwaitUpdate))
        if record is registers.Plan:
            program.accept_plan(self._bank.get(registers.Plan))
        elif record is registers.SequenceHeader:
            self._offer(self._bank.get(registers.SequenceHeader))
        elif beat is not None:
            program.heartbeat(beat)
        return None

    def _command(self, block: declaration.Block, caller: Caller) -> None:
        command, who = self._bank.get(block.record), caller.name
        program, watchdog = self._program, self._program.watchdog
        match command:
            case common.JournalQuery():
                self._publication.journal.answer(command)
                return
            case registers.Grant():
                self.granted = command.until_tick
                self.changed.set()
                return
            case registers.ControlSession():
                self.asked, self.pending_time_base, self.granted = command, None, 0
                self._note(common.EventKind.SESSION, command.realtime, who, value=command.factor)
            case common.SessionPace():
                pace = command.of(program.session)
                self._bank.put(common.SessionPace.shown(program.session, pace))
                if pace != (self.pending_time_base or self._sessions.pace):
                    self.pending_time_base = pace
                    self._note(common.EventKind.PACE, common.pace_subject(pace), who, value=pace.factor)
            case registers.Operator():
                self._operate(command, who)
            case common.AlarmCommand():
                program.alarms.command(command, who)
            case common.WatchdogTime(time) if time != watchdog.time:
                self._note(common.EventKind.WATCHDOG_TIME, time, who, cause=watchdog.time)
                watchdog.set(time, program.tick)
        self.changed.set()
        self._publication.safety()

    def _operate(self, operator: registers.Operator, who: str) -> None:
        before = self._program.operator
        if operator.mode != before.mode:
            self._note(common.EventKind.OPERATOR_MODE, operator.mode, who)
        for place, (value, last) in enumerate(zip(operator.u, before.u, strict=True)):
            if abs(value - last) > 1e-4:  # those that are written back as they were read have not been changed
                self._note(common.EventKind.SETPOINT, place, who, value=value)
        self._program.operate(operator)

    def _note_lease(self, event: common.LeaseEvent, who: str) -> None:
        self._note(common.EventKind.LEASE, event, who)

    def _note(self, kind: common.EventKind, subject: int, who: str, *, cause: int = 0, value: float = 0.0) -> None:
        now = max(self._program.tick, self._program.alarms.now)
        self._program.journal.note(now, kind, subject, cause, value=value, who=who)

    def _offer(self, header: registers.SequenceHeader) -> None:
        rows = [row.u for row in self._bank.get_rows(registers.SequenceRow, header.length)]
        answer = self._program.offer(InputSequence(header, rows))
        self._bank.put_sealed(answer)
        if answer.verdict != registers.Verdict.ACCEPTED:
            self._publication.safety()

    def _await_update(self, asked: registers.AwaitUpdate) -> Awaitable[None] | None:
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
        if self._latched(wanted):
            return None
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[None] = loop.create_future()
        self._waiting[answer] = wanted, self._begun
        timer = loop.call_later(LONGEST_WAIT_S, _answer, answer)

        def end(_: asyncio.Future[None]) -> None:
            timer.cancel()
            del self._waiting[answer]

        answer.add_done_callback(end)
        return answer

    def _latched(self, wanted: int) -> bool:
        latched = self._program.player.update
        return latched is not None and latched.update >= wanted

    def on_departure(self, role: declaration.Role) -> None:
        """The last client of this role has disconnected: do not wait for an optimiser."""
        if role is declaration.Role.OPTIMIZER:
            self._program.optimizer_lost()
            self._publication.safety()
            self.changed.set()

    def on_close(self, caller: Caller) -> None:
        """Note that a connection has closed."""
        self.lease.closed(caller)

    def on_refusal(self, kind: str) -> None:
        """A server has refused a client's request."""
        if kind == "access_refused":
            self._program.alarms.pulse(common.AlarmKind.ACCESS_REFUSED)


def _answer(waiting: asyncio.Future[None]) -> None:
    if not waiting.done():
        waiting.set_result(None)
