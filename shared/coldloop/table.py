"""Tables in text files of users, as spreadsheets and historians write them.

Commas, semicolons or tabs between columns; points or commas in numbers; a line of units below the header; lines before
it; rows without anything in them. What was assumed is in `notes`.
"""

import csv
import io
import math
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Final

from coldloop.errors import UsageError
from coldloop.text import decoded, not_text, read_bytes

TIME: Final = "time_s"
SEPARATORS: Final = {"\t": "tabs", ";": "semicolons", ",": "commas"}
HEAD: Final = 50
"""Lines among which the header is."""
QUOTED: Final = 80
"""Characters of a file in a message."""
NUMBER: Final = re.compile(r"(?=[+-]?[.,]?\d)[+-]?(\d{1,3}([.,' \xa0]\d{3})+|\d*)([.,]\d*)?([eE][+-]?\d+)?")
READING: Final = re.compile(rf"{NUMBER.pattern}$|[+-]?(nan|inf)|\d+[-./]\w+[-./]|.*\d:\d\d", re.IGNORECASE)
"""Pattern that a number, a date or a time begins with, and the name of a unit does not."""
QUALITY: Final = re.compile(r"(.*[\W_])?(qual|qlty|q|opcquality|status ?(code)?|qualit(y|ät|aet|é))")
"""Names of columns that say how good readings are."""
GOOD: Final = {"good", "ok", "g", "gut", "valid", "normal", "true"}
"""Words of such columns; beside them numbers whose two highest bits of eight are set, as OPC has them (192)."""
OPC_GOOD: Final = 0xC0


def is_good(text: str, more: Collection[str] = ()) -> bool:
    """Return whether the text of a quality is good, as an empty one is; `more` are texts that are good too."""
    text = text.casefold()
    if re.fullmatch(r"\d+(\.0*)?", text):
        return text in more or int(float(text)) & OPC_GOOD == OPC_GOOD
    return not text or text in more or re.split(r"[\W\d_]", text)[0] in GOOD


def plain(name: str) -> str:
    """Return the name of a column in small letters, without a unit in brackets."""
    return re.sub(r"\s*[\[(][^\[(]*[\])]$", "", " ".join(name.split()).lstrip("# ")).casefold()


@dataclass(frozen=True)
class Table:
    """The cells of a file."""

    where: str
    """Names it in messages."""
    names: tuple[str, ...]
    """Names of the columns."""
    rows: tuple[tuple[int, list[str]], ...]
    """Number of the line and cells, as many as there are names or more."""
    decimal: str
    """A point or a comma."""
    notes: tuple[str, ...]
    error: type[UsageError] = field(default=UsageError, repr=False)

    def place(self, name: str) -> int | None:
        """Return where a column is: by its name, else by its name in other capitals or before a unit.

        Raises:
            UsageError: There are two.
        """
        for names, wanted in ((list(self.names), name), ([plain(each) for each in self.names], plain(name))):
            if names.count(wanted) > 1:
                raise self.error(f"{self.where}: two columns are named {wanted}; remove one")
            if wanted in names:
                return names.index(wanted)
        return None

    def columns(self, wanted: Sequence[str]) -> list[list[float]]:
        """Return the numbers of some columns; of TIME, which may be in ISO 8601, the seconds since the first.

        Raises:
            UsageError: One is missing or has a cell that is no number, or a reading is not good; one line.
        """
        places = [self.place(name) for name in wanted]
        missing = [name for name, place in zip(wanted, places, strict=True) if place is None]
        if missing:
            raise self.error(
                f"{self.where}: no column {', '.join(missing)}; its header is {','.join(self.names)[:QUOTED]!r}, and "
                f"should name {','.join(wanted)}"
            )
        if not self.rows:
            raise self.error(f"{self.where}: no line of numbers; add some")
        qualities = set(self.qualities()) - set(places)
        for line, cells in self.rows if qualities else ():
            bad = next((place for place in qualities if not is_good(cells[place])), None)
            if bad is not None:
                raise self.error(
                    f"{self.where}, line {line}, {self.names[bad]}: {cells[bad][:QUOTED]!r} is not known as good; "
                    "`coldloop import` leaves out readings that are not"
                )
        return [self._numbers(place, name) for place, name in zip(places, wanted, strict=True) if place is not None]

    def qualities(self) -> list[int]:
        """Return the columns that say how good readings are: of a short name if it has words or whole numbers only."""
        named = [place for place, name in enumerate(self.names) if QUALITY.fullmatch(plain(name))]
        cells = {place: {row[place] for _, row in self.rows} - {""} for place in named}
        return [
            place for place, texts in cells.items()
            if "qual" in plain(self.names[place])
            or (any(map(is_good, texts)) and all(text.isdigit() or math.isnan(self.number(text)) for text in texts))
        ]  # fmt: skip

    def _numbers(self, place: int, name: str) -> list[float]:
        cells = [(line, cells[place]) for line, cells in self.rows]
        if name == TIME and math.isnan(self.number(cells[0][1])):
            return self._seconds(cells)
        found = [self.number(text) for _, text in cells]
        odd = next((k for k, value in enumerate(found) if not math.isfinite(value)), None)
        if odd is not None:
            raise self.error(
                f"{self.where}, line {cells[odd][0]}, {name}: {cells[odd][1][:QUOTED]!r} is no finite number; leave "
                "out what comes before or after such a gap, or fill it (`coldloop import` does)"
            )
        return found

    def _seconds(self, cells: Sequence[tuple[int, str]]) -> list[float]:
        found: list[float] = []
        for line, text in cells:
            try:
                found.append((datetime.fromisoformat(text) - datetime.fromisoformat(cells[0][1])).total_seconds())
            except (ValueError, TypeError):
                raise self.error(
                    f"{self.where}, line {line}, {TIME}: {text[:QUOTED]!r} is no finite number of seconds and not in "
                    "ISO 8601, as all or none are; `coldloop import` reads other dates"
                ) from None
        return found

    def number(self, text: str) -> float:
        """Return the number in a cell, NaN if there is none."""
        try:
            if "," in text and NUMBER.fullmatch(text):
                if self.decimal == "." and "." not in text:
                    return math.nan
                text = re.sub(r"[.' \xa0]" if self.decimal == "," else ",", "", text).replace(",", ".")
            elif self.decimal == "," and "." in text:
                return math.nan
            return float(text)
        except ValueError:
            return math.nan


def read_table(path: Path, wanted: Collection[str], remedy: str, error: type[UsageError] = UsageError) -> Table:
    """Return the table in a file; what is not UTF-8 is taken for Latin-1, as numbers and our names are equal in both.

    Raises:
        UsageError: It cannot be read; one line, of the kind `error`.
    """
    data = read_bytes(path, remedy, error)
    try:
        return table_of(decoded(data), str(path), wanted, error)
    except UnicodeDecodeError as failure:
        if b"\0" in data or b"\x1f" in data:
            raise error(f"{path}: {not_text(failure)}") from None
        note = f"read as Latin-1, as it is not UTF-8 (byte {failure.start})"
    return table_of(data.decode("cp1252", errors="replace"), str(path), wanted, error, note)


def table_of(
    text: str, where: str, wanted: Collection[str], error: type[UsageError] = UsageError, *notes: str
) -> Table:
    """Return the table in a text, whose header has one of the wanted names.

    Raises:
        UsageError: It cannot be read; one line, of the kind `error`.
    """
    hint = re.match(r"sep=(.)\r?\n", text)  # for a spreadsheet
    text = "\n" + text[hint.end() :] if hint else text
    names, head = {plain(name) for name in wanted}, "".join(islice(io.StringIO(text, newline=""), HEAD))
    separators = [hint[1]] if hint else [*SEPARATORS]
    heads = (
        (each, at)
        for each in separators
        for at, (_, row) in enumerate(_rows(head, each, where, error))
        if len(row) > 1 and names & {*map(plain, row)}
    )
    separator, at = next(heads, (separators[-1], 0))
    before = list(_rows(text, separator, where, error))
    header = [" ".join(name.split()).lstrip("# ") for name in before[at][1]] if before else []
    rows = [(line, row + [""] * (len(header) - len(row))) for line, row in before[at + 1 :] if row[0][:1] != "#"]
    said = [] if separator == "," else [f"{SEPARATORS.get(separator, repr(separator))} between columns"]
    if rows and not any(READING.match(cell) for cell in rows[0][1]):
        said.append(f"line {rows[0][0]} taken for units")
        rows = rows[1:]
    decimal = _decimal([cell for _, row in rows for cell in row], separator)
    said += ["decimal commas"] if decimal == "," else []
    return Table(where, tuple(header), tuple(rows), decimal, (*notes, *said), error)


def _rows(text: str, separator: str, where: str, error: type[UsageError]) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that have anything in them, and the numbers of their lines."""
    lines = io.StringIO(text, newline="")
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)  # noqa: TID251
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                yield reader.line_num, cells
    except csv.Error as failure:
        raise error(f"{where}, line {reader.line_num}: {failure}; write a number in each column") from None


def _decimal(cells: Sequence[str], separator: str) -> str:
    """Return the decimal sign: a comma where it follows points in a number, or where no number has a point."""
    commas = [cell for cell in cells if "," in cell and NUMBER.fullmatch(cell)]
    if any("." in cell for cell in commas):
        return "," if all(cell.rfind(",") > cell.rfind(".") for cell in commas) else "."
    pointed = separator == "," or any("." in cell and NUMBER.fullmatch(cell) for cell in cells)
    return "," if commas and not pointed else "."
