"""Waiting for what other processes do: patiently, for the machine may be busy with something else."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Final, TypeVar

T = TypeVar("T")

PATIENCE_S: Final = 120.0
POLL_S: Final = 0.02
LONGEST_POLL_S: Final = 10.0
"""Longest time that a poll counts: a machine suspended for minutes must not use up the patience."""


def eventually(condition: Callable[[], T], what: str) -> T:
    """Wait until a condition holds; return what it returned."""
    waited, before = 0.0, time.monotonic()
    while not (found := condition()):
        waited, before = waited + min(time.monotonic() - before, LONGEST_POLL_S), time.monotonic()
        assert waited < PATIENCE_S, f"{what}: not within {PATIENCE_S:g} s"
        time.sleep(POLL_S)
    return found


async def until(read: Callable[[], Awaitable[T]], wanted: Callable[[T], bool] = bool) -> T:
    """Return the first value read that is as wanted."""
    deadline = time.monotonic() + PATIENCE_S
    while not wanted(value := await read()):
        assert time.monotonic() < deadline, f"still {value} after {PATIENCE_S:g} s"
        await asyncio.sleep(POLL_S / 4)
    return value
