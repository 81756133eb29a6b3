"""The rig: puts the three services together, drives, records and evaluates them. `simulate` is its front door."""

import sys
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from coldloop_rig.runs.simulation import Simulation, simulate

__all__ = ["Simulation", "simulate"]

PYTHON: Final = (sys.executable, "-P")
"""Starts processes of this package, without the folder where the user is: a `plant.py` there is not ours."""


def __getattr__(name: str) -> Any:  # noqa: ANN401 whatever it is
    """Import what a front door names when it is used: the command line starts without it."""
    if name in __all__:
        from coldloop_rig.runs import simulation  # noqa: PLC0415

        return getattr(simulation, name)
    raise AttributeError(f"module '{__name__}' has no attribute {name!r}")
