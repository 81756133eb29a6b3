"""Lets kernels call the control PLC's arithmetic, which is plain Python (that PLC runs without numba), and be exported.

Rounding to single precision has a form of its own for numba.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numba.extending import overload, register_jitable

from coldloop.kernels import single_precision
from coldloop_control_plc import output_limits, sensors

PORTABLE: Final[tuple[Callable[..., Any], ...]] = (
    single_precision.neighbour,
    output_limits.admit,
    output_limits.admits,
    output_limits.are_near,
    output_limits.begin,
    output_limits.change,
    output_limits.copy_state,
    output_limits.in_range,
    output_limits.is_reached,
    output_limits.judge,
    output_limits.nearest,
    output_limits.rate_share,
    output_limits.resume,
    output_limits.same,
    sensors.are_inside,
    sensors.have_moved,
    sensors.is_frozen,
    sensors.is_to_move,
    sensors.note_moves,
    sensors.moved,
    sensors.count_unchanged,
)

for function in PORTABLE:
    register_jitable(error_model="numpy")(function)


@overload(single_precision.single, jit_options={"error_model": "numpy"}, strict=False)
def _single(value: Any) -> Any:  # noqa: ANN401, ARG001 a type of numba
    return lambda value: np.float64(np.float32(value))
