"""The energy balance of the cold box: what it stores, and what crosses its boundary.

Stored are the bath's internal energy and, in each cell, that of gas and wall at constant pressure and constant mass.
"""

import numpy as np

from coldloop.kernels.compiled import kernel
from coldloop_plant.cold_box import ColdBox, evaluate
from coldloop_plant.components.heat_exchanger import HeatExchanger, heat_capacity
from coldloop_plant.components.phase_separator import content, outflow
from coldloop_plant.helium import Helium, saturation, supply_cell
from coldloop_plant.numeric import Array, RealArray, at_least

NODES, WEIGHTS = np.polynomial.legendre.leggauss(32)


@kernel
def energy_rates(x: Array, u: Array, w: float, box: ColdBox, helium: Helium) -> tuple[float, float]:
    """Return how fast the stored energy rises, and what crosses the boundary inwards (W); equal but for rounding.

    The boundary is crossed by the supply and the return at the warm end, the relief valve's flow, the turbine's shaft
    and the heat of heater and load.
    """
    dx = np.empty_like(x)
    s, warm, relief, _ = evaluate(x, u, w, box, helium, dx, np.empty(22, dtype=x.dtype))
    stored = stored_rate(x, dx, box, box.P_HP, helium)
    first34 = 2 + box.nef1.cells + box.nef2.cells
    top = outflow(box.separator, x[0], x[1], saturation(x[0], helium), helium)
    h_in, _, _ = supply_cell(box.P_HP, box.T_in, helium.isobar, helium.departure)
    h_turbine, _, _ = supply_cell(box.P_HP, x[first34 + box.nef34.cells - 1], helium.isobar, helium.departure)
    crossing = (s.m_jt + s.m_t) * h_in - warm.mass_flow * warm.h - relief * top.h
    crossing += at_least(u[1], 0.0) + w - s.m_t * (h_turbine - s.exhaust.h_out)
    return stored, crossing


@kernel
def stored_rate(x: Array, dx: Array, box: ColdBox, P: float, helium: Helium) -> float:
    """Return how fast the stored energy rises (W) with the rates `dx` and the supply at `P` (Pa)."""
    c = content(box.separator, x[0], x[1], helium)
    first2 = 2 + box.nef1.cells
    first34 = first2 + box.nef2.cells
    last = first34 + box.nef34.cells
    stored: float = c.U_P * dx[0] + c.U_V * dx[1]
    stored += stored_in_cells(box.nef1, P, x[2:first2], dx[2:first2], helium)
    stored += stored_in_cells(box.nef2, P, x[first2:first34], dx[first2:first34], helium)
    stored += stored_in_cells(box.nef34, P, x[first34:last], dx[first34:last], helium)
    return stored


@kernel
def stored_in_cells(exchanger: HeatExchanger, P: float, T: Array, dT: Array, helium: Helium) -> float:
    """Return how fast the energy in the cells of an exchanger rises (W)."""
    total: float = 0.0 * (T[0] + P)
    for i in range(exchanger.cells):
        total += heat_capacity(exchanger, P, T[i], helium) * dT[i]
    return total


def energy_gained(before: RealArray, after: RealArray, box: ColdBox, helium: Helium) -> float:
    """Return by how much the stored energy differs between two states (J), at constant supply pressure."""
    gained = (
        content(box.separator, after[0], after[1], helium).energy
        - content(box.separator, before[0], before[1], helium).energy
    )
    exchangers = [unit for unit in (box.nef1, box.nef2, box.nef34) for _ in range(unit.cells)]
    for exchanger, start, end in zip(exchangers, before[2:], after[2:], strict=True):
        middle, half = 0.5 * (start + end), 0.5 * (end - start)
        capacities = [heat_capacity(exchanger, box.P_HP, middle + half * node, helium) for node in NODES]
        gained += half * float(np.dot(WEIGHTS, capacities))
    return float(gained)
