"""Text for people: tables in Markdown or aligned; on a terminal within its width, and coloured by state."""

import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from enum import IntEnum
from itertools import groupby, pairwise
from typing import Final

from coldloop.errors import printable

Cell = str | float | int

SHA256: Final = re.compile("[0-9a-f]{64}")
"""Pattern of a SHA-256 digest, of which a table shows the first digits."""


def aligned(rows: Sequence[Sequence[str]], *, numbers: bool = False) -> str:
    """Return rows as lines of aligned columns; of `numbers`, all columns but the first are aligned to the right."""
    rows = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    others = str.rjust if numbers else str.ljust
    lines = ("  ".join([row[0].ljust(widths[0]), *map(others, row[1:], widths[1:])]).rstrip() for row in rows)
    return "".join(f"{line}\n" for line in lines)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Cell]], caption: str = "") -> str:
    """Return a table in Markdown, behind a caption if there is one; numbers have four digits."""
    lines = [f"{caption}\n"] if caption else []
    lines += [_line(header), "|" + "---|" * len(header), *(_line([_cell(value) for value in row]) for row in rows)]
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(map(printable, cells))} |"


def _cell(value: Cell) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value[:12]}…" if isinstance(value, str) and SHA256.fullmatch(value) else str(value)


GAP: Final = re.compile(" {2,}")
"""Gap between the columns of a table."""


class Colour(IntEnum):
    """Colours of a state, by their ANSI codes."""

    GOOD = 32
    ATTENTION = 33
    FAILED = 31


def width() -> int | None:
    """Return the columns of the terminal that standard output is; None where it is none."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def coloured(text: str, colour: Colour) -> str:
    """Return the text in a colour, on a terminal that may have some."""
    return f"\x1b[{colour:d}m{text}\x1b[0m" if sys.stdout.isatty() and not os.environ.get("NO_COLOR") else text


def cut(line: str, columns: int | None) -> str:
    """Return the beginning of a line that is longer than so many columns."""
    return line if columns is None or len(line) <= columns else f"{line[: columns - 1]}…"


def fitted(text: str, columns: int | None) -> str:
    """Return text in lines of at most so many columns: sentences wrapped, tables with some columns below the others."""
    if columns is None:
        return text
    parts = groupby(text.splitlines(), key=lambda line: bool(GAP.search(line.strip())))
    return "".join(f"{line}\n" for table, lines in parts for line in _fitted(list(lines), columns, table=table))


def _fitted(lines: list[str], columns: int, *, table: bool) -> Iterator[str]:
    longest = max(map(len, lines))
    ends = [2, longest]
    if table:
        cells = zip(*(line.ljust(longest) for line in lines), strict=True)
        filled = "".join(" " if set(column) == {" "} else "x" for column in cells)
        ends = [*(gap.end() for gap in GAP.finditer(filled)), longest]
    if longest <= columns:
        yield from lines
    elif len(ends) <= 2 or len(lines) == 1:
        hanging = " " * min(ends[0], columns // 2)
        for line in lines:
            yield from textwrap.wrap(line, columns, subsequent_indent=hanging, break_long_words=False) or [""]
    else:
        begin = ends[0]
        for end, following in pairwise([*ends[1:], longest + columns]):
            if ends[0] + following - begin > columns:
                yield from (f"{line[: ends[0]]:{ends[0]}}{line[begin:end]}".rstrip() for line in lines)
                begin = end
