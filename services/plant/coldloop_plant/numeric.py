"""Number types of the kernels: every kernel runs on real numbers and, for the complex step, on complex ones."""

from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import inlined

RealArray: TypeAlias = NDArray[np.float64]
Array: TypeAlias = NDArray[Any]  # float64 or complex128
PA_PER_BAR: Final = 1e5


@inlined
def at_least(value: float, bound: float) -> float:
    """Return `value`, or `bound` where the real part is below it."""
    if value.real < bound.real:
        return 0.0 * value + bound
    return value


@inlined
def at_most(value: float, bound: float) -> float:
    """Return `value`, or `bound` where the real part is above it."""
    if value.real > bound.real:
        return 0.0 * value + bound
    return value
