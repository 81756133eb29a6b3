"""Lets kernels call the control PLC's scan, which is plain Python (that PLC runs without numba), and be exported.

Rounding to single precision has a form of its own for numba.
"""

from collections.abc import Callable
from inspect import isfunction
from typing import Any, Final

import numpy as np
from numba.extending import overload, register_jitable

from coldloop.kernels import single_precision
from coldloop.safety import watchdog
from coldloop_control_plc import alarms, output_limits, player, scan, sensors

PORTABLE: Final[tuple[Callable[..., Any], ...]] = (
    single_precision.neighbour,
    *(
        function
        for module in (alarms, output_limits, player, scan, sensors, watchdog)
        for name, function in vars(module).items()
        if isfunction(function) and function.__module__ == module.__name__ and not name.startswith("_")
    ),
)

for function in PORTABLE:
    register_jitable(error_model="numpy")(function)


@overload(single_precision.single, jit_options={"error_model": "numpy"}, strict=False)
def _single(value: Any) -> Any:  # noqa: ANN401, ARG001 a type of numba
    return lambda value: np.float64(np.float32(value))
