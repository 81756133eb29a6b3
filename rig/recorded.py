"""What a run leaves behind: the physical trace, tick by tick, and what the optimiser did, update by update."""

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.process import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import PlantSample

FloatArray = NDArray[np.float32]


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

    @classmethod
    def of(cls, samples: Sequence[PlantSample]) -> "SampleBlock":
        """Return samples as a block."""
        load, u, y, x = (
            np.array([getattr(sample, name) for sample in samples], dtype=np.float32)
            for name in ("load", "u", "y", "x")
        )
        return cls(samples[0].tick, load, u, y, x)

    def split(self, ticks: int) -> tuple["SampleBlock", "SampleBlock"]:
        """Return the first `ticks` ticks, and the rest."""
        parts = self[1:]
        return (
            SampleBlock(self.first, *(part[:ticks] for part in parts)),
            SampleBlock(self.first + ticks, *(part[ticks:] for part in parts)),
        )

    @property
    def rows(self) -> NDArray[np.float32]:
        """Load, inputs, outputs and states side by side, shape (N, 54), as the digest of a trace takes them."""
        side_by_side = np.hstack([self.load[:, None], self.u, self.y, self.x])
        return np.ascontiguousarray(side_by_side, dtype="<f4")


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

    @property
    def block(self) -> SampleBlock:
        """The trace as one block."""
        return SampleBlock(0, self.load, self.u, self.y, self.x)

    @property
    def trace_sha256(self) -> str:
        """SHA-256 over load, inputs, outputs and states of all ticks, as little-endian single precision."""
        return hashlib.sha256(self.block.rows.tobytes()).hexdigest()
