"""The energy balance of the refrigerator's cold part: cold box, NEF6, NEF5's coil.

Stored are the bath's internal energy and that of gas and wall in each cell, whose mass and pressure move. The station
is isothermal.
"""

from coldloop.kernels.compiled import kernel
from coldloop_plant.components.heat_exchanger import TRICKLE
from coldloop_plant.components.phase_separator import content, outflow
from coldloop_plant.helium import WARM_CP, Helium, saturation, supply_cell
from coldloop_plant.numeric import RealArray, at_least
from coldloop_refrigerator.high_pressure import (
    CAPACITY,
    COMPRESSION,
    ENERGY,
    EXPANSION,
    FIRST,
    WORK,
    H,
    hold_passes,
    piped,
    read_passes,
    side_pressure,
    supply_at,
)
from coldloop_refrigerator.physics import BOX_STATES, STATION, Crossing, Refrigerator


@kernel
def refrigerator_energy_rates(
    x: RealArray, dx: RealArray, crossing: Crossing, load: float, plant: Refrigerator, helium: Helium
) -> tuple[float, float]:
    """Return how fast the stored energy rises, and what crosses the boundary inwards (W); equal but for rounding.

    `dx` and `crossing` are from `evaluate_refrigerator` at `x`; `load` in W. Nitrogen and the turbine's shaft take
    heat and work, the relief valve and the low-pressure line helium.
    """
    box, pipes = plant.box, piped(plant.box, plant.precooler)
    filling, cold, leaving, cooling = crossing.filling, crossing.cold, crossing.leaving, crossing.cooling
    bath = content(box.separator, x[0], x[1], helium)
    stored = bath.U_P * dx[0] + bath.U_V * dx[1] + plant.precooler.nef5.capacity * dx[pipes.coil]
    stored += stored_in_passes(x, dx, filling.P, filling.P_rate, plant, helium)
    top = outflow(box.separator, x[0], x[1], saturation(x[0], helium), helium)
    h_turbine, _, _ = supply_cell(filling.P, x[BOX_STATES - 1], helium.isobar, helium.departure)
    inwards = filling.entering * filling.h - leaving.mass_flow * leaving.h - crossing.relief * top.h
    inwards -= at_least(leaving.mass_flow, TRICKLE) * WARM_CP * (cooling.warm_end.T - leaving.T)
    inwards += at_least(crossing.heater, 0.0) + load - cold.m_t * (h_turbine - cold.exhaust.h_out)
    return stored, inwards - cooling.boiling.heat


@kernel
def stored_in_passes(x: RealArray, dx: RealArray, P: float, dP: float, plant: Refrigerator, helium: Helium) -> float:
    """Return how fast the energy of gas and walls in the passes rises (W), from their properties alone.

    At `P` (Pa), which rises by `dP` (Pa/s).
    """
    pipes = piped(plant.box, plant.precooler)
    held = read_passes(x, pipes, helium)
    hold_passes(supply_at(P), pipes, held)
    total: float = 0.0
    for i in range(FIRST, pipes.coil):
        cell = held.cells[i]
        total += cell[CAPACITY] * (1.0 + cell[EXPANSION] * cell[H]) * dx[i]
        total += (cell[COMPRESSION] * cell[H] - cell[WORK]) * dP
    return total


@kernel
def stored_energy(x: RealArray, T_ambient: float, plant: Refrigerator, helium: Helium) -> float:
    """Return the energy in bath, coil and passes (J)."""
    pipes = piped(plant.box, plant.precooler)
    held = read_passes(x, pipes, helium)
    T_hot = T_ambient + plant.station.cooler_approach
    hold_passes(supply_at(side_pressure(plant.station.hp.volume, x[STATION], T_hot, held.mass)), pipes, held)
    total: float = content(plant.box.separator, x[0], x[1], helium).energy
    total += plant.precooler.nef5.capacity * x[pipes.coil]
    for i in range(FIRST, pipes.coil):
        total += held.cells[i, ENERGY]
    return total
