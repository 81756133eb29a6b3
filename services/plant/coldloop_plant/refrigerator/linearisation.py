"""Linearisation of the refrigerator by the complex step, see `coldloop_plant.cold_box.linearisation`."""

import numpy as np

from coldloop_plant.cold_box.linearisation import COMPLEX_STEP, state_scales
from coldloop_plant.helium.properties import Helium
from coldloop_plant.numeric import RealArray
from coldloop_plant.refrigerator.physics import COMMAND_NAMES, STATE_UNITS, Refrigerator, rates, read

SCALES_BY_UNIT = {"K": 1.0, "kg": 0.01, "1": 0.01, "%": 1.0}


def rate_scales(plant: Refrigerator) -> RealArray:
    """Return the size of an ordinary deviation of each state: as in the cold box; 10 g of helium, 1 % of opening."""
    box = state_scales(plant.box)
    return np.concatenate([box, [SCALES_BY_UNIT[unit] for unit in STATE_UNITS[box.size :]]])


def jacobian(x: RealArray, u: RealArray, v: RealArray, d: RealArray, plant: Refrigerator, helium: Helium) -> RealArray:
    """Return the derivatives of (dx/dt, y, signals) with respect to (x, u, v, d), shape (89, 61)."""
    point = np.concatenate([x, u, v, d]).astype(np.complex128)
    cuts = np.cumsum([x.size, u.size, len(COMMAND_NAMES)])
    columns = []
    for k in range(point.size):
        moved = point.copy()
        moved[k] += 1j * COMPLEX_STEP
        xk, uk, vk, dk = np.split(moved, cuts)
        y, signals = read(xk, uk, vk, dk, plant, helium)
        columns.append(np.concatenate([rates(xk, uk, vk, dk, plant, helium), y, signals]).imag / COMPLEX_STEP)
    return np.stack(columns, axis=1)
