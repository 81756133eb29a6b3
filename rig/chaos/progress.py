"""What is seen while a plan is run."""

import time
from typing import Final, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from coldloop.process import TICK_S
from coldloop.registers.control_plc import Mode
from rig.chaos.observer import Sight

REFRESH_S: Final = 0.2


class ChaosProgress:
    """A progress bar on standard error: plant time, mode, and the faults that are on."""

    def __init__(self, ticks: int) -> None:
        self._bar = Progress(
            TextColumn("{task.fields[clock]}"), BarColumn(bar_width=24), TaskProgressColumn(),
            TextColumn("{task.fields[line]}"), console=Console(stderr=True), auto_refresh=False,
        )  # fmt: skip
        self._task = self._bar.add_task("", total=ticks, clock="0:00:00", line="")
        self._shown = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar.live.is_started:
            self._bar.refresh()
            self._bar.stop()

    def __call__(self, tick: int, sight: Sight, faults: list[str]) -> None:
        """Show where the run is, a few times a second."""
        now = time.monotonic()
        if now - self._shown < REFRESH_S:
            return
        self._shown = now
        self._bar.start()
        hours, rest = divmod(int(tick * TICK_S), 3600)
        mode = Mode(sight.ladder.mode).name if sight.ladder is not None else "control PLC away"
        self._bar.update(
            self._task, completed=tick, clock=f"{hours}:{rest // 60:02}:{rest % 60:02}",
            line="  ".join([mode, *faults]),
        )  # fmt: skip
        self._bar.refresh()
