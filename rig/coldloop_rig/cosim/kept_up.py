"""Services of a rig that stays up: one that has ended is started again, after a pause, and not for ever."""

import asyncio
import signal
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Final, Protocol

from coldloop.errors import LinkError

PAUSES_S: Final = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Before each further start; after the last one the service is given up."""
STEADY_S: Final = 60.0
"""After this time without an exit the pauses start from the first one."""


class Restartable(Protocol):
    """A process that can be started again."""

    @property
    def name(self) -> str:
        """What it is, in a message."""

    async def ended(self) -> str:
        """Wait until it has ended; return how, such as `was ended by SIGKILL`."""

    async def restart(self) -> None:
        """Start it where it was before."""


async def keep_up(
    process: Restartable, restarted: Callable[[], Awaitable[None]] | None = None, pauses_s: tuple[float, ...] = PAUSES_S
) -> None:
    """Start a process again whenever it has ended, until cancelled.

    Args:
        process: Which one.
        restarted: Work after each start, given up when the process ends again.
        pauses_s: Before each start in a row.

    Raises:
        LinkError: It has ended once more than there are pauses.
    """
    loop = asyncio.get_running_loop()
    restarts, since = 0, loop.time()
    work: Callable[[], Awaitable[None]] = _nothing
    while True:
        how = await _run_until_exit(process, work)
        if loop.time() - since > STEADY_S:
            restarts = 0
        if restarts == len(pauses_s):
            raise LinkError(f"{process.name} {how}; given up after {restarts} restarts")
        pause = pauses_s[restarts]
        restarts += 1
        say(f"{process.name} {how}: started again in {pause:g} s ({restarts} of {len(pauses_s)})")
        await asyncio.sleep(pause)
        since = loop.time()
        await process.restart()
        work = restarted or _nothing


async def _nothing() -> None:
    """Do nothing after a start."""


async def _run_until_exit(process: Restartable, work: Callable[[], Awaitable[None]]) -> str:
    """Wait until a process has ended while `work` runs, which is cancelled with it; return how it has ended."""
    exited, running = asyncio.ensure_future(process.ended()), asyncio.ensure_future(work())
    try:
        await asyncio.wait({exited, running}, return_when=asyncio.FIRST_COMPLETED)
        if not exited.done():
            await running
        return await exited
    finally:
        exited.cancel()
        running.cancel()
        await asyncio.gather(exited, running, return_exceptions=True)


def end_of(code: int, last_words: str) -> str:
    """Return how a process has ended: by which signal, or with which exit code and last line of its log."""
    if code < 0:
        try:
            return f"was ended by {signal.Signals(-code).name}"
        except ValueError:
            return f"was ended by signal {-code}"
    return f"has ended with exit code {code}: {last_words}"


def say(text: str) -> None:
    """Print a line for the operator or the log; ignore a closed output."""
    with suppress(OSError):  # the disk may be full, the terminal closed
        sys.stderr.write(f"coldloop: {text}\n")
        sys.stderr.flush()
