"""Waiting for what other processes do: patiently, for the machine may be busy with something else."""

import time
from collections.abc import Callable
from typing import Final, TypeVar

T = TypeVar("T")

PATIENCE_S: Final = 120.0
POLL_S: Final = 0.02


def eventually(condition: Callable[[], T], what: str) -> T:
    """Wait until a condition holds; return what it returned."""
    deadline = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE_S:g} s"
        time.sleep(POLL_S)
    return found
