"""How the vectors of an instance of the problem follow from the state, the load and the input before."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop_optimizer_plc.qp.linear_algebra import add_transposed_product

Array = NDArray[np.float64]


class Maps(NamedTuple):
    """How an instance follows from the parameters; the state and the load are stacked as s = (x, w)."""

    phi: Array
    """Shape (n_s, n)."""
    constant: Array
    """Shape (n_s, n_s)."""
    outputs: Array
    """Shape (n_s, 56)."""
    output_bounds: Array
    rate_bounds: Array
    rate_first: Array
    """1.0 for the rows of the interval before the first knot."""
    rate_before: Array
    """Shape (3, 38)."""
    low: Array
    high: Array
    first_rate: Array
    """Rates of the inputs, scaled, where they bound the first knot as a box; infinite where they do not."""
    input_scale: Array
    rest: Array
    """s at rest by the target, scaled inputs, shape (3, n_s); (0, n_s) where the target is the operating point."""
    holding: Array
    """2 Phi times a profile that holds an input, shape (3, n), or (0, n)."""


@kernel
def first_knot_range(maps: Maps, rate: Array, u_before: Array, share: float, i: int) -> tuple[float, float]:
    """Return the range of input i at the first knot, within a share of its rate (3,) of the input before it, scaled."""
    start = u_before[i] / maps.input_scale[i]
    reach = rate[i] * share
    return min(max(start - reach, maps.low[i]), maps.high[i]), min(max(start + reach, maps.low[i]), maps.high[i])


@kernel
def keep_first_rate(maps: Maps, rate: Array, u_before: Array, share: float, z: Array) -> None:
    """Move the inputs of the first knot of z (n,) to within their rate (3,), scaled, of the input before it (3,)."""
    for i in range(u_before.shape[0]):
        low, high = first_knot_range(maps, rate, u_before, share, i)
        z[i] = min(max(z[i], low), high)


@kernel
def instance(
    maps: Maps, x: Array, w: float, u_before: Array, share: float, target: Array
) -> tuple[Array, Array, Array, Array, float]:  # fmt: skip
    """Return phi, gamma, low, high and the constant of the cost, which is about a target (3,) of scaled inputs.

    With its states at rest taken from s, and its inputs from z, the cost is as about the operating point.
    """
    zero, one, half = x.dtype.type(0.0), x.dtype.type(1.0), x.dtype.type(0.5)
    s = np.empty(x.shape[0] + 1, x.dtype)
    for i in range(x.shape[0]):
        s[i] = x[i]
    s[x.shape[0]] = w
    deviation = s.copy()
    add_transposed_product(maps.rest, -target, deviation)
    phi = np.zeros(maps.phi.shape[1], x.dtype)
    add_transposed_product(maps.phi, deviation, phi)
    about_rest = phi.copy()
    add_transposed_product(maps.holding, -target, phi)
    outputs, rates = maps.output_bounds.shape[0], maps.rate_bounds.shape[0]
    gamma = np.empty(outputs + rates, x.dtype)
    for r in range(outputs):
        gamma[r] = maps.output_bounds[r]
    for r in range(rates):
        gamma[outputs + r] = maps.rate_bounds[r] * (share if maps.rate_first[r] > zero else one)
    add_transposed_product(maps.outputs, s, gamma[:outputs])
    add_transposed_product(maps.rate_before, u_before, gamma[outputs:])
    low, high = maps.low.copy(), maps.high.copy()
    for i in range(u_before.shape[0]):
        low[i], high[i] = first_knot_range(maps, maps.first_rate, u_before, share, i)
    weighted = np.zeros(s.shape[0], x.dtype)
    add_transposed_product(maps.constant, deviation, weighted)
    constant = zero
    for i in range(s.shape[0]):
        constant += deviation[i] * weighted[i]
    inputs = 0
    while inputs < phi.shape[0] and np.isfinite(maps.high[inputs]):  # slacks have no upper bound
        inputs += 1
    for i in range(maps.holding.shape[0]):
        for j in range(i, inputs, u_before.shape[0]):
            constant -= half * (about_rest[j] + phi[j]) * target[i]
    return phi, gamma, low, high, constant
