"""What optimisers and operators write to the control PLC, and what it makes of it."""

import asyncio
from collections.abc import Awaitable

from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.control_plc import (
    Acknowledgement,
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
from coldloop.registers.safety import AlarmCommand, AlarmKind, WatchdogTime
from coldloop.seal import sealed
from coldloop.sequence import InputSequence
from control_plc.program import ControlProgram
from control_plc.publication import Publication

LONGEST_WAIT_S = 1.0
"""Longest time that a read of the latch waits for an update; the optimiser then asks again."""


class Clients:
    """Takes what clients write; `changed` is set with everything that a scan may have waited for."""

    def __init__(self, program: ControlProgram, bank: RegisterBank, publication: Publication) -> None:
        self._program = program
        self._bank = bank
        self._publication = publication
        self._news = asyncio.Event()
        self._waits = 0
        self.changed = asyncio.Event()
        self.granted = 0
        """Lock-step scans every tick before this one."""
        self.asked: ControlSession | None = None
        """A session that is to begin."""
        for empty in (bank.get(Update), LatchedUpdate(), Acknowledgement(0, Verdict.NONE), Plan(0, 0)):
            bank.put(sealed(empty))

    @property
    def optimizer_waits(self) -> bool:
        """An optimiser has asked for an update and is owed the answer: that it is silent means nothing."""
        return self._waits > 0

    def tell(self, update: Update) -> None:
        """Show a new update, and answer who waits for it."""
        self._bank.put(sealed(update))
        self._bank.put(sealed(LatchedUpdate(update.session, update.update, update.tick)))
        self._news.set()
        self._news = asyncio.Event()

    def on_write(self, block: Block, caller: Caller) -> Awaitable[None] | None:  # noqa: ARG002
        """Take what a client has written; an awaitable lets its answer wait."""
        present = self._program.optimizer_present
        wait = self._take(block)
        if self._program.optimizer_present is not present:
            self._publication.safety()
        return wait

    def _take(self, block: Block) -> Awaitable[None] | None:
        record, program = block.record, self._program
        if record is AwaitUpdate:
            return self._await_update(self._bank.get(AwaitUpdate))
        if record is Plan:
            program.accept_plan(self._bank.get(Plan))
        elif record is SequenceHeader:
            self._offer(self._bank.get(SequenceHeader))
        elif record is Grant:
            self.granted = self._bank.get(Grant).until_tick
        elif record is ControlSession:
            self.asked = self._bank.get(ControlSession)
            self.granted = 0
        elif record is Heartbeat:
            program.heartbeat(self._bank.get(Heartbeat))
        else:
            self._command(record)
        if record is not SequenceRow:
            self.changed.set()
        return None

    def _command(self, record: type[object]) -> None:
        """Do what an operator has written."""
        program = self._program
        if record is Operator:
            program.operate(self._bank.get(Operator))
        elif record is AlarmCommand:
            program.alarms.command(self._bank.get(AlarmCommand))
        elif record is WatchdogTime:
            program.watchdog.set(self._bank.get(WatchdogTime).time, program.tick)
        else:
            return
        self._publication.safety()

    def _offer(self, header: SequenceHeader) -> None:
        rows = [self._bank.get(SequenceRow, row) for row in range(header.length)]
        answer = self._program.offer(InputSequence(header, rows))
        self._bank.put(sealed(answer))
        if answer.verdict != Verdict.ACCEPTED:
            self._publication.safety()
        self._publication.status()

    def _await_update(self, asked: AwaitUpdate) -> Awaitable[None] | None:
        """Let the answer wait for the update asked for; one who asks out of session gets the next fresh one."""
        program = self._program
        program.optimizer_seen()
        wanted = asked.update
        if asked.session != program.session or not self._publication.running:
            latched = program.player.update
            if latched is not None and not (program.awaiting_plan and latched.tick == program.tick - 1):
                program.abandon()
                self._bank.put(sealed(latched._replace(session=0)))  # what waits in vain is not given this one
                wanted = latched.update + 1
            else:
                wanted = latched.update if latched else 0
            self.changed.set()
        return None if self._latched(wanted) else self._wait_for(wanted)

    def _latched(self, wanted: int) -> bool:
        latched = self._program.player.update
        return latched is not None and latched.update >= wanted

    async def _wait_for(self, wanted: int) -> None:
        """Wait for an update; an update of a newer session, which counts from 0 again, will do."""
        session = self._program.session
        self._waits += 1
        try:
            async with asyncio.timeout(LONGEST_WAIT_S):
                while not self._latched(wanted):
                    await self._news.wait()
                    if self._program.session != session:
                        return
        except TimeoutError:
            return
        finally:
            self._waits -= 1

    def on_departure(self, role: Role) -> None:
        """Nobody of this role is connected any more: an optimiser is not waited for."""
        if role is Role.OPTIMIZER:
            self._program.optimizer_lost()
            self._publication.safety()
            self.changed.set()

    def on_refusal(self, kind: str) -> None:
        """A server has refused something to somebody."""
        if kind == "access_refused":
            self._program.alarms.happened(AlarmKind.ACCESS_REFUSED)
