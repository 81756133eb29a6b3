"""A quadratic problem solved by a library, as a reference."""

from typing import Final

import daqp
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNBOUNDED: Final = 1e30


def solved_by_daqp(H: Array, f: Array, A: Array, low: Array, high: Array) -> Array:
    """Minimise z' H z / 2 + f' z; the bounds of the first variables, then of the rows of A."""
    low, high = np.maximum(low, -UNBOUNDED), np.minimum(high, UNBOUNDED)
    sense = np.zeros(len(high), dtype=np.int32)
    H, A = np.ascontiguousarray(H), np.ascontiguousarray(A)
    z, _, flag, _ = daqp.solve(H, f.copy(), A, high, low, sense, primal_tol=1e-9)
    assert flag == 1
    return np.array(z)
