"""The floating-point type that the optimiser computes with on line.

The PLC of the paper has single precision only. What is computed off line (maps, gains, transitions) is computed in
double precision and rounded once; everything that depends on a measurement is computed in the chosen type.
"""

from typing import TypeAlias, cast

import numpy as np

from coldloop_optimizer_plc.computing_settings import Arithmetic

Real: TypeAlias = type[np.float64]
"""The scalar type in use. Annotations say double for either type: kernels are compiled for the type they are given."""

DOUBLE: Real = np.float64


def real_of(arithmetic: Arithmetic) -> Real:
    """Return the scalar type of an arithmetic."""
    return cast("Real", np.float32) if arithmetic is Arithmetic.FLOAT32 else DOUBLE
