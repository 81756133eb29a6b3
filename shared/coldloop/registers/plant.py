"""Register map of the plant: a remote I/O rack, and the controls of a simulation."""

from enum import IntEnum
from typing import Annotated, Final, NamedTuple

from coldloop.process import INPUT_NAMES, INPUT_UNITS, OUTPUT_NAMES, OUTPUT_UNITS, STATE_NAMES, STATE_UNITS
from coldloop.registers.common import IDENTITY_BLOCK, STATISTICS_BLOCK
from coldloop.registers.declaration import Block, RegisterMap, Role, f32, f32_array, u16, u32
from coldloop.registers.safety import WatchdogStatus, WatchdogTime

HISTORY_ROWS: Final = 256
LOAD_ROWS: Final = 2048
MAX_LOAD_W: Final = 10_000.0


class Actuators(NamedTuple):
    """Outputs of the control PLC for one tick. Those of another session than the plant's are answered, not applied."""

    tick: Annotated[int, u32("Tick of these outputs; in lock-step writing the present one moves the plant on")]
    cv155: Annotated[float, f32("Opening of the Joule-Thomson valve", unit="%", low=0, high=100)]
    ncr22: Annotated[float, f32("Actuator part of the bath heater's power", unit="W", low=0, high=1000)]
    cv156: Annotated[float, f32("Opening of the turbine valve", unit="%", low=0, high=100)]
    session: Annotated[int, u32("Session that these outputs belong to")]
    crc: Annotated[
        int, u32("CRC-32 of the registers before; 0 is none, a wrong one leaves the outputs as they are")
    ] = 0


class Measurement(NamedTuple):
    """What the rack reads at one tick."""

    tick: Annotated[int, u32("Tick at which these values were read")]
    load: Annotated[float, f32("Heat load NCR22_HL (the same heater, so it is known)", unit="W")]
    y: Annotated[tuple[float, ...], f32_array("Measured output", OUTPUT_NAMES, OUTPUT_UNITS)]
    x: Annotated[tuple[float, ...], f32_array("Simulated state: no sensor has it", STATE_NAMES, STATE_UNITS)]
    session: Annotated[int, u32("Session")]
    crc: Annotated[int, u32("CRC-32 of the registers before")] = 0


class SensorFaultKind(IntEnum):
    """What is wrong with a sensor, on purpose."""

    NONE = 0
    NOT_A_NUMBER = 1
    FROZEN = 2
    VALUE = 3


class SensorFault(NamedTuple):
    """A fault put into one output of the simulation. Row i is output i; the history keeps the true value."""

    kind: Annotated[int, u16("0 none, 1 not a number, 2 frozen at its present value, 3 the value below", high=3)]
    value: Annotated[float, f32("Value that the sensor shows with fault 3")]


class PlantSession(NamedTuple):
    """Starts a simulation session when written."""

    session: Annotated[int, u32("Number of the session; a new number starts anew from tick 0")]
    realtime: Annotated[int, u16("0 lock-step, 1 real time", high=1)]
    factor: Annotated[float, f32("Seconds of plant time in one second of real time", low=0.01, high=10_000)]
    seed: Annotated[int, u32("Seed of the sensor noise")]
    load_steps: Annotated[int, u16("Rows of the load table that are in use", high=LOAD_ROWS)]


class LoadStep(NamedTuple):
    """One step of the load table, held until the next one."""

    tick: Annotated[int, u32("First tick of the step", unit="0.25 s")]
    watts: Annotated[float, f32("Heat load", unit="W", low=0, high=MAX_LOAD_W)]


class PlantSample(NamedTuple):
    """One row of the history: everything physical at one tick. The row of tick n is n modulo the number of rows."""

    tick: Annotated[int, u32("Tick of the row")]
    load: Annotated[float, f32("Heat load", unit="W")]
    u: Annotated[tuple[float, ...], f32_array("Input applied from this tick on", INPUT_NAMES, INPUT_UNITS)]
    y: Annotated[tuple[float, ...], f32_array("Measured output", OUTPUT_NAMES, OUTPUT_UNITS)]
    x: Annotated[tuple[float, ...], f32_array("Simulated state", STATE_NAMES, STATE_UNITS)]


PLANT_MAP: Final = RegisterMap(
    service="plant",
    version=2,
    blocks=(
        IDENTITY_BLOCK,
        STATISTICS_BLOCK,
        Block("actuators", 100, Actuators, "Outputs of the control PLC", Role.CONTROL),
        Block("measurement", 200, Measurement, "Inputs of the control PLC"),
        Block(
            "watchdog", 310, WatchdogStatus, "Watches the control PLC; outputs go to their safe state when it expires"
        ),
        Block("watchdog time", 320, WatchdogTime, "Sets that watchdog", Role.CONTROL),
        Block("sensor faults", 330, SensorFault, "Faults put into the outputs", Role.OPERATOR, len(OUTPUT_NAMES)),
        Block("session", 400, PlantSession, "Start of a simulation session", Role.OPERATOR),
        Block("load table", 1000, LoadStep, "Heat load over the session", Role.OPERATOR, LOAD_ROWS),
        Block("history", 16384, PlantSample, "The last ticks", rows=HISTORY_ROWS),
    ),
)
