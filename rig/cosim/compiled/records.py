"""The numbers that ordinary ticks change, as records and arrays that kernels overwrite."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.signals import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES, TICKS_PER_SAMPLE
from coldloop.registers.control_plc import SEQUENCE_ROWS
from control_plc.output_limits import Limits
from optimizer_plc.rules import UpdatingRule
from optimizer_plc.scheme import Constants
from optimizer_plc.session_state import OptimizerState
from plant.cold_box.physics import ColdBox
from plant.helium.properties import Helium
from plant.refrigerator.physics import Refrigerator
from plant.refrigerator.station_law import StationLaw
from plant.refrigerator.tick import RefrigeratorMemory

Array = NDArray[np.float64]

BLOCK_TICKS: Final = 512
"""Ticks that a loop does at most before it returns: a signal waits for no more."""
NOT: Final = -1
"""Tick of what is not."""

GUARD: Final = np.dtype([
    ("applied", "f8", 3), ("anchor", "f8", 3), ("coming", "f8", 3),
    ("moves", "i8", TICKS_PER_SAMPLE), ("before", "f8", (TICKS_PER_SAMPLE, 3)),
    ("start", "i8"), ("share", "f8"), ("moved", "i8"), ("oldest", "i8"), ("out_of_bounds", "?"),
])  # fmt: skip
"""`control_plc.output_limits.GuardState`."""

SCAN: Final = np.dtype([
    ("first", "i8"), ("tick", "i8"), ("next_update", "i8"), ("updates", "i8"), ("update_tick", "i8"),
    ("update_load", "f8"), ("load_step", "f8"), ("u_before", "f8", 3), ("number", "i8"), ("first_tick", "i8"),
    ("length", "i8"), ("tau_u", "i8"), ("accepted", "i8"), ("triggered", "i8"), ("lowest", "i8"),
    ("level_since", "i8"), ("t5_since", "i8"), ("unchanged", "i8", len(OUTPUT_NAMES)),
    ("rests", "i8", len(OUTPUT_NAMES)), ("seen", "f8", len(OUTPUT_NAMES)), ("load_index", "i8"), ("solved", "i8"),
    ("short", "f8"), ("suspects", "i8"),
])  # fmt: skip
"""The control PLC and the load.

first: tick of the trace's first row. tick: the next scan. next_update, updates: tick and number of the next update.
update_tick, update_load, u_before: the one under way, and what was applied before it. load_step: change of the load (W)
that interrupts it, or 0. number, first_tick, length, tau_u: the sequence being played. accepted: sequences accepted.
triggered, lowest: the optimiser's watchdog. level_since, t5_since: since when a band alarm is about to change.
unchanged, rests, seen: of the sensor check. load_index: step of the load that holds. solved: reports made. short,
suspects: sign of the shortage, and suspects, of the last plan."""


class BoxConstants(NamedTuple):
    """A cold box alone."""

    box: ColdBox
    helium: Helium


class BoxState(NamedTuple):
    """A cold box alone between two ticks."""

    x: Array
    """Shape (28,)."""
    y: Array
    """Outputs, shape (22,)."""
    station: Array
    """Nothing, shape (0,)."""
    noise: Array
    """Draws for the sensors, a row for each tick of the trace, shape (N, 22) or (0, 22)."""
    slope: Array
    """dx/dt at x under `held`, shape (28,)."""
    held: Array
    """Inputs and load of the tick before, shape (4,); NaN where they are not known."""


class RefrigeratorConstants(NamedTuple):
    """The whole refrigerator and its station's controller."""

    plant: Refrigerator
    helium: Helium
    law: StationLaw


class RefrigeratorState(NamedTuple):
    """A refrigerator between two ticks."""

    x: Array
    """States of the cold box, the first 28 of `memory.x`."""
    y: Array
    """As in `BoxState`."""
    station: Array
    """Signals, mode and alarms of the station, shape (21,)."""
    noise: Array
    """As in `BoxState`."""
    memory: RefrigeratorMemory
    ahead: Array
    """Disturbances at each tick of the trace and at the one behind it, without load, shape (N + 1, 16)."""


PlantConstants = BoxConstants | RefrigeratorConstants
PlantState = BoxState | RefrigeratorState


class World(NamedTuple):
    """What does not change in a run."""

    plant: PlantConstants
    biases: Array
    """What the sensors show too much, shape (22,)."""
    deviations: Array
    """Standard deviations of the sensors' noise, shape (22,)."""
    load_ticks: NDArray[np.int64]
    """First tick of each step of the load."""
    load_watts: Array
    limits: Limits
    low: Array
    """Lowest value in the range of a sensor, shape (22,)."""
    high: Array
    least: NDArray[np.int64]
    """Ticks for which each output is at least unchanged before it is frozen, shape (22,)."""
    least_load: float
    largest_load: float
    watchdog: int
    """Time-out, ticks; 0 is off."""
    load_step: float
    """Change of the load that interrupts an updating period, W, or 0."""


class Optimizer(NamedTuple):
    """The optimiser's program, as kernels take it."""

    constants: Constants
    method: Any
    """Of a solver of our own."""
    rule: UpdatingRule
    memory: OptimizerState
    """Its state, which is overwritten."""


class Alarms(NamedTuple):
    """The two band alarms as they are until one of them changes."""

    level_band: tuple[float, float]
    t5_band: tuple[float, float]
    level_active: bool
    t5_active: bool
    level_delay: int
    """Ticks until the alarm follows its condition."""
    t5_delay: int


class Trace(NamedTuple):
    """N ticks in a row as they are recorded."""

    load: NDArray[np.float32]
    u: NDArray[np.float32]
    y: NDArray[np.float32]
    x: NDArray[np.float32]
    station: NDArray[np.float32]
    """Signals, mode and alarms of the compression station, no columns for a cold box alone."""


class Reports(NamedTuple):
    """What the optimiser did, a row an update."""

    counts: NDArray[np.int64]
    """Update, tick, tau_u, q, iterations."""
    values: NDArray[np.float32]
    """The numbers of `Optimization` from `j_effective` on."""


def empty_trace(station: int) -> Trace:
    """Return room for a block, with so many columns of the station."""
    sizes = (len(INPUT_NAMES), len(OUTPUT_NAMES), len(STATE_NAMES), station)
    return Trace(np.empty(BLOCK_TICKS, np.float32), *(np.empty((BLOCK_TICKS, size), np.float32) for size in sizes))


def empty_reports() -> Reports:
    """Return room for the updates of a block."""
    return Reports(np.empty((BLOCK_TICKS, 5), np.int64), np.empty((BLOCK_TICKS, 11), np.float32))


def empty_rows() -> Array:
    """Return room for two of the longest sequences."""
    return np.zeros((2, SEQUENCE_ROWS, len(INPUT_NAMES)))


def record(kind: Any) -> Any:  # noqa: ANN401 numpy's types of records
    """Return room for one record."""
    return np.zeros(1, kind)
