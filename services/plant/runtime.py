"""The plant on the bus: a remote I/O rack in front of the simulation.

In lock-step, writing the outputs of the present tick answers with its measurement and then moves the plant on. In
real time the plant moves by the clock, half a tick away from the scans, whatever the control PLC does.
"""

import asyncio
import logging
import math
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from coldloop import __version__
from coldloop.clock import Pacer, Schedule
from coldloop.errors import ModelFileError
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.model_file import ModelHeader, read_header
from coldloop.process import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES, TICK_S
from coldloop.registers.bank import Caller, RegisterBank
from coldloop.registers.common import Identity, ServiceState
from coldloop.registers.declaration import Block
from coldloop.registers.plant import (
    HISTORY_ROWS,
    PLANT_MAP,
    Actuators,
    LoadStep,
    Measurement,
    OutputVerdict,
    PlantSample,
    PlantSession,
    SensorFault,
    SensorFaultKind,
)
from coldloop.registers.safety import WatchdogTime
from coldloop.retained import RetainedFile, RetainedStateError
from coldloop.seal import sealed
from coldloop.session import Pace, TimeMode
from coldloop.telemetry import Telemetry
from coldloop.watchdog import Watchdog
from plant.cold_box import REFERENCE
from plant.helium.properties import load_helium
from plant.load import find_load
from plant.model import parameters_digest
from plant.program import LoadProfile, MeasurementNoise, PlantProgram
from plant.settings import PlantSettings, SafeAction, SensorSettings

log = logging.getLogger("coldloop.plant")

OWNER = "plant/1"
"""Who retained states belong to, and the version of what they hold."""
STALE_TICKS = 8
"""In real time, outputs that are older than this are not applied."""


def own_header(file: Path) -> ModelHeader:
    """Return the header of a model file of this very plant.

    Raises:
        ModelFileError: The file cannot be read, or the model was made from another plant.
    """
    header = read_header(file)
    names = (header.state_names, header.input_names, header.output_names)
    if header.parameters_digest != _own_parameters_digest() or names != (STATE_NAMES, INPUT_NAMES, OUTPUT_NAMES):
        raise ModelFileError(f"{file}: a model of another plant; make one with `coldloop model --out FILE`")
    return header


@cache
def _own_parameters_digest() -> str:
    return parameters_digest(REFERENCE, load_helium())


def make_program(header: ModelHeader, sensors: SensorSettings, load: LoadProfile, seed: int) -> PlantProgram:
    """Return the plant at the operating point of its model file."""
    deviations = sensors.deviations
    noise = MeasurementNoise(deviations, seed) if any(deviations) else None
    return PlantProgram(box=REFERENCE, x0=header.x0, u0=header.u0, load=load, noise=noise)


class PlantRack:
    """Connects the program to the registers."""

    def __init__(self, settings: PlantSettings) -> None:
        self._settings = settings
        self._header = own_header(settings.model.file)
        self.bank = RegisterBank(PLANT_MAP, settings.plant.word_order)
        self._watchdog = Watchdog(settings.plant.watchdog.ticks)
        self._faults: dict[int, float] = {}
        file = settings.plant.retain.file
        self._retained = RetainedFile(file, OWNER, self._header.short_digest) if file else None
        self._failure: asyncio.Future[None] | None = None
        if not self._resume():
            load = find_load(settings.plant.load, self._header.w0)
            self._begin(1 if settings.session.autostart else 0, self._configured_pace(), load, settings.plant.seed)

    def _configured_pace(self) -> Pace:
        session = self._settings.session
        return Pace(session.mode is TimeMode.REALTIME, session.factor)

    def _begin(self, session: int, pace: Pace, load: LoadProfile, seed: int) -> None:
        self._program = make_program(self._header, self._settings.plant.sensors, load, seed)
        self._session, self._pace, self._load, self._seed = session, pace, load, seed
        self._applied = self._header.u0
        self._moving = False
        self._clock: asyncio.Task[None] | None = None
        self._watchdog.set(self._watchdog.time, 0)
        self._faults.clear()
        self._show_applied()
        self.bank.put(sealed(self._measurement()))
        self._publish()

    # -- retained state ------------------------------------------------------------------------------------------------

    def _resume(self) -> bool:
        """Go on where a session was when the rack was ended; tell whether that was kept."""
        if self._retained is None:
            return False
        try:
            content = self._retained.load()
            if content is None:
                return False
            load = LoadProfile(tuple(content["times"]), tuple(content["watts"]))
            self._begin(content["session"], Pace(*content["pace"]), load, content["seed"])
            self._program.resume(**content["program"])
        except (RetainedStateError, KeyError, TypeError, ValueError) as error:
            log.warning("retained state refused", extra={"reason": str(error)})
            return False
        tick = self._program.tick
        cv155, ncr22, cv156 = content["program"]["u"]
        self._applied = cv155, ncr22, cv156
        self._watchdog.set(self._watchdog.time, tick)
        self._show_applied()
        self.bank.put(sealed(self._measurement()))
        self._publish()
        log.warning("session resumed", extra={"session": self._session, "tick": tick})
        return True

    def _keep(self) -> None:
        if self._retained is None or not self._session:
            return
        state = {
            "session": self._session, "pace": self._pace, "times": self._load.times, "watts": self._load.watts,
            "seed": self._seed, "program": self._program.retained(),
        }  # fmt: skip
        try:
            self._retained.save(state)
        except RetainedStateError as error:
            log.error("the state is not retained", extra={"reason": str(error)})  # noqa: TRY400 one line

    def on_write(self, block: Block, caller: Caller) -> None:  # noqa: ARG002
        """Take what a client has written."""
        if block.record is Actuators:
            self._exchange(self.bank.get(Actuators))
        elif block.record is PlantSession:
            self._start_session(self.bank.get(PlantSession))
        elif block.record is WatchdogTime:
            self._watchdog.set(self.bank.get(WatchdogTime).time, self._program.tick)
        elif block.record is SensorFault:
            self._set_faults()

    def _set_faults(self) -> None:
        """Take the sensors' faults; a frozen one keeps showing what it shows now."""
        shown = self._measurement().y
        rows = [self.bank.get(SensorFault, row) for row in range(len(OUTPUT_NAMES))]
        values = {
            SensorFaultKind.NOT_A_NUMBER: lambda row: math.nan,  # noqa: ARG005 - one signature for all kinds
            SensorFaultKind.FROZEN: lambda row: shown[row],
            SensorFaultKind.VALUE: lambda row: rows[row].value,
        }
        self._faults = {row: values[SensorFaultKind(fault.kind)](row) for row, fault in enumerate(rows) if fault.kind}

    # -- sessions ------------------------------------------------------------------------------------------------------

    def _start_session(self, asked: PlantSession) -> None:
        if self._clock is not None:
            self._clock.cancel()
        steps = [self.bank.get(LoadStep, row) for row in range(asked.load_steps)]
        load = LoadProfile(tuple(s.tick for s in steps), tuple(s.watts for s in steps))
        self._begin(asked.session, Pace(bool(asked.realtime), asked.factor), load, asked.seed)
        log.info("session started", extra={"session": asked.session, "realtime": bool(asked.realtime)})

    # -- exchange ------------------------------------------------------------------------------------------------------

    def _exchange(self, asked: Actuators) -> None:
        if self._moving:  # the next request came in before the plant had moved on
            self._advance()
        if asked.session != self._session or not self._is_timely(asked.tick):
            self._show_applied()
            self.bank.put(sealed(self._measurement()))
            return
        self._applied = (asked.cv155, asked.ncr22, asked.cv156)
        self._program.apply(self._applied)
        self._watchdog.trigger(self._program.tick)
        self.bank.put(sealed(self._measurement()._replace(verdict=OutputVerdict.TAKEN)))
        if self._pace.realtime:
            self._start_clock()
        else:
            self._moving = True
            asyncio.get_running_loop().call_soon(self._advance)  # after the answer is on its way

    def _is_timely(self, tick: int) -> bool:
        """Tell whether outputs of this tick are for now: what a network has held up is not applied late."""
        if self._pace.realtime:
            return tick >= self._program.tick - STALE_TICKS
        return tick == self._program.tick

    def _show_applied(self) -> None:
        """Put what is applied into the registers, for the control PLC to read back."""
        cv155, ncr22, cv156 = self._applied
        self.bank.put(sealed(Actuators(self._program.tick, cv155, ncr22, cv156, self._session)))

    def _advance(self) -> None:
        """Record the tick that ends and move on to the next."""
        if not self._moving:
            return
        self._moving = False
        program = self._program
        self.bank.put(
            PlantSample(program.tick, program.load, self._applied, program.measure(), program.state),
            program.tick % HISTORY_ROWS,
        )
        program.advance()
        self._watch()
        self._publish()
        self._keep()

    def _watch(self) -> None:
        """Bring the outputs into their safe state when the control PLC has been silent for too long."""
        tick, watchdog = self._program.tick, self._settings.plant.watchdog
        if not self._watchdog.check(tick):
            return
        log.warning("watchdog expired", extra={"tick": tick, "action": watchdog.action})
        if watchdog.action is SafeAction.SAFE:
            self._applied = watchdog.safe_state
            self._program.apply(self._applied)
            self._show_applied()

    def _start_clock(self) -> None:
        """Let the plant move by the clock from its present tick on, if it does not yet."""
        if self._clock is None:
            self._clock = asyncio.get_running_loop().create_task(self._run_by_the_clock(), name="plant clock")
            self._clock.add_done_callback(self._clock_ended)

    def _clock_ended(self, clock: "asyncio.Task[None]") -> None:
        if not clock.cancelled() and self._failure is not None and not self._failure.done():
            self._failure.set_exception(clock.exception() or RuntimeError("the plant's clock has ended"))

    async def run(self) -> None:
        """Keep an eye on the plant's clock until cancelled; a session that was resumed moves on at once.

        Raises:
            Exception: What the clock has failed of.
        """
        self._failure = asyncio.get_running_loop().create_future()
        if self._pace.realtime and self._program.tick:
            self._start_clock()
        await self._failure

    async def _run_by_the_clock(self) -> None:
        begun = time.monotonic() - self._program.tick * TICK_S / self._pace.factor
        pacer = Pacer(Schedule(begun, self._pace.factor))
        while True:
            await pacer.until(self._program.tick + 0.5)
            self._moving = True
            self._advance()
            self.bank.put(sealed(self._measurement()))

    # -- what others see -----------------------------------------------------------------------------------------------

    def _measurement(self) -> Measurement:
        program = self._program
        y = program.measure()
        if self._faults:
            y = tuple(self._faults.get(output, value) for output, value in enumerate(y))
        return Measurement(program.tick, program.load, y, program.state, self._session, self._applied)

    def _publish(self) -> None:
        program = self._program
        self.bank.put(self._watchdog.registers(program.tick))
        self.bank.put(
            Identity(
                map_digest=PLANT_MAP.digest,
                map_version=PLANT_MAP.version,
                state=ServiceState.RUNNING if self._session else ServiceState.READY,
                model_digest=self._header.short_digest,
                session=self._session,
                tick=program.tick,
                heartbeat=program.tick & 0xFFFF,
            )
        )

    def snapshot(self) -> Mapping[str, object]:
        """Return what telemetry publishes."""
        program = self._program
        return {
            "session": self._session,
            "tick": program.tick,
            "load_w": program.load,
            "inputs": dict(zip(INPUT_NAMES, self._applied, strict=True)),
            "outputs": dict(zip(OUTPUT_NAMES, program.measure(), strict=True)),
        }


async def serve(settings: PlantSettings) -> None:
    """Serve the plant until cancelled."""
    rack = PlantRack(settings)
    identity = DeviceIdentity(product="Coldloop plant", revision=__version__)
    server = ModbusServer(rack.bank, settings=settings.plant.server, on_write=rack.on_write, identity=identity)
    await server.start()
    log.info("serving", extra={"host": settings.plant.server.host, "port": server.port})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(rack.run(), name="plant")
            tasks.create_task(Telemetry(settings.telemetry, "plant", rack.snapshot).run(), name="telemetry")
    finally:
        await server.close()
