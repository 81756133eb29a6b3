"""Linearisation by the complex step: f'(x) = Im f(x + i h) / h, without subtraction and so exact to rounding."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from coldloop.process.cold_box import OUTPUT_NAMES
from coldloop_plant.cold_box.physics import ColdBox, derivative, outputs
from coldloop_plant.helium.properties import Helium
from coldloop_plant.numeric import Array, RealArray

COMPLEX_STEP = 1e-30  # in scaled units
DIFFERENCE_STEP = 2e-3  # the same, for the central differences


class Linearisation(NamedTuple):
    """dx/dt = A x + B u + F w, y = C x + D u + G w, in deviations and physical units."""

    A: RealArray
    """Shape (28, 28)."""
    B: RealArray
    """Shape (28, 3)."""
    F: RealArray
    """Shape (28,)."""
    C: RealArray
    """Shape (22, 28)."""
    D: RealArray
    """Shape (22, 3)."""
    G: RealArray
    """Shape (22,)."""


def state_scales(box: ColdBox) -> RealArray:
    """Return the size of an ordinary deviation of each state: 2 kPa, 1 % of level, 1 K."""
    cells = box.nef1.cells + box.nef2.cells + box.nef34.cells
    return np.array([2e3, box.separator.volume / 100.0, *[1.0] * cells])


def linearise(x: RealArray, u: RealArray, w: float, box: ColdBox, helium: Helium) -> Linearisation:
    """Return the linear model of the cold box at (x, u, w)."""
    return _split(_complex_step(x, u, w, box, helium), x.size, u.size)


def state_and_load_jacobian(
    x: RealArray, u: RealArray, w: float, box: ColdBox, helium: Helium
) -> tuple[RealArray, RealArray]:
    """Return the derivatives of dx/dt with respect to the state, (28, 28), and to the load, (28,)."""
    linear = linearise(x, u, w, box, helium)
    return linear.A, linear.F


def linearisation_error(x: RealArray, u: RealArray, w: float, box: ColdBox, helium: Helium) -> float:
    """Return the largest difference between the complex step and central differences.

    The differences are extrapolated once after Richardson. Both Jacobians are scaled: states by `state_scales`, inputs
    by 10 %, 50 W, 10 %, the load by 50 W, outputs by 1 (%, Hz, K, bar), rates per second.
    """
    exact = _complex_step(x, u, w, box, helium)
    columns = _scales(box)
    rows = np.concatenate([state_scales(box), np.ones(len(OUTPUT_NAMES))])
    coarse = _central(x, u, w, box, helium, DIFFERENCE_STEP)
    fine = _central(x, u, w, box, helium, DIFFERENCE_STEP / 2.0)
    difference = exact - (4.0 * fine - coarse) / 3.0
    return float(np.max(np.abs(difference * columns / rows[:, np.newaxis])))


def _scales(box: ColdBox) -> RealArray:
    return np.concatenate([state_scales(box), [10.0, 50.0, 10.0, 50.0]])


def _complex_step(x: RealArray, u: RealArray, w: float, box: ColdBox, helium: Helium) -> RealArray:
    """Return the Jacobian of (dx/dt, y) with respect to (x, u, w), shape (50, 32)."""
    stacked = _stacked(x.size, box, helium)
    point = np.concatenate([x, u, [w]]).astype(np.complex128)
    columns = []
    for k, scale in enumerate(_scales(box)):
        moved = point.copy()
        moved[k] += 1j * COMPLEX_STEP * scale
        columns.append(stacked(moved).imag / (COMPLEX_STEP * scale))
    return np.stack(columns, axis=1)


def _central(x: RealArray, u: RealArray, w: float, box: ColdBox, helium: Helium, step: float) -> RealArray:
    """Return the same Jacobian by central differences."""
    stacked = _stacked(x.size, box, helium)
    point = np.concatenate([x, u, [w]])
    columns = []
    for k, scale in enumerate(_scales(box)):
        ahead, behind = point.copy(), point.copy()
        ahead[k] += step * scale
        behind[k] -= step * scale
        columns.append((stacked(ahead) - stacked(behind)) / (ahead[k] - behind[k]))
    return np.stack(columns, axis=1)


def _stacked(states: int, box: ColdBox, helium: Helium) -> Callable[[Array], Array]:
    """Return the function (x, u, w) -> (dx/dt, y), on one vector each."""

    def evaluate(point: Array) -> Array:
        x, u, w = point[:states], point[states:-1], point[-1]
        return np.concatenate([derivative(x, u, w, box, helium), outputs(x, u, w, box, helium)])

    return evaluate


def _split(jacobian: RealArray, states: int, inputs: int) -> Linearisation:
    rates, signals = jacobian[:states], jacobian[states:]
    x, u, w = slice(states), slice(states, states + inputs), states + inputs
    return Linearisation(rates[:, x], rates[:, u], rates[:, w], signals[:, x], signals[:, u], signals[:, w])
