"""A run to be done: its scenario, its configuration, how the programs are connected; and the signal that ends it."""

import signal
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from coldloop import config, errors, table, text
from coldloop.modbus.settings import Endpoint
from coldloop.process.load_profile import LoadProfile
from coldloop_plant.load import HOUR_TICKS, named_families
from coldloop_rig.results.recording import Recorder, Way
from coldloop_rig.settings import Settings

INPUTS: Final = "inputs"
LOAD_COPY: Final = f"{INPUTS}/load.csv"


@dataclass(frozen=True, slots=True)
class Scenario:
    """One run from the operating point on."""

    ticks: int
    load: LoadProfile
    updating_period_s: float
    """0 is adaptive."""
    seed: int
    realtime: bool = False
    factor: float = 1.0


def natural_ticks(name: str, load: LoadProfile) -> int:
    """Return the default duration of a run under the load of this name or file; it ends 1200 ticks after a file's."""
    families = named_families(name)
    return len(families) * HOUR_TICKS if families else load.times[-1] + 1200


def with_copied_load(settings: Settings, profile: LoadProfile, folder: Path) -> Settings:
    """Return settings that name a copy of the load in the folder of a run; those of a named load as they are.

    The copy is written from what was read: a pipe is read once, and a file may change meanwhile.
    """
    if named_families(settings.plant.load) is not None:
        return settings
    (folder / INPUTS).mkdir(exist_ok=True)
    process, steps = settings.process, zip(profile.times, profile.watts, strict=True)
    rows = "".join(f"{tick * process.tick_s!r},{watts!r}\n" for tick, watts in steps)
    text.whole_text(folder / LOAD_COPY, f"{table.TIME},{process.load.column}\n{rows}")
    plant = settings.plant.model_copy(update={"load": str(folder / LOAD_COPY)})
    return settings.model_copy(update={"plant": plant})


Conduct = Callable[[Recorder, Path], Awaitable[None]]
"""Does a run: takes its recorder and the folder of its results."""


@dataclass(frozen=True)
class Job:
    """A run to be done."""

    effective: config.Configuration[Settings]
    scenario: Scenario
    way: Way
    endpoints: tuple[Endpoint, ...] = ()
    """Endpoints of a running rig to attach to; empty where the run starts its own."""
    conduct: Conduct | None = None
    """Function that does the run in a way that the other fields do not describe."""
    optimizer: tuple[str, ...] = ()
    """A program that takes the place of our optimiser, with its options."""


class StopRequest:
    """A signal on its way to the run."""

    def __init__(self) -> None:
        self.error: errors.RunInterruptedError | None = None
        self.recorder: Recorder | None = None
        self.cancel: Callable[[], object] | None = None

    def __call__(self, number: signal.Signals) -> None:
        """Take a signal (signal handler)."""
        self.error = errors.RunInterruptedError(number.name, number)
        if self.recorder is not None:
            self.recorder.stop(self.error)
        if self.cancel is not None:
            self.cancel()
