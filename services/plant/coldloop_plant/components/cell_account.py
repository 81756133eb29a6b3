"""Cells of exchangers hold what the stages of a step brought them.

A Runge-Kutta step integrates temperatures. Where a cell warms by much in one step, while its heat capacity bends, it
gains a little more or less than its flows brought; the temperature is corrected for that. In ordinary operation the
stages of a step move cells by less than `COARSE`, and nothing is corrected.
"""

import numpy as np

from coldloop.kernels.compiled import inlined, kernel
from coldloop_plant.components.heat_exchanger import HeatExchanger
from coldloop_plant.helium.properties import Helium, supply_cell
from coldloop_plant.numeric import RealArray

COARSE = 0.04  # K
WILD = 50.0  # K in one step: no state of a plant, and not worth being summed up
PANEL = 0.1  # K, of the integral over the heat capacity
LEAST_ENERGY = 1e-3  # J: what is less is left alone,
SETTLED_ENERGY = 1e-6  # J, and what is more is corrected to this
MOST_CORRECTIONS = 4
NODE = np.sqrt(0.6)  # of Gauss and Legendre's rule of three nodes


@kernel
def heat_capacity(exchanger: HeatExchanger, P: float, T: float, helium: Helium) -> float:
    """Return the heat capacity of one cell (J/K) at `P` (Pa) and `T` (K)."""
    _, rho_cp, c_wall = supply_cell(P, T, helium.isobar, helium.departure)
    return (exchanger.volume * rho_cp + exchanger.aluminium * c_wall) / exchanger.cells


@inlined
def widest_move(stages: RealArray, x: RealArray, first: int, last: int) -> float:
    """Return how far the states `first` to `last` - 1 go from those of the first stage, at most, up to `x`."""
    widest: float = 0.0
    for i in range(first, last):
        widest = max(widest, abs(x[i] - stages[0, i]))
    for k in range(1, 4):
        for i in range(first, last):
            widest = max(widest, abs(stages[k, i] - stages[0, i]))
    return widest


@kernel
def settle_cells(
    exchanger: HeatExchanger,
    first: int,
    P: float,
    stages: RealArray,
    slopes: RealArray,
    dt: float,
    x: RealArray,
    helium: Helium,
) -> None:
    """Correct the temperatures in `x` of an exchanger's cells, whose first is `first`, where they moved by much.

    Those that hold what they were brought within `LEAST_ENERGY` are left alone: halving a step has to pay.

    Args:
        exchanger: Parameters.
        first: Index of its first cell in `x`.
        P: Supply pressure, Pa.
        stages: States at the stages, shape (4, N).
        slopes: Their rates, shape (4, N).
        dt: Step, s.
        x: State after the step, shape (N,).
        helium: Tables.
    """
    for i in range(first, first + exchanger.cells):
        widest = abs(x[i] - stages[0, i])
        for k in range(1, 4):
            widest = max(widest, abs(stages[k, i] - stages[0, i]))
        if COARSE < widest < WILD:
            brought: float = 0.0
            for k in range(4):
                weight = dt / 6.0 if k in (0, 3) else dt / 3.0
                brought += weight * heat_capacity(exchanger, P, stages[k, i], helium) * slopes[k, i]
            missing = brought - _held_between(exchanger, P, stages[0, i], x[i], helium)
            if abs(missing) <= LEAST_ENERGY:
                continue
            for _ in range(MOST_CORRECTIONS):
                x[i] += missing / heat_capacity(exchanger, P, x[i], helium)
                missing = brought - _held_between(exchanger, P, stages[0, i], x[i], helium)
                if abs(missing) <= SETTLED_ENERGY:
                    break


@kernel
def _held_between(exchanger: HeatExchanger, P: float, low: float, high: float, helium: Helium) -> float:
    """Return what one cell takes up from one temperature to another (J)."""
    panels = 1 + int(abs(high - low) / PANEL)
    width, total = (high - low) / panels, 0.0
    for panel in range(panels):
        middle = low + (panel + 0.5) * width
        outer = heat_capacity(exchanger, P, middle - 0.5 * NODE * width, helium)
        outer += heat_capacity(exchanger, P, middle + 0.5 * NODE * width, helium)
        total += width * (5.0 * outer + 8.0 * heat_capacity(exchanger, P, middle, helium)) / 18.0
    return total
