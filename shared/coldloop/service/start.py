"""Start of a service as a program: options, configuration, logs, event loop, signals, exit code."""

import argparse
import asyncio
import contextlib
import gc
import logging
import signal
import sys
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Final, TypeVar

from pydantic import BaseModel

from coldloop import __version__
from coldloop.config import load_configuration
from coldloop.errors import ColdloopError
from coldloop.kernels.first_use import Kernels, announce_with
from coldloop.service.command_line import add_configuration_options
from coldloop.service.logs import end_logs, set_up_logs

S = TypeVar("S", bound=BaseModel)

log = logging.getLogger("coldloop.service.start")

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
    announce_with(_log_kernels)
    code, last_line = 1, None
    try:
        configuration = load_configuration(
            settings, file=options.config, assignments=options.assignments, others=SECTIONS,
            options={"model.file": (options.process, "--process")} if options.process else {},
        )  # fmt: skip
        code = run_event_loop(lambda: _until_stopped(serve(configuration.settings), with_parent=options.with_parent))
    except ColdloopError as error:
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
    except ColdloopError as error:
        sys.stderr.write(f"{name}: {error}\n")
        return error.exit_code


def _log_kernels(kernels: Kernels) -> None:
    log.info(COMPILING, extra={"kernels": kernels.owner, "about_s": kernels.about_s})


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
        raise _first_cause(group) from None
    return 0


def _first_cause(group: BaseExceptionGroup[BaseException]) -> BaseException:
    for error in group.exceptions:
        if isinstance(error, BaseExceptionGroup):
            return _first_cause(error)
        if isinstance(error, ColdloopError):
            return error
    return group
