"""The rig: puts the three services together, drives, records and evaluates them. `simulate` is its front door."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from coldloop_rig.runs.simulation import Simulation, simulate

__all__ = ["Simulation", "simulate"]


def __getattr__(name: str) -> Any:  # noqa: ANN401 whatever it is
    """Import what a front door names when it is used: the command line starts without it."""
    if name in __all__:
        from coldloop_rig.runs import simulation  # noqa: PLC0415

        return getattr(simulation, name)
    raise AttributeError(f"module '{__name__}' has no attribute {name!r}")
