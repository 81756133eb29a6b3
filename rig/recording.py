"""What a run leaves behind: the physical trace, tick by tick, and what the optimiser did, update by update."""

import hashlib
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import PlantSample

FloatArray = NDArray[np.float32]


class LinkStatistics(NamedTuple):
    """How well a run kept time, as the control PLC counts it."""

    deadline_misses: int = 0
    overruns: int = 0
    lateness_max_ms: float = 0.0
    lateness_p99_ms: float = 0.0


class Recorder:
    """Collects samples and updates while a run goes on; `progress` is called after each sample."""

    def __init__(self, ticks: int, progress: Callable[["Recorder"], None] | None = None) -> None:
        self.ticks = ticks
        self.samples: list[PlantSample] = []
        self.updates: list[Optimization] = []
        self.link = LinkStatistics()
        self._progress = progress
        self._began = self._last = time.monotonic()

    def begin(self) -> None:
        """Begin to count real time: the first tick is about to be done."""
        self._began = self._last = time.monotonic()

    @property
    def wall_seconds(self) -> float:
        """Real time from the beginning to the last sample."""
        return self._last - self._began

    def sample(self, sample: PlantSample) -> None:
        """Take the next tick."""
        self.samples.append(sample)
        self._last = time.monotonic()
        if self._progress is not None:
            self._progress(self)

    def update(self, update: Optimization) -> None:
        """Take the next update."""
        self.updates.append(update)

    def recording(self) -> "Recording":
        """Return what was recorded, with the updates whose sequence was played within the run.

        An update that a load step has cut off is not among them.
        """
        load, u, y, x = (
            np.array([getattr(sample, name) for sample in self.samples], dtype=np.float32)
            for name in ("load", "u", "y", "x")
        )
        ends = [later.tick for later in self.updates[1:]] + [self.ticks]
        played = [
            update
            for update, end in zip(self.updates, ends, strict=False)
            if update.tick + update.tau_u <= end and update.tick + update.tau_u < self.ticks
        ]
        return Recording(load, u, y, x, played, self.link)


class Recording(NamedTuple):
    """A finished run of N ticks."""

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
    def trace_sha256(self) -> str:
        """SHA-256 over load, inputs, outputs and states of all ticks, as little-endian single precision."""
        rows = np.hstack([self.load[:, None], self.u, self.y, self.x])
        return hashlib.sha256(np.ascontiguousarray(rows, dtype="<f4").tobytes()).hexdigest()
