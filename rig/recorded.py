"""What a run leaves behind: the physical trace, tick by tick, and what the optimiser did, update by update."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES, STATION_SIGNAL_NAMES
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
    """Inputs applied, shape (N, 3)."""
    y: FloatArray
    """Measured outputs, shape (N, 22)."""
    x: FloatArray
    """Simulated states, shape (N, 28)."""
    station: FloatArray = NO_STATION
    """Signals, mode and alarms of the compression station, shape (N, 21); (0, 0) for a cold box alone."""

    @classmethod
    def of(cls, samples: Sequence[PlantSample], stations: Mapping[int, StationSample] | None = None) -> "SampleBlock":
        """Return samples, and what is known of the station at their ticks, as a block."""
        load, u, y, x = (
            np.array([getattr(sample, name) for sample in samples], dtype=np.float32)
            for name in ("load", "u", "y", "x")
        )
        if not stations:
            return cls(samples[0].tick, load, u, y, x)
        station = np.full((len(samples), STATION_COLUMNS), np.nan, dtype=np.float32)
        for row, sample in enumerate(samples):
            if known := stations.get(sample.tick):
                station[row] = (*known.signals, known.mode, known.alarms)
        return cls(samples[0].tick, load, u, y, x, station)

    def split(self, ticks: int) -> tuple["SampleBlock", "SampleBlock"]:
        """Return the first `ticks` ticks, and the rest."""
        parts = self[1:]
        return (
            SampleBlock(self.first, *(part[:ticks] for part in parts)),
            SampleBlock(self.first + ticks, *(part[ticks:] for part in parts)),
        )

    @property
    def rows(self) -> NDArray[np.float32]:
        """Load, inputs, outputs and states side by side, shape (N, 54)."""
        side_by_side = np.hstack([self.load[:, None], self.u, self.y, self.x])
        return np.ascontiguousarray(side_by_side, dtype="<f4")

    @property
    def digested(self) -> bytes:
        """What the digest of a trace takes: the rows, and after each that of the station where there is one."""
        if not self.station.size:
            return self.rows.tobytes()
        return np.ascontiguousarray(np.hstack([self.rows, self.station]), dtype="<f4").tobytes()


def joined(blocks: Sequence[SampleBlock]) -> SampleBlock:
    """Return blocks that follow each other as one."""
    if not blocks:
        sizes = (len(INPUT_NAMES), len(OUTPUT_NAMES), len(STATE_NAMES))
        return SampleBlock(0, np.empty(0, np.float32), *(np.empty((0, size), np.float32) for size in sizes))
    columns = (np.concatenate(parts) for parts in zip(*(block[1:] for block in blocks), strict=True))
    return SampleBlock(blocks[0].first, *columns)


class Recording(NamedTuple):
    """A finished run of N ticks in memory."""

    load: FloatArray
    """W, shape (N,)."""
    u: FloatArray
    """Inputs applied, shape (N, 3)."""
    y: FloatArray
    """Measured outputs, shape (N, 22)."""
    x: FloatArray
    """Simulated states, shape (N, 28)."""
    updates: list[Optimization]
    link: LinkStatistics
    station: FloatArray = NO_STATION
    """As in `SampleBlock`."""

    @property
    def block(self) -> SampleBlock:
        """The trace as one block."""
        return SampleBlock(0, self.load, self.u, self.y, self.x, self.station)

    @property
    def trace_sha256(self) -> str:
        """SHA-256 over load, inputs, outputs, states and station of all ticks, as little-endian single precision."""
        return hashlib.sha256(self.block.digested).hexdigest()
