"""Arguments that compiled loops read and overwrite: the state of the scan as records, constants, the trace, reports."""

from collections.abc import Sequence
from dataclasses import fields
from functools import cache
from typing import Any, Final, NamedTuple, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from coldloop_control_plc.output_limits import Limits
from coldloop_control_plc.scan import Scan, ScanConstants
from coldloop_optimizer_plc import decisions, rules, scheme

Array = NDArray[np.float64]

BLOCK_TICKS: Final = 512
"""Ticks that a loop does at most before it returns: a signal waits for no more."""
KINDS: Final = {int: "i8", float: "f8", bool: "?"}
FLAGS: Final = "u1"
"""Kind of a list of flags: numba has none of truth values within records."""


Records = Any
"""`Scan` with records in the place of its parts, or one of these."""


@cache
def _kinds(part: type) -> dict[str, str]:
    """Return the fields of a part of the scan's state and their kinds, where lists have those of their numbers."""
    kinds, hints = {}, get_type_hints(part)
    for field in fields(part):
        hint = hints[field.name]
        while inner := get_args(hint):
            (hint,) = inner
        kinds[field.name] = FLAGS if hint is bool is not hints[field.name] else KINDS[hint]
    return kinds


def record_of(part: Any, count: int = 1) -> Records:  # noqa: ANN401 its class
    """Return so many records of a part of the scan's state, the first of which holds it."""
    kinds = _kinds(part.__class__)
    records = np.zeros(count, [(name, kind, np.shape(getattr(part, name))) for name, kind in kinds.items()])
    write(part, records)
    return records


def write(part: Any, records: Records) -> None:  # noqa: ANN401 its class
    """Write a part of the scan's state into the first record."""
    record = records[0]
    for name in _kinds(part.__class__):
        record[name] = getattr(part, name)


def restore(part: Any, records: Records) -> None:  # noqa: ANN401 its class
    """Overwrite a part of the scan's state by the first record."""
    record = records[0]
    for name, kind in _kinds(part.__class__).items():
        value, present = record[name].tolist(), getattr(part, name)
        if isinstance(present, list):
            present[:] = map(bool, value) if kind == FLAGS else value
        else:
            setattr(part, name, value)


def scan_records(scan: Scan) -> Records:
    """Return the state of the scan as records, with room for a twin of the guard's."""
    return Scan(*(record_of(part, 2 if part is scan.guard else 1) for part in scan))


def as_arrays(constants: Any) -> Any:  # noqa: ANN401 named tuples
    """Return a tuple of constants with arrays in the place of sequences; limits stay as they are."""
    if isinstance(constants, Limits) or not isinstance(constants, Sequence):
        return constants
    if hasattr(constants, "_fields"):
        return type(constants)(*map(as_arrays, constants))
    return np.array(constants) if len(constants) else np.empty(0, np.int64)


PlantState = Any
"""A plant between two ticks, a named tuple with these arrays and its own ones.

x, y: states and outputs. station: signals, mode and alarms of a compression station, shape (21,) or (0,). noise: draws
for the sensors, a row for each tick of the trace, or no rows.
"""


class World(NamedTuple):
    """Constants of a run: plant, sensors, load and scan."""

    plant: Any
    """Plant constants; the type depends on the plant kind."""
    biases: Array
    """Sensor biases, added to the outputs, shape (outputs,)."""
    deviations: Array
    """Standard deviations of the sensors' noise, shape (outputs,)."""
    load_ticks: NDArray[np.int64]
    """First tick of each step of the load."""
    load_watts: Array
    scan: ScanConstants
    """Constants of the scan, with arrays in the place of sequences."""


class Optimizer(NamedTuple):
    """The optimiser's program, as kernels take it."""

    constants: scheme.Constants
    method: Any
    """Solver constants; the type depends on the solver, which is one of our own."""
    rule: rules.UpdatingRule
    starts: decisions.Starts
    memory: scheme.OptimizerState
    """State of the optimiser, which is overwritten."""
    latched: decisions.Latched
    """Room for an update."""


FIRST: Final = 0
TICK: Final = 1
LOAD: Final = 2
SOLVED: Final = 3
"""Places in the counts of a loop: tick of the trace's first row, the next tick, step of the load, reports made."""


class Trace(NamedTuple):
    """N ticks in a row as they are recorded."""

    load: NDArray[np.float32]
    u: NDArray[np.float32]
    y: NDArray[np.float32]
    x: NDArray[np.float32]
    station: NDArray[np.float32]
    """Signals, mode and alarms of the compression station, no columns for a cold box alone."""


class Reports(NamedTuple):
    """Reports of the optimiser, one row per update."""

    counts: NDArray[np.int64]
    """Update, tick, tau_u, q, iterations."""
    values: NDArray[np.float32]
    """The numbers of `Optimization` from `j_effective` on."""
