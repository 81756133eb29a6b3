"""The optimiser PLC on the bus: client of the control PLC, server of its own diagnostics.

State and requests of the link are in `control_link.py`. Here are the registers, the clock, and the order of things.
"""

import asyncio
import logging
import secrets
import time
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple, TypeAlias

from coldloop import __version__, config, errors
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.settings import InputLimits
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop.registers import common, maps_of
from coldloop.registers import optimizer_plc as registers
from coldloop.registers.bank import Caller, IllegalValueError, RegisterBank
from coldloop.registers.codec import WordOrder, blank
from coldloop.registers.common import EventKind, SessionPace
from coldloop.registers.control_plc import AwaitUpdate, Plan, Update, Verdict
from coldloop.registers.declaration import Block, RegisterMap
from coldloop.registers.optimizer_plc import ControlLinkState
from coldloop.safety.writers import InputSequence
from coldloop.service.journal import Journal, JournalPublication
from coldloop.service.monitoring import MetricsServer, Telemetry
from coldloop.service.start import SERVING
from coldloop.session import TimeBase, TimeMode
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.control_link import ControlClient, ControlLink
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.settings import SHOWN, OptimizerSettings, ProgramSettings

log = logging.getLogger("coldloop.optimizer_plc")
MakeProgram: TypeAlias = Callable[[LtiModel, ProgramSettings, InputLimits], OptimizerProgram]

LOOK_OUT_TICKS: Final = 1 / 8
"""Plant time between two looks for a load step in real time: the new computation begins so much later."""
HEARTBEAT_TICKS: Final = 4  # plant time between two heartbeats while an answer is computed
SHORTEST_PAUSE_S: Final = 0.001
"""Real time between two such requests, however high the factor: others want to be served too."""
LONGEST_PAUSE_S: Final = 1.0  # lower limit of it at low factors: a new session does not wait for an obsolete answer
SHORTEST_WAIT_S: Final = 0.02
"""An answer without a new update that comes sooner, in real time, is followed by a pause: it should have waited."""
FRESH_UPDATE: Final = AwaitUpdate(session=0, update=0)  # asks for a fresh update, whatever the session
NO_UPDATE: Final = registers.Optimization(*(0,) * len(registers.Optimization._fields))


class OptimizerPublication:
    """Registers and journal of the optimiser PLC; the budget decides which periods can be asked for in real time."""

    def __init__(
        self, register_map: RegisterMap, order: WordOrder, budget: PlcBudget, limits: registers.OperatingLimits,
        model_digest: int, holder: int,
    ) -> None:  # fmt: skip
        self.bank = RegisterBank(register_map, order)
        self.bank.put(limits)
        self.bank.put_sealed(blank(registers.Prediction, self.bank.map))
        self.bank.judged_by(self._judge, registers.OptimizerSession)
        self.bank.judged_by(self._judge_pace, SessionPace)
        self.pace = TimeBase(realtime=False, factor=1.0)
        """Time base of the session under way."""
        self._budget = budget
        self._model_digest = model_digest
        self._journal = Journal()
        self._shown = JournalPublication(self._journal, self.bank)
        self._asked_by = ""
        self._last: registers.Optimization | None = None
        self._session = self._tick = 0
        self._predict: Callable[[], registers.Prediction] | None = None
        """Computes the prediction that is to be shown; None when the registers have it."""
        self._journal.note(0, EventKind.BOOT)
        self._shown.show()
        self.link = ControlLink(holder, self._journal, self._shown.show)
        self.bank.keep_fresh(registers.ControlLinkStatus, self.link.registers)
        self.bank.keep_fresh(common.Identity, self._identity)
        self.bank.keep_fresh(registers.Prediction, self._prediction)

    def _judge(self, asked: registers.OptimizerSession, _row: int, _caller: Caller) -> None:
        """Refuse an updating period that there is not, or whose answers would never be there in time."""
        ticks = asked.updating_period
        if 0 < ticks < SHORTEST_TICKS:
            raise IllegalValueError(
                f"session.updating_period = {ticks}: give {SHORTEST_TICKS} or more, or 0 (adaptive)"
            )
        if ticks and asked.realtime and not self._budget.is_enough(ticks):
            period_s = ticks * self._budget.times.tick_s
            raise IllegalValueError(
                f"session.updating_period = {ticks}: in real time no answer is there within {period_s:g} s, one "
                f"iteration takes {self._budget.answer_after_s(1):g} s with its preparation: give more, or 0 (adaptive)"
            )

    def _judge_pace(self, asked: SessionPace, _row: int, _caller: Caller) -> None:
        try:
            asked.of(self._session)
        except ValueError as error:
            raise IllegalValueError(f"pace: {error}") from None

    def on_write(self, block: Block, caller: Caller) -> None:
        """Answer a query of the journal; the settings of a session are taken when it begins."""
        if block.record is common.JournalQuery:
            self._shown.answer(self.bank.get(common.JournalQuery))
        elif block.record is registers.OptimizerSession:
            self._asked_by = caller.name
        elif block.record is SessionPace:
            before, pace = self.pace, self.bank.get(SessionPace).of(self._session)
            self.bank.put(SessionPace.shown(self._session, pace))
            if pace == before:
                return
            self.pace = pace
            self._journal.note(
                self.link.tick, EventKind.PACE, common.pace_subject(pace), value=pace.factor, who=caller.name
            )
            self._shown.show()

    def asked_for(self, session: int) -> registers.OptimizerSession | None:
        """Return the settings that an operator has written for a session."""
        asked = self.bank.get(registers.OptimizerSession)
        return asked if asked.session == session else None

    def session_started(self, session: int, pace: TimeBase, rule: registers.UpdatingRuleStatus) -> None:
        """Show that a session has begun."""
        who = self._asked_by if self.asked_for(session) is not None else ""
        self._session, self._tick, self._last = session, 0, None
        for row in range(registers.HISTORY_ROWS):  # the updates of another session are not those of this one
            self.bank.put(NO_UPDATE, row)
        self._journal.note(self.link.tick, EventKind.SESSION, int(pace.realtime), value=pace.factor, who=who)
        self.pace = pace
        self.bank.put(SessionPace.shown(session, pace))
        self.bank.put(rule)
        self._predict = None
        self.bank.put_sealed(blank(registers.Prediction, self.bank.map))
        self._shown.show()

    def optimised(self, tick: int, done: registers.Optimization) -> None:
        """Show what was done with the update latched at `tick`."""
        self._tick, self._last = tick, done
        self.bank.put(done, done.update % registers.HISTORY_ROWS)

    def predicted(self, predict: Callable[[], registers.Prediction]) -> None:
        """Show what a delivered sequence is expected to lead to: it is computed when it is read."""
        self._predict = predict

    def _prediction(self) -> registers.Prediction | None:
        predict, self._predict = self._predict, None
        return None if predict is None else predict()

    def _identity(self) -> common.Identity:
        return common.Identity(
            map_digest=self.bank.map.digest, map_version=self.bank.map.version,
            state=common.ServiceState.RUNNING if self._session else common.ServiceState.READY,
            model_digest=self._model_digest, session=self._session, tick=self._tick,
            heartbeat=(self._last.update + 1 if self._last else 0) & 0xFFFF,
        )  # fmt: skip

    def snapshot(self) -> Mapping[str, object]:
        """Return what telemetry publishes."""
        shown = {"session": self._session, "link": self.link.state.name.lower()}
        return {**shown, **(self._last._asdict() if self._last else {})}


class _Answer(NamedTuple):
    """A sequence on its way."""

    update: Update
    sequence: InputSequence
    ready: float  # time at which the PLC would have computed it, on the monotonic clock, s
    plan: Plan
    planned: bool  # the control PLC has the plan: in real time it is sent at once, in lock-step with the sequence
    resumed: bool = False  # the link has been lost since it was computed


class OptimizerPlc:
    """Connects the program, which `program` makes, to the registers and to the control PLC.

    Raises ConfigurationError or ModelFileError if the files for TLS, or the model file, cannot be used.
    """

    def __init__(self, settings: OptimizerSettings, program: MakeProgram = OptimizerProgram) -> None:
        section = settings.optimizer_plc
        self._settings, self._tick_s = settings, settings.process.tick_s
        maps = maps_of(settings.process)
        self._program = program(load(settings.model.file), section.program, settings.limits)
        digest, holder = self._program.model_digest, 1 + secrets.randbelow(0xFFFFFFFF)
        self.publication = OptimizerPublication(
            maps.optimizer_plc, section.word_order, self._program.budget, self._program.operating_limits, digest, holder
        )
        self.publication.bank.keep_fresh(registers.ModelDeviation, self._program.model_deviation)
        common.publish_configuration(self.publication.bank, config.selected(settings, SHOWN))
        self._link = self.publication.link
        self._control = ControlClient(
            maps.control_plc, section.control_plc, self._link, digest, str(settings.model.file)
        )
        self._configured_pace = TimeBase(settings.session.mode is TimeMode.REALTIME, settings.session.factor)
        self._session = 0
        self._wanted = FRESH_UPDATE
        self._kept: _Answer | None = None

    def close(self) -> None:
        """Disconnect from the control PLC."""
        self._control.close()

    async def run(self) -> None:
        """Serve one update after the other until cancelled; a control PLC that is absent or lost is looked for.

        Raises ModelFileError if the first one that was found runs another model.
        """
        while True:
            await asyncio.sleep(self._link.pause_s(time.monotonic()))
            self._link.attempt(time.monotonic())
            try:
                await self._control.introduce()
                if self._link.is_worth_logging("found", time.monotonic()):
                    log.info("control PLC found")
                await self._resume()
                await self._serve_updates()
            except errors.ModelFileError as error:
                if not self._link.was_up:
                    raise
                self._lose(error)
            except errors.LinkError as error:
                self._lose(error)

    def _lose(self, error: errors.ColdloopError) -> None:
        """Note why the link is lost, and prepare the next attempt."""
        was_foreign = self._link.state is ControlLinkState.OTHER_MASTER
        self._link.failed(error)
        state, reason = self._link.state, str(error)
        if state is not ControlLinkState.OTHER_MASTER:  # its connection may stay: nothing is wrong with it
            self._control.close()
        if isinstance(error, (errors.RequestRefusedError, errors.UnfitValueError)):
            self._session = 0  # its state leads to rejected sequences: restart the session
        if state is not ControlLinkState.SEARCHING:  # others may have had the lease meanwhile
            self._wanted, self._kept = FRESH_UPDATE, None
        else:
            try:
                self._control.reload_certificates()
            except errors.ConfigurationError as unusable:
                reason = f"{reason}; {unusable}"
        still_foreign = was_foreign and state is ControlLinkState.OTHER_MASTER
        if not still_foreign and self._link.is_worth_logging(reason, time.monotonic()):
            log.warning("control PLC lost", extra={"link": state.name.lower(), "reason": reason})

    async def _resume(self) -> None:
        """Deliver what was on its way when the link was lost, unless it has arrived."""
        answer, self._kept = self._kept, None
        if answer is None:
            return
        verdict = await self._control.verdict_on(answer.sequence)
        self._link.go(ControlLinkState.COMPUTING)
        if verdict is None:
            await self._finish(answer._replace(resumed=True))
        else:
            self._link.go(ControlLinkState.DELIVERING)
            await self._conclude(answer.update, verdict)

    async def _serve_updates(self) -> None:
        while True:
            asked_at = time.monotonic()
            update = await self._control.next_update(self._wanted)
            arrived_at = time.monotonic()
            is_awaited = self._wanted is FRESH_UPDATE or update.update >= self._wanted.update
            if update.session and (update.session != self._session or is_awaited):  # no old one, for want of another
                self._wanted = FRESH_UPDATE  # should the link be lost before this one is planned
                await self._answer(update, arrived_at)
                continue
            begun_anew = update.update + 1 < self._wanted.update  # under the same number: updates count from 0 again
            if update.session != self._wanted.session or begun_anew:
                self._wanted = FRESH_UPDATE
            if arrived_at - asked_at < SHORTEST_WAIT_S:
                await asyncio.sleep(SHORTEST_WAIT_S)

    async def _start(self, session: int) -> None:
        """Begin a session, or begin it anew: at the pace that it has by now, with the period that is asked for."""
        period_s = self._settings.optimizer_plc.program.updating_period_s
        pace, asked = await self._control.pace(session), self.publication.asked_for(session)
        if asked is not None:
            period_s = asked.updating_period * self._tick_s
        if pace is None:
            pace = TimeBase(bool(asked.realtime), asked.factor) if asked is not None else self._configured_pace
        self._session = session
        self._program.restart(period_s)
        self.publication.session_started(session, pace, self._program.rule_status())
        log.info("session started", extra={"session": session, "updating_period_s": period_s})

    async def _answer(self, update: Update, arrived_at: float) -> None:
        """Plan and solve; in real time, deliver not before the PLC would have the answer."""
        program = self._program
        self._link.tick = update.tick
        if update.session != self._session:
            await self._start(update.session)
        self._link.go(ControlLinkState.COMPUTING)
        plan = program.plan(update)
        realtime = self.publication.pace.realtime
        if realtime:  # the next scan does not wait for it
            await self._control.plan(plan)
        sequence = program.solve()
        ready = arrived_at + program.answer_after_s() / self.publication.pace.factor
        await self._finish(_Answer(update, sequence, ready, plan, planned=realtime))

    async def _finish(self, answer: _Answer) -> None:
        """Deliver an answer when it is ready; keep it, once, should the link be lost meanwhile."""
        self._kept = None if answer.resumed else answer
        if self.publication.pace.realtime and not await self._is_computed(answer):
            self._link.go(ControlLinkState.WAITING, interrupted=1)
            await self._conclude(answer.update, Verdict.NONE)
            return
        self._link.go(ControlLinkState.DELIVERING)
        plan = None if answer.planned else answer.plan
        await self._conclude(answer.update, await self._control.deliver(answer.sequence, plan))

    async def _conclude(self, update: Update, verdict: Verdict) -> None:
        """Take the verdict, Verdict.NONE of an answer that was given up, and decide which update to ask for next."""
        self._kept = None
        if verdict is not Verdict.NONE:
            self._link.go(ControlLinkState.WAITING, rejected=int(verdict is not Verdict.ACCEPTED))
        if verdict not in (Verdict.NONE, Verdict.ACCEPTED):
            log.warning("sequence rejected", extra={"update": update.update, "verdict": verdict.name.lower()})
        self.publication.optimised(update.tick, self._program.report(verdict))
        if verdict is Verdict.ACCEPTED:
            self.publication.predicted(self._program.predictor())
        unplanned = verdict is Verdict.WRONG_UPDATE
        if unplanned:  # a plan that came too late: this update leads to no other, unless a load step has led to one
            newest = await self._control.newest()
            unplanned = newest.session == update.session and newest.update <= update.update
        # late once is late for ever with updates that have been waiting: begin again with a fresh one
        begin_again = unplanned or verdict is Verdict.LATE
        if begin_again or verdict is Verdict.ACCEPTED:
            self._program.answered(late=begin_again)
        self._wanted = FRESH_UPDATE if begin_again else AwaitUpdate(update.session, update.update + 1)

    async def _is_computed(self, answer: _Answer) -> bool:
        """Wait until the PLC would have its answer; return whether no load step or session has cut it off before."""
        interruptible = answer.plan.load_step > 0  # a load step may end the updating period
        spacing_s = self._tick_s * (LOOK_OUT_TICKS if interruptible else HEARTBEAT_TICKS) / self.publication.pace.factor
        look_s = min(max(spacing_s, SHORTEST_PAUSE_S), LONGEST_PAUSE_S)
        while (remaining := answer.ready - time.monotonic()) > 0.0:
            await asyncio.sleep(min(remaining, look_s))
            # an answer that is ready does not wait for a sign of life
            look = interruptible or remaining > look_s
            if not look:
                continue
            newest = await self._control.newest()
            stepped = interruptible and newest.update > answer.update.update
            if stepped or newest.session != answer.update.session:
                return False
        return True


async def serve(settings: OptimizerSettings, program: MakeProgram = OptimizerProgram) -> None:
    """Serve and optimise until cancelled."""
    plc = OptimizerPlc(settings, program)
    shown = plc.publication
    identity = DeviceIdentity(product="Coldloop optimiser PLC", revision=__version__)
    server = ModbusServer(
        shown.bank, settings=settings.optimizer_plc.server, on_write=shown.on_write, identity=identity
    )
    await server.start()
    log.info(SERVING, extra={"host": settings.optimizer_plc.server.host, "port": server.port})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(MetricsServer(settings.optimizer_plc.metrics, shown.bank).run(), name="metrics")
            tasks.create_task(plc.run(), name="optimiser")
            tasks.create_task(Telemetry(settings.telemetry, "optimizer_plc", shown.snapshot).run(), name="telemetry")
    finally:
        plc.close()
        await server.close()
