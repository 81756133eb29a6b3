"""The optimiser PLC on the bus: client of the control PLC, server of its own diagnostics.

The state of the link is kept by `control_link.py`; what is asked again when it gets lost, by `control_client.py`. Here
are the clock, and the order of things.
"""

import asyncio
import logging
import secrets
import time
from collections.abc import Callable
from typing import Final, NamedTuple, TypeAlias

from coldloop import __version__
from coldloop.config import selected
from coldloop.errors import (
    ColdloopError,
    ConfigurationError,
    LinkError,
    ModelFileError,
    RequestRefusedError,
    UnfitValueError,
)
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.settings import InputLimits
from coldloop.registers import maps_of
from coldloop.registers.common import publish_configuration
from coldloop.registers.control_plc import AwaitUpdate, Plan, Update, Verdict
from coldloop.registers.optimizer_plc import ControlLinkState, ModelDeviation
from coldloop.safety.writers import InputSequence
from coldloop.service.monitoring import MetricsServer, Telemetry
from coldloop.service.start import SERVING
from coldloop.session import TimeBase, TimeMode
from coldloop_optimizer_plc.control_client import ControlClient
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.publication import OptimizerPublication
from coldloop_optimizer_plc.settings import SHOWN, OptimizerSettings, ProgramSettings

log = logging.getLogger("coldloop.optimizer_plc")
MakeProgram: TypeAlias = Callable[[LtiModel, ProgramSettings, InputLimits], OptimizerProgram]

LOOK_OUT_TICKS: Final = 1 / 8
"""Plant time between two looks for a load step in real time: the new computation begins so much later."""
HEARTBEAT_TICKS: Final = 4
"""Plant time between two heartbeats while an answer is computed."""
SHORTEST_PAUSE_S: Final = 0.001
"""Real time between two such requests, however high the factor: others want to be served too."""
LONGEST_PAUSE_S: Final = 1.0
"""Lower limit of it at low factors: a new session does not wait for an obsolete answer."""
SHORTEST_WAIT_S: Final = 0.02
"""An answer without a new update that comes sooner, in real time, is followed by a pause: it should have waited."""
FRESH_UPDATE: Final = AwaitUpdate(session=0, update=0)
"""Asks for a fresh update, whatever the session."""


class _Answer(NamedTuple):
    """A sequence on its way."""

    update: Update
    sequence: InputSequence
    ready: float
    """Time at which the PLC would have computed it, on the monotonic clock, s."""
    plan: Plan
    planned: bool
    """The control PLC has the plan: in real time it is sent at once, in lock-step with the sequence."""
    resumed: bool = False
    """The link has been lost since it was computed."""


class OptimizerPlc:
    """Connects the program to the registers and to the control PLC.

    Args:
        settings: Of this service.
        program: Makes the program.

    Raises:
        ConfigurationError: The files for TLS cannot be used.
        ModelFileError: The model file cannot be used.
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
        self.publication.bank.keep_fresh(ModelDeviation, self._program.model_deviation)
        publish_configuration(self.publication.bank, selected(settings, SHOWN))
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

    # -- the link ------------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Serve one update after the other until cancelled; a control PLC that is absent or lost is looked for.

        Raises:
            ModelFileError: The first control PLC that was found runs another model.
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
            except ModelFileError as error:
                if not self._link.was_up:
                    raise
                self._lose(error)
            except LinkError as error:
                self._lose(error)

    def _lose(self, error: ColdloopError) -> None:
        """Note why the link is lost, and prepare the next attempt."""
        was_foreign = self._link.state is ControlLinkState.OTHER_MASTER
        self._link.failed(error)
        state, reason = self._link.state, str(error)
        if state is not ControlLinkState.OTHER_MASTER:  # its connection may stay: nothing is wrong with it
            self._control.close()
        if isinstance(error, (RequestRefusedError, UnfitValueError)):
            self._session = 0  # its state leads to rejected sequences: restart the session
        if state is not ControlLinkState.SEARCHING:  # others may have had the lease meanwhile
            self._wanted, self._kept = FRESH_UPDATE, None
        else:
            try:
                self._control.reload_certificates()
            except ConfigurationError as unusable:
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
        self._link.computes()
        if verdict is None:
            await self._finish(answer._replace(resumed=True))
        else:
            self._link.delivers()
            await self._conclude(answer.update, verdict)

    # -- updates -------------------------------------------------------------------------------------------------------

    async def _serve_updates(self) -> None:
        while True:
            asked_at = time.monotonic()
            update = await self._control.next_update(self._wanted)
            arrived_at = time.monotonic()
            if self._is_news(update):
                self._wanted = FRESH_UPDATE  # should the link be lost before this one is planned
                await self._answer(update, arrived_at)
                continue
            begun_anew = update.update + 1 < self._wanted.update  # under the same number: updates count from 0 again
            if update.session != self._wanted.session or begun_anew:
                self._wanted = FRESH_UPDATE
            if arrived_at - asked_at < SHORTEST_WAIT_S:
                await asyncio.sleep(SHORTEST_WAIT_S)

    def _is_news(self, update: Update) -> bool:
        """Distinguish an awaited update from the old one that the control PLC returns when nothing happens."""
        if not update.session:
            return False
        if update.session != self._session:
            return True
        return self._wanted is FRESH_UPDATE or update.update >= self._wanted.update

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
        self._link.computes()
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
            self._link.interrupted()
            await self._conclude(answer.update, Verdict.NONE)
            return
        self._link.delivers()
        plan = None if answer.planned else answer.plan
        await self._conclude(answer.update, await self._control.deliver(answer.sequence, plan))

    async def _conclude(self, update: Update, verdict: Verdict) -> None:
        """Take the verdict, Verdict.NONE of an answer that was given up, and decide which update to ask for next."""
        self._kept = None
        if verdict is not Verdict.NONE:
            self._link.acknowledged(verdict)
        if verdict not in (Verdict.NONE, Verdict.ACCEPTED):
            log.warning("sequence rejected", extra={"update": update.update, "verdict": verdict.name.lower()})
        self.publication.optimised(update.tick, self._program.report(verdict))
        if verdict is Verdict.ACCEPTED:
            self.publication.predicted(self._program.predictor())
        # a plan that came too late: this update leads to no other, unless a load step has led to one
        unplanned = verdict is Verdict.WRONG_UPDATE and not await self._is_superseded(update)
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

    async def _is_superseded(self, update: Update) -> bool:
        """Return whether the control PLC has latched another update since, and give it a sign of life."""
        newest = await self._control.newest()
        return newest.session != update.session or newest.update > update.update


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
