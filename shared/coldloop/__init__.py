"""Shared parts of the services, and the front door: `coldloop.simulate(...)`, `coldloop.Process.read(...)`."""

from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from coldloop.process.declaration import Process

__version__: Final = "0.3.0"
__all__ = ["Process", "simulate"]
FRONT_DOOR: Final = "coldloop.front_door"
"""Group of entry points: what is found when it is asked for, since nothing here imports the rig."""


def __getattr__(name: str) -> Any:  # noqa: ANN401 whatever it is
    """Import what the front door names when it is used: services start without it."""
    if name == "Process":
        return import_module("coldloop.process.declaration").Process
    if find_spec(f"{__name__}.{name}") is not None:  # `from coldloop import errors` asks here before it imports
        return import_module(f"{__name__}.{name}")
    for found in entry_points(group=FRONT_DOOR, name=name):
        return found.load()
    raise AttributeError(f"module 'coldloop' has no attribute {name!r}")
