"""The control PLC on the bus: client of the plant's rack, server of the optimiser and of operators.

A scan makes one exchange (FC23) with the rack. In lock-step the next scan waits for what it needs: the operator's
grant, the optimiser's plan, and at an updating instant its sequence. In real time it waits for the clock only.
"""

import asyncio
import logging
import time
from collections.abc import Awaitable, Mapping

from coldloop import __version__
from coldloop.clock import Pacer, Schedule
from coldloop.limits import InputLimits
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.model_file import ModelHeader, read_header
from coldloop.process import INPUT_NAMES, OUTPUT_NAMES, TICK_S
from coldloop.registers.bank import RegisterBank
from coldloop.registers.common import Identity, ServiceState
from coldloop.registers.control_plc import (
    CONTROL_MAP,
    AwaitUpdate,
    ControlSession,
    Grant,
    Mode,
    Plan,
    Process,
    SequenceHeader,
    SequenceRow,
    Status,
)
from coldloop.registers.declaration import Block
from coldloop.registers.plant import PLANT_MAP, Measurement
from coldloop.sequence import InputSequence
from coldloop.session import Pace, TimeMode
from coldloop.telemetry import Telemetry
from control_plc.classical import ClassicalLoops
from control_plc.program import ControlProgram
from control_plc.settings import ControlSection, ControlSettings, Driver

log = logging.getLogger("coldloop.control_plc")

TICKS_PER_SECOND = round(1 / TICK_S)
LONGEST_WAIT_S = 1.0
"""Longest time that a read of the latch waits for an update; the optimiser then asks again."""


def make_program(header: ModelHeader, section: ControlSection, limits: InputLimits) -> ControlProgram:
    """Return the program that the configuration asks for, at the operating point of its model file."""
    classical = ClassicalLoops(section.classical, limits, header.y0) if section.driver is Driver.CLASSICAL else None
    return ControlProgram(
        limits=limits, model_digest=header.short_digest, initial_inputs=header.u0, classical=classical
    )


class ControlPlc:
    """Connects the program to the registers and to the plant."""

    def __init__(self, settings: ControlSettings) -> None:
        header = read_header(settings.model.file)
        section = settings.control_plc
        self._settings = settings
        self._model_digest = header.short_digest
        self._program = make_program(header, section, settings.limits)
        self._plant = RegisterClient.at(PLANT_MAP, section.plant)
        self.bank = RegisterBank(CONTROL_MAP, section.word_order)
        self._pace = Pace(settings.session.mode is TimeMode.REALTIME, settings.session.factor)
        self._pacer = self._new_pacer()
        self._running = False
        self._granted = 0
        self._overruns = 0
        self._news = asyncio.Event()
        self._changed = asyncio.Event()
        self._asked: ControlSession | None = None
        self._publish_status()
        self._publish_identity()

    def close(self) -> None:
        """Let go of the plant."""
        self._plant.close()

    def _new_pacer(self) -> Pacer:
        return Pacer(Schedule(time.monotonic(), self._pace.factor))

    # -- scan cycle ----------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Scan until cancelled.

        Raises:
            PeerUnreachableError: The plant is not there, or does not move as it should.
        """
        await self._plant.connect(self._settings.control_plc.plant.patience_s)
        if self._settings.session.autostart:
            session = self._settings.session
            self._start(ControlSession(1, session.mode is TimeMode.REALTIME, session.factor))
        while True:
            await self._until_due()
            await self._scan()

    async def _until_due(self) -> None:
        """Wait until the next scan may begin."""
        while True:
            if self._asked is not None:
                self._start(self._asked)
            if self._running and self._pace.realtime:
                if self._program.tick == 0:
                    self._pacer = self._new_pacer()
                lateness = await self._pacer.until(self._program.tick)
                self._overruns += lateness * 1000 > self._settings.control_plc.scan_tolerance_ms
                if self._asked is None:
                    return
            elif self._may_go_on():
                return
            else:
                self._changed.clear()
                await self._changed.wait()

    def _may_go_on(self) -> bool:
        program = self._program
        return (
            self._running
            and program.tick < self._granted
            and not program.awaiting_plan
            and not program.awaiting_sequence
        )

    async def _scan(self) -> None:
        program = self._program
        actuators = program.begin_scan()
        measurement = await self._plant.exchange(actuators, Measurement)
        if not self._fits(measurement):
            self._end_session(measurement)
            return
        update = program.end_scan(measurement)
        if program.process is not None:
            self.bank.put(program.process)
        if update is not None or program.tick % TICKS_PER_SECOND == 0:
            self._publish_status()
        if update is not None:
            self.bank.put(update)
            self._news.set()
            self._news = asyncio.Event()
        self._publish_identity()

    def _fits(self, measurement: Measurement) -> bool:
        """Tell whether the plant is where the session has it; in real time it may be a tick off."""
        same_tick = measurement.tick == self._program.tick or self._pace.realtime
        return measurement.session == self._program.session and same_tick

    def _end_session(self, measurement: Measurement) -> None:
        """Wait for a new session: the plant was restarted, or is driven by somebody else."""
        self._running = False
        self._publish_status()
        self._publish_identity()
        log.error(
            "session ended: the plant has left it",
            extra={
                "session": self._program.session,
                "tick": self._program.tick,
                "plant_session": measurement.session,
                "plant_tick": measurement.tick,
            },
        )

    def _start(self, asked: ControlSession) -> None:
        self._asked = None
        self._program.restart(asked.session)
        self._pace = Pace(bool(asked.realtime), asked.factor)
        self._granted = self._overruns = 0
        self._running = True
        self._pacer = self._new_pacer()
        self._publish_status()
        self._publish_identity()
        log.info("session started", extra={"session": asked.session, "realtime": bool(asked.realtime)})

    # -- what clients write --------------------------------------------------------------------------------------------

    def on_write(self, block: Block) -> Awaitable[None] | None:
        """Take what a client has written; an awaitable lets its answer wait."""
        record = block.record
        if record is AwaitUpdate:
            return self._await_update(self.bank.get(AwaitUpdate))
        if record is Plan:
            self._program.accept_plan(self.bank.get(Plan))
        elif record is SequenceHeader:
            self._offer(self.bank.get(SequenceHeader))
        elif record is Grant:
            self._granted = self.bank.get(Grant).until_tick
        elif record is ControlSession:
            self._asked = self.bank.get(ControlSession)
        if record is not SequenceRow:
            self._changed.set()
        return None

    def _offer(self, header: SequenceHeader) -> None:
        rows = [self.bank.get(SequenceRow, row) for row in range(header.length)]
        answer = self._program.offer(InputSequence(header, rows))
        self.bank.put(answer)
        if answer.verdict != 1:
            log.warning("sequence rejected", extra={"number": answer.number, "verdict": answer.verdict})
        if self._pace.realtime:
            self._publish_status()

    def _await_update(self, asked: AwaitUpdate) -> Awaitable[None] | None:
        """Let the answer wait for the update asked for; one who asks out of session gets the next fresh one."""
        program = self._program
        wanted = asked.update
        if asked.session != program.session or not self._running:
            latched = program.update
            if latched is not None and not (program.awaiting_plan and latched.tick == program.tick - 1):
                program.abandon()
                wanted = latched.update + 1
            else:
                wanted = latched.update if latched else 0
            self._changed.set()
        return None if self._latched(wanted) else self._wait_for(wanted)

    def _latched(self, wanted: int) -> bool:
        latched = self._program.update
        return latched is not None and latched.update >= wanted

    async def _wait_for(self, wanted: int) -> None:
        """Wait for an update; an update of a newer session, which counts from 0 again, will do."""
        session = self._program.session
        try:
            async with asyncio.timeout(LONGEST_WAIT_S):
                while not self._latched(wanted):
                    await self._news.wait()
                    if self._program.session != session:
                        return
        except TimeoutError:
            return

    # -- what others see -----------------------------------------------------------------------------------------------

    def _publish_status(self) -> None:
        program, record = self._program, self._pacer.record
        self.bank.put(
            Status(
                mode=program.mode,
                update=program.update.update if program.update else 0,
                next_update_tick=program.next_update_tick,
                playing=program.playing,
                remaining=program.remaining,
                accepted=program.accepted,
                rejected=program.rejected,
                deadline_misses=program.deadline_misses,
                overruns=self._overruns,
                lateness_max=record.maximum_s * 1000 if self._pace.realtime else 0.0,
                lateness_p99=record.percentile_s(0.99) * 1000 if self._pace.realtime else 0.0,
            )
        )

    def _publish_identity(self) -> None:
        program = self._program
        self.bank.put(
            Identity(
                map_digest=CONTROL_MAP.digest,
                map_version=CONTROL_MAP.version,
                state=ServiceState.RUNNING if self._running else ServiceState.READY,
                model_digest=self._model_digest,
                session=program.session,
                tick=program.tick,
                heartbeat=program.tick & 0xFFFF,
            )
        )

    def snapshot(self) -> Mapping[str, object]:
        """Return what telemetry publishes."""
        status, process = self.bank.get(Status), self.bank.get(Process)
        return {
            "session": self._program.session,
            "tick": process.tick,
            **status._asdict(),
            "mode": Mode(status.mode).name.lower(),
            "load_w": process.load,
            "inputs": dict(zip(INPUT_NAMES, process.u, strict=True)),
            "outputs": dict(zip(OUTPUT_NAMES, process.y, strict=True)),
        }


async def serve(settings: ControlSettings) -> None:
    """Serve and scan until cancelled."""
    plc = ControlPlc(settings)
    identity = DeviceIdentity(product="Coldloop control PLC", revision=__version__)
    server = ModbusServer(plc.bank, settings=settings.control_plc.server, on_write=plc.on_write, identity=identity)
    await server.start()
    log.info("serving", extra={"host": settings.control_plc.server.host, "port": server.port})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(plc.run(), name="scan cycle")
            tasks.create_task(Telemetry(settings.telemetry, "control_plc", plc.snapshot).run(), name="telemetry")
    finally:
        plc.close()
        await server.close()
