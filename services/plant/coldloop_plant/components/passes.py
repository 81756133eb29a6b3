"""High-pressure passes that take and give helium: the gas in the cells of exchangers whose pressure moves.

A cell of volume v and wall W holds M = v rho(P, T) and U = v (rho h - P) + W u. With one pressure P everywhere, m_in at
its hot end and m_out at its cold end:

    m_in - m_out = v (rho_T dT/dt + rho_P dP/dt)
    C dT/dt = m_in (h_in - h) - m_out (h_out - h) - Q + v (1 - rho h_P) dP/dt,   C = v rho h_T + W c

h_in and h_out are the enthalpies that the flows carry: those of the cells that they come from. Q goes to the
low-pressure gas. So m_in is affine in dP/dt, cell by cell from the cold end, where the flow is known. All slopes are
those of the tables (`supply_cubics`): what the cells hold changes by what these equations say, to rounding.
"""

from typing import NamedTuple

from coldloop.kernels.compiled import inlined, kernel
from coldloop_plant.components.heat_exchanger import HeatExchanger
from coldloop_plant.helium.properties import (
    HIGHEST_DEPARTURE,
    HIGHEST_SUPPLY,
    ISOBAR_PRESSURE,
    LOWEST_DEPARTURE,
    LOWEST_SUPPLY,
    Helium,
    supply_cubics,
)
from coldloop_plant.numeric import Array

CUBICS = 18
"""Columns of `supply_cubics`."""
H, CAPACITY, EXPANSION, COMPRESSION, WORK, MASS, ENERGY, M_IN, M_IN_P, H_IN, INFLOW, GAIN = range(12)
COLUMNS = 12
"""Of a cell: h (J/kg), C (J/K), v rho_T/C (kg/J), v rho_P (kg/Pa), v (1 - rho h_P) (J/Pa), M (kg), U (J); m_in at
constant pressure (kg/s), its slope in dP/dt (kg/Pa), h_in (J/kg); dM/dt (kg/s), dU/dt (W)."""
MOST_FILLING = 0.8
"""Share of what enters that a cell keeps at most because that is colder; more, and cells of one temperature each cannot
be solved from the cold end. What enters then brings the heat that remains from the cell before."""


class Supply(NamedTuple):
    """A pressure, and where it is in the tables of the high-pressure gas."""

    P: float
    """Pa."""
    bar: float
    """From 16 bar, held at the ends of the tables, bar."""
    edge: float
    """End of the tables (Pa) from which on rho goes in proportion to P; 0 between them."""


@inlined
def supply_at(P: float) -> Supply:
    """Return the place of `P` (Pa)."""
    if P.real < LOWEST_SUPPLY:
        return Supply(P, LOWEST_DEPARTURE + 0.0 * P, LOWEST_SUPPLY)
    if P.real > HIGHEST_SUPPLY:
        return Supply(P, HIGHEST_DEPARTURE + 0.0 * P, HIGHEST_SUPPLY)
    return Supply(P, (P - ISOBAR_PRESSURE) / 1e5, 0.0)


@inlined
def cubic(c: Array, first: int, bar: float) -> float:
    """Return the cubic whose coefficients begin at `first`."""
    value: float = c[first] + bar * (c[first + 1] + bar * (c[first + 2] + bar * c[first + 3]))
    return value


@inlined
def cubic_slope(c: Array, first: int, bar: float) -> float:
    """Return its derivative, per Pa."""
    value: float = (c[first + 1] + bar * (2.0 * c[first + 2] + bar * 3.0 * c[first + 3])) / 1e5
    return value


@inlined
def density_and_slope(c: Array, first: int, at: Supply) -> tuple[float, float]:
    """Return rho and its slope in P, where the cubic for rho begins at `first`."""
    rho = cubic(c, first, at.bar)
    if at.edge > 0.0:
        return rho * (at.P / at.edge), rho / at.edge
    return rho, cubic_slope(c, first, at.bar)


@kernel
def read_cells(exchanger: HeatExchanger, T: Array, helium: Helium, cubics: Array, mass: Array) -> None:
    """Write the cubics at the temperatures `T` of its cells, and add the mass that they hold to `mass`.

    Args:
        exchanger: Parameters.
        T: Shape (cells,), hot end first, K.
        helium: Tables.
        cubics: Shape (cells, 18), overwritten.
        mass: Cubic in bar from 16 bar of the mass in the passes, kg, shape (4,).
    """
    volume = exchanger.volume / exchanger.cells
    for i in range(exchanger.cells):
        supply_cubics(T[i], helium, cubics[i])
        for power in range(4):
            mass[power] += volume * cubics[i, 8 + power]


@kernel
def hold_cells(exchanger: HeatExchanger, at: Supply, cubics: Array, cells: Array) -> None:
    """Write what follows from pressure and temperature into the columns up to `ENERGY` of `cells` (cells, 12)."""
    volume, wall = exchanger.volume / exchanger.cells, exchanger.aluminium / exchanger.cells
    for i in range(exchanger.cells):
        c, cell = cubics[i], cells[i]
        h = cubic(c, 0, at.bar)
        rho, rho_P = density_and_slope(c, 8, at)
        rho_T = cubic(c, 12, at.bar)
        h_P = cubic_slope(c, 0, at.bar)
        if at.edge > 0.0:
            rho_T, h_P = rho_T * (at.P / at.edge), 0.0 * h_P
        capacity = volume * rho * cubic(c, 4, at.bar) + wall * c[16]
        cell[H], cell[CAPACITY], cell[EXPANSION] = h, capacity, volume * rho_T / capacity
        cell[COMPRESSION] = volume * rho_P
        cell[WORK] = volume * (1.0 - rho * h_P)
        cell[MASS] = volume * rho
        cell[ENERGY] = volume * (rho * h - at.P) + wall * c[17]


class Passing(NamedTuple):
    """A flow that is affine in dP/dt, with what it carries."""

    m: float
    """At constant pressure, kg/s; positive from the hot to the cold end."""
    slope: float
    """Slope in dP/dt, kg/Pa."""
    h: float
    """J/kg."""


@inlined
def warmth_of(h: float, expansion: float, h_before: float) -> float:
    """Return by how much (J/kg) what flows into a cell from before, with `h_before`, is warmer than the cell."""
    warmth = h_before - h
    if (expansion * warmth).real > MOST_FILLING:
        warmth = MOST_FILLING / expansion
    return warmth


@kernel
def march_flows(
    exchanger: HeatExchanger,
    heat: Array,
    leaving: Passing,
    tapped: float,
    h_before: float,
    forwards: Array,
    cells: Array,
) -> Passing:
    """Return what enters at the hot end of an exchanger, and write that of each cell into `cells`.

    Args:
        exchanger: Parameters.
        heat: Given by each cell to the low-pressure gas, W, shape (cells,).
        leaving: At the cold end.
        tapped: Leaves there beside it as the last cell is, kg/s.
        h_before: Enthalpy before the first cell, J/kg.
        forwards: Whether the flow into each cell comes from its hot side, shape (cells,).
        cells: From `hold_cells`.
    """
    m, m_P, h_out = leaving.m, leaving.slope, leaving.h
    for i in range(exchanger.cells - 1, -1, -1):
        cell = cells[i]
        warmth = 0.0 * h_before
        if forwards[i]:
            warmth = warmth_of(cell[H], cell[EXPANSION], cells[i - 1, H] if i > 0 else h_before)
        through = 1.0 - cell[EXPANSION] * (h_out - cell[H])
        kept = 1.0 / (1.0 - cell[EXPANSION] * warmth)  # not in the way of what follows from cell to cell
        m = kept * through * m + kept * (tapped - cell[EXPANSION] * heat[i])
        tapped = 0.0 * tapped
        m_P = kept * through * m_P + kept * (cell[COMPRESSION] + cell[EXPANSION] * cell[WORK])
        h_out = cell[H] + warmth
        cell[M_IN], cell[M_IN_P], cell[H_IN] = m, m_P, h_out
    return Passing(m, m_P, h_out)


@kernel
def pass_rates(exchanger: HeatExchanger, leaving: Passing, tapped: float, dP: float, cells: Array, dT: Array) -> None:
    """Replace the heat of each cell (W) in `dT` by the rate of its temperature (K/s) at dP/dt (Pa/s).

    What it takes of mass and energy goes into the last columns of `cells`; `leaving` and `tapped` are those of
    `march_flows`.
    """
    m_out, h_out = leaving.m + leaving.slope * dP, leaving.h
    for i in range(exchanger.cells - 1, -1, -1):
        cell, heat = cells[i], dT[i]
        m_in, h_in = cell[M_IN] + cell[M_IN_P] * dP, cell[H_IN]
        gained = m_in * (h_in - cell[H]) - m_out * (h_out - cell[H]) - heat
        dT[i] = (gained + cell[WORK] * dP) / cell[CAPACITY]
        cell[INFLOW] = m_in - m_out - tapped
        cell[GAIN] = gained + cell[H] * cell[INFLOW]
        m_out, h_out, tapped = m_in, h_in, 0.0 * tapped


@kernel
def turn_flows(exchanger: HeatExchanger, dP: float, cells: Array, forwards: Array) -> bool:
    """Write which way the flow into each cell goes at dP/dt; return whether that differs from what was written."""
    turned = False
    for i in range(exchanger.cells):
        forward = (cells[i, M_IN] + cells[i, M_IN_P] * dP).real >= 0.0
        turned = turned or forward != forwards[i]
        forwards[i] = forward
    return turned
