"""What a run is to do, whichever way it is run."""

from dataclasses import dataclass

from coldloop.process.load_profile import LoadProfile
from plant.load import HOUR_TICKS, named_families

BEHIND_LAST_STEP = 1200
"""Default time that a run continues after the last step of a load file."""


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
    """Return the default duration of a run under the load of this name or file."""
    families = named_families(name)
    return len(families) * HOUR_TICKS if families else load.times[-1] + BEHIND_LAST_STEP
