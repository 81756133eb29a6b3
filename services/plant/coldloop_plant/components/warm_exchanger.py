"""Counter-flow exchanger for warm helium, whose heat capacity is constant: few cells, however long the exchanger.

The cells of `heat_exchanger` take the mean of each as the driving temperature, so their number bounds how close the
streams come: half the fall over a cell, 14 K between 300 and 80 K with eight of them. Here each cell is itself a
counter-flow exchanger: at rest, cells in series are exactly one exchanger of the sum of their UA.
"""

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop_plant.components.heat_exchanger import STILL, TRICKLE, HeatExchanger, LowPressureFlow
from coldloop_plant.components.parameters import require
from coldloop_plant.helium.properties import WARM_CP
from coldloop_plant.numeric import Array, at_least, at_most

SMALL = 1e-3
LARGEST_EXPONENT = 30.0


@kernel
def _decay(z: float) -> float:
    """Return (1 - exp(-z))/z, which is 1 at z = 0."""
    if abs(z.real) < SMALL:
        return 1.0 - z * (0.5 - z * (1.0 / 6.0 - z / 24.0))
    decay: float = (1.0 - np.exp(-z)) / z
    return decay


@kernel
def exchanged_heat(UA: float, C_high: float, C_low: float, difference: float) -> float:
    """Return the heat (W) between two counter-flowing streams of heat capacity flows `C_high` and `C_low` (W/K).

    `difference` (K) is that of the two temperatures at which they enter. The closed solution of the two energy
    balances, written so that it is smooth where both capacity flows are equal: Q = dT g/(1/UA + g/C_high), g = (1 -
    exp(-z))/z, z = UA (1/C_low - 1/C_high).
    """
    unbalance = 1.0 / C_low - 1.0 / C_high
    if abs(UA * unbalance.real) > LARGEST_EXPONENT:
        UA = LARGEST_EXPONENT / abs(unbalance.real)  # a longer one exchanges no more
    g = _decay(UA * unbalance)
    return difference * g / (1.0 / UA + g / C_high)


@kernel
def transfer_warm(
    exchanger: HeatExchanger, T: Array, T_hot: float, flows: Array, low: LowPressureFlow, heat: Array
) -> LowPressureFlow:
    """Write what each cell gives to the low-pressure gas into `heat` (W) and return that gas at the hot end.

    `T` holds the temperature at which the high-pressure gas leaves each cell, hot end first (K), and of its wall;
    `T_hot` (K) is that at which it enters the first one, `flows` (kg/s) what enters each. As that flow comes to rest,
    the low-pressure gas takes its heat from the wall.
    """
    UA = exchanger.UA / exchanger.cells
    swept = at_least(low.mass_flow, TRICKLE)
    C_low, sweeping = swept * WARM_CP, at_most(low.mass_flow / TRICKLE, 1.0)
    T_low, h_low = low.T, low.h
    for i in range(exchanger.cells - 1, -1, -1):
        T_before = T[i - 1] if i > 0 else T_hot
        given = exchanged_heat(UA, at_least(flows[i], TRICKLE) * WARM_CP, C_low, T_before - T_low)
        if flows[i].real < STILL:
            moving = at_least(flows[i] / STILL, 0.0)
            by_wall = (1.0 - moving) * C_low * (1.0 - np.exp(-2.0 * UA / C_low))
            given = sweeping * (moving * given + by_wall * (T[i] - T_low))
        heat[i] = given
        T_low = T_low + given / C_low
        h_low = h_low + given / swept
    return LowPressureFlow(low.mass_flow, low.P, T_low, h_low)


def check_warm_exchanger(name: str, exchanger: HeatExchanger, cells: int) -> None:
    """Refuse parameters that no exchanger has, or another number of cells (`ParameterError`)."""
    require(name, "UA", exchanger.UA, 0.0, 1e6)
    require(name, "volume", exchanger.volume, 0.0, 100.0)
    require(name, "aluminium", exchanger.aluminium, 0.0, 1e5)
    require(name, "cells", exchanger.cells, cells - 1, cells)
