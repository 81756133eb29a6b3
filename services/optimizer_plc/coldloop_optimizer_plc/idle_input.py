"""An input that has lost its effect: the valve of a turbine that stands, for all that its speed and pressures say.

It is no variable of the problem until the turbine turns again: its bounds collapse to where it is.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.process.declaration import Process
from coldloop_optimizer_plc.qp.arithmetic import Real

Array = NDArray[np.float64]

SLOW: Final = 0.05
"""Share of the turbine's speed at the operating point below which it may stand."""
STANDSTILL_RATIO: Final = 1.1
"""Of the pressures before and behind its nozzle, below which nothing flows; it is some ten in operation."""
ROOM: Final = 1e-3
"""Between a bound and an input that is held, scaled: methods of the interior need some. Sequences hold it exactly."""
MOST_BITS: Final = 31
"""Of the mask of suspects in an exported optimiser."""


class TurbineWatch(NamedTuple):
    """How a turbine that stands is known; kernels are shared by processes, and have no places of theirs in them."""

    valve: int
    """Input before the turbine; -1: neither speed nor pressures are measured."""
    speed: int
    """Output, ..."""
    before: int
    """... and those of the pressures before ..."""
    behind: int
    """... and behind it."""
    slow: float
    """Speed below which it may stand."""
    ratio: float
    """Of the pressures, below which nothing flows."""
    bit: int
    """Of the valve in the mask of suspects: it follows those of the outputs."""


def turbine_watch(process: Process, y0: Array, real: Real) -> TurbineWatch:
    """Return how the turbine of the process is watched, by its outputs (n_y,) at the operating point."""
    bath, outputs = process.bath, process.output_names
    if bath is None or not bath.turbine_speed or len(outputs) + len(process.inputs) > MOST_BITS:
        return TurbineWatch(-1, 0, 0, 0, real(-math.inf), real(STANDSTILL_RATIO), 0)
    valve, speed = process.input_names.index(bath.turbine_valve), outputs.index(bath.turbine_speed)
    before, behind = map(outputs.index, bath.turbine_pressures)
    bit = 1 << (len(outputs) + valve)
    return TurbineWatch(valve, speed, before, behind, real(SLOW * y0[speed]), real(STANDSTILL_RATIO), bit)


@kernel
def stands(c: TurbineWatch, y: Array) -> bool:
    """Return whether outputs (n_y,) say that the turbine stands; a reading that is no number says nothing."""
    slow: bool = y[c.speed] < c.slow and y[c.before] < c.ratio * y[c.behind]
    return slow


@kernel
def idle_valve(c: TurbineWatch, suspects: int) -> int:
    """Return the input that has no effect by the mask of suspects, or -1."""
    return c.valve if suspects >= c.bit else -1
