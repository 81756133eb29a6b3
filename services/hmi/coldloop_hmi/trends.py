"""What the trends are drawn from: samples by tick in a bounded store, thinned without losing an excursion."""

import math
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from coldloop.process.declaration import Process
from coldloop.process.station import STATION_SIGNAL_NAMES
from coldloop.registers.control_plc import Mode, ProcessNow
from coldloop_hmi.quality import SOUND, Doubts, Quality

STATION_NAMES: Final = ("P12", "P11")
"""Signals of a refrigerator's station that are kept: high and low pressure."""
MOST_ROWS: Final = 65_536
SPARE_ROWS: Final = 4096
"""Rows that are removed at a time, so that removing costs little."""


class ModeInterval(NamedTuple):
    """A stretch of plant time with one mode."""

    start: float
    end: float
    mode: int


class Doubtful(NamedTuple):
    """A stretch of plant time in which the reading of an output is in doubt."""

    start: float
    end: float
    quality: Quality


class Gap(NamedTuple):
    """A stretch in which nothing was read: the ticks of the samples before and after it."""

    start: int
    end: int


Columns = dict[str, list[float | None]]
"""Values by signal; None where nothing was read."""


class TrendStore:
    """Samples of the process in the order of their ticks, at most `kept_s` of plant time of them."""

    def __init__(self, process: Process, kept_s: float) -> None:
        self._process = process
        self._kept_ticks = round(kept_s / process.tick_s)
        self.station_names = STATION_NAMES if process.has_station else ()
        self.names = ("load", *process.input_names, *process.output_names, "mode", *self.station_names)
        """Of its columns; `mode` is that of the fail-safe ladder."""
        self._places = tuple(map(STATION_SIGNAL_NAMES.index, self.station_names))
        self._no_station = [math.nan] * len(self._places)
        self.ticks = array("q")
        self._columns: dict[str, array[float]] = {name: array("f") for name in self.names}
        self._doubts: list[Doubts] = []
        self._gaps: list[Gap] = []

    def __len__(self) -> int:
        return len(self.ticks)

    @property
    def last_tick(self) -> int:
        """Tick of the newest sample; -1 when there is none."""
        return self.ticks[-1] if self.ticks else -1

    def clear(self) -> None:
        """Forget everything."""
        del self.ticks[:], self._doubts[:], self._gaps[:]
        for column in self._columns.values():
            del column[:]

    def add(
        self, process: ProcessNow, mode: int, doubts: Doubts = SOUND, station: Sequence[float] = (), *,
        is_after_gap: bool = False,
    ) -> None:  # fmt: skip
        """Add a sample; one that is not newer than the last one is left out.

        Args:
            process: The sample.
            mode: Of the fail-safe ladder.
            doubts: Outputs whose readings are in doubt.
            station: Signals of a refrigerator's station; empty, or all 0, of a plant without.
            is_after_gap: Between the last sample and this one nothing could be read.
        """
        if process.tick <= self.last_tick:
            return
        if is_after_gap and process.tick - self.last_tick > 1 and self.ticks:
            self._gaps.append(Gap(self.last_tick, process.tick))
        self.ticks.append(process.tick)
        self._doubts.append(doubts)
        kept = [station[place] for place in self._places] if any(station) else self._no_station
        values = (process.load, *process.u, *process.y, float(mode), *kept)
        for name, value in zip(self.names, values, strict=True):
            self._columns[name].append(value)
        self._trim()

    def _trim(self) -> None:
        excess = max(len(self.ticks) - MOST_ROWS, 0)
        oldest = bisect_left(self.ticks, self.ticks[-1] - self._kept_ticks)
        drop = max(excess, oldest)
        if drop >= SPARE_ROWS or (drop and 2 * drop >= len(self.ticks)):
            del self.ticks[:drop], self._doubts[:drop]
            for column in self._columns.values():
                del column[:drop]
            self._gaps = [gap for gap in self._gaps if gap.start >= self.ticks[0]]

    def between(self, start: int, end: int) -> range:
        """Return the rows from tick `start` to tick `end`."""
        return range(bisect_left(self.ticks, start), bisect_right(self.ticks, end))

    def column(self, name: str, rows: range) -> "array[float]":
        """Return values of a column."""
        return self._columns[name][rows.start : rows.stop]

    def gaps(self, start: int, end: int) -> list[Gap]:
        """Return the stretches in which nothing was read that reach into those from tick `start` to `end`."""
        return [gap for gap in self._gaps if gap.end > start and gap.start < end]

    def thinned(self, names: Sequence[str], start: int, end: int, points: int) -> tuple[list[float], Columns]:
        """Return times (s) and columns from tick `start` to `end`, of about `points` points.

        A longer stretch is reduced to the least and the largest value of each of `points / 2` intervals. Where a gap
        begins all columns have None.
        """
        rows, tick_s = self.between(start, end), self._process.tick_s
        times = [tick * tick_s for tick in self.ticks[rows.start : rows.stop]]
        columns = {name: self.column(name, rows) for name in names}
        return thin(times, columns, points, tick_s, [gap.end * tick_s for gap in self.gaps(start, end)])

    def modes(self, start: int, end: int) -> list[ModeInterval]:
        """Return the modes between two ticks, stretch by stretch."""
        rows, tick_s = self.between(start, end), self._process.tick_s
        after_gap = {gap.end * tick_s for gap in self.gaps(start, end)}
        found: list[ModeInterval] = []
        for tick, value in zip(self.ticks[rows.start : rows.stop], self.column("mode", rows), strict=True):
            time, mode = tick * tick_s, int(value)
            if found and time not in after_gap:
                found[-1] = found[-1]._replace(end=time)
            if not found or found[-1].mode != mode or time in after_gap:
                found.append(ModeInterval(time, time, mode))
        return found

    def doubtful(self, start: int, end: int) -> dict[str, list[Doubtful]]:
        """Return the intervals in which readings of outputs are in doubt between two ticks, by name.

        Each lasts until the first sample of another quality, or a gap.
        """
        rows, tick_s = self.between(start, end), self._process.tick_s
        after_gap = {gap.end for gap in self.gaps(start, end)}
        found: dict[str, list[Doubtful]] = {}
        before: dict[str, Quality] = {}
        last = 0
        for tick, doubts in zip(self.ticks[rows.start : rows.stop], self._doubts[rows.start : rows.stop], strict=True):
            if doubts != SOUND or before:
                reach, now = (last + 1 if tick in after_gap else tick) * tick_s, doubts.named(self._process)
                for name in before:
                    found[name][-1] = found[name][-1]._replace(end=reach)
                for name, quality in now.items():
                    if before.get(name) != quality or tick in after_gap:
                        found.setdefault(name, []).append(Doubtful(tick * tick_s, tick * tick_s, quality))
                before = now
            last = tick
        for name in before:
            found[name][-1] = found[name][-1]._replace(end=(last + 1) * tick_s)
        return found

    def doubts_at(self, row: int) -> dict[str, Quality]:
        """Return the outputs whose readings are in doubt, and how."""
        return self._doubts[row].named(self._process)


def thin(
    times: Sequence[float], columns: Mapping[str, Sequence[float]], points: int, tick_s: float,
    edges: Sequence[float] = (),
) -> tuple[list[float], Columns]:  # fmt: skip
    """Reduce columns to the least and the largest value of each of `points / 2` intervals, if they are longer.

    No interval reaches across one of the times `edges`, in order, that end a gap; a tick after it begins there is None.
    """
    cuts = [0, *(bisect_left(times, edge) for edge in edges), len(times)]
    found: list[float] = []
    reduced: Columns = {name: [] for name in columns}
    for first, end in pairwise(cuts):
        if first == end:
            continue
        if found:
            found.append(found[-1] + tick_s)
            for values in reduced.values():
                values.append(None)
        share = max(2, points * (end - first) // len(times))
        piece_times, piece = _thin_piece(times[first:end], {n: c[first:end] for n, c in columns.items()}, share)
        found += piece_times
        for name in reduced:
            reduced[name] += piece[name]
    return found, reduced


def _thin_piece(
    times: Sequence[float], columns: Mapping[str, Sequence[float]], points: int
) -> tuple[list[float], dict[str, list[float]]]:
    count = len(times)
    if count <= points:
        return list(times), {name: [rounded(value) for value in column] for name, column in columns.items()}
    every = -(-count // max(1, points // 2))
    starts = range(0, count, every)
    thinned_times: list[float] = []
    for first in starts:
        thinned_times += [times[first], times[min(first + every, count) - 1]]
    thinned: dict[str, list[float]] = {}
    for name, column in columns.items():
        values: list[float] = []
        for first in starts:
            part = column[first : first + every]
            least, largest = rounded(min(part)), rounded(max(part))
            values += [least, largest] if part[0] <= part[-1] else [largest, least]
        thinned[name] = values
    return thinned_times, thinned


def rounded(value: float) -> float:
    """Return a single-precision number with the digits that it has."""
    return float(f"{value:.7g}")


def mode_name(mode: int) -> str:
    """Return the word for a mode of the ladder."""
    return Mode(mode).name.lower() if mode in Mode.__members__.values() else str(mode)
