"""The speed and the memory of the reference PLC, from the times of the Cholesky factorisation that the paper gives."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from coldloop_rig.plc_sizing.operations import dense_cholesky

Array = NDArray[np.float64]

MEMORY_BYTES = 2_000_000
"""The memory card, shared by code and variables: the paper's 2 Mb, which 4 * 700^2 bytes just fit."""
QPOASES_ON_LAPTOP_S = 120e-6
"""One iteration of qpOASES on the paper's laptop."""


class ActiveRows(NamedTuple):
    """Rows of Gamma in the ODE solver's stage matrix."""

    mean: float
    worst: float


ACTIVE_ROWS = ActiveRows(mean=2.5, worst=31.0)
"""Measured in the closed loop over hours a to f, tau_u = 5 s; the hourly means are 0.7 to 4.4 (`docs/budget.md`)."""
WORKING_SET = 25.0
"""Constraints assumed in the working set of the active-set methods: half of the variables."""


class CholeskyTimes(NamedTuple):
    """Measured times; shape (25,) each."""

    size: Array
    plc_s: Array
    laptop_s: Array


class SpeedCurve(NamedTuple):
    """Time of a factorisation, c1 n + c2 n^2 + c3 n^3 in seconds: the work at the start of loops, and within them."""

    c1: float
    c2: float
    c3: float

    def time_s(self, n: float) -> float:
        """Return the time of a Cholesky factorisation of size n, in seconds."""
        return n * (self.c1 + n * (self.c2 + n * self.c3))

    def flops_per_s(self, length: float) -> float:
        """Return the speed in loops as long as those of a factorisation of size `length`."""
        return dense_cholesky(length).flops / self.time_s(length)


def cholesky_times() -> CholeskyTimes:
    """Read the paper's table."""
    table = np.loadtxt(Path(__file__).parent / "data" / "cholesky_times.csv", delimiter=",", skiprows=4)
    return CholeskyTimes(table[:, 0], table[:, 1] * 1e-3, table[:, 2] * 1e-6)


def fitted(size: Array, plc_s: Array) -> SpeedCurve:
    """Return the curve without negative coefficients that has the least sum of squared relative errors."""
    powers = np.stack([size, size**2, size**3], axis=1) / plc_s[:, None]
    coefficients, _ = nnls(powers, np.ones(len(size)))
    return SpeedCurve(*coefficients.tolist())


def reference_curve() -> SpeedCurve:
    """Return the curve of the paper's table."""
    times = cholesky_times()
    return fitted(times.size, times.plc_s)


def residuals(curve: SpeedCurve, times: CholeskyTimes) -> Array:
    """Return the relative errors of the curve, shape (25,)."""
    modelled = np.array([curve.time_s(n) for n in times.size.tolist()])
    errors: Array = modelled / times.plc_s - 1.0
    return errors


def slow_down(times: CholeskyTimes, size: float) -> float:
    """Return how many times longer than the laptop the PLC takes, between the sizes of the table."""
    return float(np.interp(size, times.size, times.plc_s / times.laptop_s))
