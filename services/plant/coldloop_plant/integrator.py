"""Fixed-step integration: one classical Runge-Kutta step a tick."""

from typing import Any

import numpy as np

from coldloop.kernels.borrowing import borrowed
from coldloop.kernels.compiled import kernel
from coldloop.kernels.named import named
from coldloop_plant.cold_box.physics import OUTPUTS, ColdBox, evaluate
from coldloop_plant.cold_box.settling import settle_box
from coldloop_plant.components.phase_separator import add_to_account, content, start_account
from coldloop_plant.helium.properties import Helium
from coldloop_plant.numeric import RealArray


@kernel
def advance(x: RealArray, u: RealArray, w: float, dt: float, box: ColdBox, helium: Helium) -> RealArray:
    """Return the state after `dt` seconds (shape (28,)), with inputs and load held.

    Stable up to dt = 0.5 s everywhere, and up to 1.6 s near the operating point. Loops run in a fixed order, so that
    the result is the same to the bit everywhere.
    """
    slope = np.empty(x.shape[0])
    evaluate(x, u, w, box, helium, slope, np.empty(OUTPUTS))
    return advance_along(x, slope, u, w, dt, box, helium)


@kernel
def advance_along(
    x: RealArray, slope: RealArray, u: RealArray, w: float, dt: float, box: ColdBox, helium: Helium
) -> RealArray:
    """Return the state after `dt` seconds, where `slope` (28,), dx/dt at `x`, is known; it is overwritten."""
    n = x.shape[0]
    y = np.empty(OUTPUTS)
    stage, total = np.empty(n), np.empty(n)
    stages, slopes = np.empty((4, n)), np.empty((4, n))
    account = start_account(content(box.separator, x[0], x[1], helium), slope)
    for i in range(n):
        stages[0, i], slopes[0, i] = x[i], slope[i]
        total[i] = slope[i]
        stage[i] = x[i] + 0.5 * dt * slope[i]
    for k, fraction in ((1, 0.5), (2, 1.0)):
        _, _, _, held = evaluate(stage, u, w, box, helium, slope, y)
        account = add_to_account(account, held, slope, 2.0)
        for i in range(n):
            stages[k, i], slopes[k, i] = stage[i], slope[i]
            total[i] += 2.0 * slope[i]
            stage[i] = x[i] + fraction * dt * slope[i]
    _, _, _, held = evaluate(stage, u, w, box, helium, slope, y)
    account = add_to_account(account, held, slope, 1.0)
    for i in range(n):
        stages[3, i], slopes[3, i] = stage[i], slope[i]
        stage[i] = x[i] + dt / 6.0 * (total[i] + slope[i])
    settle_box(box, account, stages, slopes, dt, stage, helium)
    return stage


@kernel
def advance_and_read(
    x: RealArray,
    slope: RealArray,
    held: bool,  # noqa: FBT001 - a kernel takes its arguments by position
    u: RealArray,
    w: float,
    dt: float,
    box: Any,  # noqa: ANN401 - any nesting of tuples
    helium: Any,  # noqa: ANN401 - any nesting of tuples
) -> tuple[RealArray, RealArray]:
    """Return the state after `dt` seconds and the outputs there.

    `slope` (28,) becomes dx/dt at the new state. Where inputs and load are `held`, it is that at `x` from the step
    before, which saves one of five evaluations. `box` and `helium` come as `plain_tuples`.
    """
    plant, tables = named(ColdBox, box), named(Helium, borrowed(helium))
    y = np.empty(OUTPUTS)
    if not held:
        evaluate(x, u, w, plant, tables, slope, y)
    ahead = advance_along(x, slope, u, w, dt, plant, tables)
    evaluate(ahead, u, w, plant, tables, slope, y)
    return ahead, y
