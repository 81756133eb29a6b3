"""What a run leaves behind: the physical trace, tick by tick, and what the optimiser did, update by update."""

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process.station import STATION_SIGNAL_NAMES
from coldloop.registers.audit import Event
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import PlantSample, StationSample

FloatArray = NDArray[np.float32]

NO_STATION: FloatArray = np.empty((0, 0), np.float32)
STATION_COLUMNS = len(STATION_SIGNAL_NAMES) + 2


class LinkStatistics(NamedTuple):
    """How well a run kept time, as the control PLC counts it."""

    deadline_misses: int = 0
    overruns: int = 0
    lateness_max_ms: float = 0.0
    lateness_p99_ms: float = 0.0


class SampleBlock(NamedTuple):
    """N ticks in a row."""

    first: int
    """Tick of the first row."""
    load: FloatArray
    """W, shape (N,)."""
    u: FloatArray
    """Inputs applied, shape (N, inputs)."""
    y: FloatArray
    """Measured outputs, shape (N, outputs)."""
    x: FloatArray
    """Simulated states, shape (N, states)."""
    station: FloatArray = NO_STATION
    """Signals, mode and alarms of the compression station, shape (N, 21); (0, 0) for a cold box alone."""

    @classmethod
    def of(cls, samples: Sequence[PlantSample]) -> "SampleBlock":
        """Return samples that follow each other as a block."""
        pending = PendingTicks(samples[0].tick)
        pending.extend(len(samples), samples[0])
        for sample in samples:
            pending.put(sample, None)
        return pending.take(len(samples))

    def split(self, ticks: int) -> tuple["SampleBlock", "SampleBlock"]:
        """Return the first `ticks` ticks, and the rest."""
        parts = self[1:]
        return (
            SampleBlock(self.first, *(part[:ticks] for part in parts)),
            SampleBlock(self.first + ticks, *(part[ticks:] for part in parts)),
        )

    @property
    def rows(self) -> NDArray[np.float32]:
        """Load, inputs, outputs and states side by side, shape (N, signals)."""
        side_by_side = np.hstack([self.load[:, None], self.u, self.y, self.x])
        return np.ascontiguousarray(side_by_side, dtype="<f4")

    @property
    def digested(self) -> bytes:
        """What the digest of a trace takes: the rows, and after each that of the station where there is one."""
        if not self.station.size:
            return self.rows.tobytes()
        return np.ascontiguousarray(np.hstack([self.rows, self.station]), dtype="<f4").tobytes()


class PendingTicks:
    """The newest ticks of a run, in a row, which may still be replaced; `first` is the oldest of them."""

    def __init__(self, first: int = 0) -> None:
        self._parts: list[FloatArray] = []
        self._has_station = False
        self.first, self.count = first, 0

    def extend(self, ticks: int, like: PlantSample | SampleBlock) -> None:
        """Add ticks of which nothing is known, of as many signals as a sample or a block has."""
        end = self.count + ticks
        if not self._parts:
            sizes = (1, *(np.shape(part)[-1] for part in (like.u, like.y, like.x)), STATION_COLUMNS)
            self._parts = [np.empty((max(2048, end), size), np.float32) for size in sizes]
        if end > len(self._parts[0]):
            self._parts = [np.resize(part, (2 * end, part.shape[1])) for part in self._parts]
        for part in self._parts:
            part[self.count : end] = np.nan
        self.count = end

    def put(self, sample: PlantSample, station: StationSample | None) -> bool:
        """Put a tick where it belongs; return whether nothing was known of it before."""
        row = sample.tick - self.first
        load, u, y, x, warm = self._parts
        unknown = bool(np.isnan(load[row, 0]))
        load[row, 0], u[row], y[row], x[row] = sample.load, sample.u, sample.y, sample.x
        if station is not None:
            self._has_station = True
            warm[row] = (*station.signals, station.mode, station.alarms)
        return unknown

    def put_block(self, block: SampleBlock) -> None:
        """Put ticks in a row where they belong."""
        rows = slice(block.first - self.first, block.first - self.first + len(block.load))
        load, u, y, x, warm = self._parts
        load[rows, 0], u[rows], y[rows], x[rows] = block.load, block.u, block.y, block.x
        if block.station.size:
            self._has_station = True
            warm[rows] = block.station

    def take(self, ticks: int) -> SampleBlock:
        """Take the oldest ticks away."""
        ticks = min(ticks, self.count)
        load, u, y, x, warm = (part[:ticks].copy() for part in self._parts)
        for part in self._parts:
            part[: self.count - ticks] = part[ticks : self.count].copy()
        first, self.first, self.count = self.first, self.first + ticks, self.count - ticks
        return SampleBlock(first, load[:, 0], u, y, x, warm if self._has_station else NO_STATION)


def joined(blocks: Sequence[SampleBlock]) -> SampleBlock:
    """Return blocks that follow each other as one."""
    if not blocks:
        return SampleBlock(0, np.empty(0, np.float32), *(np.empty((0, 0), np.float32) for _ in range(3)))
    columns = (np.concatenate(parts) for parts in zip(*(block[1:] for block in blocks), strict=True))
    return SampleBlock(blocks[0].first, *columns)


class Recording(NamedTuple):
    """A finished run of N ticks in memory."""

    load: FloatArray
    """W, shape (N,)."""
    u: FloatArray
    """Inputs applied, shape (N, inputs)."""
    y: FloatArray
    """Measured outputs, shape (N, outputs)."""
    x: FloatArray
    """Simulated states, shape (N, states)."""
    updates: list[Optimization]
    link: LinkStatistics
    station: FloatArray = NO_STATION
    """As in `SampleBlock`."""
    events: Sequence[tuple[str, Event]] = ()
    """Of the journals, with the service that each is of."""

    @property
    def block(self) -> SampleBlock:
        """The trace as one block."""
        return SampleBlock(0, self.load, self.u, self.y, self.x, self.station)

    @property
    def trace_sha256(self) -> str:
        """SHA-256 over load, inputs, outputs, states and station of all ticks, as little-endian single precision."""
        return hashlib.sha256(self.block.digested).hexdigest()
