"""Start of a service as a program: options, configuration, logs, event loop, signals, exit code.

Logs are one JSON object a line on standard error, written by a thread that never holds up its callers. Lines that are
not read are dropped and counted; the next line that is written says how many in `dropped`.
"""

import argparse
import asyncio
import contextlib
import gc
import io
import json
import logging
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from datetime import UTC, datetime
from typing import Any, Final, TextIO, TypeVar

from pydantic import BaseModel

from coldloop import __version__, config, errors
from coldloop.kernels.cache import announce_with
from coldloop.service import add_configuration_options

CAPACITY: Final = 1000
"""Lines that wait to be written; a line has a few hundred bytes."""
FLUSH_S: Final = 1.0
"""How long the end of a program waits for the reader of its lines."""

Write = Callable[[str], object]


def to_stream(stream: TextIO) -> Write:
    """Return how to write a line to a stream.

    A stream with a file descriptor is written to past its buffer: the interpreter takes the buffer's lock when it ends,
    and aborts when a thread that is blocked in a write holds it.
    """
    try:
        descriptor = stream.fileno()
    except io.UnsupportedOperation:
        return lambda line: stream.write(f"{line}\n")

    def write(line: str) -> None:
        data = memoryview(f"{line}\n".encode(errors="backslashreplace"))
        while data:
            data = data[os.write(descriptor, data) :]

    return write


log = logging.getLogger("coldloop.service.start")

STANDARD_ATTRIBUTES = frozenset(logging.makeLogRecord({}).__dict__) | {"message", "asctime", "taskName"}


class JsonFormatter(logging.Formatter):
    """Formats a record as JSON: time, level, service, logger, event, and whatever was passed as `extra`."""

    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "service": self._service,
            "logger": record.name,
            "event": record.getMessage(),
        }
        line.update((key, value) for key, value in record.__dict__.items() if key not in STANDARD_ATTRIBUTES)
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str, ensure_ascii=False)


MOST_EVENTS = 1000
"""Different events that are counted at a time."""
LAST_LINE_S = 0.2
"""How long the last line is waited for, when those before it have been written."""


class FloodFilter(logging.Filter):
    """Lets at most `lines` of one event through in an interval; the next one says how many were left out."""

    def __init__(self, lines: int = 20, interval_s: float = 10.0, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._lines = lines
        self._interval_s = interval_s
        self._now = now
        self._seen: dict[tuple[str, ...], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to write a record."""
        about = tuple(str(getattr(record, name, "")) for name in ("alarm", "mode"))
        event, now = (record.name, str(record.msg), *about), self._now()
        if len(self._seen) > MOST_EVENTS:
            self._seen.clear()
        since, count = self._seen.get(event, (now, 0))
        if now - since >= self._interval_s:
            if count > self._lines:
                record.left_out = count - self._lines
            since, count = now, 0
        self._seen[event] = since, count + 1
        return count < self._lines


class QueueingHandler(logging.Handler):
    """Formats records into a bounded queue of lines, which a thread writes.

    Args:
        write: Writes one line; it may block, and is called by the thread alone.
    """

    def __init__(self, write: Write) -> None:
        super().__init__()
        self._write = write
        self._lines: deque[str] = deque()
        self._changed = threading.Condition()  # re-entrant: a finaliser that runs meanwhile may log, too
        self._unwritten = self._refused = self._unread = 0
        self._told = 0
        """Number of dropped lines that a later line has reported."""
        self._is_closed = False
        # A daemon: the interpreter does not wait for it at the end, when it may be blocked for good.
        threading.Thread(target=self._run, name="log lines", daemon=True).start()

    @property
    def dropped(self) -> int:
        """Lines that found the queue full, or no reader, since the start."""
        return self._refused + self._unread

    def emit(self, record: logging.LogRecord) -> None:
        """Let a record be written; called with the handler's lock held."""
        dropped = self.dropped
        if dropped > self._told:
            record.dropped = dropped - self._told
        try:
            line = self.format(record)
        except Exception as error:  # noqa: BLE001 - a scan does not fail because of what it logs
            about = {"name": record.name, "levelname": record.levelname, "created": record.created}
            what = {"msg": "a record cannot be formatted", "reason": repr(error), "text": str(record.msg)}
            line = self.format(logging.makeLogRecord({**about, **what}))
        if self.put(line):
            self._told = dropped

    def put(self, line: str) -> bool:
        """Let a line be written after those before it; return False when it was dropped instead."""
        with self._changed:
            if self._is_closed or len(self._lines) >= CAPACITY:
                self._refused += 1
                return False
            self._lines.append(line)
            self._unwritten += 1
            self._changed.notify_all()
            return True

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._lines or self._is_closed)
                if not self._lines:
                    return
                line = self._lines.popleft()
            try:
                self._write(line)
            except (OSError, ValueError):  # the reader has gone, or the stream is closed
                self._unread += 1
            with self._changed:
                self._unwritten -= 1
                self._changed.notify_all()

    def is_written(self, within_s: float = FLUSH_S) -> bool:
        """Wait until all lines are written; return whether they were, in time."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._unwritten, within_s)

    def flush(self) -> None:
        """Wait until all is written, for a bounded time."""
        self.is_written()

    def close(self) -> None:
        """Write what waits, for a bounded time, and end the thread."""
        if not self._is_closed:
            if self.is_written() and self.dropped > self._told:
                last = {"name": log.name, "levelno": logging.WARNING, "levelname": "WARNING", "msg": "lines dropped"}
                self.handle(logging.makeLogRecord(last))
            with self._changed:
                self._is_closed = True
                self._changed.notify_all()
            self.is_written(LAST_LINE_S)
        super().close()


_handlers: list[QueueingHandler] = []
"""The handler of this process, when its logs are set up."""


def set_up_logs(service: str, level: str, stream: TextIO = sys.stderr) -> None:
    """Send the logs of this process, from `level` up, to `stream`."""
    handler = QueueingHandler(to_stream(stream))
    handler.setFormatter(JsonFormatter(service))
    handler.addFilter(FloodFilter())
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    _handlers[:] = [handler]


def dropped() -> int:
    """Return how many lines of this process were dropped, because those before them were not read."""
    return sum(handler.dropped for handler in _handlers)


def end_logs(last_line: str | None = None) -> None:
    """Write a last line of plain text, if there is one, and what waits before it; for a bounded time."""
    for handler in _handlers:
        if last_line is not None:
            handler.put(last_line)
        handler.close()


S = TypeVar("S", bound=BaseModel)

COMPILING: Final = "compiling kernels"
"""Logged when a service compiles kernels, with `kernels`, whose they are, and `about_s`, the seconds that it takes."""
SERVING: Final = "serving"
"""Logged when a service answers."""
SECTIONS = ("limits", "model", "session", "plant", "control_plc", "optimizer_plc", "telemetry", "rig", "hmi")
"""Sections of a configuration file; each service reads those that concern it."""


def main(name: str, settings: type[S], serve: Callable[[S], Awaitable[None]], arguments: Sequence[str] | None) -> int:
    """Run a service until it is stopped; return its exit code."""
    parser = argparse.ArgumentParser(f"python -m {name}", description=f"Coldloop: {name}.", allow_abbrev=False)
    add_configuration_options(parser)
    parser.add_argument("--process", metavar="MODEL", help="model file of the process; the key model.file")
    parser.add_argument("--log-level", default="info", choices=("debug", "info", "warning", "error"))
    parser.add_argument(
        "--with-parent", action="store_true", help="end when standard input is closed: for programs that start services"
    )
    parser.add_argument("--version", action="version", version=__version__)
    options = parser.parse_args(arguments)
    set_up_logs(name, options.log_level)
    announce_with(lambda one: log.info(COMPILING, extra={"kernels": one.owner, "about_s": one.about_s}))
    code, last_line = 1, None
    try:
        configuration = config.load_configuration(
            settings, file=options.config, assignments=options.assignments, others=SECTIONS,
            options={"model.file": (options.process, "--process")} if options.process else {},
        )  # fmt: skip
        code = run_event_loop(lambda: _until_stopped(serve(configuration.settings), with_parent=options.with_parent))
    except errors.ColdloopError as error:
        code, last_line = error.exit_code, f"{name}: {error}"
    except Exception:  # the interpreter would write it past the queue, and block on its reader
        log.exception("failed")
    end_logs(last_line)
    gc.freeze()  # otherwise the interpreter looks for cycles in all modules before it ends
    return code


def in_one_line(name: str, start: Callable[[], int]) -> int:
    """Return what `start` returns, which imports a service and runs it; an error there is reported in one line."""
    try:
        return start()
    except errors.ColdloopError as error:
        sys.stderr.write(f"{name}: {error}\n")
        return error.exit_code


def run_event_loop(start: Callable[[], Any]) -> int:
    """Run a coroutine that returns an exit code, on the fastest event loop there is."""
    try:
        import uvloop  # noqa: PLC0415 not on every platform
    except ImportError:
        factory = None
    else:
        factory = uvloop.new_event_loop
    with asyncio.Runner(loop_factory=factory) as runner:
        return int(runner.run(start()))


async def _until_stopped(service: Awaitable[None], *, with_parent: bool) -> int:
    """Run the service; SIGTERM, SIGINT or the parent's end end it in good order."""
    loop = asyncio.get_running_loop()
    task = asyncio.ensure_future(service)
    if with_parent:
        farewell = asyncio.StreamReader()
        await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(farewell), sys.stdin)
        asyncio.ensure_future(farewell.read()).add_done_callback(lambda _: task.cancel())
    for number in (signal.SIGTERM, signal.SIGINT):
        with contextlib.suppress(NotImplementedError):  # Windows
            loop.add_signal_handler(number, task.cancel)
    try:
        await task
    except asyncio.CancelledError:
        return 0
    except BaseExceptionGroup as group:
        cause: BaseException | None = group.subgroup(errors.ColdloopError)
        while isinstance(cause, BaseExceptionGroup):
            cause = cause.exceptions[0]
        raise (cause or group) from None
    return 0
