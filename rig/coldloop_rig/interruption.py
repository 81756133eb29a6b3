"""Handling of Ctrl-C, SIGTERM and the end of the terminal (SIGHUP) in a command.

A run takes them as a request to stop and writes what it has (`INTERRUPTION.passed_to`). Anything else ends at once:
no exception is raised inside an import or a compiled kernel, where it would surface as a traceback.
"""

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Coroutine, Iterator
from types import FrameType, TracebackType
from typing import Any, Final, NoReturn, Self

from coldloop.errors import RunInterruptedError

SIGNALS: Final = tuple(
    signal.Signals[name] for name in ("SIGINT", "SIGTERM", "SIGHUP") if name in signal.Signals.__members__
)
LISTENS_S: Final = 2.0
"""A run in one process that has not taken a signal after so long is in code that does not return."""


class Interruption:
    """The handler of these signals, within the context."""

    def __init__(self) -> None:
        self._request: Callable[[signal.Signals], None] | None = None
        self._before: dict[signal.Signals, object] = {}
        self._number = signal.SIGINT
        """The last one that was received."""

    def __enter__(self) -> Self:
        """Install the handler; outside the main thread nothing is changed."""
        with contextlib.suppress(ValueError):
            for number in SIGNALS:
                if number.name == "SIGHUP" and signal.getsignal(number) is signal.SIG_IGN:  # `nohup`
                    continue
                self._before[number] = signal.signal(number, self._received)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Restore the handlers that were there before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before.clear()

    @contextlib.contextmanager
    def passed_to(self, request: Callable[[signal.Signals], None]) -> Iterator[None]:
        """Pass the first signal on to `request` within the context; a second one ends the program."""
        self._request = request
        try:
            yield
        finally:
            self._request = None

    @contextlib.contextmanager
    def in_one_process(self) -> Iterator[None]:
        """A run without an event loop: until `begun` the system ends it on SIGTERM and SIGHUP, also inside a compiler.

        Raises:
            RunInterruptedError: It has not taken a signal after `LISTENS_S`, as in code of others.
        """
        if not self._before:  # not the command line, or not its main thread
            yield
            return
        before = signal.signal(signal.SIGALRM, self._raise)
        self._handle(signal.SIG_DFL)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)
            self.begun()

    def begun(self) -> None:
        """Take SIGTERM and SIGHUP back: there is something to keep, and compiling is over."""
        self._handle(self._received)

    def _handle(self, handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
        for number in self._before.keys() - {signal.SIGINT}:
            signal.signal(number, handler)

    def _raise(self, *_: object) -> NoReturn:
        raise RunInterruptedError(self._number.name, self._number)

    def _received(self, number: int, _: FrameType | None) -> None:
        request, self._request = self._request, None
        if request is None:
            end_at_once(number)
        self._number = signal.Signals(number)
        request(self._number)
        if signal.getsignal(signal.SIGALRM) == self._raise:
            signal.setitimer(signal.ITIMER_REAL, LISTENS_S)


def end_at_once(number: int) -> NoReturn:
    """End the process with the exit code of a signal; its services end with their standard input."""
    with contextlib.suppress(OSError):  # the terminal may have gone
        if sys.stderr is not None and sys.stderr.isatty() and not os.environ.get("NO_COLOR"):
            os.write(2, b"\r\033[?25h\n")  # shows the cursor, which a progress bar hides
        os.write(2, b"coldloop: interrupted\n")
    os._exit(128 + number)


INTERRUPTION: Final = Interruption()
"""Interruption handler of the command line."""


def run_until_interrupted(start: Callable[[], Coroutine[Any, Any, None]]) -> bool:
    """Run a coroutine to its end, or cancel it at the first signal; return whether a signal ended it."""
    import asyncio  # noqa: PLC0415 most commands do without, and this module is imported first of all

    from coldloop.service.start import run_event_loop  # noqa: PLC0415

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
