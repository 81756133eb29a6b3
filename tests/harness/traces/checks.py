"""Tables of numbers as short checks, and where two tables differ by these.

A table is a digest per column, a check per row of each group of columns, and a check per column of each block of rows.
The digests say whether anything differs, the rows where it begins, the blocks in which columns.
"""

import hashlib
from collections.abc import Iterator, Sequence
from itertools import accumulate, zip_longest
from typing import Any, Final, NamedTuple, TypeAlias, TypedDict

import numpy as np
from numpy.typing import NDArray

Group: TypeAlias = NDArray[Any]
"""Columns of one type, shape (rows, columns); what is no number is NaN."""

BLOCK_ROWS: Final = 16
COLUMN_DIGITS: Final = 8
"""Hexadecimal digits of a column's digest."""
ROW_DIGITS: Final = 3
"""Hexadecimal digits of a row's check in a group: one difference in 4096 is named a row late, or by its block alone."""
CELL_DIGITS: Final = 2
"""Hexadecimal digits of a column's check in a block."""


class Table(TypedDict):
    """Checks of a table, as they are in the file."""

    rows: int
    columns: list[str]
    """Digests of each group's columns, separated by spaces."""
    blocks: list[str]
    """Checks of each block of rows: each group's checks of the rows, and those of all columns, separated by spaces."""


class Difference(NamedTuple):
    """First difference of two tables."""

    first: int
    """First row that differs."""
    last: int
    """Last row in question: `first`, or the last row of its block where the rows' checks show no difference."""
    columns: tuple[int, ...]
    """Columns that differ in the block of the row, of the groups that differ in the row."""
    others: tuple[int, ...]
    """Columns that differ elsewhere."""


def checked(groups: Sequence[Group]) -> Table:
    """Return the checks of groups of columns, which have the same number of rows."""
    plain = [_plain(group) for group in groups]
    rows = len(plain[0])
    blocks = [slice(first, min(first + BLOCK_ROWS, rows)) for first in range(0, rows, BLOCK_ROWS)]
    return Table(
        rows=rows,
        columns=[" ".join(_check(column, COLUMN_DIGITS) for column in group.T) for group in plain],
        blocks=[" ".join(_block([group[block] for group in plain])) for block in blocks],
    )


def _plain(group: Group) -> Group:
    """Return the same numbers as little-endian bytes, with one NaN for all."""
    numbers = group.astype(group.dtype.newbyteorder("<"))
    numbers[np.isnan(numbers)] = np.nan
    return numbers


def _check(numbers: Group, digits: int) -> str:
    return hashlib.sha256(np.ascontiguousarray(numbers).tobytes()).hexdigest()[:digits]


def _block(groups: Sequence[Group]) -> Iterator[str]:
    for group in groups:
        yield "".join(_check(row, ROW_DIGITS) for row in group)
    yield "".join(_check(column, CELL_DIGITS) for group in groups for column in group.T)


def sizes_of(table: Table) -> list[int]:
    """Return the number of columns of each group."""
    return [len(group.split()) for group in table["columns"]]


def difference(recorded: Table, found: Table) -> Difference | None:
    """Return where two tables of the same groups begin to differ, over the rows that both have; None is nowhere."""
    digests = [[one for group in table["columns"] for one in group.split()] for table in (recorded, found)]
    differing = [number for number, (one, other) in enumerate(zip(*digests, strict=True)) if one != other]
    rows = min(recorded["rows"], found["rows"])
    for number, (one, other) in enumerate(zip(recorded["blocks"], found["blocks"], strict=False)):
        if one != other:
            first = number * BLOCK_ROWS
            seen = _in_block(one.split(), other.split(), sizes_of(recorded), rows - first)
            if seen is not None:
                row, columns = seen
                last = first + BLOCK_ROWS - 1 if row is None else first + row
                columns = columns or differing
                others = tuple(column for column in differing if column not in columns)
                return Difference(first + (row or 0), min(last, rows - 1), tuple(columns), others)
    if differing and recorded["rows"] == found["rows"]:
        return Difference(0, rows - 1, tuple(differing), ())
    return None


def _in_block(
    recorded: Sequence[str], found: Sequence[str], sizes: Sequence[int], rows: int
) -> tuple[int | None, list[int]] | None:
    """Return the first row of a block that differs and the columns that do; None when its first `rows` are the same."""
    begins = [
        next((row for row, pair in enumerate(_pairs(*pair, ROW_DIGITS)) if row < rows and pair[0] != pair[1]), None)
        for pair in zip(recorded[:-1], found[:-1], strict=True)
    ]
    row = min((row for row in begins if row is not None), default=None)
    whole = rows >= BLOCK_ROWS or len(recorded[0]) == len(found[0])
    if row is None and not whole:
        return None  # the block is longer in one of them, which is all
    groups = [number for number, size in enumerate(sizes) for _ in range(size)]
    columns = [
        column
        for column, (one, other) in enumerate(_pairs(recorded[-1], found[-1], CELL_DIGITS))
        if one != other and (row is None or begins[groups[column]] == row)
    ]
    starts = [0, *accumulate(sizes)]
    if row is not None and not columns:  # their checks are the same by chance
        columns = [c for g, begin in enumerate(begins) if begin == row for c in range(starts[g], starts[g + 1])]
    return row, columns


def _pairs(one: str, other: str, digits: int) -> Iterator[tuple[str, str]]:
    """Return the checks of two rows of checks, pair by pair."""
    first, second = ([text[at : at + digits] for at in range(0, len(text), digits)] for text in (one, other))
    return zip_longest(first, second, fillvalue="")
