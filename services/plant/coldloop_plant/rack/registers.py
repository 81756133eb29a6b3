"""The registers of the rack: what clients write is judged and taken, and what they read is kept up to date."""

import logging
import secrets
import time
from collections.abc import Callable

from coldloop.config import selected
from coldloop.process.load_profile import LoadProfile
from coldloop.process.model_file import ModelHeader
from coldloop.registers.audit import Event, EventKind, JournalQuery
from coldloop.registers.bank import BusyError, Caller, IllegalValueError, RegisterBank
from coldloop.registers.common import Identity, ServiceState, SessionPace
from coldloop.registers.configuration import publish_configuration
from coldloop.registers.declaration import Block
from coldloop.registers.plant import (
    HISTORY_ROWS,
    LOAD_ROWS,
    STATION_ROWS,
    Actuators,
    LiveLoad,
    LoadAhead,
    LoadStatus,
    LoadStep,
    Measurement,
    ModelRangeStatus,
    OutputVerdict,
    PlantSession,
    SensorFault,
    StationStatus,
    Surroundings,
    plant_map,
)
from coldloop.registers.safety import LeaseEvent, LeaseStatus, WatchdogStatus, WatchdogTime
from coldloop.registers.text import from_words
from coldloop.safety.lease import WriterLease
from coldloop.service.journal import Journal, JournalPublication
from coldloop.session.settings import TimeBase, TimeMode
from coldloop_plant.load import find_load
from coldloop_plant.rack.faults import HEALTHY
from coldloop_plant.rack.outputs import next_generation
from coldloop_plant.rack.rack import APPLIED, MakePlant, Rack, Session
from coldloop_plant.rack.retained_state import PlantStateStore
from coldloop_plant.settings import SHOWN, PlantSettings

log = logging.getLogger("coldloop.plant")


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
        self,
        settings: PlantSettings,
        header: ModelHeader,
        make_plant: MakePlant,
        *,
        first_generation: int | None = None,
        age: Callable[[], float] = lambda: 0.0,
        now: Callable[[], float] = time.monotonic,
        utc: Callable[[], float] = time.time,
    ) -> None:
        self._model_digest, process = header.short_digest, header.declared
        self._age = age
        self.bank = RegisterBank(plant_map(process), settings.plant.word_order)
        publish_configuration(self.bank, selected(settings, SHOWN))
        self._store = PlantStateStore(settings.plant.retain.file, header.short_digest, process)
        self.rack, resumed = self._switched_on(
            settings, header, make_plant, utc, first_generation or secrets.randbelow(2**31) + 1
        )
        self._journal = JournalPublication(self.rack.journal, self.bank)
        self.rack.journal.note(self.rack.tick, EventKind.BOOT, int(resumed), int(self._store.refused))
        self.lease = WriterLease("the outputs", lambda: self.rack.silence_s, self._note_lease, now)
        self._kept_generation = 0
        self._written_row = 0
        self._outdated = True
        """The measurement in the registers is not that of now."""
        self._connect()
        if resumed:
            self._show_session()
        elif self.rack.session.number:
            self._show_pace()
        self.bank.put(WatchdogTime(self.rack.watchdog.time))
        self.bank.put(self.rack.surroundings or Surroundings())
        self._show_applied()
        self._finish()

    def _switched_on(
        self,
        settings: PlantSettings,
        header: ModelHeader,
        make_plant: MakePlant,
        utc: Callable[[], float],
        first_generation: int,
    ) -> tuple[Rack, bool]:
        """Return the rack at the beginning of the configured session, or, and True, where it was when it ended."""
        section, configured = settings.plant, settings.session
        pace = TimeBase(configured.mode is TimeMode.REALTIME, configured.factor)
        load = find_load(section.load, header.w0, header.declared)
        session = Session(1 if configured.autostart else 0, pace, load, section.seed)
        state = self._store.recall()
        journal = (
            Journal(now=utc)
            if state is None
            else Journal(boot=state.boot % 0xFFFF_FFFF + 1, count=state.events, now=utc)
        )
        generation = first_generation if state is None else next_generation(state.generation)
        rack = Rack(
            section.watchdog, header.u0, make_plant, session, journal=journal,
            rate=settings.limits.rate if section.rate_limited else None, generation=generation,
            process=header.declared,
        )  # fmt: skip
        if state is None or not state.session:
            return rack, False
        try:
            rack.resume(state)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            self._store.refuse(repr(error))
            return rack, False
        return rack, True

    def _connect(self) -> None:
        """Let the bank ask us about what is written and what is read."""
        bank = self.bank
        bank.judged_by(self._judge_outputs, Actuators)
        bank.judged_by(self._judge_watchdog, WatchdogTime)
        bank.judged_by(self._judge_session, PlantSession)
        bank.judged_by(self._judge_load, LoadStep)
        bank.judged_by(self._judge_live_load, LiveLoad, LoadAhead)
        bank.judged_by(self._judge_pace, SessionPace)
        bank.judged_by(self._judge_surroundings, Surroundings)
        bank.keep_fresh(Identity, self._identity)
        bank.keep_fresh(Measurement, self._measurement)
        bank.keep_fresh(WatchdogStatus, lambda: self.rack.watchdog.registers(self.rack.tick))
        bank.keep_fresh(LeaseStatus, self.lease.registers)
        bank.keep_fresh(StationStatus, lambda: self.rack.station_status)
        bank.keep_fresh(ModelRangeStatus, lambda: self.rack.model_range)
        bank.keep_fresh(LoadStatus, lambda: self.rack.load.status(self.rack.tick))
        self._takers: dict[type[tuple[object, ...]], Callable[[str], None]] = {
            PlantSession: self._start_session,
            WatchdogTime: self._set_watchdog,
            SensorFault: self._set_faults,
            LoadStep: self._note_load,
            LiveLoad: self._set_load,
            LoadAhead: self._set_load_ahead,
            SessionPace: self._set_pace,
            Surroundings: self._set_surroundings,
            JournalQuery: self._answer_query,
        }

    # -- judging, before anything is stored ----------------------------------------------------------------------------

    def _judge_outputs(self, asked: Actuators, _row: int, caller: Caller) -> None:
        self._check_lease(caller, asked.holder)

    def _judge_watchdog(self, _asked: WatchdogTime, _row: int, caller: Caller) -> None:
        self._check_lease(caller, None)

    def _check_lease(self, caller: Caller, holder: int | None) -> None:
        try:
            self.lease.check(caller, holder)
        except BusyError:
            self._finish()
            raise

    def _judge_session(self, asked: PlantSession, _row: int, _caller: Caller) -> None:
        try:
            self._load_of(asked)
        except ValueError as error:
            raise IllegalValueError(f"the first {asked.load_steps} rows of the load table: {error}") from None

    def _judge_load(self, _step: LoadStep, row: int, _caller: Caller) -> None:
        self._written_row = row  # every load that is in range may be written: a session judges the table

    def _judge_live_load(self, asked: LiveLoad | LoadAhead, _row: int, _caller: Caller) -> None:
        try:
            self.rack.load_steps(asked)
        except ValueError as error:
            raise IllegalValueError(f"load: {error}") from None

    def _judge_pace(self, asked: SessionPace, _row: int, _caller: Caller) -> None:
        try:
            asked.of(self.rack.session.number)
        except ValueError as error:
            raise IllegalValueError(f"pace: {error}") from None

    def _judge_surroundings(self, _asked: Surroundings, _row: int, _caller: Caller) -> None:
        if self.rack.surroundings is None:
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
        if verdict in {*APPLIED, OutputVerdict.CHANGED}:
            self.lease.take(caller, asked.holder)
        if verdict is not OutputVerdict.ACCEPTED or not asked.crc:
            self._show_applied()

    def _start_session(self, who: str) -> None:
        asked = self.bank.get(PlantSession)
        pace = TimeBase(bool(asked.realtime), asked.factor)
        self.rack.start(Session(asked.session, pace, self._load_of(asked), asked.seed), who)
        for output in range(len(self.rack.process.outputs)):
            self.bank.put(HEALTHY, output)
        self.bank.put(LiveLoad(0, self.rack.load.value(0)))
        self.bank.put(self.rack.surroundings or Surroundings())
        self._show_pace()
        self._show_applied()

    def _set_watchdog(self, who: str) -> None:
        self.rack.set_watchdog(self.bank.get(WatchdogTime).time, who)

    def _set_faults(self, who: str) -> None:
        self.rack.set_faults([self.bank.get(SensorFault, row) for row in range(len(self.rack.process.outputs))], who)

    def _note_load(self, who: str) -> None:
        row = self._written_row
        watts = self.bank.get(LoadStep, row).watts
        self.rack.journal.note(self.rack.tick, EventKind.LOAD, row, value=watts, who=who)

    def _set_load(self, who: str) -> None:
        steps = self.rack.load_steps(self.bank.get(LiveLoad))
        self.rack.set_load(steps, who, ahead=False)
        # unsealed and for the next tick, so that a simple client need write no more than the watts
        self.bank.put(LiveLoad(0, steps[0].watts))

    def _set_load_ahead(self, who: str) -> None:
        self.rack.set_load(self.rack.load_steps(self.bank.get(LoadAhead)), who, ahead=True)

    def _set_pace(self, who: str) -> None:
        self.rack.set_pace(self.bank.get(SessionPace).of(self.rack.session.number), who)
        self._show_pace()

    def _set_surroundings(self, who: str) -> None:
        self.rack.give(self.bank.get(Surroundings), who)

    def _show_pace(self) -> None:
        session = self.rack.session
        self.bank.put(SessionPace.shown(session.number, session.pace))

    def _answer_query(self, _who: str) -> None:
        self._journal.answer(self.bank.get(JournalQuery))

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
        station = self.rack.station
        if station is not None:
            self.bank.put(station, station.tick % STATION_ROWS)
        sample = self.rack.advance()
        self.bank.put(sample, sample.tick % HISTORY_ROWS)
        self._outdated = True
        if self.rack.outputs.generation != generation:
            self._show_applied()
        if self.rack.session.pace.realtime:
            self.lease.note_end()
        self._show_events()
        self._keep()

    # -- what others see -----------------------------------------------------------------------------------------------

    def _measurement(self) -> Measurement | None:
        age = self._age()
        if not (age or self._outdated):
            return None
        self._outdated = False
        return self.rack.measurement(age, self.lease.refused)

    def _identity(self) -> Identity:
        rack = self.rack
        return Identity(
            map_digest=self.bank.map.digest,
            map_version=self.bank.map.version,
            state=ServiceState.RUNNING if rack.session.number else ServiceState.READY,
            model_digest=self._model_digest,
            session=rack.session.number,
            tick=rack.tick,
            heartbeat=rack.tick & 0xFFFF,
        )

    def _show_session(self) -> None:
        """Put the session that was resumed into the registers, as its operator had written it."""
        session = self.rack.session
        steps = list(zip(session.load.times, session.load.watts, strict=True))[:LOAD_ROWS]
        for row, (tick, watts) in enumerate(steps):
            self.bank.put(LoadStep(tick, watts), row)
        pace = session.pace
        self.bank.put(PlantSession(session.number, int(pace.realtime), pace.factor, session.seed, len(steps)))
        self.bank.put(LiveLoad(0, self.rack.load.value(self.rack.tick)))
        self._show_pace()

    def _show_applied(self) -> None:
        """Put what is applied into the registers of the outputs; the seal keeps others from completing it by a part."""
        rack, outputs = self.rack, self.rack.outputs
        self.bank.put_sealed(Actuators(rack.tick, outputs.u, rack.session.number, outputs.holder, outputs.generation))

    def _note_lease(self, event: LeaseEvent, who: str) -> None:
        self.rack.journal.note(self.rack.tick, EventKind.LEASE, event, who=who)

    def _finish(self) -> None:
        """End a request: show its events, and retain them: no generation and no event number is given out twice."""
        if self._show_events() or self.rack.outputs.generation != self._kept_generation:
            self._keep()

    def _show_events(self) -> bool:
        """Show and log new events; return whether there were any."""
        if not self._journal.is_behind:
            return False
        for event in self._journal.show():
            log_event(event)
        return True

    def _keep(self) -> None:
        self._kept_generation = self.rack.outputs.generation
        if self._store.active:
            self._store.keep(self.rack.retained())


def log_event(event: Event) -> None:
    """Write an event of the journal to the log."""
    kind = EventKind(event.kind)
    grave = kind is EventKind.WATCHDOG_EXPIRED or (kind, event.subject) == (EventKind.LEASE, LeaseEvent.REFUSED)
    log.log(
        logging.WARNING if grave else logging.INFO,
        kind.name.lower().replace("_", " "),
        extra={
            "number": event.number, "tick": event.tick, "subject": event.subject, "cause": event.cause,
            "value": event.value, "who": from_words(event.who),
        },
    )  # fmt: skip
