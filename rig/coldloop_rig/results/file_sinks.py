"""Samples, updates and events as Arrow tables, and the sinks that write them while a run lasts, in constant memory.

The columns are those of `columns.py`, in the same order. Files are written row group by row group; space on the disk is
reserved for ending a run in good order when the disk is full.
"""

import errno
import math
import os
import tempfile
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Final, Generic, NamedTuple, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from coldloop.errors import ResultsError, UsageError
from coldloop.process import declaration, model_range
from coldloop.registers import common, control_plc, optimizer_plc, plant
from coldloop.service.journal import describe, utc_text
from coldloop_rig.results.columns import EVENTS, STATION, TRACE, UPDATES, RunFile, files_of, number_array, text_array
from coldloop_rig.results.recording import PLANT, SampleBlock, Sink, StageCost, joined

RESERVED_BYTES: Final = 24 * 1024**2
"""A row group of the trace (9 MB), the index of 1,000 h (4 MB), the summary and the figures."""
FULL: Final = (errno.ENOSPC, errno.EDQUOT)


class DiskReserve:
    """An invisible file of `RESERVED_BYTES`, which the system frees at the latest when the program ends.

    Raises UsageError: there is less free space than that.
    """

    def __init__(self, folder: Path) -> None:
        self._file: BinaryIO | None = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self.released = False
        try:
            os.posix_fallocate(self._file.fileno(), 0, RESERVED_BYTES)
        except AttributeError:  # not on every platform
            self.close()
        except OSError as error:
            self.close()
            if error.errno in FULL:
                raise UsageError(f"{folder}: less than {RESERVED_BYTES >> 20} MB free; choose another --out") from None

    def release(self) -> None:
        """Release the space: the disk is full otherwise."""
        self.released = True
        self.close()

    def close(self) -> None:
        """Release the space at the end of a run."""
        if self._file is not None:
            self._file.close()
            self._file = None


class ReservedFile(FileIO):
    """A file for writing that draws on a reserve when the disk is full."""

    def __init__(self, path: Path, reserve: DiskReserve) -> None:
        super().__init__(path, "wb")
        self._reserve = reserve

    def write(self, data: Any) -> int:  # noqa: ANN401 any buffer
        """Write all of `data`. Raises OSError if it cannot be written, not even with the reserve."""
        rest = memoryview(data).cast("B")
        while rest:
            try:
                rest = rest[super().write(rest) :]
            except OSError as error:
                if error.errno not in FULL or self._reserve.released:
                    raise
                self._reserve.release()
        return len(data)


T = TypeVar("T")

GROUP_TICKS: Final = 32_768
"""Ticks of a row group of the trace, 2.3 h: its columns fit into 9 MB, and the index of 1,000 h into 4 MB."""
HELD_BACK_TICKS: Final = 2048  # the newest ticks wait until it is known which of the updates were played
SEARCHED: Final = ["tick", "time_s"]
"""Columns whose range is in the index; more would make it, and the memory of a long run, several times as large."""
GROUP_ROWS: Final = 16_384  # rows of a row group of updates and events


class _FileSink(Sink, Generic[T]):
    """Writes a file of a run, with the columns that are declared for its name, in row groups of `enough` rows."""

    name: ClassVar[str]
    enough: int = GROUP_ROWS

    def __init__(self, folder: Path, reserve: DiskReserve, process: declaration.Process) -> None:
        self._file = ReservedFile(folder / self.name, reserve)
        self._folder, self._reserve, self._process = folder, reserve, process
        self._taken: list[T] = []
        self._rows = 0
        schema = files_of(process)[self.name].schema
        self._writer = pq.ParquetWriter(
            pa.PythonFile(self._file, mode="w"), schema, compression="zstd", write_statistics=SEARCHED,
            use_dictionary=[field.name for field in schema if pa.types.is_string(field.type)],
        )  # fmt: skip

    def _take(self, part: T, rows: int = 1) -> None:
        """Take rows.

        Raises OSError: they cannot be written; ResultsError: the disk is full; what was written is whole, and the file
        can be closed.
        """
        self._taken.append(part)
        self._rows += rows
        if self._rows >= self.enough:
            self._writer.write_table(self._table(self._group()))
            if self._reserve.released:
                raise ResultsError(f"{self._folder}: the disk is full; what was recorded before is kept")

    def _group(self) -> list[T]:
        taken, self._taken, self._rows = self._taken, [], 0
        return taken

    def _table(self, parts: list[T]) -> pa.Table:
        raise NotImplementedError

    def close(self) -> None:
        try:
            if self._taken:
                self._writer.write_table(self._table(self._taken))
        finally:
            try:
                self._writer.close()
            finally:
                self._file.close()


class TraceSink(_FileSink[SampleBlock]):
    """Writes `trace.parquet`."""

    name = TRACE

    def __init__(self, folder: Path, reserve: DiskReserve, cost: StageCost) -> None:
        super().__init__(folder, reserve, cost.process)
        self.enough = GROUP_TICKS + HELD_BACK_TICKS
        self._cost = cost
        self._driving = DrivingHistory(cost.process)
        self._updates: deque[optimizer_plc.Optimization] = deque()

    def update(self, update: optimizer_plc.Optimization) -> None:
        """Take an update, which the ticks from its own on refer to."""
        self._updates.append(update)

    def event(self, service: str, event: common.Event) -> None:
        """Take an event, which the ticks from its own on refer to."""
        self._driving.event(service, event)

    def block(self, block: SampleBlock) -> None:
        """Take ticks."""
        self._take(block, len(block.load))

    def _group(self) -> list[SampleBlock]:
        group, rest = joined(self._taken).split(GROUP_TICKS)
        self._taken, self._rows = [rest], len(rest.load)
        return [group]

    def _table(self, parts: list[SampleBlock]) -> pa.Table:
        block = joined(parts)
        table = trace_table(block, self._updates, self._cost, self._driving)
        end = block.first + len(block.load)
        while len(self._updates) > 1 and self._updates[1].tick <= end:
            self._updates.popleft()
        self._driving.forget(end)
        return table


class StationSink(_FileSink[SampleBlock]):
    """Writes `station.parquet`; only for a plant that has a station, and leaves no file if it was never read."""

    name = STATION
    enough = GROUP_TICKS
    _is_read = False

    def block(self, block: SampleBlock) -> None:
        """Take ticks, if the station was read in them."""
        if block.station.size:
            self._is_read = True
            self._take(block, len(block.load))

    def close(self) -> None:
        """Write the rest."""
        super().close()
        if not self._is_read:
            (self._folder / self.name).unlink()

    def _table(self, parts: list[SampleBlock]) -> pa.Table:
        return station_table(joined(parts), self._process)


class UpdatesSink(_FileSink[optimizer_plc.Optimization]):
    """Writes `updates.parquet`."""

    name = UPDATES

    def update(self, update: optimizer_plc.Optimization) -> None:
        """Take an update."""
        self._take(update)

    def _table(self, parts: list[optimizer_plc.Optimization]) -> pa.Table:
        return updates_table(parts, self._process)


class EventsSink(_FileSink[tuple[str, common.Event]]):
    """Writes `events.parquet`."""

    name = EVENTS

    def event(self, service: str, event: common.Event) -> None:
        """Take an event."""
        self._take((service, event))

    def _table(self, parts: list[tuple[str, common.Event]]) -> pa.Table:
        return events_table(parts, self._process)


DRIVERS: Final[Mapping[int, str]] = {
    control_plc.Mode.MPC: "optimizer",
    control_plc.Mode.REST: "optimizer",
    control_plc.Mode.HOLD: "nobody",
    control_plc.Mode.CLASSICAL: "loops",
    control_plc.Mode.MANUAL: "operator",
}
"""Source of the applied inputs in each mode; "nobody" while the last ones are held."""


class Driving(NamedTuple):
    """State of the control PLC from one tick on."""

    tick: int = 0
    mode: int | None = None
    cause: int = control_plc.Cause.NONE
    bad: frozenset[int] = frozenset()
    """Outputs whose measurement was substituted."""


class DrivingHistory:
    """Takes events of a process in the order of each journal; returns the columns of ticks that do not come back.

    A restarted control PLC may resume some ticks back: its later events hold from there on.
    """

    def __init__(self, process: declaration.Process) -> None:
        self.process = process
        self._states = [Driving()]
        self._faults: dict[int, list[common.Event]] = {output: [] for output in process.controlled}
        self._held = dict.fromkeys(process.controlled, math.nan)
        """Values that frozen sensors show, by output."""

    def event(self, service: str, event: common.Event) -> None:
        """Take an event."""
        if service == PLANT:
            if event.kind == common.EventKind.SESSION:  # it begins with healthy sensors
                self._faults = {output: [] for output in self._faults}
            elif event.kind == common.EventKind.SENSOR_FAULT and event.subject in self._faults:
                self._faults[event.subject].append(event)
            return
        last = self._states[-1]
        if event.kind == common.EventKind.MODE:
            self._change(last._replace(tick=event.tick, mode=event.subject, cause=event.cause))
        elif event.kind == common.EventKind.SENSOR and event.subject < len(self.process.outputs):
            bad = last.bad | {event.subject} if event.cause else last.bad - {event.subject}
            self._change(last._replace(tick=event.tick, bad=bad))

    def _change(self, state: Driving) -> None:
        while self._states[-1].tick >= state.tick and len(self._states) > 1:
            self._states.pop()
        self._states.append(state)

    def columns(self, ticks: NDArray[np.int64]) -> list[pa.Array]:
        """Return mode, cause, driver and bad sensors at these ticks, which are in a row."""
        starts = [state.tick for state in self._states[1:]]
        places = np.searchsorted(starts, ticks, side="right")
        texts: list[tuple[str | None, ...]] = []
        for _, mode, cause, outputs in self._states:
            bad = " ".join(self.process.output_names[output] for output in sorted(outputs))
            words = (
                (None,) * 3
                if mode is None
                else (control_plc.Mode.word_of(mode), control_plc.Cause.word_of(cause), DRIVERS.get(mode))
            )
            texts.append((*words, bad))
        return [text_array(each, places) for each in zip(*texts, strict=True)]

    def measured(self, ticks: NDArray[np.int64], y: NDArray[np.float32]) -> list[pa.Array]:
        """Return what sensors of banded outputs showed, null where no number; `y` (N, outputs) is without faults."""
        first, end = int(ticks[0]), int(ticks[-1]) + 1
        columns = []
        for output, faults in self._faults.items():
            values, before = y[:, output].copy(), None
            for fault, until in zip(faults, [*(later.tick for later in faults[1:]), end], strict=False):
                begin, stop = np.clip([fault.tick - first, until - first], 0, len(values))
                if fault.cause == plant.SensorFaultKind.FROZEN and first <= fault.tick < end:
                    # the value shown then: the output itself, or that of the previous fault
                    self._held[output] = _shown_by(before, values[fault.tick - first], self._held[output])
                if fault.cause and begin < stop:
                    values[begin:stop] = _shown_by(fault, 0.0, self._held[output])
                before = fault
            columns.append(number_array(values, pa.float32(), np.isnan(values)))
        return columns

    def forget(self, tick: int) -> None:
        """Forget what concerns ticks before `tick` only."""
        keep = bisect_right([state.tick for state in self._states[1:]], tick)
        del self._states[:keep]
        for faults in self._faults.values():
            del faults[: max(0, bisect_right([fault.tick for fault in faults], tick) - 1)]


def _shown_by(fault: common.Event | None, true: float, held: float) -> float:
    """Return what a sensor shows by the event of its last fault."""
    if fault is None or fault.cause == plant.SensorFaultKind.NONE:
        return float(true)
    if fault.cause == plant.SensorFaultKind.NOT_A_NUMBER:
        return math.nan
    return held if fault.cause == plant.SensorFaultKind.FROZEN else fault.value


def trace_table(
    block: SampleBlock, updates: Sequence[optimizer_plc.Optimization], cost: StageCost, driving: DrivingHistory
) -> pa.Table:
    """Return the trace of a block; `updates` are those played, from the last before it on; `driving` has the events."""
    ticks, process = block.first + np.arange(len(block.load)), driving.process
    outside: Any = (
        model_range.recorded_model_range(block.x, block.station) if process.has_station else np.zeros(len(ticks))
    )
    columns = [
        ticks, ticks * process.tick_s, *block.rows.T, *driving.measured(ticks, block.y), *driving.columns(ticks),
        cost.of(block), *_held(ticks, updates, process.tick_s), (outside, np.isnan(block.load)),
    ]  # fmt: skip
    return _of_arrays(columns, files_of(process)[TRACE])


def station_table(block: SampleBlock, process: declaration.Process) -> pa.Table:
    """Return what is known of the station at the ticks of a block that has one."""
    ticks = block.first + np.arange(len(block.load))
    unknown = np.isnan(block.station[:, 0])
    known = ((np.nan_to_num(column), unknown) for column in block.station.T)
    return _of_arrays([ticks, ticks * process.tick_s, *known], files_of(process)[STATION])


def _of_arrays(columns: Sequence[Any], file: RunFile) -> pa.Table:
    """Return the table of columns: Arrow arrays, numbers, or numbers with a mask of those that are unknown."""
    schema = file.schema
    arrays = [
        data if isinstance(data, pa.Array)
        else number_array(data[0], field.type, data[1]) if isinstance(data, tuple)
        else number_array(data, field.type)
        for field, data in zip(schema, columns, strict=True)
    ]  # fmt: skip
    return pa.table(arrays, schema)


def _held(ticks: Any, updates: Sequence[optimizer_plc.Optimization], tick_s: float) -> list[Any]:  # noqa: ANN401 an array of integers
    """Return the columns that change at updating instants only, with a mask of the ticks before the first.

    The time of an update that a load step has cut off belongs to the one before.
    """
    latest = np.searchsorted([row.tick for row in updates], ticks, side="right") - 1
    none = latest < 0
    rows = [(row.update, row.tau_u * tick_s, row.iterations, row.j_effective) for row in updates] or [(0, 0.0, 0, 0.0)]
    return [(np.asarray(column)[np.maximum(latest, 0)], none) for column in zip(*rows, strict=True)]


def updates_table(updates: Sequence[optimizer_plc.Optimization], process: declaration.Process) -> pa.Table:
    """Return the table of updates."""
    tick_s = process.tick_s
    rows = [{**row._asdict(), "time_s": row.tick * tick_s, "tau_u_s": row.tau_u * tick_s} for row in updates]
    return _of_rows(rows, files_of(process)[UPDATES])


def events_table(events: Sequence[tuple[str, common.Event]], process: declaration.Process) -> pa.Table:
    """Return the table of events."""
    rows = [
        {
            **text._asdict(), "service": service, "number": event.number, "boot": event.boot, "utc": utc_text(event),
            "tick": event.tick, "time_s": event.tick * process.tick_s, "value": event.value if text.value else None,
        }
        for service, event in events for text in [describe(event, process)]
    ]  # fmt: skip
    return _of_rows(rows, files_of(process)[EVENTS])


def _of_rows(rows: Sequence[dict[str, Any]], file: RunFile) -> pa.Table:
    columns: list[Any] = []
    for column in file.columns:
        values, is_text = [row[column.name] for row in rows], pa.types.is_string(column.kind)
        unknown = np.array([value is None for value in values], bool)
        columns.append(text_array(values) if is_text else ([value or 0 for value in values], unknown))
    return _of_arrays(columns, file)
