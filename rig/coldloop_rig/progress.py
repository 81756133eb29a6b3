"""The progress line of a run: simulated time, speed and the state of the loop."""

import os
import time
from typing import Final, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn

from coldloop.process.declaration import Process
from coldloop.registers import optimizer_plc, plant
from coldloop_rig.results.recording import Sink

REFRESH_S: Final = 0.1


class PlantTimeBar:
    """A progress bar that appears with its first sign of progress; what goes wrong before is shown alone."""

    _bar: Progress

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar.live.is_started:
            self._bar.refresh()
            self._bar.stop()


def clock(seconds: float) -> str:
    """Return plant time as hours, minutes and seconds."""
    hours, rest = divmod(int(seconds), 3600)
    return f"{hours}:{rest // 60:02}:{rest % 60:02}"


def make_console() -> Console:
    """Return a console on standard error; without a terminal, or with NO_COLOR, it writes no control sequences."""
    plain = bool(os.environ.get("NO_COLOR")) or os.environ.get("TERM") == "dumb"
    return Console(stderr=True, force_terminal=False if plain else None)


class RunProgress(PlantTimeBar, Sink):
    """A progress bar on standard error, with the loop's live line on a wide terminal."""

    def __init__(self, ticks: int, process: Process) -> None:
        console = make_console()
        columns: list[ProgressColumn] = [TextColumn("{task.fields[clock]}"), TaskProgressColumn()]
        if console.width >= 72:  # columns that the bar with speed and remaining time needs
            columns.insert(1, BarColumn(bar_width=24))
            columns += [TextColumn("{task.fields[speed]}"), TimeRemainingColumn()]
        if console.is_terminal and console.width >= 120:
            columns.append(TextColumn("[dim]{task.fields[line]}"))
        self._bar = Progress(*columns, console=console, auto_refresh=False)
        self._task = self._bar.add_task("", total=ticks, clock="0:00:00", speed="", line="")
        self._ticks, self._process = ticks, process
        self._done = 0
        self._updating = ""
        self._began = self._shown = time.monotonic()

    def begin(self) -> None:
        """Begin to count the speed."""
        self._began = time.monotonic()

    def reported(self, update: optimizer_plc.Optimization) -> None:
        """Remember what the optimiser does."""
        self._updating = f"  tau_u {update.tau_u * self._process.tick_s:.2f} s  J {update.j_effective:.3g}"

    def sample(self, sample: plant.PlantSample) -> None:
        """Show where the run is, a few times a second."""
        self._done = sample.tick + 1
        last = self._done == self._ticks
        if self._done % 8 and not last:
            return
        now = time.monotonic()
        if now - self._shown < REFRESH_S and not last:
            return
        self._shown = now
        self._bar.start()  # not before there is something to show: an error is then shown alone
        seconds = self._done * self._process.tick_s
        values = zip(self._process.banded[:3], self._process.controlled, strict=False)
        outputs = "  ".join(f"{one.name} {sample.y[place]:.2f} {one.unit}".rstrip() for one, place in values)
        speed = f"{seconds / max(now - self._began, 1e-9):,.0f} x real time"
        line = f"{outputs}{self._updating}"
        self._bar.update(self._task, completed=self._done, clock=clock(seconds), speed=speed, line=line)
        self._bar.refresh()
