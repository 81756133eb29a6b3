"""The plant's rack: outputs in, measurements out, one tick at a time. No registers, no sockets, no clock.

In lock-step, outputs that are taken make the plant due for one tick. In real time it moves from the first outputs on,
whatever the control PLC does.
"""

import math
from collections.abc import Mapping, Sequence
from enum import IntFlag
from typing import Annotated, Any, Final, NamedTuple, Self

from pydantic import BaseModel, Field, model_validator

from coldloop.kernels.single_precision import single
from coldloop.process import cold_box, declaration, load_profile
from coldloop.registers import bank, common
from coldloop.registers import plant as registers
from coldloop.registers.plant import Actuators, OutputVerdict, SensorFault, SensorFaultKind
from coldloop.safety.watchdog import Watchdog
from coldloop.safety.writers import SIMPLE_CLIENT
from coldloop.service.journal import Journal
from coldloop.session import TimeBase
from coldloop_plant.load import LoadSchedule
from coldloop_plant.program import MakePlant
from coldloop_plant.settings import SafeAction, WatchdogSettings

STALE_TICKS: Final = 8  # In real time, outputs that are further than this from the present tick are not taken

ROUNDING: Final = 1e-6  # Share of a value that single precision may add to a change

Inputs = tuple[float, ...]


class AppliedOutputs:
    """The outputs being applied, and the judgement of those that are sent.

    A *generation* is a stretch of time in which at most one writer has changed the outputs. It ends when something else
    changes them: a session begins, the safe state is applied, the rack restarts, another writer comes, or the rack lets
    its writer move them only a part of the way. Who sends the generation that it has read back therefore knows what is
    applied; all others are answered `CHANGED`.

    For all writers together: in one tick of the rack no output moves further than its rate.

    Args:
        u: Outputs, in the order of the inputs of the process.
        rate: Largest change of each in one tick; None does not limit.
        holder: Number of the client whose outputs these are; `SIMPLE_CLIENT` is also that of the safe state, and of
            what a session begins with.
        generation: 1 or more.
    """

    def __init__(
        self, u: Inputs, *, rate: Inputs | None = None, holder: int = SIMPLE_CLIENT, generation: int = 1
    ) -> None:
        self.u = self._at_beginning = u  # Outputs that are applied, and those that were when the present tick began
        self._rate = rate
        self.holder = holder
        self.generation = generation
        self.verdict = OutputVerdict.NONE  # On the outputs that were sent last in this generation
        self._writer: bank.Caller | None = None

    def begin_tick(self) -> None:
        """Note that a tick of the rack begins."""
        self._at_beginning = self.u

    def replace(self, u: Inputs) -> None:
        """Apply other outputs than a client's, in one step; a generation begins."""
        self.u = self._at_beginning = u
        self.holder = SIMPLE_CLIENT
        self._begin_generation()

    def offer(
        self, asked: Actuators, caller: bank.Caller, *, session: int, tick: int, realtime: bool, ended: bool = False
    ) -> OutputVerdict:
        """Judge outputs, and take them if they are for the present session (0 is none), tick and generation.

        The tick in which a session has `ended` takes none.
        """
        if not session or asked.session != session:
            self.verdict = OutputVerdict.WRONG_SESSION
        elif ended or abs(asked.tick - tick) > (STALE_TICKS if realtime else 0):
            self.verdict = OutputVerdict.STALE
        else:
            self.verdict = self._judge_writer(asked, caller)
        return self.verdict

    def _judge_writer(self, asked: Actuators, caller: bank.Caller) -> OutputVerdict:
        writer = self._writer
        if writer is not None and (
            asked.holder != self.holder or (asked.holder == SIMPLE_CLIENT and writer.connection != caller.connection)
        ):  # another number, or another connection of clients without one
            self._begin_generation()
        if asked.generation not in (0, self.generation):
            return OutputVerdict.CHANGED
        self.u, self.holder = asked.u, asked.holder
        if self._rate is not None:
            self.u = tuple(map(_limited, asked.u, self._at_beginning, self._rate))
        taken = self.u == asked.u
        if not taken:
            self._begin_generation()
        self._writer = caller
        return OutputVerdict.ACCEPTED if taken else OutputVerdict.LIMITED

    def _begin_generation(self) -> None:
        self.generation = next_generation(self.generation)
        self.verdict = OutputVerdict.NONE
        self._writer = None


def _limited(wanted: float, before: float, rate: float) -> float:
    if abs(wanted - before) <= rate + ROUNDING * abs(before):
        return wanted
    return single(min(max(wanted, before - rate), before + rate))


def next_generation(generation: int) -> int:
    """Return the number after a generation's: 1 to 2^32 - 1, never 0."""
    return generation % 0xFFFF_FFFF + 1


Count = Annotated[int, Field(ge=0, lt=2**32)]


class RetainedPlantState(BaseModel, frozen=True, extra="forbid"):
    """The state of a rack between two ticks."""

    boot: Count
    events: Annotated[int, Field(ge=0, lt=2**31)]
    generation: Annotated[int, Field(ge=1, lt=2**32)]
    holder: Count
    session: Count  # 0: none yet; the other fields are as configured
    pace: TimeBase
    watchdog: Annotated[int, Field(ge=0, lt=2**16)]  # Its time-out, in ticks
    times: tuple[Annotated[int, Field(ge=0, le=declaration.LAST_TICK)], ...]  # Ticks of the load's steps
    watts: tuple[float, ...]
    seed: Count
    program: dict[str, Any]  # Argument of `PlantProgram.resume`

    @model_validator(mode="after")
    def _possible(self) -> Self:
        tick = self.program.get("tick", 0)
        if not isinstance(tick, int) or not 0 <= tick <= declaration.LAST_TICK:
            raise ValueError(f"no session has a tick {tick!r}")
        return self


APPLIED: Final = (OutputVerdict.ACCEPTED, OutputVerdict.LIMITED)  # Verdicts on outputs that move the plant
HEALTHY: Final = SensorFault(SensorFaultKind.NONE, 0.0)
UNWATCHED_SILENCE_S: Final = 10.0  # Real time after which a silent client loses its lease when the watchdog is off


class Session(NamedTuple):
    """A run of the simulation from tick 0 on."""

    number: int  # 0 is none: the plant waits for an operator
    pace: TimeBase
    load: load_profile.LoadProfile
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
        process: declaration.Process = cold_box.COLD_BOX,
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
        self.program = self._make_plant(self.load, session.seed)  # The simulation
        self.session = session
        self._load_by = ""  # Who writes steps of the load ahead
        self._faults = [HEALTHY] * len(self.process.outputs)
        self._shown: dict[int, float] = {}  # Readings of the faulty sensors, by output
        self.watchdog.set(self.watchdog.time, 0)
        self.model_range = registers.ModelRangeStatus(self.program.model_range, self.program.tick)
        """Parts of the simulation outside its property tables, and since when."""
        self.moving = False  # The plant is due to move: in lock-step by one tick, in real time by the clock from now on

    @property
    def tick(self) -> int:
        """The present tick."""
        return self.program.tick

    @property
    def has_ended(self) -> bool:
        """The session has reached its last tick: the plant moves again in another one."""
        return self.tick >= declaration.LAST_TICK

    @property
    def silence_s(self) -> float:
        """Real time (s) after which the client that writes outputs counts as silent."""
        pace = self.session.pace
        if not self.watchdog.time:
            return UNWATCHED_SILENCE_S
        return self.watchdog.time * self.process.tick_s / (pace.factor if pace.realtime else 1.0)

    # -- sessions ------------------------------------------------------------------------------------------------------

    def start(self, session: Session, who: str) -> None:
        """Begin a session at tick 0."""
        self._set_up(session)
        self.outputs.replace(self._u0)
        pace = session.pace
        self.journal.note(0, common.EventKind.SESSION, int(pace.realtime), value=pace.factor, who=who)
        self.journal.note(0, common.EventKind.LOAD, value=session.load.value(0), who=who)

    def resume(self, state: RetainedPlantState) -> None:
        """Resume a session after a restart of the rack; a new generation of outputs begins.

        Raises:
            ArithmeticError, AttributeError, LookupError, TypeError, ValueError: It is not the state of such a plant, or
                one that the plant cannot resume; nothing has changed.
        """
        load = load_profile.LoadProfile(state.times, state.watts)
        schedule = LoadSchedule(load, self.process.load)
        tried = self._make_plant(schedule, state.seed)  # not used any further: the state may be nonsense
        tried.resume(**state.program)
        tried.advance()
        if not all(map(math.isfinite, (*tried.measure(), *tried.state))):
            raise ValueError("the plant cannot advance from there")
        program = self._make_plant(schedule, state.seed)
        program.resume(**state.program)
        self._set_up(Session(state.session, state.pace, load, state.seed))
        self.program, self.load = program, schedule
        self.model_range = registers.ModelRangeStatus(program.model_range, program.tick)
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
            times=load.times, watts=load.watts, seed=session.seed, program=self.program.retained(),
        )  # fmt: skip

    # -- outputs -------------------------------------------------------------------------------------------------------

    def offer(self, asked: Actuators, caller: bank.Caller) -> OutputVerdict:
        """Judge outputs, and apply them from the present tick on if they are taken: at the last one none are."""
        verdict = self.outputs.offer(
            asked, caller, session=self.session.number, tick=self.tick, realtime=self.session.pace.realtime,
            ended=self.has_ended,
        )  # fmt: skip
        if verdict in APPLIED:
            self.program.apply(self.outputs.u)
            self.watchdog.trigger(self.tick)
            self.moving = True
        return verdict

    def advance(self) -> registers.PlantSample:
        """Go one tick forward; return the record of the tick that ends."""
        program = self.program
        sample = registers.PlantSample(program.tick, program.load, self.outputs.u, program.measure(), program.state)
        self.moving = self.session.pace.realtime
        before = program.station
        program.advance()
        self.outputs.begin_tick()
        now, outside = program.station, program.model_range
        if before is not None and now is not None:
            if now.mode != before.mode:
                self.journal.note(self.tick, common.EventKind.STATION_MODE, now.mode)
            self._note_flags(common.EventKind.STATION_ALARM, registers.StationAlarm, before.alarms, now.alarms)
        if outside != self.model_range.outside:
            self._note_flags(common.EventKind.MODEL_RANGE, cold_box.ModelRange, self.model_range.outside, outside)
            self.model_range = registers.ModelRangeStatus(outside, self.tick)
        if self.watchdog.check(program.tick):
            safe = self._safety.action is SafeAction.SAFE
            if safe:
                self.outputs.replace(self._safety.safe_state)
                program.apply(self.outputs.u)
            self.journal.note(self.tick, common.EventKind.WATCHDOG_EXPIRED, int(safe))
        return sample

    def _note_flags(self, kind: common.EventKind, flags: type[IntFlag], before: int, now: int) -> None:
        """Note which flags have come or gone."""
        for number, flag in enumerate(flags):
            if (before ^ now) & flag:
                self.journal.note(self.tick, kind, number, int(bool(now & flag)))

    def give(self, asked: registers.Surroundings, who: str) -> None:
        """Change what a refrigerator is given, from the next tick on.

        Raises:
            ValueError: The plant is a cold box alone.
        """
        before = self.program.surroundings
        self.program.give(asked)
        for place, (old, new) in enumerate(zip(before or asked, asked, strict=True)):
            if new != old:
                self.journal.note(self.tick, common.EventKind.SURROUNDINGS, place, value=float(new), who=who)

    # -- what operators change -----------------------------------------------------------------------------------------

    def set_watchdog(self, time: int, who: str) -> None:
        """Change the time-out of the watchdog (ticks, 0 is off), and restart it; the same one does nothing."""
        if time == self.watchdog.time:
            return
        self.journal.note(self.tick, common.EventKind.WATCHDOG_TIME, time, self.watchdog.time, who=who)
        self.watchdog.set(time, self.tick)

    def load_steps(self, asked: registers.LiveLoad | registers.LoadAhead) -> list[registers.LoadStep]:
        """Judge a load written during a session; return its steps.

        Raises:
            ValueError: It is not for this session, or not a load that can be taken now.
        """
        if not self.session.number:
            raise ValueError("there is no session: a new one takes its load from the load table")
        if isinstance(asked, registers.LiveLoad):
            steps = [registers.LoadStep(asked.tick or self.tick + 1, asked.watts)]
        elif asked.session != self.session.number:
            raise ValueError(f"session {self.session.number} is under way, not {asked.session}")
        else:
            steps = asked.steps
        self.load.check(steps, self.tick)
        return steps

    def set_load(self, steps: Sequence[registers.LoadStep], who: str, *, ahead: bool) -> None:
        """Take steps of the load; of those that come in turn from one client, the first only is noted."""
        self.load.put(steps, self.tick)
        if not ahead or who != self._load_by:
            self.journal.note(self.tick, common.EventKind.LIVE_LOAD, int(ahead), value=steps[0].watts, who=who)
        self._load_by = who if ahead else ""

    def set_pace(self, pace: TimeBase, who: str) -> None:
        """Change the time base from the present tick on; the same one does nothing."""
        if pace == self.session.pace:
            return
        self.session = self.session._replace(pace=pace)
        self.moving = pace.realtime and (self.moving or self.tick > 0)
        self.journal.note(self.tick, common.EventKind.PACE, common.pace_subject(pace), value=pace.factor, who=who)

    def set_faults(self, faults: Sequence[SensorFault], who: str) -> None:
        """Take the faults of all sensors; one that freezes keeps what it shows now."""
        y = self._readings()
        for output, (before, fault) in enumerate(zip(self._faults, faults, strict=True)):
            if fault != before:
                self._faults[output] = fault
                self._shown.pop(output, None)
                if fault.kind:
                    others = {SensorFaultKind.NOT_A_NUMBER: math.nan, SensorFaultKind.FROZEN: y[output]}
                    self._shown[output] = others.get(SensorFaultKind(fault.kind), fault.value)
                self.journal.note(
                    self.tick, common.EventKind.SENSOR_FAULT, output, fault.kind, value=fault.value, who=who
                )

    def _readings(self) -> tuple[float, ...]:
        """Return what the sensors show, the faulty ones too."""
        y = self.program.measure()
        return tuple(self._shown.get(output, value) for output, value in enumerate(y)) if self._shown else y

    # -- what others see -----------------------------------------------------------------------------------------------

    def measurement(self, age: float, refused: int = 0) -> registers.Measurement:
        """Return what the sensors show, and what is applied.

        Args:
            age: Time since the tick began, in ticks.
            refused: Writes of others that the lease has refused so far.
        """
        program, outputs = self.program, self.outputs
        return registers.Measurement(
            program.tick, program.load, self._readings(), program.state, self.session.number, outputs.u, outputs.holder,
            outputs.generation, outputs.verdict, refused & 0xFFFF, age,
        )  # fmt: skip

    def snapshot(self) -> Mapping[str, object]:
        """Return what telemetry publishes: outputs as the sensors show them, the faulty ones too."""
        program, station, further = self.program, self.program.station, dict[str, object]()
        if station is not None:
            further["station"] = {
                **dict(zip(cold_box.STATION_SIGNAL_NAMES, station.signals, strict=True)),
                "mode": registers.StationMode(station.mode).name.lower(),
                "alarms": [one.name.lower() for one in registers.StationAlarm(station.alarms) if one.name],
            }
        return {
            "session": self.session.number,
            "tick": program.tick,
            "load_w": program.load,
            "inputs": dict(zip(self.process.input_names, self.outputs.u, strict=True)),
            "outputs": dict(zip(self.process.output_names, self._readings(), strict=True)),
            "model_range": [part.name.lower() for part in cold_box.ModelRange(self.model_range.outside) if part.name],
            **further,
        }
