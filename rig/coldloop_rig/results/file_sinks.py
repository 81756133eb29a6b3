"""Sinks that write the files of a run while it runs, row group by row group, in constant memory."""

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Generic, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from coldloop.errors import ResultsError
from coldloop.process.declaration import Process
from coldloop.registers.audit import Event
from coldloop.registers.optimizer_plc import Optimization
from coldloop_rig.results.columns import EVENTS, STATION, TRACE, UPDATES, files_of
from coldloop_rig.results.disk_reserve import DiskReserve, ReservedFile
from coldloop_rig.results.driving import DrivingHistory
from coldloop_rig.results.indicators import StageCost
from coldloop_rig.results.recorded import joined
from coldloop_rig.results.recording import SampleBlock, Sink
from coldloop_rig.results.tables import events_table, station_table, trace_table, updates_table

T = TypeVar("T")

GROUP_TICKS: Final = 32_768
"""Ticks of a row group of the trace, 2.3 h: its columns fit into 9 MB, and the index of 1,000 h into 4 MB."""
HELD_BACK_TICKS: Final = 2048
"""The newest ticks wait until it is known which of the updates were played."""
SEARCHED: Final = ["tick", "time_s"]
"""Columns whose range is in the index; more would make it, and the memory of a long run, several times as large."""
GROUP_ROWS: Final = 16_384
"""Rows of a row group of updates and events."""


class ParquetFile:
    """A file of a run, with the columns that are declared for its name."""

    def __init__(self, path: Path, reserve: DiskReserve, process: Process) -> None:
        self._file = ReservedFile(path, reserve)
        self._reserve = reserve
        self._path = path
        schema = files_of(process)[path.name].schema
        self._writer = pq.ParquetWriter(
            pa.PythonFile(self._file, mode="w"), schema, compression="zstd", write_statistics=SEARCHED,
            use_dictionary=[field.name for field in schema if pa.types.is_string(field.type)],
        )  # fmt: skip

    def write(self, table: pa.Table) -> None:
        """Write a row group.

        Raises:
            OSError: It cannot be written.
        """
        self._writer.write_table(table)

    def check(self) -> None:
        """Return whether more can be written.

        Raises:
            ResultsError: The disk is full; what was written is whole, and the file can be closed.
        """
        if self._reserve.released:
            raise ResultsError(f"{self._path.parent}: the disk is full; what was recorded before is kept")

    def close(self) -> None:
        """Write the index that makes the file readable, and close it."""
        try:
            self._writer.close()
        finally:
            self._file.close()


class TraceSink(Sink):
    """Writes `trace.parquet`."""

    def __init__(self, folder: Path, reserve: DiskReserve, cost: StageCost) -> None:
        self._file = ParquetFile(folder / TRACE, reserve, cost.process)
        self._cost = cost
        self._blocks: list[SampleBlock] = []
        self._driving = DrivingHistory(cost.process)
        self._updates: deque[Optimization] = deque()

    def update(self, update: Optimization) -> None:
        """Take an update, which the ticks from its own on refer to."""
        self._updates.append(update)

    def event(self, service: str, event: Event) -> None:
        """Take an event, which the ticks from its own on refer to."""
        self._driving.event(service, event)

    def block(self, block: SampleBlock) -> None:
        """Take ticks; write them when they are many."""
        self._blocks.append(block)
        if sum(len(one.load) for one in self._blocks) >= GROUP_TICKS + HELD_BACK_TICKS:
            group, rest = joined(self._blocks).split(GROUP_TICKS)
            self._blocks = [rest]
            self._write(group)
            self._file.check()

    def _write(self, block: SampleBlock) -> None:
        table = trace_table(block, self._updates, self._cost, self._driving)
        end = block.first + len(block.load)
        while len(self._updates) > 1 and self._updates[1].tick <= end:
            self._updates.popleft()
        self._driving.forget(end)
        self._file.write(table)

    def close(self) -> None:
        """Write the rest."""
        try:
            if self._blocks:
                self._write(joined(self._blocks))
        finally:
            self._file.close()


class StationSink(Sink):
    """Writes `station.parquet`, if there is a station."""

    def __init__(self, folder: Path, reserve: DiskReserve, process: Process) -> None:
        self._path, self._reserve, self._process = folder / STATION, reserve, process
        self._file: ParquetFile | None = None
        self._blocks: list[SampleBlock] = []

    def block(self, block: SampleBlock) -> None:
        """Take ticks; write them when they are many."""
        if not block.station.size:
            return
        if self._file is None:
            self._file = ParquetFile(self._path, self._reserve, self._process)
        self._blocks.append(block)
        if sum(len(one.load) for one in self._blocks) >= GROUP_TICKS:
            self._write(self._file)
            self._file.check()

    def _write(self, file: ParquetFile) -> None:
        blocks, self._blocks = self._blocks, []
        file.write(station_table(joined(blocks), self._process))

    def close(self) -> None:
        """Write the rest."""
        if self._file is not None:
            try:
                if self._blocks:
                    self._write(self._file)
            finally:
                self._file.close()


class _RowFile(Generic[T]):
    """A file of rows that come one by one."""

    def __init__(
        self, path: Path, reserve: DiskReserve, process: Process, as_table: Callable[[Sequence[T], Process], pa.Table]
    ) -> None:
        self._file = ParquetFile(path, reserve, process)
        self._process, self._as_table = process, as_table
        self._rows: list[T] = []

    def add(self, row: T) -> None:
        """Take a row; write them when they are many."""
        self._rows.append(row)
        if len(self._rows) >= GROUP_ROWS:
            self._write()
            self._file.check()

    def _write(self) -> None:
        rows, self._rows = self._rows, []
        self._file.write(self._as_table(rows, self._process))

    def close(self) -> None:
        """Write the rest."""
        try:
            if self._rows:
                self._write()
        finally:
            self._file.close()


class UpdatesSink(Sink):
    """Writes `updates.parquet`."""

    def __init__(self, folder: Path, reserve: DiskReserve, process: Process) -> None:
        self._rows = _RowFile(folder / UPDATES, reserve, process, updates_table)

    def update(self, update: Optimization) -> None:
        """Write an update."""
        self._rows.add(update)

    def close(self) -> None:
        """Write the rest."""
        self._rows.close()


class EventsSink(Sink):
    """Writes `events.parquet`."""

    def __init__(self, folder: Path, reserve: DiskReserve, process: Process) -> None:
        self._rows = _RowFile(folder / EVENTS, reserve, process, events_table)

    def event(self, service: str, event: Event) -> None:
        """Write an event."""
        self._rows.add((service, event))

    def close(self) -> None:
        """Write the rest."""
        self._rows.close()
