"""Starts rigs for one test, and stops them."""

from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from coldloop_rig.testing.live_rig import LiveRig, up


class Rigs:
    """The value of the fixture `coldloop_rigs`; a context at whose end all its rigs are stopped.

    Args:
        folder: Takes a folder for each rig, with the logs of its services.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = ExitStack()
        self._started = 0

    def up(self, **arguments: Any) -> LiveRig:  # noqa: ANN401 those of `rig.testing.up`
        """Start a rig; the arguments are those of `rig.testing.up`."""
        self._started += 1
        arguments.setdefault("folder", self._folder / f"rig{self._started}")
        return self._stack.enter_context(up(**arguments))

    def __enter__(self) -> Self:
        """Return this."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the rigs."""
        self._stack.__exit__(kind, error, trace)
