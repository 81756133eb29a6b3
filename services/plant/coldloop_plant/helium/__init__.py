"""Thermodynamic properties of helium, read from the shipped tables.

All kernels take real or complex arguments, are differentiable, and hold arguments outside the tables at the edge; the
saturation line goes on straight. Enthalpies and entropies share CoolProp's reference. `tabulate` says how the tables
are made and how exact they are.

Tables are piecewise cubic on uniform grids. They hold, at each node, the value and the slopes of a twice differentiable
cubic spline, the slopes multiplied by the grid's step. Reading one is then the cubic Hermite formula between two nodes
(or its tensor product between four). A table may have nodes before its start: it was made longer, and what is read of
its first part keeps its bits.
"""

from functools import cache
from importlib.resources import files
from math import floor
from typing import Any, NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined, kernel
from coldloop_plant.numeric import Array, RealArray, at_least, at_most

# Weights of (left value, left slope, right value, right slope).
Weights = tuple[float, float, float, float]


class Curves(NamedTuple):
    """Several functions of one variable, tabulated on the same grid."""

    start: float  # Argument at the node of index `before`
    step: float  # Distance between nodes
    before: int  # Nodes before the start
    nodes: RealArray  # Shape (nodes, functions, 2): value, slope times step


class Surface(NamedTuple):
    """One function of two variables, tabulated; of each the grid is as in `Curves`, rows for the first one."""

    row_start: float
    row_step: float
    rows_before: int
    column_start: float
    column_step: float
    columns_before: int
    nodes: RealArray  # Shape (rows, columns, 4): value, slope along the columns, slope along the rows, mixed slope


@inlined
def locate(position: float, start: float, step: float, before: int, count: int) -> tuple[int, float]:
    """Return the index of the node to the left of `position` and the fraction of the way to the next."""
    scaled = (position - start) / step
    index = max(min(floor(scaled.real), count - 2 - before), -before)
    fraction = scaled - index
    if fraction.real < 0.0:
        fraction = 0.0 * fraction
    elif fraction.real > 1.0:
        fraction = 0.0 * fraction + 1.0
    return index + before, fraction


@inlined
def hermite_weights(t: float) -> Weights:
    """Return the cubic Hermite weights at the fraction `t` of a step."""
    rest = 1.0 - t
    return (1.0 + 2.0 * t) * rest * rest, t * rest * rest, t * t * (3.0 - 2.0 * t), -t * t * rest


@inlined
def hermite_slope_weights(t: float) -> Weights:
    """Return the derivatives of the cubic Hermite weights with respect to `t`."""
    rest = 1.0 - t
    return -6.0 * t * rest, rest * (1.0 - 3.0 * t), 6.0 * t * rest, t * (3.0 * t - 2.0)


@inlined
def read_curve(nodes: RealArray, index: int, function: int, weights: Weights) -> float:
    """Return one function of a `Curves`, given the interval and the weights within it."""
    left: float = weights[0] * nodes[index, function, 0] + weights[1] * nodes[index, function, 1]
    right: float = weights[2] * nodes[index + 1, function, 0] + weights[3] * nodes[index + 1, function, 1]
    return left + right


@inlined
def read_surface(table: Surface, row: float, column: float) -> tuple[float, float]:
    """Return the function's value and its derivative along the columns."""
    i, t = locate(row, table.row_start, table.row_step, table.rows_before, table.nodes.shape[0])
    value, slope = _read_across(table, i, hermite_weights(t), column)
    return value, slope


@inlined
def read_surface_slopes(table: Surface, row: float, column: float) -> tuple[float, float, float]:
    """Return the function's value, its derivative along the columns, and that along the rows."""
    i, t = locate(row, table.row_start, table.row_step, table.rows_before, table.nodes.shape[0])
    value, slope = _read_across(table, i, hermite_weights(t), column)
    across, _ = _read_across(table, i, hermite_slope_weights(t), column)
    return value, slope, across / table.row_step


@inlined
def _read_across(table: Surface, i: int, across: Weights, column: float) -> tuple[float, float]:
    """Return value and derivative along the columns between the rows `i` and `i + 1`, weighted by `across`."""
    nodes = table.nodes
    j, s = locate(column, table.column_start, table.column_step, table.columns_before, nodes.shape[1])
    left, left_slope = _between_rows(nodes, i, j, across)
    right, right_slope = _between_rows(nodes, i, j + 1, across)
    w, d = hermite_weights(s), hermite_slope_weights(s)
    value = w[0] * left + w[1] * left_slope + w[2] * right + w[3] * right_slope
    slope = d[0] * left + d[1] * left_slope + d[2] * right + d[3] * right_slope
    return value, slope / table.column_step


@inlined
def _between_rows(nodes: RealArray, row: int, column: int, across: Weights) -> tuple[float, float]:
    """Return the value and the slope along the columns, at a column of nodes and between two rows."""
    value = across[0] * nodes[row, column, 0] + across[1] * nodes[row, column, 2]
    value += across[2] * nodes[row + 1, column, 0] + across[3] * nodes[row + 1, column, 2]
    slope = across[0] * nodes[row, column, 1] + across[1] * nodes[row, column, 3]
    slope += across[2] * nodes[row + 1, column, 1] + across[3] * nodes[row + 1, column, 3]
    return value, slope


GAS_CONSTANT = 2077.26  # J/(kg K), of helium
ISOBAR_PRESSURE = 16e5  # Pa
LOWEST_SATURATION, HIGHEST_SATURATION = 0.3e5, 2.25e5  # Pa, ends of the saturation line's table
LOWEST_DEPARTURE, HIGHEST_DEPARTURE = -11.0, 3.0  # bar from there; beyond, h is held and rho in proportion to P
LOWEST_SUPPLY, HIGHEST_SUPPLY = ISOBAR_PRESSURE + 1e5 * LOWEST_DEPARTURE, ISOBAR_PRESSURE + 1e5 * HIGHEST_DEPARTURE
COLDEST = 1.0  # K, below the table; for the logarithm
WARMEST_ISOBAR = 300.0  # K; above it the gas has the heat capacity that it has there
COLDEST_ENTHALPY = 6.1e3  # J/kg, before a turbine, at the edge of the table
LARGEST_SUPERHEAT, LARGEST_EXCESS = 115.0, 600e3  # K and J/kg, the same for the vapour
EDGE_TEMPERATURE = 118.0  # K, of vapour with that excess
WARM_CP = 5193.2  # J/(kg K), of helium there
ALUMINIUM_ENTHALPY = 4  # its place in `Helium.isobar`
SUPERHEAT_OFFSET = 0.3  # K, keeps the logarithm of the superheat finite on the saturation line
EXCESS_OFFSET = 1500.0  # J/kg, the same for the enthalpy above that of the saturated vapour


class Helium(NamedTuple):
    """The tables that the kernels of this module read."""

    isobar: Curves
    """Along the 16 bar isobar, in ln T, 2.5 to 300 K: h, rho, rho cp; and aluminium's heat capacity and enthalpy."""
    saturation: Curves
    """Along the saturation line, in P, 0.3 to 2.25 bar: T, rho_l, rho_v, h_l, h_v, s_v."""
    vapour: Surface
    """On (P, ln(T - Tsat + 0.3 K)): h."""
    vapour_superheat: Surface
    """On (P, ln(h - h_v + 1500 J/kg)): ln(T - Tsat + 0.3 K)."""
    vapour_excess: Surface
    """On (P, s - s_v): ln(h - h_v + 1500 J/kg)."""
    turbine_entropy: Surface
    """On (ln P, ln h), 0.3 to 20 bar: s + R ln P, which is smooth down to low pressures."""
    departure: Curves
    """In ln T as `isobar`: cubics in bar from 16 bar for enthalpy, density and rho cp, nine coefficients."""
    vapour_density: Surface
    """On (P, ln(h - h_v + 1500 J/kg)): ln rho."""


class Saturation(NamedTuple):
    """Temperature (K), densities (kg/m3), enthalpies (J/kg) and entropy (J/(kg K)) of boiling helium at one pressure.

    Of the liquid (l) and the vapour (v). Or their derivatives with respect to the pressure, per Pa.
    """

    T: float
    rho_l: float
    rho_v: float
    h_l: float
    h_v: float
    s_v: float


@cache
def load_helium() -> Helium:
    """Return the shipped tables."""
    with files("coldloop_plant.helium").joinpath("helium_tables.npz").open("rb") as file, np.load(file) as archive:
        stored: dict[str, Any] = {name: archive[name] for name in archive.files}

    def curves(name: str) -> Curves:
        start, step, before = stored[f"{name}_grid"].tolist()
        return Curves(start, step, int(before), stored[name])

    def surface(name: str) -> Surface:
        row_start, row_step, rows, column_start, column_step, columns = stored[f"{name}_grid"].tolist()
        return Surface(row_start, row_step, int(rows), column_start, column_step, int(columns), stored[name])

    return Helium(
        isobar=curves("isobar"),
        saturation=curves("saturation"),
        vapour=surface("vapour"),
        vapour_superheat=surface("vapour_superheat"),
        vapour_excess=surface("vapour_excess"),
        turbine_entropy=surface("turbine_entropy"),
        departure=curves("departure"),
        vapour_density=surface("vapour_density"),
    )


@inlined
def _departure(P: float, function: int, i: int, weights: Weights, departure: Curves) -> float:
    """Return by how much a function of the isobar differs at `P` (Pa, 5e5 to 19e5) from that at 16 bar."""
    bar = at_most(at_least((P - ISOBAR_PRESSURE) / 1e5, LOWEST_DEPARTURE), HIGHEST_DEPARTURE)
    nodes = departure.nodes
    cubic: float = bar * (
        read_curve(nodes, i, 3 * function, weights)
        + bar
        * (read_curve(nodes, i, 3 * function + 1, weights) + bar * read_curve(nodes, i, 3 * function + 2, weights))
    )
    return cubic


@inlined
def thinned(P: float, density: float) -> float:
    """Return `density` in proportion to `P` (Pa) below 5 and above 19 bar, where its table ends."""
    if P.real < LOWEST_SUPPLY:
        return density * (P / LOWEST_SUPPLY)
    if P.real > HIGHEST_SUPPLY:
        return density * (P / HIGHEST_SUPPLY)
    return density


@inlined
def _supply(P: float, T: float, function: int, table: Curves, departure: Curves) -> tuple[float, float, int, Weights]:
    """Return h (J/kg) and rho or rho cp, the `function` of the isobar's table, with the place of `T` there."""
    i, t = locate(np.log(at_least(T, COLDEST)), table.start, table.step, table.before, table.nodes.shape[0])
    weights = hermite_weights(t)
    h = read_curve(table.nodes, i, 0, weights) + 0.0 * P
    found = read_curve(table.nodes, i, function, weights) + 0.0 * P
    if P != ISOBAR_PRESSURE:
        h += _departure(P, 0, i, weights, departure)
        found = thinned(P, found + _departure(P, function, i, weights, departure))
    if T.real > WARMEST_ISOBAR:
        return h + WARM_CP * (T - WARMEST_ISOBAR), found * WARMEST_ISOBAR / T, i, weights
    return h, found, i, weights


@inlined
def supply_enthalpy_and_density(P: float, T: float, helium: Helium) -> tuple[float, float]:
    """Return h (J/kg) and rho (kg/m3) of the high-pressure gas at `P` (Pa, 5e5 to 19e5) and `T` (K, 2.5 to 350).

    At 16 bar they are those of the isobar's table, to the bit; below 5 and above 19 bar rho goes on in proportion to P.
    Elsewhere h is within 0.1 K times cp and rho within 5 %
    of CoolProp from 6 to 8 K, where cp has its peak, within 0.03 K and 3 % else below 10 K, within 0.01 K and 1 % from
    there to 80 K, and above within 1e-5.
    """
    h, rho, _, _ = _supply(P, T, 1, helium.isobar, helium.departure)
    return h, rho


@inlined
def supply_cell(P: float, T: float, table: Curves, departure: Curves) -> tuple[float, float, float]:
    """Return what an exchanger cell needs at `P` (Pa) and `T` (K): h (J/kg), rho cp (J/(m3 K)), c_Al (J/(kg K)).

    `table` and `departure` are `Helium.isobar` and `Helium.departure`. Ranges as for
    `supply_enthalpy_and_density`; rho cp is within 18 % below 10 K (9 % from 12 to 19 bar) and 6 % above.
    """
    h, rho_cp, i, weights = _supply(P, T, 2, table, departure)
    return h, rho_cp, read_curve(table.nodes, i, 3, weights)


@inlined
def supply_cubics(T: float, helium: Helium, row: Array) -> None:
    """Write what does not depend on the pressure of the high-pressure gas and its wall at `T` (K) into `row` (18).

    Coefficients of the cubics in bar from 16 bar for h (J/kg), their slopes (per K), the same for rho (kg/m3); heat
    capacity (J/(kg K)) and enthalpy (J/kg) of aluminium. They are those of `supply_enthalpy_and_density`, and
    derivatives of one another to rounding: beyond the table h and the wall's enthalpy go on with their slopes, below it
    rho is held.
    """
    table, further = helium.isobar, helium.departure.nodes
    i, t = locate(np.log(at_least(T, COLDEST)), table.start, table.step, table.before, table.nodes.shape[0])
    w, d = hermite_weights(t), hermite_slope_weights(t)
    inside = T
    if T.real > WARMEST_ISOBAR:
        inside = WARMEST_ISOBAR + 0.0 * T
    elif i == 0 and t.real <= 0.0:
        inside = np.exp(table.start - table.before * table.step) + 0.0 * T
    per_kelvin = 1.0 / (table.step * inside)
    w_T = (d[0] * per_kelvin, d[1] * per_kelvin, d[2] * per_kelvin, d[3] * per_kelvin)
    row[0], row[4] = read_curve(table.nodes, i, 0, w), read_curve(table.nodes, i, 0, w_T)
    row[8], row[12] = read_curve(table.nodes, i, 1, w), read_curve(table.nodes, i, 1, w_T)
    for power in range(3):
        row[1 + power], row[5 + power] = read_curve(further, i, power, w), read_curve(further, i, power, w_T)
        row[9 + power], row[13 + power] = read_curve(further, i, 3 + power, w), read_curve(further, i, 3 + power, w_T)
    row[16] = read_curve(table.nodes, i, ALUMINIUM_ENTHALPY, w_T)
    row[17] = read_curve(table.nodes, i, ALUMINIUM_ENTHALPY, w)
    if inside.real != T.real:
        _go_on(T, inside, row)


@kernel
def _go_on(T: float, edge: float, row: Array) -> None:
    """Continue what `supply_cubics` wrote at the end `edge` of the table (K) to `T` (K)."""
    warm = T.real > WARMEST_ISOBAR
    for power in range(4):
        if warm:
            row[4 + power] = 0.0 * T + (WARM_CP if power == 0 else 0.0)
            row[8 + power] = row[8 + power] * WARMEST_ISOBAR / T
            row[12 + power] = -row[8 + power] / T
        else:
            row[12 + power] = 0.0 * T
        row[power] += row[4 + power] * (T - edge)
    row[17] += row[16] * (T - edge)


@inlined
def _saturation_at(nodes: RealArray, i: int, w: Weights, step: float) -> Saturation:
    T, rho_l, rho_v = read_curve(nodes, i, 0, w), read_curve(nodes, i, 1, w), read_curve(nodes, i, 2, w)
    h_l, h_v, s_v = read_curve(nodes, i, 3, w), read_curve(nodes, i, 4, w), read_curve(nodes, i, 5, w)
    return Saturation(T / step, rho_l / step, rho_v / step, h_l / step, h_v / step, s_v / step)


@inlined
def saturation(P: float, helium: Helium) -> Saturation:
    """Return the properties of boiling helium at `P` (Pa, 0.3e5 to 2.25e5); outside they go on with their slope."""
    table = helium.saturation
    i, t = locate(P, table.start, table.step, table.before, table.nodes.shape[0])
    w = hermite_weights(t)
    if P.real < LOWEST_SATURATION:
        w = (1.0 + 0.0 * t, (P - LOWEST_SATURATION) / table.step, 0.0 * t, 0.0 * t)
    elif P.real > HIGHEST_SATURATION:
        w = (0.0 * t, 0.0 * t, 1.0 + 0.0 * t, (P - HIGHEST_SATURATION) / table.step)
    return _saturation_at(table.nodes, i, w, 1.0)


@inlined
def saturation_slopes(P: float, helium: Helium) -> Saturation:
    """Return the derivatives of `saturation` with respect to P, per Pa; outside the table those at its edge."""
    table = helium.saturation
    i, t = locate(P, table.start, table.step, table.before, table.nodes.shape[0])
    w = hermite_slope_weights(t)
    return _saturation_at(table.nodes, i, w, table.step)


@inlined
def vapour_enthalpy_and_cp(P: float, T: float, T_sat: float, table: Surface) -> tuple[float, float]:
    """Return h (J/kg) and cp (J/(kg K)) of the vapour at `P` (Pa, 0.3e5 to 2.25e5) and `T` (K, T_sat to 350).

    `table` is `Helium.vapour`; beyond its 115 K of superheat the gas is perfect.
    """
    superheat = at_least(T - T_sat, 0.0) + SUPERHEAT_OFFSET
    if superheat.real > LARGEST_SUPERHEAT:
        h, _ = read_surface(table, P, np.log(LARGEST_SUPERHEAT))
        return h + WARM_CP * (superheat - LARGEST_SUPERHEAT), WARM_CP + 0.0 * superheat
    h, slope = read_surface(table, P, np.log(superheat))
    return h, slope / superheat


@inlined
def vapour_temperature(P: float, h: float, sat: Saturation, helium: Helium) -> float:
    """Return T (K) at `P` (Pa) and `h` (J/kg); with `h` below that of the saturated vapour, the boiling point."""
    if h.real <= sat.h_v.real:
        return sat.T + 0.0 * h
    excess = h - sat.h_v + EXCESS_OFFSET
    beyond = at_least(excess - LARGEST_EXCESS, 0.0)
    superheat, _ = read_surface(helium.vapour_superheat, P, np.log(excess - beyond))
    T: float = sat.T + np.exp(superheat) - SUPERHEAT_OFFSET + beyond / WARM_CP
    return T


@kernel
def vapour_density(
    P: float, excess: float, sat: Saturation, slope: Saturation, helium: Helium
) -> tuple[float, float, float]:
    """Return rho (kg/m3) of the vapour at `P` (Pa, 0.3e5 to 2.25e5) and `excess` (J/kg, 0 or more) above saturation.

    With its derivatives with respect to P and to the excess. `sat` and `slope` are those of the saturation line, which
    it leaves without a jump. Beyond the table the gas is perfect in temperature; outside its pressures the share of the
    saturated density is held.
    """
    beyond = at_least(excess + EXCESS_OFFSET - LARGEST_EXCESS, 0.0)
    inside = excess + EXCESS_OFFSET - beyond
    log_rho, by_log, log_rho_P = read_surface_slopes(helium.vapour_density, P, np.log(inside))
    at_edge, _, at_edge_P = read_surface_slopes(helium.vapour_density, P, np.log(EXCESS_OFFSET))
    rho = sat.rho_v * np.exp(log_rho - at_edge)
    by_excess = rho * by_log / inside
    by_P = slope.rho_v / sat.rho_v
    if LOWEST_SATURATION <= P.real <= HIGHEST_SATURATION:
        by_P += log_rho_P - at_edge_P
    if beyond.real > 0.0:
        warmer = 1.0 + beyond / (WARM_CP * EDGE_TEMPERATURE)
        rho = rho / warmer
        by_excess = -rho / warmer / (WARM_CP * EDGE_TEMPERATURE)
    return rho, rho * by_P, by_excess


@inlined
def enthalpy_after_isentropic_expansion(P: float, s: float, helium: Helium) -> float:
    """Return h (J/kg) at `P` (Pa, 0.3e5 to 2.25e5) and `s` (J/(kg K)); wet vapour follows dh = T ds."""
    sat = saturation(P, helium)
    if s.real <= sat.s_v.real:
        return sat.h_v + sat.T * (s - sat.s_v)
    excess, _ = read_surface(helium.vapour_excess, P, s - sat.s_v)
    h: float = sat.h_v + np.exp(excess) - EXCESS_OFFSET
    return h


@inlined
def entropy_before_expansion(P: float, h: float, helium: Helium) -> float:
    """Return s (J/(kg K)) at `P` (Pa, 0.3e5 to 20e5) and `h` (J/kg, 6e3 to 1600e3, that is 4 to 305 K at 16 bar).

    Held beyond these ends; below the coldest enthalpy it goes on with ds = dh/T of there.
    """
    log_pressure, within = np.log(at_least(P, 1.0)), at_least(h, COLDEST_ENTHALPY)
    entropy_sum, slope = read_surface(helium.turbine_entropy, log_pressure, np.log(within))
    s: float = entropy_sum - GAS_CONSTANT * log_pressure + slope * (h - within) / within
    return s
