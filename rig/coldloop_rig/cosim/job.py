"""A run to be done: configuration, scenario, how the programs are connected; and the signal that ends it early."""

import signal
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

from coldloop.config import Configuration
from coldloop.errors import RunInterruptedError
from coldloop.modbus.endpoints import Endpoint
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.results.way import Way
from coldloop_rig.settings import Settings

Conduct = Callable[[Recorder, Path], Awaitable[None]]
"""Does a run: takes its recorder and the folder of its results."""


@dataclass(frozen=True)
class Job:
    """A run to be done."""

    effective: Configuration[Settings]
    scenario: Scenario
    way: Way
    endpoints: tuple[Endpoint, ...] = ()
    """Of a rig that is up, to attach to."""
    conduct: Conduct | None = None
    """How it is done, in a way that the others do not describe."""
    optimizer: tuple[str, ...] = ()
    """A program that takes the place of our optimiser, with its options."""


class StopRequest:
    """A signal on its way to the run."""

    def __init__(self) -> None:
        self.error: RunInterruptedError | None = None
        self.recorder: Recorder | None = None
        self.cancel: Callable[[], object] | None = None

    def __call__(self, number: signal.Signals) -> None:
        """Take a signal (signal handler)."""
        self.error = RunInterruptedError(number.name, number)
        if self.recorder is not None:
            self.recorder.stop(self.error)
        if self.cancel is not None:
            self.cancel()
