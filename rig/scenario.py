"""What a run is to do, whichever way it is run."""

from dataclasses import dataclass

from plant.program import LoadProfile


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
