"""Shows on standard error that services compile kernels before they serve: they write to log files."""

import asyncio
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from coldloop.kernels.first_use import Kernels, announce
from coldloop.parsing import parsed_json
from coldloop.service.start import COMPILING, SERVING

LOOK_S: Final = 0.25
TOGETHER_S: Final = 1.5
"""Services that are started at once say within this time that they compile."""


async def show_compiling(logs: Sequence[Path]) -> None:
    """Announce what the services with these logs compile, in one line; return when all of them serve."""
    while not any(_compiling(logs)):
        if all(SERVING in events for events in map(_events, logs)):
            return
        await asyncio.sleep(LOOK_S)
    await asyncio.sleep(TOGETHER_S)
    announce(*_compiling(logs))


def _compiling(logs: Sequence[Path]) -> list[Kernels]:
    found = (_events(log).get(COMPILING) for log in logs)
    return [Kernels(line["kernels"], line["about_s"]) for line in found if line is not None]


def _events(log: Path) -> dict[str, dict[str, Any]]:
    """Return the lines of a log by what happened, of each the last one."""
    return {line["event"]: line for line in _lines(log)}


def _lines(log: Path) -> Iterator[dict[str, Any]]:
    for text in log.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = parsed_json(text)
        except ValueError:  # the last words of a service, or half a line
            continue
        if isinstance(line, dict) and "event" in line:
            yield line
