"""What is seen while a run goes on: simulated time, speed, and the state of the loop in one line."""

import time
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from coldloop.process import L1, T5, TICK_S
from rig.recording import Recorder

REFRESH_S = 0.1


class PlantTimeBar:
    """A progress bar that appears with its first sign of progress; what goes wrong before stands alone."""

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


class RunProgress(PlantTimeBar):
    """A progress bar on standard error, with the loop's live line on a terminal."""

    def __init__(self, ticks: int) -> None:
        console = Console(stderr=True)
        live = [TextColumn("[dim]{task.fields[line]}")] if console.is_terminal else []
        self._bar = Progress(
            TextColumn("{task.fields[clock]}"),
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeRemainingColumn(),
            *live,
            console=console,
            auto_refresh=False,
        )
        self._task = self._bar.add_task("", total=ticks, clock="0:00:00", speed="", line="")
        self._shown = time.monotonic()

    def __call__(self, recorder: Recorder) -> None:
        """Show where the run is, a few times a second."""
        done = len(recorder.samples)
        if done % 8 and done != recorder.ticks:
            return
        now = time.monotonic()
        if now - self._shown < REFRESH_S and done != recorder.ticks:
            return
        self._shown = now
        self._bar.start()  # not before there is something to show: an error then stands alone
        seconds = done * TICK_S
        speed = seconds / max(recorder.wall_seconds, 1e-9)
        self._bar.update(
            self._task,
            completed=done,
            clock=clock(seconds),
            speed=f"{speed:,.0f} x real time",
            line=_line(recorder),
        )
        self._bar.refresh()


def _line(recorder: Recorder) -> str:
    y = recorder.samples[-1].y
    line = f"L1 {y[L1]:.2f} %  T5 {y[T5]:.2f} K"
    if recorder.updates:
        update = recorder.updates[-1]
        line += f"  tau_u {update.tau_u * TICK_S:.2f} s  J {update.j_effective:.3g}"
    return line
