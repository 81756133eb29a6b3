"""Sinks that write the files of a run while it runs, row group by row group, in constant memory.

Space on the disk is reserved for ending a run in good order when the disk is full.
"""

import errno
import os
import tempfile
from collections import deque
from functools import partial
from pathlib import Path
from typing import BinaryIO, Final, Generic, TypeVar

import pyarrow as pa
import pyarrow.parquet as pq

from coldloop.errors import ResultsError, UsageError
from coldloop.process.declaration import Process
from coldloop.registers.audit import Event
from coldloop.registers.optimizer_plc import Optimization
from coldloop_rig.results.columns import EVENTS, STATION, TRACE, UPDATES, files_of
from coldloop_rig.results.indicators import StageCost
from coldloop_rig.results.recording import SampleBlock, Sink, joined
from coldloop_rig.results.tables import DrivingHistory, events_table, station_table, trace_table, updates_table

RESERVED_BYTES: Final = 24 * 1024**2
"""A row group of the trace (9 MB), the index of 1,000 h (4 MB), the summary and the figures."""
FULL: Final = (errno.ENOSPC, errno.EDQUOT)


class DiskReserve:
    """An invisible file of `RESERVED_BYTES`, which the system frees at the latest when the program ends.

    Raises:
        UsageError: There is less free space than that.
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


class ReservedFile:
    """A file for writing that draws on a reserve when the disk is full."""

    def __init__(self, path: Path, reserve: DiskReserve) -> None:
        self._file = path.open("wb", buffering=0)
        self._reserve = reserve

    def write(self, data: bytes) -> int:
        """Write all of `data`. Raises OSError if it cannot be written, not even with the reserve."""
        rest = memoryview(data).cast("B")
        while rest:
            try:
                rest = rest[self._file.write(rest) :]
            except OSError as error:
                if error.errno not in FULL or self._reserve.released:
                    raise
                self._reserve.release()
        return len(data)

    def tell(self) -> int:
        """Return the position."""
        return self._file.tell()

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def closed(self) -> bool:
        """Whether the file is closed."""
        return self._file.closed


T = TypeVar("T")

GROUP_TICKS: Final = 32_768
"""Ticks of a row group of the trace, 2.3 h: its columns fit into 9 MB, and the index of 1,000 h into 4 MB."""
HELD_BACK_TICKS: Final = 2048
"""The newest ticks wait until it is known which of the updates were played."""
SEARCHED: Final = ["tick", "time_s"]
"""Columns whose range is in the index; more would make it, and the memory of a long run, several times as large."""
GROUP_ROWS: Final = 16_384
"""Rows of a row group of updates and events."""


class _FileSink(Sink, Generic[T]):
    """Writes a file of a run, with the columns that are declared for its name, in row groups of `enough` rows."""

    def __init__(self, path: Path, reserve: DiskReserve, process: Process, enough: int) -> None:
        self._file = ReservedFile(path, reserve)
        self._path, self._reserve, self._process, self._enough = path, reserve, process, enough
        self._taken: list[T] = []
        self._rows = 0
        schema = files_of(process)[path.name].schema
        self._writer = pq.ParquetWriter(
            pa.PythonFile(self._file, mode="w"), schema, compression="zstd", write_statistics=SEARCHED,
            use_dictionary=[field.name for field in schema if pa.types.is_string(field.type)],
        )  # fmt: skip

    def _take(self, part: T, rows: int = 1) -> None:
        """Take rows.

        Raises:
            OSError: They cannot be written.
            ResultsError: The disk is full; what was written is whole, and the file can be closed.
        """
        self._taken.append(part)
        self._rows += rows
        if self._rows >= self._enough:
            self._writer.write_table(self._table(self._group()))
            if self._reserve.released:
                raise ResultsError(f"{self._path.parent}: the disk is full; what was recorded before is kept")

    def _group(self) -> list[T]:
        """Return what is written now."""
        taken, self._taken, self._rows = self._taken, [], 0
        return taken

    def _table(self, parts: list[T]) -> pa.Table:
        raise NotImplementedError

    def close(self) -> None:
        """Write the rest, and the index that makes the file readable."""
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

    def __init__(self, folder: Path, reserve: DiskReserve, cost: StageCost) -> None:
        super().__init__(folder / TRACE, reserve, cost.process, GROUP_TICKS + HELD_BACK_TICKS)
        self._cost = cost
        self._driving = DrivingHistory(cost.process)
        self._updates: deque[Optimization] = deque()

    def update(self, update: Optimization) -> None:
        """Take an update, which the ticks from its own on refer to."""
        self._updates.append(update)

    def event(self, service: str, event: Event) -> None:
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


class _StationFile(_FileSink[SampleBlock]):
    def block(self, block: SampleBlock) -> None:
        self._take(block, len(block.load))

    def _table(self, parts: list[SampleBlock]) -> pa.Table:
        return station_table(joined(parts), self._process)


class StationSink(Sink):
    """Writes `station.parquet`, if there is a station."""

    def __init__(self, folder: Path, reserve: DiskReserve, process: Process) -> None:
        self._make = partial(_StationFile, folder / STATION, reserve, process, GROUP_TICKS)
        self._file: _StationFile | None = None

    def block(self, block: SampleBlock) -> None:
        """Take ticks."""
        if block.station.size:
            self._file = self._file or self._make()
            self._file.block(block)

    def close(self) -> None:
        """Write the rest."""
        if self._file is not None:
            self._file.close()


class UpdatesSink(_FileSink[Optimization]):
    """Writes `updates.parquet`."""

    def __init__(self, folder: Path, reserve: DiskReserve, process: Process) -> None:
        super().__init__(folder / UPDATES, reserve, process, GROUP_ROWS)

    def update(self, update: Optimization) -> None:
        """Take an update."""
        self._take(update)

    def _table(self, parts: list[Optimization]) -> pa.Table:
        return updates_table(parts, self._process)


class EventsSink(_FileSink[tuple[str, Event]]):
    """Writes `events.parquet`."""

    def __init__(self, folder: Path, reserve: DiskReserve, process: Process) -> None:
        super().__init__(folder / EVENTS, reserve, process, GROUP_ROWS)

    def event(self, service: str, event: Event) -> None:
        """Take an event."""
        self._take((service, event))

    def _table(self, parts: list[tuple[str, Event]]) -> pa.Table:
        return events_table(parts, self._process)
