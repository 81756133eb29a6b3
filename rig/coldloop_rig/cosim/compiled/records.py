"""The numbers that ordinary ticks change, as records and arrays that kernels overwrite."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.declaration import Process
from coldloop_control_plc.output_limits import Limits
from coldloop_control_plc.sensors import Kinds
from coldloop_optimizer_plc.rules import UpdatingRule
from coldloop_optimizer_plc.scheme import Constants, OptimizerState

Array = NDArray[np.float64]

BLOCK_TICKS: Final = 512
"""Ticks that a loop does at most before it returns: a signal waits for no more."""
NOT: Final = -1
"""Tick of what is not."""


def guard_type(limits: Limits) -> np.dtype[Any]:
    """Return the record of a `coldloop_control_plc.output_limits.GuardState`."""
    inputs, ticks = len(limits.low), limits.ticks_per_sample
    return np.dtype([
        ("applied", "f8", (inputs,)), ("anchor", "f8", (inputs,)), ("coming", "f8", (inputs,)),
        ("moves", "i8", ticks), ("before", "f8", (ticks, inputs)),
        ("moved", "i8"), ("start", "i8"), ("share", "f8"), ("oldest", "i8"), ("out_of_bounds", "?"),
    ])  # fmt: skip


def scan_type(process: Process) -> np.dtype[Any]:
    """Return the record of the control PLC and the load.

    first: tick of the trace's first row. tick: the next scan. next_update, updates: tick and number of the next
    update. update_tick, update_load, u_before: the one under way, and what was applied before it. load_step: change of
    the load that interrupts it, or 0. number, first_tick, length, tau_u: the sequence being played. accepted: sequences
    accepted. triggered, lowest: the optimiser's watchdog. since: since when each band alarm is about to change.
    unchanged, rests, seen, inputs, inputs_moved: of the sensor check. image_count, image_moved, image_inputs: of its
    watch of the image. seen_x, seen_load: of the tick before the trace's first row. same: the image is unchanged.
    load_index: step of the load that holds. solved: reports made. short, suspects: sign of the shortage, and suspects,
    of the last plan.
    """
    inputs, outputs, states = len(process.inputs), len(process.outputs), len(process.states)
    return np.dtype([
        ("first", "i8"), ("tick", "i8"), ("next_update", "i8"), ("updates", "i8"), ("update_tick", "i8"),
        ("update_load", "f8"), ("load_step", "f8"), ("u_before", "f8", (inputs,)), ("number", "i8"),
        ("first_tick", "i8"), ("length", "i8"), ("tau_u", "i8"), ("accepted", "i8"), ("triggered", "i8"),
        ("lowest", "i8"), ("since", "i8", (len(process.bands),)),
        ("unchanged", "i8", (outputs,)), ("rests", "i8", (outputs,)),
        ("seen", "f8", (outputs,)), ("seen_x", "f8", (states,)), ("seen_load", "f8"), ("same", "?"),
        ("image_count", "i8"), ("image_moved", "?"), ("image_inputs", "f8", (inputs,)),
        ("inputs", "f8", (outputs, inputs)), ("inputs_moved", "i8", (outputs,)), ("load_index", "i8"),
        ("solved", "i8"), ("short", "f8"), ("suspects", "i8"),
    ])  # fmt: skip


PlantState = Any
"""A plant between two ticks, a named tuple with these arrays and its own ones.

x, y: states and outputs. station: signals, mode and alarms of a compression station, shape (21,) or (0,). noise: draws
for the sensors, a row for each tick of the trace, or no rows.
"""


class World(NamedTuple):
    """What does not change in a run."""

    plant: Any
    """Of its kind."""
    biases: Array
    """What the sensors show too much, shape (outputs,)."""
    deviations: Array
    """Standard deviations of the sensors' noise, shape (outputs,)."""
    load_ticks: NDArray[np.int64]
    """First tick of each step of the load."""
    load_watts: Array
    limits: Limits
    low: Array
    """Lowest value in the range of a sensor, shape (outputs,)."""
    high: Array
    least: NDArray[np.int64]
    """Ticks for which each output is at least unchanged before it is frozen, shape (outputs,)."""
    controlled: NDArray[np.bool_]
    """Which outputs have a band, shape (outputs,)."""
    kinds: Kinds
    moves: Array
    """How far an input must have moved for something to be seen of it, shape (inputs,)."""
    may_rest: bool
    """Nothing may be measured to move while the inputs do not."""
    each_may_rest: bool
    """Nor need an output move while others do, then."""
    frozen_ticks: int
    """Ticks for which the image is at least unchanged before it is an old one."""
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
    """The band alarms as they are until one of them changes; arrays are of shape (bands,)."""

    low: Array
    high: Array
    places: NDArray[np.int64]
    """The output of each."""
    active: NDArray[np.bool_]
    delays: NDArray[np.int64]
    """Ticks until each alarm follows its condition."""


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


def empty_trace(process: Process, station: int) -> Trace:
    """Return room for a block, with so many columns of the station."""
    sizes = len(process.inputs), len(process.outputs), len(process.states), station
    rooms = (np.empty((BLOCK_TICKS, size), np.float32) for size in sizes)
    return Trace(np.empty(BLOCK_TICKS, np.float32), *rooms)


def empty_reports() -> Reports:
    """Return room for the updates of a block."""
    return Reports(np.empty((BLOCK_TICKS, 5), np.int64), np.empty((BLOCK_TICKS, 11), np.float32))
