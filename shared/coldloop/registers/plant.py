"""Register map of the plant: a remote I/O rack, and the controls of a simulation."""

from collections.abc import Sequence
from enum import IntFlag
from functools import cache
from itertools import accumulate, pairwise
from typing import Annotated, Final, NamedTuple

from coldloop.process import cold_box, declaration
from coldloop.registers import common
from coldloop.registers import declaration as reg
from coldloop.registers.declaration import Block, Numbers, RegisterMap, Role, Worded

HISTORY_ROWS: Final = 256
STATION_ROWS: Final = 128
LOAD_ROWS: Final = 2048
MAX_STATE: Final = 1e9
"""No number of a simulated state, in Pa, m3 or K, is further from 0."""
MAX_AGE: Final = 1e5
"""Longest time, in ticks, by which a rack that was stopped may be late."""
AHEAD_STEPS: Final = 24
"""Steps of the load in one request."""
_STEPS: Final = tuple(map(str, range(AHEAD_STEPS)))
LONGEST_AHEAD_TICKS: Final = 0xFFFF
"""Ticks that one request can say that a step lasts."""


class OutputVerdict(Worded):
    """Judgement of the last outputs by the rack."""

    NONE = 0
    """None have been sent, or they were refused with an exception."""
    ACCEPTED = 1
    WRONG_SESSION = 2
    STALE = 3
    """For another tick than the present one; in real time, too old."""
    CHANGED = 4, "changed since they were read back"
    """The outputs have changed since they were read back: read them back again."""
    LIMITED = 5, "limited to the rate in a tick"
    """Applied as far as the rate of one tick allows: read them back again."""


class Actuators(NamedTuple):
    """Outputs for one tick, of the one control PLC that holds the lease of the rack.

    The rack judges them whole; its next measurement shows whether they were accepted.
    """

    tick: Annotated[
        int,
        reg.u32("Tick of these outputs; in lock-step the present one advances the plant", high=declaration.LAST_TICK),
    ]
    u: Annotated[Numbers, reg.each_input("{}")]
    session: Annotated[int, reg.u32("Session of these outputs")]
    holder: Annotated[int, reg.u32("Number chosen by the writer; 0 is a simple client")] = 0
    generation: Annotated[int, reg.u32("Generation that was read back; 0 does not compare")] = 0
    crc: Annotated[int, reg.u32("CRC-32 of the registers before; 0 is none, a wrong one is refused")] = 0


class Measurement(NamedTuple):
    """Measured values and applied outputs of the rack at one tick.

    Load, outputs and states may be any number, or NaN: sensors fail, and the control PLC works without them.
    """

    tick: Annotated[int, reg.u32("Tick at which these values were read", high=declaration.LAST_TICK)]
    load: Annotated[float, reg.of_load("{noun} {name}, which is known", finite=False)]
    y: Annotated[Numbers, reg.of_outputs("Measured output", finite=False)]
    x: Annotated[Numbers, reg.of_states("Simulated state, not measured", finite=False)]
    session: Annotated[int, reg.u32("Session")]
    u: Annotated[Numbers, reg.of_inputs("Input being applied", in_span=True)]
    holder: Annotated[int, reg.u32("Holder of these outputs; 0 is a simple client, safe or initial state")] = 0
    generation: Annotated[
        int, reg.u32("Rises when outputs change other than by their writer: safe state, session, new writer", low=1)
    ] = 1
    verdict: Annotated[int, reg.u16("Outputs sent last: {}", values=OutputVerdict)] = OutputVerdict.NONE
    refused: Annotated[int, reg.u16("Writes of others that were refused so far; wraps")] = 0
    age: Annotated[
        float, reg.f32("Time since this tick began, by the rack's clock, in ticks; 0 in lock-step", low=0, high=MAX_AGE)
    ] = 0.0
    crc: Annotated[int, reg.u32("CRC-32 of the registers before")] = 0


class SensorFaultKind(Worded):
    """Kind of a fault that is put on a sensor on purpose."""

    NONE = 0
    NOT_A_NUMBER = 1
    FROZEN = 2, "frozen at its present value"
    VALUE = 3, "the value below"


class SensorFault(NamedTuple):
    """A fault put into one output of the simulation. Row i is output i; the history keeps the true value."""

    kind: Annotated[int, reg.u16("{}", values=SensorFaultKind)]
    value: Annotated[float, reg.f32("Value that the sensor shows with fault 3")]


class PlantSession(NamedTuple):
    """Starts a simulation session when written."""

    session: Annotated[int, reg.u32("Number of the session; the simulation restarts from tick 0", low=1)]
    realtime: Annotated[int, reg.u16("{}", high=1, values=common.TimeBaseKind)]
    factor: Annotated[float, reg.f32("Seconds of plant time in one second of real time", low=0.01, high=10_000)]
    seed: Annotated[int, reg.u32("Seed of the sensor noise")]
    load_steps: Annotated[int, reg.u16("Rows of the load table that are in use", low=1, high=LOAD_ROWS)]


class LoadStep(NamedTuple):
    """One step of the load table, held until the next one."""

    tick: Annotated[int, reg.in_ticks(reg.u32("First tick of the step", high=declaration.LAST_TICK))]
    watts: Annotated[float, reg.of_load("{noun}", in_span=True)]


class LoadStatus(NamedTuple):
    """The heat load, and what is known of it."""

    watts: Annotated[float, reg.of_load("{noun} now")] = 0.0
    next_tick: Annotated[int, reg.in_ticks(reg.u32("Tick of the next step that is known; 0 is none"))] = 0
    next_watts: Annotated[float, reg.of_load("{noun} from then on")] = 0.0
    last_tick: Annotated[
        int, reg.in_ticks(reg.u32("Tick of the last step that is known; it is held from there on"))
    ] = 0
    upcoming: Annotated[int, reg.u16("Known future steps")] = 0
    free: Annotated[int, reg.u16("Further steps that can be accepted now")] = 0


class LiveLoad(NamedTuple):
    """Changes the heat load of the session under way; what was known of later ticks is dropped."""

    tick: Annotated[
        int, reg.in_ticks(reg.u32("First tick, in the future; 0 is the next tick", high=declaration.LAST_TICK))
    ] = 0
    watts: Annotated[float, reg.of_load("{noun}", in_span=True)] = 0.0
    crc: Annotated[int, reg.u32("CRC-32 of the registers before; 0 is none, a wrong one is refused")] = 0


class LoadAhead(NamedTuple):
    """Steps of the heat load that are to come, for loads of any length; what was known from the first on is dropped."""

    session: Annotated[int, reg.u32("Session of these steps")] = 0
    tick: Annotated[int, reg.in_ticks(reg.u32("Tick of the first step, in the future", high=declaration.LAST_TICK))] = 0
    length: Annotated[int, reg.u16("Steps in use", low=1, high=AHEAD_STEPS)] = 1
    watts: Annotated[
        Numbers,
        lambda process: reg.f32(
            f"{process.load.noun} of step", elements=_STEPS, units=(process.load.unit,) * AHEAD_STEPS
        ),
    ] = (0.0,) * AHEAD_STEPS
    ticks: Annotated[
        tuple[int, ...],
        reg.Field(reg.Kind.U16, "Ticks from this step to the next one; of the last one unused", elements=_STEPS),
    ] = (0,) * AHEAD_STEPS
    crc: Annotated[int, reg.u32("CRC-32 of the registers before; 0 is none, a wrong one is refused")] = 0

    @classmethod
    def first_of(cls, session: int, ticks: Sequence[int], watts: Sequence[float]) -> "LoadAhead":
        """Return the first of these steps, as many as one record can say: `length` of them.

        Args:
            session: That they are for.
            ticks: At which each step begins.
            watts: Heat load of each.
        """
        gaps: list[int] = []
        for before, after in pairwise(ticks[:AHEAD_STEPS]):
            if after - before > LONGEST_AHEAD_TICKS:
                break
            gaps.append(after - before)
        length = len(gaps) + 1
        spare = AHEAD_STEPS - length
        return cls(session, ticks[0], length, (*watts[:length], *[0.0] * spare), (*gaps, *[0] * (spare + 1)))

    @property
    def steps(self) -> list[LoadStep]:
        """The steps in use.

        Raises:
            ValueError: There are none, or a step lasts no time.
        """
        if not 1 <= self.length <= AHEAD_STEPS:
            raise ValueError(f"{self.length} steps are not 1 to {AHEAD_STEPS}")
        if not all(self.ticks[: self.length - 1]):
            raise ValueError("a step lasts one tick or more")
        starts = list(accumulate(self.ticks[: self.length - 1], initial=self.tick))
        if starts[-1] > declaration.LAST_TICK:
            raise ValueError(f"tick {starts[-1]} is after the last one of a session, {declaration.LAST_TICK}")
        return [LoadStep(*step) for step in zip(starts, self.watts, strict=False)]


class PlantSample(NamedTuple):
    """One row of the history: everything physical at one tick. The row of tick n is n modulo the number of rows."""

    tick: Annotated[int, reg.u32("Tick of the row")]
    load: Annotated[float, reg.of_load("{noun}")]
    u: Annotated[Numbers, reg.of_inputs("Input applied from this tick on")]
    y: Annotated[Numbers, reg.of_outputs("Measured output", finite=False)]
    x: Annotated[Numbers, reg.of_states("Simulated state", finite=False)]


class StationMode(Worded):
    """Mode of the compression station's controller: what it can do about the pressures."""

    AUTOMATIC = 0
    """All valves are within their ranges."""
    LIMITED = 1, "a valve at its end"
    """A valve is at the end of its range: a pressure may leave its set point."""
    CHARGE_STOPPED = 2, "charging stopped"
    """The low pressure is so high that helium is no longer let in from the buffer."""
    ONE_COMPRESSOR = 3
    STOPPED = 4
    """No compressor runs: total trip. The cold box is isolated, the high-pressure line empties into the buffer."""
    STARTING = 5
    """The first compressor idles or is being loaded, with the bypass open; the cold box is isolated until it is."""
    OVERRIDE = 6, "a pressure beyond its limit moves the buffer's valves"
    """A pressure is beyond a limit: it moves the buffer's valves, whatever the controller asks for."""


class StationAlarm(IntFlag):
    """Alarms of compression station and nitrogen pre-cooler, one bit each."""

    HP_HIGH = 1
    HP_LOW = 2
    LP_HIGH = 4
    LP_LOW = 8
    NC1_TRIPPED = 16
    NC2_TRIPPED = 32
    NITROGEN_LOW = 64
    HELIUM_LOST = 128
    TOTAL_TRIP = 256
    """No compressor runs: CV155, CV156 and the heater are off, whatever the control PLC asks for."""
    BATH_RELIEF = 512
    """The bath's relief valve blows into the recovery line."""
    TURBINE_TRIPPED = 1024
    OVERSPEED = 2048
    """It was the protection that tripped the turbine; held until the turbine is switched off."""
    ACTUATOR = 4096
    """CV155, CV156 or the heater is not as the control PLC asks."""
    SUCTION_TRIP = 8192
    """The low pressure has stopped a compressor; held until that is switched off."""


_WARM_SIGNALS: Final = reg.f32(
    "Warm signal", elements=cold_box.STATION_SIGNAL_NAMES, units=cold_box.STATION_SIGNAL_UNITS, finite=False
)
_WARM_VALVES: Final = reg.f32("Requested opening of valve", elements=cold_box.STATION_VALVE_NAMES, units=("%",) * 4)


class StationSample(NamedTuple):
    """Compression station and nitrogen pre-cooler at one tick; all 0 where the plant is a cold box alone."""

    tick: Annotated[int, reg.u32("Tick of the row")]
    signals: Annotated[Numbers, _WARM_SIGNALS]
    mode: Annotated[int, reg.u16("Pressure control: {}", high=0xFFFF, values=StationMode)] = StationMode.AUTOMATIC
    alarms: Annotated[
        int,
        reg.u16(
            "Bits: 1 HP high, 2 HP low, 4 LP high, 8 LP low, 16 NC1, 32 NC2 tripped, 64 nitrogen low, 128 helium lost, "
            "256 total trip, 512 relief of the bath, 1024 turbine tripped, "
            "2048 by overspeed, 4096 an actuator not as asked, 8192 a compressor tripped by low suction pressure"
        ),
    ] = 0


class StationStatus(NamedTuple):
    """Compression station and nitrogen pre-cooler now; all 0 where the plant is a cold box alone."""

    tick: Annotated[int, reg.u32("Tick at which these values were read")] = 0
    mode: Annotated[int, reg.u16("As in the station history")] = StationMode.AUTOMATIC
    alarms: Annotated[int, reg.u16("As in the station history")] = 0
    signals: Annotated[Numbers, _WARM_SIGNALS] = (0.0,) * len(cold_box.STATION_SIGNAL_NAMES)
    commands: Annotated[Numbers, _WARM_VALVES] = (0.0,) * len(cold_box.STATION_VALVE_NAMES)
    acting: Annotated[Numbers, reg.of_inputs("Acting on the cold box, whatever is asked")] = (0.0,) * 3


class ModelRangeStatus(NamedTuple):
    """Whether the simulation is within its property tables; outside them its values are not to be believed."""

    outside: Annotated[
        int,
        reg.u16(
            "Bits: 1 bath, 2 supply, 4 return pressure, 8 a cell too cold, 16 a cell too warm, "
            "32 a dry bath too warm; 0 is within"
        ),
    ] = 0
    since: Annotated[int, reg.u32("Tick at which this last changed")] = 0


def _blocking(exchanger: str) -> reg.Field:
    return reg.f32(
        f"Share of {exchanger} that blocks up in an hour; below 0 it is cleaned", unit="1/h", low=-10, high=10
    )


class Surroundings(NamedTuple):
    """Boundary conditions of a refrigerator, from the next tick on; refused by a cold box alone."""

    nc1: Annotated[int, reg.u16("1: compressor NC1 runs, 0: it has tripped", high=1)] = 1
    nc2: Annotated[int, reg.u16("1: compressor NC2 runs, 0: it has tripped", high=1)] = 1
    nitrogen: Annotated[int, reg.u16("1: nitrogen in the tank, 0: none", high=1)] = 1
    leak: Annotated[float, reg.f32("Leak of the high-pressure line, as at 16 bar", unit="g/s", low=0, high=50)] = 0.0
    ambient: Annotated[float, reg.f32("Temperature of the surroundings", unit="K", low=270, high=320)] = 300.0
    turbine: Annotated[int, reg.u16("1: the turbine may run, 0: it is tripped", high=1)] = 1
    cv155: Annotated[int, reg.u16("1: CV155 follows what is asked, 0: it is stuck", high=1)] = 1
    cv156: Annotated[int, reg.u16("1: CV156 follows what is asked, 0: it is stuck", high=1)] = 1
    heater: Annotated[int, reg.u16("1: the heater follows what is asked, 0: it is off, 2: fully on, 150 W", high=2)] = 1
    blocked_nef1: Annotated[float, _blocking("NEF1")] = 0.0
    blocked_nef2: Annotated[float, _blocking("NEF2")] = 0.0
    blocked_nef34: Annotated[float, _blocking("NEF34")] = 0.0
    blocked_nef6: Annotated[float, _blocking("NEF6")] = 0.0


OF_A_REFRIGERATOR: Final = (StationStatus, StationSample, Surroundings, ModelRangeStatus)
"""Records of a compression station and of property tables."""


@cache
def plant_map(process: declaration.Process) -> RegisterMap:
    """Return the map of the rack of a process."""
    noun, outputs, operator = process.load.noun, len(process.outputs), Role.OPERATOR
    blocks = (
        common.IDENTITY_BLOCK,
        common.STATISTICS_BLOCK,
        Block("actuators", 100, Actuators, "Outputs of the control PLC", Role.CONTROL, sealed=True),
        Block("measurement", 200, Measurement, "Inputs of the control PLC", sealed=True),
        Block(
            "watchdog", 330, common.WatchdogStatus, "Watches the control PLC; applies the safe state when it expires"
        ),
        Block("watchdog time", 340, common.WatchdogTime, "Sets that watchdog", Role.CONTROL),
        Block("lease", 350, common.LeaseStatus, "Who may write outputs"),
        Block("session", 400, PlantSession, "Start of a simulation session", operator),
        Block("pace", 410, common.SessionPace, "Time base of the present session", operator),
        Block("load status", 420, LoadStatus, f"The {noun.lower()} and its known steps"),
        Block("live load", 440, LiveLoad, f"{noun} from a tick on", operator, sealed=True),
        Block("sensor faults", 500, SensorFault, "Faults injected into the measured outputs", operator, outputs),
        Block("load ahead", 600, LoadAhead, f"Future steps of the {noun.lower()}", operator, sealed=True),
        Block("station", 700, StationStatus, "Compression station and nitrogen pre-cooler of a whole refrigerator"),
        Block("surroundings", 760, Surroundings, "Trips, nitrogen, leak and weather of a whole refrigerator", operator),
        Block("model range", 780, ModelRangeStatus, "Alarm of the simulation: it has left its property tables"),
        Block("load table", 1000, LoadStep, f"{noun} over the session", operator, LOAD_ROWS),
        Block("station history", 9200, StationSample, "The last ticks of the warm part", rows=STATION_ROWS),
        Block("history", 16384, PlantSample, "The last ticks", rows=HISTORY_ROWS),
        *common.LAST_BLOCKS,
    )
    unused = () if process.has_station else OF_A_REFRIGERATOR
    return RegisterMap(service="plant", version=4, blocks=reg.placed(process, blocks), unused=unused)
