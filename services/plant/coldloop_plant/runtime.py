"""The plant on the bus: the rack's clock and its server.

In lock-step, writing the outputs of the present tick answers with its measurement and then moves the plant on. In
real time the plant moves by the clock, half a tick away from the scans, whatever the control PLC does.
"""

import asyncio
import logging
import time

from coldloop import __version__
from coldloop.errors import ColdloopError
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.registers.bank import Caller
from coldloop.registers.common import SessionPace
from coldloop.registers.declaration import Block
from coldloop.registers.plant import Actuators, PlantSession
from coldloop.service.metrics_server import MetricsServer
from coldloop.service.start import SERVING
from coldloop.service.telemetry import Telemetry
from coldloop.session.clock import Pacer, Schedule
from coldloop_plant.kinds import own_header, plant_maker
from coldloop_plant.rack.registers import RackRegisters
from coldloop_plant.settings import PlantSettings

log = logging.getLogger("coldloop.plant")


class PlantRuntime:
    """Moves the rack on: in lock-step behind each exchange, in real time by its clock."""

    def __init__(self, settings: PlantSettings) -> None:
        header = own_header(settings.model.file)
        self._clock_rate = 1.0 + settings.plant.clock_error_ppm * 1e-6
        self._clock: asyncio.Task[None] | None = None
        self._schedule: Schedule | None = None
        self._position: float | None = None
        """While paused: the present time, in ticks."""
        self._failure: asyncio.Future[None] | None = None
        self.registers = RackRegisters(settings, header, plant_maker(header, settings.plant), age=self._age)

    def on_write(self, block: Block, caller: Caller) -> None:
        """Take what a client has written, and see to it that the plant moves."""
        before = self.registers.rack.session.pace
        self.registers.on_write(block, caller)
        rack = self.registers.rack
        if block.record is PlantSession:
            self._stop_clock()
            self._position = None
        elif block.record is SessionPace and rack.session.pace != before:
            self._change_pace()
        elif block.record is Actuators and rack.moving:
            if rack.session.pace.realtime:
                self._start_clock()
            else:
                asyncio.get_running_loop().call_soon(self._move_on)  # after the answer is on its way

    def _move_on(self) -> None:
        try:
            self.registers.move_on()
        except Exception as error:  # noqa: BLE001 - whatever it is, a plant that cannot move ends the service
            self._fail(error)

    async def run(self) -> None:
        """Keep an eye on the plant until cancelled; a session in real time that was resumed moves on at once.

        Raises:
            ColdloopError: The plant cannot move any more.
        """
        self._failure = asyncio.get_running_loop().create_future()
        rack = self.registers.rack
        if rack.moving and rack.session.pace.realtime:
            self._start_clock()
        try:
            await self._failure
        finally:
            self._stop_clock()

    # -- clock ---------------------------------------------------------------------------------------------------------

    def _start_clock(self) -> None:
        """Let the plant move by the clock from its present tick on, if it does not yet."""
        rack = self.registers.rack
        if self._clock is not None or rack.session.pace.paused:
            return
        factor = rack.session.pace.factor * self._clock_rate
        position = rack.tick if self._position is None else self._position
        self._position = None
        self._schedule = Schedule(time.monotonic() - position * rack.tick_s / factor, factor, rack.tick_s)
        self._clock = asyncio.get_running_loop().create_task(self._run_clock(self._schedule), name="plant clock")
        self._clock.add_done_callback(self._clock_ended)

    def _change_pace(self) -> None:
        """Pause or resume at the present time."""
        if self._schedule is not None:
            self._position = self._schedule.position(time.monotonic())
        self._stop_clock()
        rack = self.registers.rack
        if not rack.session.pace.realtime:
            self._position = None
        elif rack.moving:
            self._start_clock()

    def _stop_clock(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
        self._clock = self._schedule = None

    async def _run_clock(self, schedule: Schedule) -> None:
        pacer, rack = Pacer(schedule), self.registers.rack
        while not rack.has_ended:
            await pacer.until(rack.tick + 0.5)
            self.registers.advance()
        rack.moving, self._schedule = False, None
        log.warning("the session has reached its last tick: begin another one", extra={"tick": rack.tick})

    def _clock_ended(self, clock: "asyncio.Task[None]") -> None:
        if clock.cancelled():
            return
        error = clock.exception()
        if error is not None:
            self._fail(error)

    def _fail(self, error: BaseException) -> None:
        if self._failure is not None and not self._failure.done():
            tick = self.registers.rack.tick
            said = str(error) if isinstance(error, ColdloopError) else repr(error)
            self._failure.set_exception(ColdloopError(f"the plant has stopped at tick {tick}: {said}"))

    def _age(self) -> float:
        """Return how long ago the present tick began by the rack's clock, in ticks; 0 while no clock runs.

        Tick n begins half a tick before it is due. The clock begins with the first outputs of a session, in the middle
        of a tick: so tick + age advances evenly from there on.
        """
        position = self._schedule.position(time.monotonic()) if self._schedule is not None else self._position
        return 0.0 if position is None else max(0.0, position - (self.registers.rack.tick - 0.5))


async def serve(settings: PlantSettings) -> None:
    """Serve the plant until cancelled."""
    plant = PlantRuntime(settings)
    registers = plant.registers
    identity = DeviceIdentity(product="Coldloop plant", revision=__version__)
    server = ModbusServer(
        registers.bank, settings=settings.plant.server, on_write=plant.on_write, identity=identity,
        on_close=registers.closed,
    )  # fmt: skip
    await server.start()
    log.info(SERVING, extra={"host": settings.plant.server.host, "port": server.port})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(MetricsServer(settings.plant.metrics, registers.bank).run(), name="metrics")
            tasks.create_task(plant.run(), name="plant")
            tasks.create_task(Telemetry(settings.telemetry, "plant", registers.rack.snapshot).run(), name="telemetry")
    finally:
        await server.close()
