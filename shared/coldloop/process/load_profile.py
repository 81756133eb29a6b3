"""The load over time, and the CSV files that hold it."""

import math
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path

from coldloop.errors import LoadFileError
from coldloop.process import declaration, sections
from coldloop.table import TIME, Table, read_table, table_of


@dataclass(frozen=True)
class LoadProfile:
    """The heat load over time, in steps that are held.

    Raises:
        ValueError: times do not start at 0, do not increase or are after the last tick of a session, lengths differ, or
            a load is not finite.
    """

    times: tuple[int, ...]
    """Ticks at which the load changes, from 0."""
    watts: tuple[float, ...]
    """The load from each of these ticks on, W."""

    def __post_init__(self) -> None:
        if not self.times or self.times[0] != 0 or len(self.times) != len(self.watts):
            raise ValueError("a load profile needs a load for each time, the first at tick 0")
        if any(later <= earlier for earlier, later in zip(self.times, self.times[1:], strict=False)):
            raise ValueError("the times of a load profile must increase")
        if self.times[-1] > declaration.LAST_TICK:
            raise ValueError(f"tick {self.times[-1]} is after the last one of a session, {declaration.LAST_TICK}")
        if not all(map(math.isfinite, self.watts)):
            raise ValueError("loads must be finite")

    def value(self, tick: int) -> float:
        """Return the load (W) that is held from `tick` (0 or later) to the next."""
        return self.watts[bisect_right(self.times, tick) - 1]


def read_load_file(path: Path, process: declaration.Process) -> LoadProfile:
    """Return the load of a CSV file with the columns time_s and load_w, or load in another unit, steps held.

    Raises:
        LoadFileError: One line that names file, line and remedy.
    """
    columns = (TIME, process.load.column, sections.LOAD_IN_WATTS)
    return _profile(read_table(path, columns, "name a readable CSV file", LoadFileError), process)


def load_profile_of(text: str, where: str, process: declaration.Process) -> LoadProfile:
    """Return the load in a CSV text; `where` names it in messages.

    Raises:
        LoadFileError: One line that names place, line and remedy.
    """
    return _profile(table_of(text, where, (TIME, process.load.column, sections.LOAD_IN_WATTS), LoadFileError), process)


def _profile(table: Table, process: declaration.Process) -> LoadProfile:
    own = process.load.column
    column = (
        own if table.place(own) is not None or table.place(sections.LOAD_IN_WATTS) is None else sections.LOAD_IN_WATTS
    )
    ticks: list[int] = []
    loads = table.columns([TIME, column])
    tick_s, unit, (low, high) = process.tick_s, process.load.unit, process.load.stored_span
    for (line, _), time, load in zip(table.rows, *loads, strict=True):
        where = f"{table.where}, line {line}"
        if not 0 <= time < declaration.LAST_TICK * tick_s:
            raise LoadFileError(f"{where}: {time:g} s is outside 0 to {declaration.LAST_TICK * tick_s:g} s")
        if not low <= load <= high:
            raise LoadFileError(f"{where}: {load:g} {unit} is outside {low:g} to {high:g} {unit}")
        tick = round(time / tick_s)
        if abs(tick * tick_s - time) > 1e-6:
            raise LoadFileError(f"{where}: {time:g} s is not a multiple of {tick_s} s")
        if not ticks and tick != 0:
            raise LoadFileError(f"{where}: the first step is at {time:g} s; begin at 0 s")
        if ticks and tick <= ticks[-1]:
            raise LoadFileError(f"{where}: {time:g} s does not come after {ticks[-1] * tick_s:g} s; sort by time_s")
        ticks.append(tick)
    return LoadProfile(tuple(ticks), tuple(loads[1]))
