"""Counter-flow heat exchanger: cells of high-pressure gas and aluminium, and a low-pressure side without storage.

A Runge-Kutta step integrates the temperatures of the cells. Where a cell warms by much in one step, while its heat
capacity bends, it gains a little more or less than its flows brought; `settle_cells` corrects the temperature for that.
In ordinary operation the stages of a step move cells by less than `COARSE`, and nothing is corrected.
"""

from typing import NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined, kernel
from coldloop_plant.helium import Helium, Saturation, Surface, saturation, supply_cell, vapour_enthalpy_and_cp
from coldloop_plant.numeric import Array, RealArray, at_least, at_most

LARGEST_RATIO = 8.0  # of the mean to the cold-end difference; more would be too stiff for a step of 0.25 s
STILL = 2e-3  # kg/s of high-pressure gas, below which the walls alone warm the low-pressure gas more and more
TRICKLE = 1e-9  # kg/s, below which the low-pressure gas simply takes the temperature of the cell


class HeatExchanger(NamedTuple):
    """A counter-flow exchanger, cut into equal cells from the hot end to the cold end."""

    UA: float  # Heat transfer coefficient times area, W/K
    volume: float  # Volume of the high-pressure side, m3
    aluminium: float  # Mass of the wall, kg
    cells: int  # Number of cells, 1 or more


class HighPressureFlow(NamedTuple):
    """The warm stream as it enters at the hot end."""

    mass_flow: float  # kg/s
    T: float  # K
    P: float  # Pa, the same all along


class LowPressureFlow(NamedTuple):
    """The cold stream as it enters at the cold end, or leaves at the hot end."""

    mass_flow: float  # kg/s
    P: float  # Pa, the same all along
    T: float  # K
    h: float  # J/kg; carried along so that energy is conserved exactly, whatever the tables' error


@inlined
def driving_difference(T_before: float, T_cell: float, T_low: float) -> float:
    """Return the temperature difference (K) between the mean of a cell and the low-pressure gas that enters it.

    With a mean, a cell of many transfer units cools the gas below the stream that cools it. The second law forbids
    that: the difference fades with that at the cold end, from outside ordinary operation (there a ratio of 1 to 5).
    """
    cold_end = T_cell - T_low
    limit = LARGEST_RATIO * cold_end if cold_end.real > 0.0 else cold_end
    return at_most(0.5 * (T_before + T_cell) - T_low, limit)


@inlined
def take_up(
    low: LowPressureFlow, cp: float, drive: float, UA: float, sat: Saturation, table: Surface
) -> tuple[float, float, float]:
    """Return T (K), h (J/kg) and cp (J/(kg K)) of the low-pressure flow after one cell of `UA` (W/K).

    Wet vapour, as a very cold turbine exhaust brings it, boils dry at constant temperature before it warms up, and
    saturated vapour that is cooled becomes wet, at most all of it liquid.
    """
    if low.h.real < sat.h_v.real:
        boiling = UA * drive / low.mass_flow
        missing = sat.h_v - low.h
        if boiling.real <= missing.real:
            return sat.T + 0.0 * boiling, at_least(low.h + boiling, at_most(sat.h_l, low.h)), cp
        UA = UA * (1.0 - missing / boiling)
    T = low.T + drive * (1.0 - np.exp(-UA / (low.mass_flow * cp)))
    if T.real < sat.T.real:
        return sat.T + 0.0 * T, sat.h_v + cp * (T - sat.T), cp
    h, cp_out = vapour_enthalpy_and_cp(low.P, T, sat.T, table)
    return T, h, cp_out


@kernel
def exchange(
    exchanger: HeatExchanger, T: Array, high: HighPressureFlow, low: LowPressureFlow, helium: Helium, given: Array,
    is_supply_held: bool,  # noqa: FBT001 compiled
) -> LowPressureFlow:  # fmt: skip
    """Write what each cell gives to the low-pressure gas (W) into `given` and return that gas at the hot end.

    If the mass of the high-pressure gas in the cells is held, as is its pressure, the rates of their temperatures (K/s)
    are written instead: in one march with the heats, whose exponentials are waited for meanwhile.

    `T` holds the temperatures of gas and wall in each cell, hot end first (K). The low-pressure side is marched from
    the cold end; in a cell it approaches the mean T_m of the gas that enters and the gas that leaves:
    T_out = T_m - (T_m - T_L) exp(-UA/(N m_L cp_L)), with cp_L where it enters the cell. As the high-pressure flow comes
    to rest, T_m becomes the temperature of the cell itself.
    """
    sat, isobar, departure, vapour = saturation(low.P, helium), helium.isobar, helium.departure, helium.vapour
    UA = exchanger.UA / exchanger.cells
    sweeping = at_least(low.mass_flow, TRICKLE)
    moving = at_most(high.mass_flow / STILL, 1.0)
    T_low, h_low = low.T, low.h
    _, cp_low = vapour_enthalpy_and_cp(low.P, T_low, sat.T, vapour)
    h_cell, rho_cp, c_wall = supply_cell(high.P, T[exchanger.cells - 1], isobar, departure)
    for i in range(exchanger.cells - 1, -1, -1):
        T_before = T[i - 1] if i > 0 else high.T
        T_ahead = T_before if moving.real >= 1.0 else T[i] + moving * (T_before - T[i])
        drive = driving_difference(T_ahead, T[i], T_low)
        T_low, h_next, cp_low = take_up(LowPressureFlow(sweeping, low.P, T_low, h_low), cp_low, drive, UA, sat, vapour)
        heat = low.mass_flow * (h_next - h_low)
        h_low = h_next
        if is_supply_held:
            h_before, rho_cp_before, c_wall_before = supply_cell(high.P, T_before, isobar, departure)
            capacity = (exchanger.volume * rho_cp + exchanger.aluminium * c_wall) / exchanger.cells
            given[i] = (high.mass_flow * (h_before - h_cell) - heat) / capacity
            h_cell, rho_cp, c_wall = h_before, rho_cp_before, c_wall_before
        else:
            given[i] = heat
    return LowPressureFlow(low.mass_flow, low.P, T_low, h_low)


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
    exchanger: HeatExchanger, first: int, P: float, stages: RealArray, slopes: RealArray, dt: float, x: RealArray,
    helium: Helium,
) -> None:  # fmt: skip
    """Correct the temperatures in `x` of an exchanger's cells, whose first is `first`, where they moved by much.

    Those that hold what they were brought within `LEAST_ENERGY` are left alone: halving a step has to pay. `P` (Pa) is
    the supply pressure; `stages` and `slopes`, the states at the stages of a step of `dt` (s) and their rates, have the
    shape (4, N).
    """
    for i in range(first, first + exchanger.cells):
        if COARSE < widest_move(stages, x, i, i + 1) < WILD:
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
