"""Work that runs until Ctrl-C or SIGTERM and then ends cleanly."""

import asyncio
import signal
from collections.abc import Callable, Coroutine
from typing import Any

from coldloop.service.start import run_event_loop
from coldloop_rig.interruption import INTERRUPTION


def run_until_interrupted(start: Callable[[], Coroutine[Any, Any, None]]) -> bool:
    """Run a coroutine to its end, or cancel it at the first signal; return whether a signal ended it."""
    interrupted = False

    async def watched() -> int:
        loop = asyncio.get_running_loop()
        task = asyncio.ensure_future(start())

        def stop(_: signal.Signals) -> None:
            nonlocal interrupted
            interrupted = True
            loop.call_soon_threadsafe(task.cancel)

        with INTERRUPTION.passed_to(stop):
            try:
                await task
            except asyncio.CancelledError:
                if not interrupted:
                    raise
        return 0

    run_event_loop(watched)
    return interrupted
