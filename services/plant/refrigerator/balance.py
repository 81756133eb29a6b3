"""The energy balance of the refrigerator's cold part: cold box, NEF6, NEF5's coil.

As in `plant.cold_box.balance`, gas and wall of a cell are taken at constant pressure. The station is isothermal.
"""

from coldloop.kernels.compiled import kernel
from plant.cold_box.balance import stored_in_cells, stored_rate
from plant.components.heat_exchanger import TRICKLE
from plant.components.phase_separator import outflow
from plant.helium.properties import WARM_CP, Helium, saturation, supply_cell
from plant.numeric import RealArray, at_least
from plant.refrigerator.physics import BOX_STATES, Crossing, Refrigerator


@kernel
def refrigerator_energy_rates(
    x: RealArray, dx: RealArray, crossing: Crossing, load: float, plant: Refrigerator, helium: Helium
) -> tuple[float, float]:
    """Return how fast the stored energy rises, and what crosses the boundary inwards (W); equal but for rounding.

    `dx` and `crossing` are from `evaluate_refrigerator` at `x`; `load` in W. Nitrogen and the turbine's shaft take
    heat and work, the relief valve and the low-pressure line helium.
    """
    box, precooler = plant.box, plant.precooler
    coil = BOX_STATES + precooler.nef6.cells
    supply, cold, leaving, cooling = crossing.entering, crossing.cold, crossing.leaving, crossing.cooling
    stored = stored_rate(x, dx, box, supply.P, helium)
    stored += stored_in_cells(precooler.nef6, supply.P, x[BOX_STATES:coil], dx[BOX_STATES:coil], helium)
    stored += precooler.nef5.capacity * dx[coil]
    top = outflow(box.separator, x[0], x[1], saturation(x[0], helium), helium)
    h_in, _, _ = supply_cell(supply.P, supply.T, helium)
    h_turbine, _, _ = supply_cell(supply.P, x[BOX_STATES - 1], helium)
    inwards = supply.mass_flow * h_in - leaving.mass_flow * leaving.h - crossing.relief * top.h
    inwards -= at_least(leaving.mass_flow, TRICKLE) * WARM_CP * (cooling.warm_end.T - leaving.T)
    inwards += at_least(crossing.heater, 0.0) + load - cold.m_t * (h_turbine - cold.exhaust.h_out)
    return stored, inwards - cooling.boiling.heat
