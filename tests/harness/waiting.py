"""Waiting for what other processes do: patiently, for the machine may be busy with something else."""

import time
from collections.abc import Callable
from typing import Final, TypeVar

T = TypeVar("T")

PATIENCE_S: Final = 120.0
POLL_S: Final = 0.02
LONGEST_POLL_S: Final = 10.0
"""What a poll counts at most: a machine that stood still for minutes is not what is waited for."""


def eventually(condition: Callable[[], T], what: str) -> T:
    """Wait until a condition holds; return what it returned."""
    waited, before = 0.0, time.monotonic()
    while not (found := condition()):
        waited, before = waited + min(time.monotonic() - before, LONGEST_POLL_S), time.monotonic()
        assert waited < PATIENCE_S, f"{what}: not within {PATIENCE_S:g} s"
        time.sleep(POLL_S)
    return found
