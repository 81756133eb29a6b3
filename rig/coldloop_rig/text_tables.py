"""Tables as text: aligned for a terminal, or in Markdown."""

import re
from collections.abc import Iterable, Sequence
from typing import Final

from coldloop.errors import printable

Cell = str | float | int

SHA256: Final = re.compile("[0-9a-f]{64}")
"""Of which a table shows the beginning."""


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
