"""The optimiser PLC on the bus: client of the control PLC, server of its own diagnostics."""

import asyncio
import logging
import time
from collections.abc import Mapping

from coldloop import __version__
from coldloop.errors import LinkError, ModelFileError
from coldloop.lti_model import load
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.process import TICK_S
from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.common import Identity, ServiceState
from coldloop.registers.control_plc import CONTROL_MAP, Acknowledgement, AwaitUpdate, Heartbeat, Status, Update, Verdict
from coldloop.registers.declaration import Block
from coldloop.registers.optimizer_plc import HISTORY_ROWS, OPTIMIZER_MAP, Optimization, OptimizerSession
from coldloop.sequence import InputSequence
from coldloop.session import Pace, TimeMode
from coldloop.telemetry import Telemetry
from optimizer_plc.program import OptimizerProgram
from optimizer_plc.settings import OptimizerSettings

log = logging.getLogger("coldloop.optimizer_plc")

ROWS_WITH_HEADER = 18
"""Rows that fit into one request with the header that commits them."""
LOOK_OUT_S = TICK_S / 8
"""Plant time between two looks for a load step in real time: the new computation begins so much later."""
HEARTBEAT_S = 1.0
"""Plant time between two signs of life while an answer is computed."""
SEARCH_S = 0.2
"""Between two attempts to reach a lost control PLC."""
STRANGER = AwaitUpdate(session=0, update=0)
"""Asks for a fresh update, whatever the session."""


class OptimizerPlc:
    """Connects the program to the registers and to the control PLC."""

    def __init__(self, settings: OptimizerSettings) -> None:
        section = settings.optimizer_plc
        self._settings = settings
        self._program = OptimizerProgram(load(settings.model.file), section.program, settings.limits)
        self._control = RegisterClient.at(CONTROL_MAP, section.control_plc)
        self.bank = RegisterBank(OPTIMIZER_MAP, section.word_order)
        self._pace = Pace(settings.session.mode is TimeMode.REALTIME, settings.session.factor)
        self._session = 0
        self._beats = 0
        self._last: Optimization | None = None
        self._publish_identity(0)

    def close(self) -> None:
        """Let go of the control PLC."""
        self._control.close()

    async def run(self) -> None:
        """Serve one update after the other until cancelled; a control PLC that is lost is looked for.

        Raises:
            PeerUnreachableError: The control PLC has never been there.
            ModelFileError: The control PLC runs another model.
        """
        await self._control.connect(self._settings.optimizer_plc.control_plc.patience_s)
        await self._introduce()
        while True:
            try:
                await self._serve_updates()
            except LinkError as error:
                log.warning("control PLC lost", extra={"reason": str(error)})
                await self._find_control_plc()

    async def _find_control_plc(self) -> None:
        while True:
            try:
                await self._control.connect(SEARCH_S)
                await self._introduce()
            except (LinkError, ModelFileError) as error:
                log.warning("control PLC not found", extra={"reason": str(error)})
                await asyncio.sleep(SEARCH_S)
            else:
                return

    async def _serve_updates(self) -> None:
        wanted = STRANGER
        while True:
            update = await self._control.exchange(wanted, Update)
            asked_at = time.monotonic()
            if self._is_news(update, wanted):
                verdict = await self._optimise(update, asked_at)
                # a plan that came too late: this update leads to no other, unless a load step has led to one
                unplanned = verdict is Verdict.WRONG_UPDATE and not await self._interrupted(update)
                # late once is late for ever with updates that have been waiting: begin again with a fresh one
                lost = unplanned or verdict is Verdict.LATE
                wanted = STRANGER if lost else AwaitUpdate(update.session, update.update + 1)
            elif update.session != wanted.session:
                wanted = STRANGER

    async def _introduce(self) -> None:
        """Tell the control PLC our model, and make sure that it is its own."""
        await self._beat()
        theirs = (await self._control.read(Identity)).model_digest
        if theirs != self._program.model_digest:
            raise ModelFileError(
                f"{self._control.peer} runs model {theirs:08x}, this optimiser {self._program.model_digest:08x} "
                f"({self._settings.model.file}): give both PLCs the same model.file"
            )

    async def _beat(self) -> Status:
        """Give a sign of life; return how the control PLC is."""
        self._beats = (self._beats + 1) & 0xFFFF
        return await self._control.exchange(Heartbeat(self._beats, self._program.model_digest), Status)

    def _is_news(self, update: Update, wanted: AwaitUpdate) -> bool:
        """Tell an awaited update from the old one that the control PLC answers with when nothing happens."""
        if not update.session:
            return False
        if update.session != self._session:
            return True
        return wanted is STRANGER or update.update >= wanted.update

    def _start(self, session: int) -> None:
        """Begin a session, with the operator's settings where they are for this one."""
        self._session = session
        self._last = None
        asked = self.bank.get(OptimizerSession)
        period_s = self._settings.optimizer_plc.program.updating_period_s
        if asked.session == session:
            self._pace = Pace(bool(asked.realtime), asked.factor)
            period_s = asked.updating_period * TICK_S
        self._program.restart(period_s)
        self._publish_identity(0)
        log.info("session started", extra={"session": session, "updating_period_s": period_s})

    async def _optimise(self, update: Update, asked_at: float) -> Verdict:
        """Plan, solve and deliver; in real time, not before the PLC would have the answer."""
        program = self._program
        if update.session != self._session:
            self._start(update.session)
        plan = program.plan(update)
        await self._control.write(plan)
        sequence = program.solve()
        verdict = Verdict.NONE
        ready = asked_at + program.answer_after_s() / self._pace.factor
        if not self._pace.realtime or await self._computed(ready, update, interruptible=plan.load_step > 0):
            verdict = await self._deliver(sequence)
        self._last = program.report(verdict)
        self.bank.put(self._last, update.update % HISTORY_ROWS)
        self._publish_identity(update.tick)
        return verdict

    async def _computed(self, ready: float, update: Update, *, interruptible: bool) -> bool:
        """Wait until the PLC would have its answer; tell whether no load step has cut it off before."""
        look_s = (LOOK_OUT_S if interruptible else HEARTBEAT_S) / self._pace.factor
        while (remaining := ready - time.monotonic()) > 0.0:
            await asyncio.sleep(min(remaining, look_s))
            look = interruptible or remaining > look_s  # an answer that is ready does not wait for a sign of life
            if look and await self._interrupted(update) and interruptible:
                return False
        return True

    async def _interrupted(self, update: Update) -> bool:
        """Tell whether the control PLC has latched another update since."""
        return (await self._beat()).update > update.update

    async def _deliver(self, sequence: InputSequence) -> Verdict:
        """Send a sequence, the header that commits it last; return what the control PLC thinks of it."""
        rows = sequence.rows
        await self._control.write_rows(rows[ROWS_WITH_HEADER:], start=ROWS_WITH_HEADER)
        answer = await self._control.exchange(sequence.header, Acknowledgement, rows=rows[:ROWS_WITH_HEADER])
        if answer.number != sequence.header.number or answer.verdict not in Verdict.__members__.values():
            raise LinkError(f"{self._control.peer}: an acknowledgement arrived damaged")
        verdict = Verdict(answer.verdict)
        if verdict is not Verdict.ACCEPTED:
            log.warning("sequence rejected", extra={"update": sequence.header.update, "verdict": verdict.name.lower()})
        return verdict

    def on_write(self, block: Block, caller: Caller) -> None:
        """Session settings are read when the session begins."""

    def _publish_identity(self, tick: int) -> None:
        self.bank.put(
            Identity(
                map_digest=OPTIMIZER_MAP.digest,
                map_version=OPTIMIZER_MAP.version,
                state=ServiceState.RUNNING if self._session else ServiceState.READY,
                model_digest=self._program.model_digest,
                session=self._session,
                tick=tick,
                heartbeat=(self._last.update + 1 if self._last else 0) & 0xFFFF,
            )
        )

    def snapshot(self) -> Mapping[str, object]:
        """Return what telemetry publishes."""
        return {"session": self._session, **(self._last._asdict() if self._last else {})}


async def serve(settings: OptimizerSettings) -> None:
    """Serve and optimise until cancelled."""
    plc = OptimizerPlc(settings)
    identity = DeviceIdentity(product="Coldloop optimiser PLC", revision=__version__)
    server = ModbusServer(plc.bank, settings=settings.optimizer_plc.server, on_write=plc.on_write, identity=identity)
    await server.start()
    log.info("serving", extra={"host": settings.optimizer_plc.server.host, "port": server.port})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(plc.run(), name="optimiser")
            tasks.create_task(Telemetry(settings.telemetry, "optimizer_plc", plc.snapshot).run(), name="telemetry")
    finally:
        plc.close()
        await server.close()
