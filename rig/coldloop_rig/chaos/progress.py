"""What is seen while a plan is run."""

import time
from typing import Final

from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from coldloop.registers.control_plc import LadderStatus, Mode
from coldloop_rig.chaos.plan import ChaosPlan
from coldloop_rig.progress import PlantTimeBar, clock, make_console

REFRESH_S: Final = 0.2


class ChaosProgress(PlantTimeBar):
    """A progress bar on standard error: plant time, mode, and the faults that are on."""

    def __init__(self, plan: ChaosPlan) -> None:
        self._bar = Progress(
            TextColumn("{task.fields[clock]}"), BarColumn(bar_width=24), TaskProgressColumn(),
            TextColumn("{task.fields[line]}"), console=make_console(), auto_refresh=False,
        )  # fmt: skip
        self._task = self._bar.add_task("", total=plan.ticks, clock="0:00:00", line="")
        self._plan = plan
        self._shown = time.monotonic()

    def __call__(self, tick: int, ladder: LadderStatus | None, faults: list[str]) -> None:
        """Show where the run is, a few times a second, and its end."""
        now = time.monotonic()
        if now - self._shown < REFRESH_S and tick < self._plan.ticks:
            return
        self._shown = now
        self._bar.start()
        mode = Mode(ladder.mode).name if ladder is not None else "control PLC away"
        self._bar.update(
            self._task, completed=tick, clock=clock(tick * self._plan.process.tick_s),
            line="  ".join([mode, *faults]),
        )  # fmt: skip
        self._bar.refresh()
