"""The control PLC on the bus: client of the plant's rack, server of the optimiser and of operators.

A scan makes one exchange (FC23) with the rack. In lock-step the next scan waits for what it needs: the operator's
grant, the optimiser's plan, and at an updating instant its sequence, as long as an optimiser is there. In real time it
waits for the clock only. A plant that is lost is looked for; a session goes on where the rack has it.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Sequence
from typing import NamedTuple

from coldloop import __version__
from coldloop.clock import Pacer, Schedule
from coldloop.errors import LinkError
from coldloop.limits import InputLimits
from coldloop.modbus.client import RegisterClient
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.model_file import ModelHeader, read_header
from coldloop.process import TICK_S
from coldloop.registers.bank import RegisterBank
from coldloop.registers.common import Identity
from coldloop.registers.control_plc import (
    CONTROL_MAP,
    ControlSession,
    Operator,
)
from coldloop.registers.plant import PLANT_MAP, Actuators, Measurement, OutputVerdict
from coldloop.registers.safety import AlarmKind
from coldloop.session import Pace, TimeMode
from coldloop.telemetry import Telemetry
from control_plc.clients import Clients
from control_plc.program import ControlProgram, OperatingPoint
from control_plc.publication import Publication
from control_plc.retained_state import Memory
from control_plc.settings import ControlSection, ControlSettings

log = logging.getLogger("coldloop.control_plc")

TICKS_PER_SECOND = round(1 / TICK_S)
SEARCH_S = 0.5
"""How long one attempt to reach a lost plant may take."""


def make_program(header: ModelHeader, section: ControlSection, limits: InputLimits) -> ControlProgram:
    """Return the program that the configuration asks for, at the operating point of its model file."""
    point = OperatingPoint(header.u0, header.y0, header.short_digest)
    return ControlProgram(limits=limits, point=point, section=section)


class _PlantPosition(NamedTuple):
    """Where the plant is."""

    session: int
    tick: int
    applied: Sequence[float]
    """What it applies; in a session that is not ours, what we applied last."""


class ControlPlc:
    """Connects the program to the registers and to the plant."""

    def __init__(self, settings: ControlSettings) -> None:
        header = read_header(settings.model.file)
        section = settings.control_plc
        self._settings = settings
        self._program = make_program(header, section, settings.limits)
        self._plant = RegisterClient.at(PLANT_MAP, section.plant)
        self.bank = RegisterBank(CONTROL_MAP, section.word_order)
        self.publication = Publication(self._program, self.bank, header.short_digest)
        self.clients = Clients(self._program, self.bank, self.publication)
        self._memory = Memory(section.retain.file, header.short_digest)
        self._pace = Pace(settings.session.mode is TimeMode.REALTIME, settings.session.factor)
        self._pacer = self._new_pacer()
        self._failures = 0
        self._awaiting_since: float | None = None
        self._publish()

    def close(self) -> None:
        """Let go of the plant."""
        self._plant.close()

    # -- scan cycle ----------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Scan until cancelled.

        Raises:
            PeerUnreachableError: The plant has never been there.
        """
        await self._plant.connect(self._settings.control_plc.plant.patience_s)
        await self._begin_at_last()
        while True:
            await self._until_due()
            await self._scan()

    async def _until_due(self) -> None:
        """Wait until the next scan may begin."""
        self._awaiting_since = None
        while True:
            if self.clients.asked is not None:
                self._start(self.clients.asked)
            if self.publication.running and self._pace.realtime:
                await self._until_clock()
                if self.clients.asked is None:
                    return
            elif self._may_go_on():
                return
            else:
                await self._until_changed()

    async def _until_clock(self) -> None:
        """Wait for the tick; when a whole one or more has been slept through, go on at the present one."""
        program = self._program
        if program.tick == 0:
            self._pacer = self._new_pacer()
        lateness = await self._pacer.until(program.tick)
        if lateness * 1000 > self._settings.control_plc.scan_tolerance_ms:
            self.publication.overruns += 1
            program.alarms.happened(AlarmKind.SCAN_OVERRUN)
        if lateness * self._pace.factor > TICK_S:
            applied: Sequence[float] = program.applied
            with contextlib.suppress(LinkError):  # the next exchange will tell
                applied = (await self._look_at_plant()).applied
            program.rejoin(self._clock_tick(), applied)

    def _clock_tick(self) -> int:
        """Return the tick that the clock shows; in lock-step, the program's."""
        if not self._pace.realtime:
            return self._program.tick
        elapsed = (time.monotonic() - self._pacer.schedule.start) * self._pace.factor
        return max(self._program.tick, int(elapsed / TICK_S))

    async def _until_changed(self) -> None:
        """Wait until somebody writes something; an optimiser that is waited for too long is lost."""
        self.clients.changed.clear()
        program = self._program
        granted = self.publication.running and program.tick < self.clients.granted
        awaited = granted and (program.awaiting_plan or program.awaiting_sequence)
        if not awaited:
            self._awaiting_since = None
            await self.clients.changed.wait()
            return
        now = time.monotonic()
        since = self._awaiting_since = self._awaiting_since or now
        try:
            async with asyncio.timeout(since + self._settings.control_plc.ladder.optimizer_patience_s - now):
                await self.clients.changed.wait()
        except TimeoutError:
            program.optimizer_lost()
            self._awaiting_since = None

    def _may_go_on(self) -> bool:
        program = self._program
        return (
            self.publication.running
            and program.tick < self.clients.granted
            and not program.awaiting_plan
            and not program.awaiting_sequence
        )

    async def _scan(self) -> None:
        program = self._program
        if self.clients.optimizer_waits:
            program.optimizer_seen()
        try:
            measurement = await self._plant.exchange(program.begin_scan(), Measurement)
        except LinkError as error:
            await self._find_plant(str(error))
            return
        elsewhere = measurement.session != program.session
        if elsewhere and not self._settings.session.autostart:
            self._leave(measurement.session, measurement.tick)
        elif measurement.verdict != OutputVerdict.TAKEN:
            await self._find_plant("it has not taken the outputs")
        elif elsewhere or (measurement.tick != program.tick and not self._pace.realtime):
            await self._find_plant(f"it is at tick {measurement.tick} of session {measurement.session}")
        else:
            self._take(measurement)

    def _take(self, measurement: Measurement) -> None:
        """End the scan with its measurement, and tell what is new."""
        program = self._program
        self._failures = 0
        program.alarms.returned(AlarmKind.PLANT_LOST)
        update = program.end_scan(measurement)
        if program.track():
            self.bank.put(program.operator)
        program.alarms.pass_by()
        if program.process is not None:
            self.bank.put(program.process)
        if update is not None or program.tick % TICKS_PER_SECOND == 0:
            self.publication.status()
        if self.publication.is_behind or program.tick % TICKS_PER_SECOND == 0:
            self.publication.safety()
        if update is not None:
            self.clients.tell(update)
        self.publication.identity()
        self._memory.keep(program, self._pace)

    # -- sessions ------------------------------------------------------------------------------------------------------

    async def _begin_at_last(self) -> None:
        """Begin, however long it takes until the plant lets us."""
        while True:
            try:
                await self._begin()
            except LinkError as error:
                log.warning("plant not ready", extra={"reason": str(error)})
                await asyncio.sleep(SEARCH_S)
            else:
                return

    async def _begin(self) -> None:
        """Go on with the session of before a restart, or with the plant's, or wait for one."""
        state = self._memory.recall()
        plant = await self._look_at_plant()
        if state is not None and state.session == plant.session != 0:
            self._program.alarms.restore(state.alarms)
            self._pace = state.pace
            await self._join(plant, state.updates, state.operator)
        elif self._settings.session.autostart:
            if plant.tick:
                await self._join(plant, 0, self._program.operator)
            else:
                self._start(ControlSession(plant.session or 1, self._pace.realtime, self._pace.factor))

    async def _look_at_plant(self) -> _PlantPosition:
        """Find out which session and tick the plant is at, and what it applies."""
        identity, actuators = await self._plant.read(Identity), await self._plant.read(Actuators)
        ours = actuators.session == identity.session
        return _PlantPosition(identity.session, identity.tick, actuators[1:4] if ours else self._program.applied)

    async def _join(self, plant: _PlantPosition, updates: int, operator: Operator) -> None:
        """Go on with the plant's session where the plant is."""
        tick = await self._in_step(plant.tick) if self._pace.realtime else plant.tick
        self._program.resume(plant.session, tick, plant.applied, updates=updates, operator=operator)
        self.publication.running = True
        self.bank.put(operator)
        self._publish()
        log.warning("session resumed", extra={"session": plant.session, "tick": tick})

    async def _in_step(self, tick: int) -> int:
        """Set the pacer by the plant's clock, which ticks half-way between our scans; return the tick to come."""
        tick_s = TICK_S / self._pace.factor
        deadline = time.monotonic() + 2 * tick_s
        present = tick
        while present == tick and time.monotonic() < deadline:
            present = (await self._plant.read(Identity)).tick
        phase = 0.5 * tick_s if present != tick else 0.0
        self._pacer = self._new_pacer(time.monotonic() + phase - present * tick_s)
        return present

    def _leave(self, session: int, tick: int) -> None:
        """The plant was restarted, or is driven by somebody else: wait for a session."""
        self.publication.running = False
        self._program.alarms.raised(AlarmKind.PLANT_LOST)
        log.error(
            "session ended: the plant has left it",
            extra={
                "session": self._program.session,
                "tick": self._program.tick,
                "plant_session": session,
                "plant_tick": tick,
            },
        )
        self._publish()

    async def _find_plant(self, reason: str) -> None:
        """Look for the plant until it is there, and go on where it is."""
        program = self._program
        log.warning("plant lost", extra={"reason": reason, "tick": program.tick})
        program.alarms.raised(AlarmKind.PLANT_LOST)
        if self._failures:  # it is there, and does not do what it is asked
            await asyncio.sleep(SEARCH_S / 5)
        self._failures += 1
        while self.clients.asked is None:
            self.publication.safety()
            with contextlib.suppress(LinkError):
                await self._plant.connect(SEARCH_S)
                plant = await self._look_at_plant()
                if plant.session == program.session:
                    break
                if self._settings.session.autostart and plant.session:
                    await self._join(plant, program.player.updates, program.operator)
                else:
                    self._leave(plant.session, plant.tick)
                return
            await asyncio.sleep(SEARCH_S / 5)
            program.alarms.now = self._clock_tick()
        else:
            return
        program.rejoin(self._clock_tick() if self._pace.realtime else plant.tick, plant.applied)
        program.alarms.now = program.tick
        self._publish()

    def _start(self, asked: ControlSession) -> None:
        self.clients.asked = None
        self._program.restart(asked.session)
        self._pace = Pace(bool(asked.realtime), asked.factor)
        self.publication.overruns = 0
        self.publication.running = True
        self._pacer = self._new_pacer()
        self.bank.put(self._program.operator)
        self._publish()
        log.info("session started", extra={"session": asked.session, "realtime": bool(asked.realtime)})

    def _new_pacer(self, start: float | None = None) -> Pacer:
        pacer = Pacer(Schedule(time.monotonic() if start is None else start, self._pace.factor))
        self.publication.lateness = pacer.record if self._pace.realtime else None
        return pacer

    def _publish(self) -> None:
        self.publication.status()
        self.publication.safety()
        self.publication.identity()


async def serve(settings: ControlSettings) -> None:
    """Serve and scan until cancelled."""
    plc = ControlPlc(settings)
    identity = DeviceIdentity(product="Coldloop control PLC", revision=__version__)
    server = ModbusServer(
        plc.bank, settings=settings.control_plc.server, on_write=plc.clients.on_write, identity=identity,
        on_departure=plc.clients.on_departure, on_refusal=plc.clients.on_refusal,
    )  # fmt: skip
    await server.start()
    log.info("serving", extra={"host": settings.control_plc.server.host, "port": server.port})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(plc.run(), name="scan cycle")
            telemetry = Telemetry(settings.telemetry, "control_plc", plc.publication.snapshot)
            tasks.create_task(telemetry.run(), name="telemetry")
    finally:
        plc.close()
        await server.close()
