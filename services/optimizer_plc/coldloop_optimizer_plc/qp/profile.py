"""The parametrised input profile U_pwc(p): piecewise affine between the decision instants, constant before the first.

Instants count sampling periods: u_j holds during the j-th one, from (j - 1) to j periods ahead.
"""

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel

Array = NDArray[np.float64]


def interpolation(knots: tuple[int, ...], at: Array) -> Array:
    """Return the matrix (len(at), len(knots)) whose product with the knots' values is the profile at `at`."""
    positions = np.asarray(knots, dtype=float)
    clamped = np.clip(np.asarray(at, dtype=float), positions[0], positions[-1])
    weights = np.zeros((len(clamped), len(positions)))
    for row, position in enumerate(clamped):
        right = min(int(np.searchsorted(positions, position, side="right")), len(positions) - 1)
        left = max(right - 1, 0)
        span = positions[right] - positions[left]
        share = (position - positions[left]) / span if span > 0 else 0.0
        weights[row, left] += 1.0 - share
        weights[row, right] += share
    return weights


@kernel
def shifted(S: Array, z: Array, n_inputs: int) -> Array:
    """Return the profile z (n,) whose values at the knots are combined by S (knots, knots), inputs and slacks alike.

    The first `n_inputs` variables are inputs at all knots.
    """
    result = np.zeros_like(z)
    knots, start = S.shape[0], 0
    for part in range(2):
        width = (n_inputs if part == 0 else z.shape[0] - n_inputs) // knots
        for old in range(knots):
            for new in range(knots):
                if S[new, old] != z.dtype.type(0.0):
                    for i in range(width):
                        result[start + width * new + i] += S[new, old] * z[start + width * old + i]
        start += width * knots
    return result


@kernel
def shift(knots: Array, periods: float) -> Array:
    """Return the matrix that shifts a profile by `periods` sampling periods: the standard hot start.

    It has the floating-point type of the knots. The value behind the horizon is the last knot's.
    """
    one, last = knots.dtype.type(1.0), knots.shape[0] - 1
    S = np.zeros((last + 1, last + 1), knots.dtype)
    for new in range(last + 1):
        position, right = min(max(knots[new] + periods, knots[0]), knots[last]), 0
        while right < last and knots[right] <= position:
            right += 1
        left = max(right - 1, 0)
        span = knots[right] - knots[left]
        share = (position - knots[left]) / span if span > 0 else knots.dtype.type(0.0)
        S[new, left] += one - share
        S[new, right] += share
    return S


@kernel
def hold(u: Array, scale: Array, n_inputs: int, z: Array) -> None:
    """Make z (n,) the profile that keeps the input deviation u (3,), without slack."""
    z[:] = z.dtype.type(0.0)
    for k in range(n_inputs):
        i = k % scale.shape[0]
        z[k] = u[i] / scale[i]


@kernel
def inputs_of(weights: Array, z: Array, scale: Array, u0: Array, rate: Array) -> Array:
    """Return the inputs (samples, 3) of a profile z (n,), for the knots' weights (samples, knots) in each sample."""
    u = np.empty((weights.shape[0], scale.shape[0]), z.dtype)
    write_inputs(weights, z, scale, u0, rate, weights.shape[0], u)
    return u


@kernel
def write_inputs(weights: Array, z: Array, scale: Array, u0: Array, rate: Array, samples: int, u: Array) -> None:
    """Write the inputs of the first samples into u (at least as many, 3).

    They are in physical units, `u0` + `scale` z, and from one sample to the next within `rate`.
    """
    m = scale.shape[0]
    for sample in range(samples):
        for i in range(m):
            value = z.dtype.type(0.0)
            for knot in range(weights.shape[1]):
                value += weights[sample, knot] * z[m * knot + i]
            u[sample, i] = value * scale[i] + u0[i]
            if sample > 0:
                u[sample, i] = min(max(u[sample, i], u[sample - 1, i] - rate[i]), u[sample - 1, i] + rate[i])
