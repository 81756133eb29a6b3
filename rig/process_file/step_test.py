"""A step test as a historian exports it: a CSV file of inputs, load and outputs over time, made into a model."""

import csv
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError
from plant.own.maker import LINEAR
from rig.process_file.declaration import ProcessFile
from rig.process_file.identified import Identified, Record, identified
from rig.process_file.linear_model import Linearised, operating_point

Array = NDArray[np.float64]

TIME: Final = "time_s"
POOR: Final = 0.5
"""Share of an output's variation, explained of the data held back, below which a model is no good."""
EVEN: Final = 0.01
"""Largest deviation of an interval from the others, over their length."""


def from_step_test(file: ProcessFile, path: Path) -> Linearised:
    """Return the model that a step test shows.

    Raises:
        UsageError: One line that names file, line and remedy.
    """
    has_load = file.load is not None and file.load.name in _header(path)
    names = [one.name for one in file.inputs] + ([file.load.name] if file.load and has_load else [])
    rows = _rows(path, [TIME, *names, *(one.name for one in file.outputs)])
    period_s = _period(path, rows[:, 0])
    every = max(1, round(file.tick_s * file.ticks_per_sample / period_s))
    inputs, outputs = rows[:, 1 : 1 + len(names)], rows[:, 1 + len(names) :]
    count = len(rows) // every
    held = inputs[: count * every].reshape(count, every, -1).mean(axis=1)
    u, w = operating_point(file)
    at = np.append(u, w)[: len(names)]
    record = Record(period_s * every, held, outputs[: count * every : every], at, tuple(names), str(path))
    found = identified(record)
    notes = () if has_load or file.load is None else (
        f"load       {path.name} has no column {file.load.name}: the model does not know what the load does",
    )  # fmt: skip
    model = model_identified(file, found, _outputs(file, found), has_load=has_load)
    return model._replace(notes=(*model.notes, *notes))


def model_identified(file: ProcessFile, found: Identified, y0: Array, *, has_load: bool) -> Linearised:
    """Return what was identified as the model of a process.

    Args:
        file: What the process file says.
        found: Of its inputs and, where `has_load`, of its load.
        y0: Outputs at its operating point.
        has_load: Whether the last input is the load.
    """
    u, w = operating_point(file)
    n, m, p = len(found.A), len(u), len(y0)
    poor = [one.name for one, share in zip(file.outputs, found.fit, strict=True) if share < POOR]
    warning = (
        (f"warning    fit: the record does not explain {', '.join(poor)}; something else moves it",) if poor else ()
    )
    fit = "  ".join(f"{one.name} {100 * share:.1f} %" for one, share in zip(file.outputs, found.fit, strict=True))
    return Linearised(
        found.A, found.B[:, :m], found.B[:, m] if has_load else np.zeros(n), found.C, np.zeros((p, m)), np.zeros(p),
        np.zeros(n), u, w, y0, {f"x{i}": "" for i in range(1, n + 1)}, LINEAR, {}, "", 0.0,
        (f"identified with {n} states; of the last third, held back, it explains  {fit}", *warning),
    )  # fmt: skip


def _outputs(file: ProcessFile, found: Identified) -> Array:
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


def _text(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    except OSError as error:
        raise UsageError(
            f"{path}: {error.strerror}; plant.step_test names a CSV file beside the process file"
        ) from None


def _header(path: Path) -> list[str]:
    return [name.strip() for name in next(csv.reader(_text(path)[:1]), [])]


def _rows(path: Path, columns: list[str]) -> Array:
    """Return the numbers of the columns, shape (N, columns)."""
    header = _header(path)
    missing = [name for name in columns if name not in header]
    if missing:
        raise UsageError(f"{path}: no column {', '.join(missing)}; the first line names {', '.join(columns)}")
    places = [header.index(name) for name in columns]
    rows = []
    for number, cells in enumerate(csv.reader(_text(path)[1:]), 2):
        if cells:
            rows.append([_number(cells, place, f"{path}, line {number}, {header[place]}") for place in places])
    if len(rows) < 2:
        raise UsageError(f"{path}: {len(rows)} lines of numbers are no record")
    return np.array(rows)


def _number(cells: list[str], place: int, where: str) -> float:
    text = cells[place].strip() if place < len(cells) else ""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise UsageError(f"{where}: {text!r} is no number; leave out what comes before or after such a gap, or fill it")
    return value


def _period(path: Path, times: Array) -> float:
    intervals = np.diff(times)
    usual = float(np.median(intervals))
    if usual <= 0.0:
        raise UsageError(f"{path}: {TIME} does not rise from line to line")
    odd = np.flatnonzero(np.abs(intervals - usual) > EVEN * usual)
    if odd.size:
        line, interval = int(odd[0]) + 3, float(intervals[odd[0]])
        raise UsageError(
            f"{path}, line {line}: {interval:g} s after the line before, others are {usual:g} s apart; "
            "export it with even times, and without gaps"
        )
    return usual
