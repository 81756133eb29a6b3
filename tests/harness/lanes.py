"""The lanes of the tests, fast, system and night: which one a test is in, and what a test of the fast lane may not do.

A test is in the lane that the fixtures it requests say. A test of the fast lane that starts a program, drives a browser
(a program) or waits for the clock fails with what it did; one that is to compile a kernel fails before that is done.
"""

import multiprocessing.util
import platform
import selectors
import sys
import time
from collections.abc import Callable, Iterable
from enum import StrEnum
from typing import Any, Final

import pytest
from numba.core import event

USES: Final = {
    "process": {"processes", "shared_processes", "coldloop_rigs", "live_rig", "programs"},
    "realtime": {"realtime"},
    "browser": {"browser"},
    "compiles": {"compiles"},
    "container": {"_engine"},
}
"""The mark of a test that requests, itself or through other fixtures, one of these."""

WAITED_S: Final = 2.0
"""Seconds that a test of the fast lane may wait for the clock in all; time limits are tested by short ones."""


class Lane(StrEnum):
    """When a test runs: with `scripts/test`, with `--system`, or with `--night`; with `--all` in any case."""

    FAST = "fast"
    SYSTEM = "system"
    NIGHT = "night"


def lane_of(marks: Iterable[str]) -> Lane:
    """Return the lane of a test that has these marks."""
    names = set(marks)
    if names & {"night", "container"}:
        return Lane.NIGHT
    return Lane.SYSTEM if names & {"process", "realtime", "browser", "compiles"} else Lane.FAST


class Watch:
    """Notes what the present test does that only tests of other lanes may do."""

    def __init__(self) -> None:
        self.waited_s = 0.0
        self.lane = Lane.FAST
        self._notes: list[str] = []
        platform.platform()  # asks `uname` the first time that a manifest is written
        sys.addaudithook(self._audit)
        event.register("numba:compile", _Compilations(self._compile))  # type: ignore[no-untyped-call]
        _before(multiprocessing.util, "spawnv_passfds", lambda path, *_: self._notes.append(f"it starts {path!r}"))
        _before(time, "sleep", self._sleep)
        original = selectors.DefaultSelector.select

        def select(selector: Any, timeout: float | None = None) -> Any:  # noqa: ANN401 types of the library
            ready = original(selector, timeout)
            if not ready and timeout is not None and timeout > 0:
                self.waited_s += timeout
            return ready

        selectors.DefaultSelector.select = select  # type: ignore[method-assign]

    def begin(self, lane: Lane) -> None:
        """Begin to watch a test of a lane."""
        self.waited_s = 0.0
        self.lane = lane
        self._notes.clear()

    @property
    def notes(self) -> list[str]:
        """Notes on what the test has done so far."""
        waited = [f"it waits {self.waited_s:.1f} s for the clock"] if self.waited_s > WAITED_S else []
        return [*dict.fromkeys(self._notes), *waited]

    def _compile(self, kernel: str) -> None:
        self._notes.append(f"it compiles {kernel}")
        judge(self.lane, self._notes)

    def _audit(self, name: str, arguments: tuple[Any, ...]) -> None:
        if name in {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system"}:
            self._notes.append(f"it starts {arguments[0]!r}" if arguments else f"it calls {name}")

    def _sleep(self, seconds: float) -> None:
        self.waited_s += seconds


class _Compilations(event.Listener):
    """Notes each kernel that is to be compiled."""

    def __init__(self, note: Callable[[str], None]) -> None:
        self._note = note

    def on_start(self, happening: Any) -> None:  # noqa: ANN401 an event of numba
        """Note a kernel."""
        self._note(happening.data["dispatcher"].py_func.__qualname__)

    def on_end(self, happening: Any) -> None:  # noqa: ANN401 an event of numba
        """Nothing: it has been noted."""


def _before(module: Any, name: str, note: Callable[..., None]) -> None:  # noqa: ANN401 any module
    original = getattr(module, name)

    def noted(*arguments: Any, **named: Any) -> Any:  # noqa: ANN401 as the original
        note(*arguments, **named)
        return original(*arguments, **named)

    setattr(module, name, noted)


def judge(lane: Lane, notes: list[str]) -> None:
    """Fail a test of the fast lane that did what others may."""
    if lane is Lane.FAST and notes:
        pytest.fail(
            f"a test of the fast lane may not do this: {'; '.join(notes)}. Let it request the fixture `programs`, "
            "`compiles` or `realtime`, and it is in the system lane",
            pytrace=False,
        )


def table(tests: Iterable[tuple[str, Lane, set[str]]]) -> list[str]:
    """Return how many tests of each file are in each lane, and the marks that put them there.

    Args:
        tests: Of each test its identifier, its lane and its marks.
    """
    files: dict[str, dict[Lane, list[set[str]]]] = {}
    for test, lane, marks in tests:
        files.setdefault(test.partition("::")[0], {}).setdefault(lane, []).append(marks & {*USES, "night"})
    rows = ["| file | fast | system | night | why |", "|---|---|---|---|---|"]
    for file, lanes in sorted(files.items()):
        why = sorted({mark for found in lanes.values() for each in found for mark in each})
        counts = " | ".join(str(len(lanes.get(lane, []))) for lane in Lane)
        rows.append(f"| {file} | {counts} | {', '.join(why)} |")
    totals = (sum(len(lanes.get(lane, [])) for lanes in files.values()) for lane in Lane)
    return [*rows, f"| all | {' | '.join(map(str, totals))} | |"]
