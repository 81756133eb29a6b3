"""Columns of numbers in a CSV file beside a process file."""

import csv
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import UsageError

Array = NDArray[np.float64]

TIME: Final = "time_s"
QUOTED: Final = 80
"""Characters of a file in a message."""


def columns(path: Path, wanted: list[str]) -> Array:
    """Return the numbers of some columns, shape (N, columns).

    Raises:
        UsageError: One line that names file, line and remedy.
    """
    names = header(path)
    missing = [name for name in wanted if name not in names]
    if missing:
        raise UsageError(
            f"{path}: no column {', '.join(missing)}; its first line is {','.join(names)[:QUOTED]!r}, and should name "
            f"{', '.join(wanted)} with commas between them, and points in numbers"
        )
    twice = next((name for name in wanted if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"{path}: two columns are named {twice}; remove one")
    places = [names.index(name) for name in wanted]
    rows = []
    for number, cells in enumerate(csv.reader(_text(path)[1:]), 2):
        if cells:
            rows.append([_number(cells, place, f"{path}, line {number}, {names[place]}") for place in places])
    if not rows:
        raise UsageError(f"{path}: no line of numbers")
    return np.array(rows)


def header(path: Path) -> list[str]:
    """Return the names of the columns."""
    return [name.strip() for name in next(csv.reader(_text(path)[:1]), [])]


def _text(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; name a CSV file beside the process file") from None


def _number(cells: list[str], place: int, where: str) -> float:
    text = cells[place].strip() if place < len(cells) else ""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise UsageError(f"{where}: {text!r} is no number; leave out what comes before or after such a gap, or fill it")
    return value
