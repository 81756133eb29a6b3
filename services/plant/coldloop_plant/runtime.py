"""The plant on the bus: its registers, its retained state, its clock and its server.

In lock-step, writing the outputs of the present tick answers with its measurement and then moves the plant on. In
real time the plant moves by the clock, half a tick away from the scans, whatever the control PLC does.
"""

import asyncio
import logging
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pydantic import ValidationError

from coldloop import __version__, config
from coldloop.errors import ColdloopError
from coldloop.modbus.server import DeviceIdentity, ModbusServer
from coldloop.process.declaration import Process
from coldloop.process.load_profile import LoadProfile
from coldloop.process.model_file import ModelHeader
from coldloop.registers import common
from coldloop.registers import plant as registers
from coldloop.registers.bank import BusyError, Caller, IllegalValueError, Judge, RegisterBank
from coldloop.registers.codec import DomainError, check_record
from coldloop.registers.declaration import Block
from coldloop.registers.plant import Actuators, LiveLoad, LoadAhead, LoadStep, PlantSession, Surroundings
from coldloop.safety.retained import RetainedFile, RetainedStateError
from coldloop.safety.writers import WriterLease
from coldloop.service.journal import Journal, JournalPublication, log_event
from coldloop.service.monitoring import MetricsServer, Telemetry
from coldloop.service.start import SERVING
from coldloop.session import LatenessRecord, TimeBase, TimeMode
from coldloop_plant.kinds import own_header, plant_maker
from coldloop_plant.load import find_load
from coldloop_plant.program import MakePlant
from coldloop_plant.rack import APPLIED, HEALTHY, Rack, RetainedPlantState, Session, next_generation
from coldloop_plant.settings import SHOWN, PlantSettings

log = logging.getLogger("coldloop.plant")

OWNER: Final = "plant/4"  # Who retained states belong to, and the version of what they hold


class RackRegisters:
    """Connects the rack to its registers, its journal and its retained state.

    Args:
        settings: The configuration.
        header: Of the model file.
        make_plant: Makes the simulation of a session.
        first_generation: Of the outputs, without a retained state; random by default, so that no client takes this
            rack for the one before its restart.
        age: Returns the time since the present tick began, in ticks; 0 while no clock runs.
        now: A clock, s, by which the lease of the outputs ends.
        utc: Time of events, seconds since 1970.
    """

    def __init__(
        self, settings: PlantSettings, header: ModelHeader, make_plant: MakePlant, *,
        first_generation: int | None = None, age: Callable[[], float] = lambda: 0.0,
        now: Callable[[], float] = time.monotonic, utc: Callable[[], float] = time.time,
    ) -> None:  # fmt: skip
        self._model_digest, process = header.short_digest, header.declared
        self._age = age
        self.bank = RegisterBank(registers.plant_map(process), settings.plant.word_order)
        common.publish_configuration(self.bank, config.selected(settings, SHOWN))
        retained = settings.plant.retain.file
        self._retained = RetainedFile(retained, OWNER, header.short_digest) if retained else None
        self._is_refused = False  # A previous state exists and is not used
        self.rack, resumed = self._switched_on(
            settings, header, make_plant, utc, first_generation or secrets.randbelow(2**31) + 1
        )
        self._journal = JournalPublication(self.rack.journal, self.bank)
        self.rack.journal.note(self.rack.tick, common.EventKind.BOOT, int(resumed), int(self._is_refused))
        self.lease = WriterLease("the outputs", lambda: self.rack.silence_s, self._note_lease, now)
        self._kept_generation = 0
        self._written_row = 0
        self._outdated = True  # The measurement in the registers is not that of now
        self._connect()
        session = self.rack.session
        if resumed:  # as its operator had written it
            steps = list(zip(session.load.times, session.load.watts, strict=True))[: registers.LOAD_ROWS]
            for row, step in enumerate(steps):
                self.bank.put(LoadStep(*step), row)
            pace = session.pace
            self.bank.put(PlantSession(session.number, int(pace.realtime), pace.factor, session.seed, len(steps)))
            self.bank.put(LiveLoad(0, self.rack.load.value(self.rack.tick)))
        if resumed or session.number:
            self._show_pace()
        self.bank.put(common.WatchdogTime(self.rack.watchdog.time))
        self.bank.put(self.rack.program.surroundings or Surroundings())
        self._show_applied()
        self._finish()

    def _switched_on(
        self, settings: PlantSettings, header: ModelHeader, make_plant: MakePlant, utc: Callable[[], float],
        first_generation: int,
    ) -> tuple[Rack, bool]:  # fmt: skip
        """Return the rack at the beginning of the configured session, or, and True, where it was when it ended."""
        section, configured = settings.plant, settings.session
        pace = TimeBase(configured.mode is TimeMode.REALTIME, configured.factor)
        load = find_load(section.load, header.w0, header.declared)
        session = Session(1 if configured.autostart else 0, pace, load, section.seed)
        state = self._recalled(header.declared)
        journal, generation = Journal(now=utc), first_generation
        if state is not None:
            journal = Journal(boot=state.boot % 0xFFFF_FFFF + 1, count=state.events, now=utc)
            generation = next_generation(state.generation)
        rack = Rack(
            section.watchdog, header.u0, make_plant, session, journal=journal, generation=generation,
            rate=settings.limits.rate if section.rate_limited else None, process=header.declared,
        )  # fmt: skip
        if state is None or not state.session:
            return rack, False
        try:
            rack.resume(state)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            self._refuse(repr(error))
            return rack, False
        return rack, True

    def _recalled(self, process: Process) -> RetainedPlantState | None:
        """Return the previous state, if any: its pace and its load are such as registers can have."""
        try:
            content = self._retained.load() if self._retained else None
            if content is None:
                return None
            state = RetainedPlantState.model_validate(content)
            for record in (
                common.SessionPace.shown(state.session, state.pace),
                *map(LoadStep, state.times, state.watts),
            ):
                check_record(record, registers.plant_map(process))
        except (RetainedStateError, DomainError) as error:
            self._refuse(str(error))
        except ValidationError as error:
            self._refuse(error.errors()[0]["msg"])
        else:
            return state
        return None

    def _refuse(self, reason: str) -> None:
        """Discard the previous state: set its file aside and log the reason."""
        self._is_refused = True
        if self._retained is not None:
            log.warning("retained state refused", extra={"reason": reason, "file": self._retained.set_aside()})

    def _connect(self) -> None:
        """Let the bank ask us about what is written and what is read."""
        bank, rack = self.bank, self.rack
        bank.judged_by(lambda asked, _, caller: self._check_lease(caller, asked.holder), Actuators)
        bank.judged_by(lambda _asked, _row, caller: self._check_lease(caller, None), common.WatchdogTime)
        table = "the first {0.load_steps} rows of the load table"
        bank.judged_by(_refusing(table, self._load_of), PlantSession)
        bank.judged_by(self._judge_load, LoadStep)
        bank.judged_by(_refusing("load", rack.load_steps), LiveLoad, LoadAhead)
        bank.judged_by(_refusing("pace", lambda asked: asked.of(rack.session.number)), common.SessionPace)
        bank.judged_by(self._judge_surroundings, Surroundings)
        bank.keep_fresh(common.Identity, self._identity)
        bank.keep_fresh(registers.Measurement, self._measurement)
        bank.keep_fresh(common.WatchdogStatus, lambda: rack.watchdog.registers(rack.tick))
        bank.keep_fresh(common.LeaseStatus, self.lease.registers)
        bank.keep_fresh(registers.StationStatus, lambda: rack.program.station_status)
        bank.keep_fresh(registers.ModelRangeStatus, lambda: rack.model_range)
        bank.keep_fresh(registers.LoadStatus, lambda: rack.load.status(rack.tick))
        sensors = range(len(rack.process.outputs))
        self._takers: dict[type[tuple[object, ...]], Callable[[str], None]] = {
            PlantSession: self._start_session,
            common.WatchdogTime: lambda who: rack.set_watchdog(bank.get(common.WatchdogTime).time, who),
            registers.SensorFault: lambda who: rack.set_faults(
                [bank.get(registers.SensorFault, row) for row in sensors], who
            ),
            LoadStep: self._note_load,
            LiveLoad: self._set_load,
            LoadAhead: lambda who: rack.set_load(rack.load_steps(bank.get(LoadAhead)), who, ahead=True),
            common.SessionPace: self._set_pace,
            Surroundings: lambda who: rack.give(bank.get(Surroundings), who),
            common.JournalQuery: lambda _: self._journal.answer(bank.get(common.JournalQuery)),
        }

    # -- judging, before anything is stored ----------------------------------------------------------------------------

    def _check_lease(self, caller: Caller, holder: int | None) -> None:
        try:
            self.lease.check(caller, holder)
        except BusyError:
            self._finish()
            raise

    def _judge_load(self, _step: LoadStep, row: int, _caller: Caller) -> None:
        self._written_row = row  # every load that is in range may be written: a session judges the table

    def _judge_surroundings(self, _asked: Surroundings, _row: int, _caller: Caller) -> None:
        if self.rack.program.surroundings is None:
            raise IllegalValueError("the plant is a cold box alone: it has no surroundings")

    def _load_of(self, asked: PlantSession) -> LoadProfile:
        steps = [self.bank.get(LoadStep, row) for row in range(asked.load_steps)]
        return LoadProfile(tuple(step.tick for step in steps), tuple(step.watts for step in steps))

    # -- taking what has been stored -----------------------------------------------------------------------------------

    def on_write(self, block: Block, caller: Caller) -> None:
        """Take what a client has written."""
        self._outdated = True
        if block.record is Actuators:
            self._take_outputs(self.bank.get(Actuators), caller)
        else:
            self._takers[block.record](caller.name)
        self._finish()

    def _take_outputs(self, asked: Actuators, caller: Caller) -> None:
        self.move_on()  # the next request may come before the plant has moved on
        verdict = self.rack.offer(asked, caller)
        if verdict in {*APPLIED, registers.OutputVerdict.CHANGED}:
            self.lease.take(caller, asked.holder)
        if verdict is not registers.OutputVerdict.ACCEPTED or not asked.crc:
            self._show_applied()

    def _start_session(self, who: str) -> None:
        asked = self.bank.get(PlantSession)
        pace = TimeBase(bool(asked.realtime), asked.factor)
        self.rack.start(Session(asked.session, pace, self._load_of(asked), asked.seed), who)
        for output in range(len(self.rack.process.outputs)):
            self.bank.put(HEALTHY, output)
        self.bank.put(LiveLoad(0, self.rack.load.value(0)))
        self.bank.put(self.rack.program.surroundings or Surroundings())
        self._show_pace()
        self._show_applied()

    def _note_load(self, who: str) -> None:
        row = self._written_row
        watts = self.bank.get(LoadStep, row).watts
        self.rack.journal.note(self.rack.tick, common.EventKind.LOAD, row, value=watts, who=who)

    def _set_load(self, who: str) -> None:
        steps = self.rack.load_steps(self.bank.get(LiveLoad))
        self.rack.set_load(steps, who, ahead=False)
        # unsealed and for the next tick, so that a simple client need write no more than the watts
        self.bank.put(LiveLoad(0, steps[0].watts))

    def _set_pace(self, who: str) -> None:
        self.rack.set_pace(self.bank.get(common.SessionPace).of(self.rack.session.number), who)
        self._show_pace()

    def _show_pace(self) -> None:
        session = self.rack.session
        self.bank.put(common.SessionPace.shown(session.number, session.pace))

    def closed(self, caller: Caller) -> None:
        """Note that a connection has closed."""
        self.lease.closed(caller)
        self._finish()

    # -- time ----------------------------------------------------------------------------------------------------------

    def move_on(self) -> None:
        """Advance the plant if it is due: in lock-step, behind the answer to outputs that were taken."""
        if self.rack.moving and not self.rack.session.pace.realtime:
            self.advance()

    def advance(self) -> None:
        """Advance the plant by one tick."""
        generation = self.rack.outputs.generation
        station = self.rack.program.station
        if station is not None:
            self.bank.put(station, station.tick % registers.STATION_ROWS)
        sample = self.rack.advance()
        self.bank.put(sample, sample.tick % registers.HISTORY_ROWS)
        self._outdated = True
        if self.rack.outputs.generation != generation:
            self._show_applied()
        if self.rack.session.pace.realtime:
            self.lease.note_end()
        self._show_events()
        self._keep()

    # -- what others see -----------------------------------------------------------------------------------------------

    def _measurement(self) -> registers.Measurement | None:
        age = self._age()
        if not (age or self._outdated):
            return None
        self._outdated = False
        return self.rack.measurement(age, self.lease.refused)

    def _identity(self) -> common.Identity:
        rack = self.rack
        return common.Identity(
            map_digest=self.bank.map.digest, map_version=self.bank.map.version,
            state=common.ServiceState.RUNNING if rack.session.number else common.ServiceState.READY,
            model_digest=self._model_digest, session=rack.session.number, tick=rack.tick,
            heartbeat=rack.tick & 0xFFFF,
        )  # fmt: skip

    def _show_applied(self) -> None:
        """Put what is applied into the registers of the outputs; the seal keeps others from completing it by a part."""
        rack, outputs = self.rack, self.rack.outputs
        self.bank.put_sealed(Actuators(rack.tick, outputs.u, rack.session.number, outputs.holder, outputs.generation))

    def _note_lease(self, event: common.LeaseEvent, who: str) -> None:
        self.rack.journal.note(self.rack.tick, common.EventKind.LEASE, event, who=who)

    def _finish(self) -> None:
        """End a request: show its events, and retain them: no generation and no event number is given out twice."""
        if self._show_events() or self.rack.outputs.generation != self._kept_generation:
            self._keep()

    def _show_events(self) -> bool:
        """Show and log new events; return whether there were any."""
        if not self._journal.is_behind:
            return False
        for event in self._journal.show():
            log_event(log, event, self.rack.process)
        return True

    def _keep(self) -> None:
        """Keep the state of now: it is the memory of a simulation, so every tick counts and no disk is waited for."""
        self._kept_generation = self.rack.outputs.generation
        if self._retained is None:
            return
        try:
            self._retained.save(self.rack.retained().model_dump(), synced=False)
        except RetainedStateError as error:
            log.error("the state is not retained", extra={"reason": str(error)})  # noqa: TRY400 one line


def _refusing(what: str, check: Callable[[Any], object]) -> Judge:
    """Return a judge that refuses a record for which `check` raises a ValueError; `what` is formatted with it."""

    def judge(asked: Any, _row: int, _caller: Caller) -> None:  # noqa: ANN401 any record
        try:
            check(asked)
        except ValueError as error:
            raise IllegalValueError(f"{what.format(asked)}: {error}") from None

    return judge


@dataclass(frozen=True, slots=True)
class Schedule:
    """Schedule of ticks: tick n at `start` + n * `tick_s` / `factor` of the monotonic clock, s."""

    start: float
    factor: float
    tick_s: float

    def due(self, tick: float) -> float:
        """Return when `tick` (or a moment between two) is due."""
        return self.start + tick * self.tick_s / self.factor

    def position(self, now: float) -> float:
        """Return where time is at `now`, in ticks."""
        return (now - self.start) * self.factor / self.tick_s


class Pacer:
    """Waits for the ticks of a schedule and records how late each wait ended."""

    def __init__(self, schedule: Schedule, now: Callable[[], float] = time.monotonic) -> None:
        self.schedule = schedule
        self.record = LatenessRecord()
        self._now = now

    async def until(self, tick: float) -> float:
        """Sleep until `tick` is due; return by how many seconds that was missed.

        The event loop gets its turn also when the tick has been due for long: other tasks are never kept waiting by
        a clock that cannot follow its schedule.
        """
        await asyncio.sleep(max(0.0, self.schedule.due(tick) - self._now()))
        lateness = max(0.0, self._now() - self.schedule.due(tick))
        self.record.add(lateness)
        return lateness


class PlantRuntime:
    """Moves the rack on: in lock-step behind each exchange, in real time by its clock."""

    def __init__(self, settings: PlantSettings) -> None:
        header = own_header(settings.model.file)
        self._clock_rate = 1.0 + settings.plant.clock_error_ppm * 1e-6
        self._clock: asyncio.Task[None] | None = None
        self._schedule: Schedule | None = None
        self._position: float | None = None  # While paused: the present time, in ticks
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
        elif block.record is common.SessionPace and rack.session.pace != before:
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
        self._schedule = Schedule(
            time.monotonic() - position * rack.process.tick_s / factor, factor, rack.process.tick_s
        )
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
        if not clock.cancelled() and (error := clock.exception()):
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
    shown = plant.registers
    identity = DeviceIdentity(product="Coldloop plant", revision=__version__)
    server = ModbusServer(
        shown.bank, settings=settings.plant.server, on_write=plant.on_write, identity=identity,
        on_close=shown.closed,
    )  # fmt: skip
    await server.start()
    log.info(SERVING, extra={"host": settings.plant.server.host, "port": server.port})
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(MetricsServer(settings.plant.metrics, shown.bank).run(), name="metrics")
            tasks.create_task(plant.run(), name="plant")
            tasks.create_task(Telemetry(settings.telemetry, "plant", shown.rack.snapshot).run(), name="telemetry")
    finally:
        await server.close()
