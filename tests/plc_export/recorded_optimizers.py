"""Updates of optimisers of several settings, as they are recorded and as they are disturbed, with their answers."""

import math
from functools import cache
from typing import Final

import numpy as np

from coldloop.config import load_configuration
from coldloop.registers.control_plc import Update
from coldloop_export.golden import SINGLE, GoldenUpdate, UpdateRecorder
from coldloop_rig.settings import Settings
from tests.harness.records import as_transmitted

PROGRAM: Final = "optimizer_plc.program."
OPTIMISERS: Final = {
    "paper": (),
    "tuned, own rule, load steps interrupt": (
        f"{PROGRAM}preset=tuned", f"{PROGRAM}adaptive.rule=contraction", f"{PROGRAM}interrupting_load_step_w=10",
    ),
}  # fmt: skip


@cache
def recorder(*assignments: str) -> UpdateRecorder:
    settings = load_configuration(Settings, environment={}, assignments=[*SINGLE, *assignments]).settings
    return UpdateRecorder(settings)


def recorded_updates(ticks: int, load: str, *assignments: str) -> list[GoldenUpdate]:
    """Return the updates of a session with adaptive periods, and of one with periods of 2.5 s."""
    return [each for period_s in (0.0, 2.5) for each in recorder(*assignments).record(ticks, load, period_s)]


def disturbed(update: Update, tick: int, number: int, playing: int, rng: np.random.Generator) -> Update:
    """Return an update with what a bad day does to it: gaps, others who drive, bad readings, load steps."""
    load = update.load + float(rng.choice([0.0, 0.0, 40.0, -60.0]))
    y = tuple(math.nan if rng.random() < 0.05 else value for value in update.y)
    playing = playing if rng.random() < 0.85 else int(rng.choice([0, playing + 7]))
    return as_transmitted(update._replace(update=number, tick=tick, playing=playing, load=load, y=y))


def disturbed_updates(
    source: list[GoldenUpdate], seed: int, fixed_ticks: int, *assignments: str
) -> list[GoldenUpdate]:  # fmt: skip
    """Return a session of disturbed updates with what the optimiser answers."""
    optimizer, rng = recorder(*assignments).optimizer, np.random.default_rng(seed)
    optimizer.restart(0.25 * fixed_ticks)
    found: list[GoldenUpdate] = []
    tick = playing = 0
    for number, each in enumerate(source[:60]):
        update = disturbed(each.update, tick, number, playing, rng)
        plan = as_transmitted(optimizer.plan(update))
        sequence = optimizer.solve() if rng.random() < 0.9 else None
        playing = sequence.header.number if sequence else playing
        found.append(GoldenUpdate(-1 if number else fixed_ticks, update, plan, sequence))
        following = plan.next_update_tick + int(rng.choice([0, 0, 0, 0, 3, 30, 2000]))
        tick = following if rng.random() < 0.9 else max(tick + 1, plan.next_update_tick - 1)
    return found
