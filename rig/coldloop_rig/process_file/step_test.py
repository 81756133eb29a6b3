"""A step test as a historian exports it: a CSV file of inputs, load and outputs over time, made into a model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from coldloop.process.declaration import Process
from coldloop.process.sections import Disturbance, Load
from coldloop.table import TIME, Table, read_table
from coldloop_plant.own.maker import LINEAR
from coldloop_rig.process_file.identified import Identified, Places, Record, identified, unexplained
from coldloop_rig.process_file.linear_model import Linearised, operating_point

Array = NDArray[np.float64]

PIECE: Final = "piece"
"""Column whose number changes where a record has a gap."""
POOR: Final = 0.5
"""Share of an output's variation, explained of the data held back, below which a model is no good."""
UNLIKE: Final = 0.3
"""Rms error of a plant on a record of it, over the deviation of the output, from which on it is told, ..."""
FAR: Final = 3.0
"""... if it is so many times that of the model found in the record."""
EVEN: Final = 0.01
"""Largest deviation of an interval from the others, over their length."""


def from_step_test(file: Process, path: Path) -> Linearised:
    """Return the model that a step test shows.

    Raises:
        UsageError: One line that names file, line and remedy.
    """
    table = _table(file, path)
    record, moved = _recorded(file, table)
    found = identified(record)
    notes = [f"record     {path.name}: {note}" for note in (*table.notes, *_unused(table, record, file))]
    notes += [
        f"unknown    {path.name} has no column {one.name}: the model does not know what it does"
        for one in file.outside
        if one not in moved
    ]
    model = model_identified(file, found, _outputs(file, found), moved)
    return model._replace(notes=(*model.notes, *notes), record=(record, found))


def record_compared(file: Process, path: Path, plant: Linearised, model: Linearised) -> list[str]:
    """Return which outputs of a record the plant that it is for explains by far worse than the model found in it."""
    record, moved = _recorded(file, _table(file, path))
    places = _places(file, moved)
    by_plant, by_model = (
        unexplained(one.A, np.hstack([one.B, one.F[:, places]]), one.C, np.hstack([one.D, one.G[:, places]]), record)
        for one in (plant, model)
    )
    return [
        f"warning    {path.name}: of {one.name} the plant itself explains {100 * max(0.0, 1.0 - its):.0f} %, the model "
        f"found in it {100 * max(0.0, 1.0 - found):.0f} %; are its columns those of this plant?"
        for one, its, found in zip(file.outputs, by_plant, by_model, strict=True)
        if its > max(UNLIKE, FAR * found)
    ]


def _table(file: Process, path: Path) -> Table:
    named = (*file.inputs, *file.outside, *file.outputs)
    return read_table(path, [TIME, *(one.name for one in named)], "name a CSV file beside the process file")


def _unused(table: Table, record: Record, file: Process) -> list[str]:
    used = {table.place(name) for name in (TIME, PIECE, *record.input_names, *(one.name for one in file.outputs))}
    left = [name for place, name in enumerate(table.names) if name and place not in used]
    return [f"not used: {', '.join(left)}"] if left else []


def _recorded(file: Process, table: Table) -> tuple[Record, list[Load | Disturbance]]:
    """Return a record in samples of the model, and what moved in it beside the inputs."""
    moved = [one for one in file.outside if table.place(one.name) is not None]
    names = [one.name for one in (*file.inputs, *moved)]
    rows = np.array(table.columns([TIME, *names, *(one.name for one in file.outputs)])).T
    number = np.zeros(len(rows)) if table.place(PIECE) is None else np.array(table.columns([PIECE])[0])
    pieces = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(number)) + 1)
    period_s = _period(table, rows[:, 0], pieces)
    _check_readings(file, table.where, rows[:, 1 + len(names) :])
    every = max(1, round(file.tick_s * file.ticks_per_sample / period_s))
    counts = [len(piece) // every for piece in pieces if len(piece) >= every]
    used = np.concatenate([piece[: len(piece) // every * every] for piece in pieces])
    inputs, outputs = rows[used, 1 : 1 + len(names)], rows[used, 1 + len(names) :]
    held = inputs.reshape(len(used) // every, every, -1).mean(axis=1)
    at, ends = np.array([one.at for one in (*file.inputs, *moved)]), np.cumsum(counts)
    cut = tuple(slice(end - count, end) for count, end in zip(counts, ends, strict=True))
    return Record(period_s * every, held, outputs[::every], at, tuple(names), table.where, cut), moved


def _places(file: Process, moved: Sequence[Load | Disturbance]) -> list[int]:
    """Return the columns that load and disturbances have in F and G."""
    return [1 + file.disturbances.index(one) if isinstance(one, Disturbance) else 0 for one in moved]


def model_identified(file: Process, found: Identified, y0: Array, moved: Sequence[Load | Disturbance]) -> Linearised:
    """Return what was identified as the model of a process.

    Args:
        file: What the process file says.
        found: Of its inputs, and of what moved beside them.
        y0: Outputs at its operating point.
        moved: The load, if it moved, and those of the other disturbances that did.
    """
    u, w = operating_point(file)
    n, m, p = len(found.A), len(u), len(y0)
    F = np.zeros((n, len(w)))
    F[:, _places(file, moved)] = found.B[:, m:]
    poor = [one.name for one, share in zip(file.outputs, found.fit, strict=True) if share < POOR]
    warning = (
        (f"warning    fit: the record does not explain {', '.join(poor)}; something else moves it",) if poor else ()
    )
    fit = "  ".join(f"{one.name} {100 * share:.1f} %" for one, share in zip(file.outputs, found.fit, strict=True))
    return Linearised(
        found.A, found.B[:, :m], F, found.C, np.zeros((p, m)), np.zeros((p, len(w))), np.zeros(n), u, w, y0,
        {f"x{i}": "" for i in range(1, n + 1)}, LINEAR, {}, "", 0.0,
        (f"identified with {n} states; of the last third, held back, it explains  {fit}", *warning),
    )  # fmt: skip


def _outputs(file: Process, found: Identified) -> Array:
    """Return the outputs at the operating point: as given, else where the model rests.

    Raises:
        UsageError: One is not given, and the model does not rest.
    """
    missing = next((one.name for one in file.outputs if one.at is None), None)
    if not found.rests and missing is not None:
        raise UsageError(
            f"outputs: {missing} needs at, its value at the operating point: by its record the plant does not rest"
        )
    return np.array(
        [rest if one.at is None else one.at for one, rest in zip(file.outputs, found.constant, strict=True)]
    )


def _check_readings(file: Process, path: str, outputs: Array) -> None:
    """Check that readings are such as the file's sensors give.

    Raises:
        UsageError: A record is in another unit, or an output never moves.
    """
    for one, column in zip(file.outputs, outputs.T, strict=True):
        low, high = one.range
        wrong = column[(column < low) | (column > high)]
        if wrong.size:
            raise UsageError(
                f"{path}: {one.name} = {wrong[0]:g} is outside the range of its sensor, {low:g} to {high:g}; "
                "give the record in the unit of the process file, without failed readings"
            )
        if np.ptp(column) == 0.0:
            raise UsageError(f"{path}: {one.name} never moves; what acts on it cannot be told")


def _period(table: Table, times: Array, pieces: Sequence[Places]) -> float:
    if len(times) < 2:
        raise UsageError(f"{table.where}: one line of numbers is no record")
    intervals = np.diff(times)
    usual = float(np.median(intervals))
    if usual <= 0.0:
        raise UsageError(f"{table.where}: {TIME} does not rise from line to line")
    uneven = np.abs(intervals - usual) > EVEN * usual
    uneven[[piece[0] - 1 for piece in pieces[1:]]] = False
    if uneven.any():
        odd = int(uneven.argmax())
        raise UsageError(
            f"{table.where}, line {table.rows[odd + 1][0]}: {intervals[odd]:g} s after the line before, others are "
            f"{usual:g} s apart; `coldloop import` makes times even and cuts at gaps"
        )
    return usual
