"""The floating-point type that the optimiser computes with on line.

The PLC of the paper has single precision only. What is computed off line (maps, gains, transitions) is computed in
double precision and rounded once; everything that depends on a measurement is computed in the chosen type.
"""

from enum import StrEnum
from typing import TypeAlias, cast

import numpy as np

Real: TypeAlias = type[np.float64]
"""The scalar type in use. Annotations say double for either type: kernels are compiled for the type they are given."""

DOUBLE: Real = np.float64


class Arithmetic(StrEnum):
    """Floating-point types to choose from."""

    FLOAT64 = "float64"
    FLOAT32 = "float32"

    @property
    def real(self) -> Real:
        """The scalar type."""
        return cast("Real", np.float32) if self is Arithmetic.FLOAT32 else DOUBLE
