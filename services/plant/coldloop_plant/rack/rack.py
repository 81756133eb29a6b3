"""The plant's rack: outputs in, measurements out, one tick at a time. No registers, no sockets, no clock.

In lock-step, outputs that are taken make the plant due for one tick. In real time it moves from the first outputs on,
whatever the control PLC does.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.declaration import LAST_TICK, Process
from coldloop.process.load_profile import LoadProfile
from coldloop.process.station import STATION_SIGNAL_NAMES, ModelRange
from coldloop.registers.audit import EventKind
from coldloop.registers.bank import Caller
from coldloop.registers.common import pace_subject
from coldloop.registers.plant import (
    Actuators,
    LiveLoad,
    LoadAhead,
    LoadStep,
    Measurement,
    ModelRangeStatus,
    OutputVerdict,
    PlantSample,
    SensorFault,
    StationAlarm,
    StationMode,
    StationSample,
    StationStatus,
    Surroundings,
)
from coldloop.safety.watchdog import Watchdog
from coldloop.service.journal import Journal
from coldloop.session.settings import TimeBase
from coldloop_plant.program import HeatLoad, PlantProgram
from coldloop_plant.rack.faults import SensorFaults
from coldloop_plant.rack.load_schedule import LoadSchedule
from coldloop_plant.rack.outputs import AppliedOutputs, Inputs, next_generation
from coldloop_plant.rack.retained_state import RetainedPlantState
from coldloop_plant.settings import SafeAction, WatchdogSettings

MakePlant = Callable[[HeatLoad, int], PlantProgram]
"""Returns the plant at tick 0, for a load and a seed of the sensors' noise."""

APPLIED: Final = (OutputVerdict.ACCEPTED, OutputVerdict.LIMITED)
"""Verdicts on outputs that move the plant."""
UNWATCHED_SILENCE_S: Final = 10.0
"""Real time after which a silent client loses its lease when the watchdog is off."""


class Session(NamedTuple):
    """A run of the simulation from tick 0 on."""

    number: int
    """0 is none: the plant waits for an operator."""
    pace: TimeBase
    load: LoadProfile
    seed: int


class Rack:
    """The simulation, its applied outputs, and the supervision of their writer.

    Args:
        watchdog: Its configuration.
        u0: Inputs at the beginning of a session.
        make_plant: Makes the simulation of a session.
        session: The one to begin with.
        journal: Takes the events.
        rate: Largest change of the outputs in one tick; None does not limit.
        generation: Number of the first generation of outputs.
        process: Whose plant it simulates.
    """

    def __init__(
        self,
        watchdog: WatchdogSettings,
        u0: Inputs,
        make_plant: MakePlant,
        session: Session,
        *,
        journal: Journal,
        rate: Inputs | None = None,
        generation: int = 1,
        process: Process = COLD_BOX,
    ) -> None:
        self.process = process
        self._rate = rate
        self._safety = watchdog
        self._u0 = u0
        self._make_plant = make_plant
        self.journal = journal
        self.watchdog = Watchdog(watchdog.ticks)
        self.outputs = AppliedOutputs(u0, rate=rate, generation=generation)
        self._set_up(session)

    def _set_up(self, session: Session) -> None:
        self.load = LoadSchedule(session.load, self.process.load)
        self._program = self._make_plant(self.load, session.seed)
        self.session = session
        self._load_by = ""
        """Who writes steps of the load ahead."""
        self.faults = SensorFaults(len(self.process.outputs))
        self.watchdog.set(self.watchdog.time, 0)
        self.model_range = ModelRangeStatus(self._program.model_range, self._program.tick)
        """Parts of the simulation outside its property tables, and since when."""
        self.moving = False
        """The plant is due to move: in lock-step by one tick, in real time by the clock from now on."""

    @property
    def tick_s(self) -> float:
        """Length of a tick, s of plant time."""
        return self.process.tick_s

    @property
    def tick(self) -> int:
        """The present tick."""
        return self._program.tick

    @property
    def has_ended(self) -> bool:
        """The session has reached its last tick: the plant moves again in another one."""
        return self.tick >= LAST_TICK

    @property
    def station(self) -> StationSample | None:
        """Compression station and nitrogen at the present tick; a cold box alone has none."""
        return self._program.station

    @property
    def silence_s(self) -> float:
        """Real time (s) after which the client that writes outputs counts as silent."""
        pace = self.session.pace
        if not self.watchdog.time:
            return UNWATCHED_SILENCE_S
        return self.watchdog.time * self.tick_s / (pace.factor if pace.realtime else 1.0)

    # -- sessions ------------------------------------------------------------------------------------------------------

    def start(self, session: Session, who: str) -> None:
        """Begin a session at tick 0."""
        self._set_up(session)
        self.outputs.replace(self._u0)
        pace = session.pace
        self.journal.note(0, EventKind.SESSION, int(pace.realtime), value=pace.factor, who=who)
        self.journal.note(0, EventKind.LOAD, value=session.load.value(0), who=who)

    def resume(self, state: RetainedPlantState) -> None:
        """Resume a session after a restart of the rack; a new generation of outputs begins.

        Raises:
            ArithmeticError, AttributeError, LookupError, TypeError, ValueError: It is not the state of such a plant, or
                one that the plant cannot resume; nothing has changed.
        """
        load = LoadProfile(state.times, state.watts)
        schedule = LoadSchedule(load, self.process.load)
        _try_a_tick(self._make_plant(schedule, state.seed), state)
        program = self._make_plant(schedule, state.seed)
        program.resume(**state.program)
        self._set_up(Session(state.session, state.pace, load, state.seed))
        self._program, self.load = program, schedule
        self.model_range = ModelRangeStatus(program.model_range, program.tick)
        self.watchdog.set(state.watchdog, program.tick)
        self.outputs = AppliedOutputs(
            tuple(state.program["u"]),
            rate=self._rate,
            holder=state.holder,
            generation=next_generation(state.generation),
        )
        self.moving = state.pace.realtime and program.tick > 0 and not self.has_ended

    def retained(self) -> RetainedPlantState:
        """Return what `resume` needs."""
        session, outputs, journal = self.session, self.outputs, self.journal
        load = self.load.from_tick(self.tick)
        return RetainedPlantState.model_construct(
            boot=journal.boot, events=journal.count, generation=outputs.generation, holder=outputs.holder,
            session=session.number, pace=session.pace, watchdog=self.watchdog.time,
            times=load.times, watts=load.watts, seed=session.seed, program=self._program.retained(),
        )  # fmt: skip

    # -- outputs -------------------------------------------------------------------------------------------------------

    def offer(self, asked: Actuators, caller: Caller) -> OutputVerdict:
        """Judge outputs, and apply them from the present tick on if they are taken: at the last one none are."""
        verdict = self.outputs.offer(
            asked, caller, session=self.session.number, tick=self.tick, realtime=self.session.pace.realtime,
            ended=self.has_ended,
        )  # fmt: skip
        if verdict in APPLIED:
            self._program.apply(self.outputs.u)
            self.watchdog.trigger(self.tick)
            self.moving = True
        return verdict

    def advance(self) -> PlantSample:
        """Go one tick forward; return the record of the tick that ends."""
        program = self._program
        sample = PlantSample(program.tick, program.load, self.outputs.u, program.measure(), program.state)
        self.moving = self.session.pace.realtime
        before = program.station
        program.advance()
        self.outputs.begin_tick()
        if before is not None and program.station is not None:
            self._note_station(before, program.station)
        self._note_model_range(program.model_range)
        if self.watchdog.check(program.tick):
            self._watchdog_expired()
        return sample

    def _note_station(self, before: StationSample, now: StationSample) -> None:
        """Note changes of the station's mode and alarms."""
        if now.mode != before.mode:
            self.journal.note(self.tick, EventKind.STATION_MODE, now.mode)
        for number, alarm in enumerate(StationAlarm):
            if (now.alarms ^ before.alarms) & alarm:
                self.journal.note(self.tick, EventKind.STATION_ALARM, number, int(bool(now.alarms & alarm)))

    def _note_model_range(self, outside: int) -> None:
        """Note what has left the property tables, or returned."""
        before = self.model_range.outside
        if outside == before:
            return
        for number, part in enumerate(ModelRange):
            if (outside ^ before) & part:
                self.journal.note(self.tick, EventKind.MODEL_RANGE, number, int(bool(outside & part)))
        self.model_range = ModelRangeStatus(outside, self.tick)

    def give(self, asked: Surroundings, who: str) -> None:
        """Change what a refrigerator is given, from the next tick on.

        Raises:
            ValueError: The plant is a cold box alone.
        """
        before = self._program.surroundings
        self._program.give(asked)
        for place, (old, new) in enumerate(zip(before or asked, asked, strict=True)):
            if new != old:
                self.journal.note(self.tick, EventKind.SURROUNDINGS, place, value=float(new), who=who)

    @property
    def station_status(self) -> StationStatus | None:
        """Status of the station, as the registers show it; None for a cold box alone."""
        return self._program.station_status

    @property
    def surroundings(self) -> Surroundings | None:
        """Boundary conditions of a refrigerator now; None for a cold box alone."""
        return self._program.surroundings

    def _watchdog_expired(self) -> None:
        """Bring the outputs into their safe state, where the configuration asks for that."""
        safe = self._safety.action is SafeAction.SAFE
        if safe:
            self.outputs.replace(self._safety.safe_state)
            self._program.apply(self.outputs.u)
        self.journal.note(self.tick, EventKind.WATCHDOG_EXPIRED, int(safe))

    # -- what operators change -----------------------------------------------------------------------------------------

    def set_watchdog(self, time: int, who: str) -> None:
        """Change the time-out of the watchdog (ticks, 0 is off), and restart it; the same one does nothing."""
        if time == self.watchdog.time:
            return
        self.journal.note(self.tick, EventKind.WATCHDOG_TIME, time, self.watchdog.time, who=who)
        self.watchdog.set(time, self.tick)

    def load_steps(self, asked: LiveLoad | LoadAhead) -> list[LoadStep]:
        """Judge a load written during a session; return its steps.

        Raises:
            ValueError: It is not for this session, or not a load that can be taken now.
        """
        if not self.session.number:
            raise ValueError("there is no session: a new one takes its load from the load table")
        if isinstance(asked, LiveLoad):
            steps = [LoadStep(asked.tick or self.tick + 1, asked.watts)]
        elif asked.session != self.session.number:
            raise ValueError(f"session {self.session.number} is under way, not {asked.session}")
        else:
            steps = asked.steps
        self.load.check(steps, self.tick)
        return steps

    def set_load(self, steps: Sequence[LoadStep], who: str, *, ahead: bool) -> None:
        """Take steps of the load; of those that come in turn from one client, the first only is noted."""
        self.load.put(steps, self.tick)
        if not ahead or who != self._load_by:
            self.journal.note(self.tick, EventKind.LIVE_LOAD, int(ahead), value=steps[0].watts, who=who)
        self._load_by = who if ahead else ""

    def set_pace(self, pace: TimeBase, who: str) -> None:
        """Change the time base from the present tick on; the same one does nothing."""
        if pace == self.session.pace:
            return
        self.session = self.session._replace(pace=pace)
        self.moving = pace.realtime and (self.moving or self.tick > 0)
        self.journal.note(self.tick, EventKind.PACE, pace_subject(pace), value=pace.factor, who=who)

    def set_faults(self, faults: Sequence[SensorFault], who: str) -> None:
        """Take the faults of all sensors."""
        for output, fault in self.faults.take(faults, self.faults.on(self._program.measure())):
            self.journal.note(self.tick, EventKind.SENSOR_FAULT, output, fault.kind, value=fault.value, who=who)

    # -- what others see -----------------------------------------------------------------------------------------------

    def measurement(self, age: float, refused: int = 0) -> Measurement:
        """Return what the sensors show, and what is applied.

        Args:
            age: Time since the tick began, in ticks.
            refused: Writes of others that the lease has refused so far.
        """
        program, outputs = self._program, self.outputs
        y = self.faults.on(program.measure())
        return Measurement(
            program.tick, program.load, y, program.state, self.session.number, outputs.u, outputs.holder,
            outputs.generation, outputs.verdict, refused & 0xFFFF, age,
        )  # fmt: skip

    def snapshot(self) -> Mapping[str, object]:
        """Return what telemetry publishes."""
        program, station = self._program, self._program.station
        return {
            "session": self.session.number,
            "tick": program.tick,
            "load_w": program.load,
            "inputs": dict(zip(self.process.input_names, self.outputs.u, strict=True)),
            "outputs": dict(zip(self.process.output_names, program.measure(), strict=True)),
            "model_range": [part.name.lower() for part in ModelRange(self.model_range.outside) if part.name],
            **({} if station is None else {"station": station_snapshot(station)}),
        }


def _try_a_tick(program: PlantProgram, state: RetainedPlantState) -> None:
    """Move a plant, which is not used any further, on from a state that may be nonsense."""
    program.resume(**state.program)
    program.advance()
    if not all(map(math.isfinite, (*program.measure(), *program.state))):
        raise ValueError("the plant cannot advance from there")


def station_snapshot(station: StationSample) -> Mapping[str, object]:
    """Return what telemetry publishes of compression station and nitrogen."""
    return {
        **dict(zip(STATION_SIGNAL_NAMES, station.signals, strict=True)),
        "mode": StationMode(station.mode).name.lower(),
        "alarms": [alarm.name.lower() for alarm in StationAlarm(station.alarms) if alarm.name],
    }
