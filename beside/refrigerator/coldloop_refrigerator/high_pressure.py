"""The high-pressure side: the line and, at the same pressure, the passes of NEF6, NEF34, NEF2 and NEF1.

Its helium is one state, so what enters and leaves is what it holds, to rounding; the pressure follows from it and from
the temperatures. NEF5's coil lies between NEF6 and NEF34; the helium in it belongs to its heat capacity, it has no
volume.

A cell of volume v and wall W holds M = v rho(P, T) and U = v (rho h - P) + W u. With one pressure P everywhere, m_in at
its hot end and m_out at its cold end:

    m_in - m_out = v (rho_T dT/dt + rho_P dP/dt)
    C dT/dt = m_in (h_in - h) - m_out (h_out - h) - Q + v (1 - rho h_P) dP/dt,   C = v rho h_T + W c

h_in and h_out are the enthalpies that the flows carry: those of the cells that they come from. Q goes to the
low-pressure gas. So m_in is affine in dP/dt, cell by cell from the cold end, where the flow is known. All slopes are
those of the tables (`supply_cubics`): what the cells hold changes by what these equations say, to rounding.

The heats of the cold box are those of the flows at the cold ends, towards CV155 and CV156, on which only depends how
fast the driving temperatures fade when they come to rest. Those of NEF6 and NEF5 are of the flows that are there: the
more helium the colder passes take or give, the more they differ from those at the cold ends.
"""

from typing import Final, NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined, kernel
from coldloop_plant import helium as properties
from coldloop_plant.cold_box import ColdBox, Streams
from coldloop_plant.components.heat_exchanger import HeatExchanger, LowPressureFlow
from coldloop_plant.helium import ISOBAR_PRESSURE, Helium, supply_cubics
from coldloop_plant.numeric import Array, at_least
from coldloop_refrigerator.warm import SECOND_VIRIAL, Precooler, Precooling, precooler_flows

CUBICS = 18  # Columns of `supply_cubics`
H, CAPACITY, EXPANSION, COMPRESSION, WORK, MASS, ENERGY, M_IN, M_IN_P, H_IN, INFLOW, GAIN = range(12)
COLUMNS = 12
"""Number of columns of a cell: h (J/kg), C (J/K), v rho_T/C (kg/J), v rho_P (kg/Pa), v (1 - rho h_P) (J/Pa), M (kg), U
(J); m_in at constant pressure (kg/s), its slope in dP/dt (kg/Pa), h_in (J/kg); dM/dt (kg/s), dU/dt (W)."""
MOST_FILLING = 0.8
"""Share of what enters that a cell keeps at most because that is colder; more, and cells of one temperature each cannot
be solved from the cold end. What enters then brings the heat that remains from the cell before."""


class Supply(NamedTuple):
    """A pressure, and where it is in the tables of the high-pressure gas."""

    P: float  # Pa
    bar: float  # From 16 bar, held at the ends of the tables, bar
    edge: float  # End of the tables (Pa) from which on rho goes in proportion to P; 0 between them


@inlined
def supply_at(P: float) -> Supply:
    """Return the place of `P` (Pa)."""
    if P.real < properties.LOWEST_SUPPLY:
        return Supply(P, properties.LOWEST_DEPARTURE + 0.0 * P, properties.LOWEST_SUPPLY)
    if P.real > properties.HIGHEST_SUPPLY:
        return Supply(P, properties.HIGHEST_DEPARTURE + 0.0 * P, properties.HIGHEST_SUPPLY)
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

    `T` (K) has the shape (cells,), hot end first, `cubics` (cells, 18); `mass` (4) is the cubic in bar from 16 bar of
    the mass in the passes, kg.
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

    m: float  # At constant pressure, kg/s; positive from the hot to the cold end
    slope: float  # Slope in dP/dt, kg/Pa
    h: float  # J/kg


@inlined
def warmth_of(h: float, expansion: float, h_before: float) -> float:
    """Return by how much (J/kg) what flows into a cell from before, with `h_before`, is warmer than the cell."""
    warmth = h_before - h
    if (expansion * warmth).real > MOST_FILLING:
        warmth = MOST_FILLING / expansion
    return warmth


@kernel
def march_flows(
    heat: Array, leaving: Passing, tapped: float, h_before: float, forwards: Array, cells: Array
) -> Passing:
    """Return what enters at the hot end of an exchanger, and write that of each cell into `cells`.

    `heat` (W) is what each cell gives to the low-pressure gas. `leaving` passes the cold end, and `tapped` (kg/s)
    leaves there beside it as the last cell is. `h_before` (J/kg) is the enthalpy before the first cell; `forwards` says
    whether the flow into each cell comes from its hot side. `cells` is from `hold_cells`.
    """
    m, m_P, h_out = leaving.m, leaving.slope, leaving.h
    for i in range(cells.shape[0] - 1, -1, -1):
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
def pass_rates(m_out: float, h_out: float, tapped: float, dP: float, cells: Array, dT: Array) -> tuple[float, float]:
    """Replace the heat of each cell of an exchanger (W) in `dT` by the rate of its temperature (K/s) at dP/dt (Pa/s).

    What it takes of mass and energy goes into the last columns of `cells`. `m_out` (kg/s) with `h_out` (J/kg) passes
    the cold end, `tapped` is that of `march_flows`. Returns what enters at the hot end in this way.
    """
    for i in range(cells.shape[0] - 1, -1, -1):
        cell, heat = cells[i], dT[i]
        m_in, h_in = cell[M_IN] + cell[M_IN_P] * dP, cell[H_IN]
        gained = m_in * (h_in - cell[H]) - m_out * (h_out - cell[H]) - heat
        dT[i] = (gained + cell[WORK] * dP) / cell[CAPACITY]
        cell[INFLOW] = m_in - m_out - tapped
        cell[GAIN] = gained + cell[H] * cell[INFLOW]
        m_out, h_out, tapped = m_in, h_in, 0.0 * tapped
    return m_out, h_out


@kernel
def turn_flows(dP: float, cells: Array, forwards: Array) -> bool:
    """Write which way the flow into each cell goes at dP/dt (Pa/s); return whether one goes another way than before."""
    turned = False
    for i in range(FIRST, forwards.shape[0]):
        forward = (cells[i, M_IN] + cells[i, M_IN_P] * dP).real >= 0.0
        turned = turned or forward != forwards[i]
        forwards[i] = forward
    return turned


FIRST: Final = 2  # Index of the first cell among the states
COARSE_PRESSURE: Final = 20.0
COARSE_CELL: Final = 0.0004  # Pa and K; where a step moves the pressure and all cells by less, nothing is corrected
MOST_STEPS: Final = 40  # Largest number of steps of Newton's method for the pressure
MOST_CORRECTIONS: Final = 30
"""Largest number of corrections of the temperatures after a step; one to three are enough but where the tables end, at
5 and 19 bar."""
SETTLED_ENERGY: Final = 1e-4
"""J that was missing in a cell, from which on the correction for it is the last: it leaves a hundredth or so."""
MOST_TURNS: Final = 6  # Within which the directions of the flows are found
MOST_PASSES: Final = 6
NEF34, NEF6 = 2, 3  # Indices in `PipedPasses`
SAME_FLOW: Final = 5e-4
"""kg/s; the heats of NEF6 are those of flows that differ by less. Each pass comes some hundred times closer."""


class PipedPasses(NamedTuple):
    """Exchangers and their places among the states."""

    exchangers: tuple[HeatExchanger, HeatExchanger, HeatExchanger, HeatExchanger]  # NEF1, NEF2, NEF34 and NEF6
    first: tuple[int, int, int, int, int]  # Index of the first cell of each, and at the end that of the coil
    before: tuple[int, int, int]  # Index of the cell, or the coil, out of which the gas flows into NEF1, NEF2 and NEF34
    coil: int
    precooler: Precooler


class Held(NamedTuple):
    """Properties of the gas in the passes."""

    cubics: Array  # Coefficients for cells and coil, `supply_cubics`, shape (states up to the coil, 18)
    mass: Array  # Cubic of the mass in all passes in bar from 16 bar, kg, shape (4,)
    cells: Array  # Columns from `H` on, shape (states up to the coil, 12)


class Filling(NamedTuple):
    """Flows of helium into and out of the high-pressure side."""

    P: float  # Pa
    P_rate: float  # Pa/s
    entering: float  # Flow from the line into NEF6, kg/s; below 0 the passes give back
    h: float  # Enthalpy that this carries, J/kg
    cells: Array  # Content and gains of the cells, see `Held`


class Gains(NamedTuple):
    """Content of the cells at the start of a step, and the sums of their weighted gains over its stages."""

    start: Array  # Columns from `H` on at the first stage
    gained: Array  # Mass (kg/s) and energy (W) of each cell, shape (states up to the coil, 2)


@kernel
def piped(box: ColdBox, precooler: Precooler) -> PipedPasses:
    """Return the passes of a refrigerator."""
    nef2 = FIRST + box.nef1.cells
    nef34 = nef2 + box.nef2.cells
    nef6 = nef34 + box.nef34.cells
    coil = nef6 + precooler.nef6.cells
    exchangers = (box.nef1, box.nef2, box.nef34, precooler.nef6)
    return PipedPasses(exchangers, (FIRST, nef2, nef34, nef6, coil), (nef34 - 1, nef6 - 1, coil), coil, precooler)


@kernel
def read_passes(x: Array, pipes: PipedPasses, helium: Helium) -> Held:
    """Return what follows from the temperatures in the state `x` alone; `cells` comes empty."""
    coil = pipes.coil
    cubics, mass = np.empty((coil + 1, CUBICS), x.dtype), np.zeros(4, x.dtype)
    for k in range(len(pipes.exchangers)):
        first, last = pipes.first[k], pipes.first[k + 1]
        read_cells(pipes.exchangers[k], x[first:last], helium, cubics[first:last], mass)
    supply_cubics(x[coil], helium, cubics[coil])
    return Held(cubics, mass, np.empty((coil + 1, COLUMNS), x.dtype))


@kernel
def line_mass(volume: float, P: float, T: float) -> tuple[float, float]:
    """Return what a line of `volume` (m3) holds (kg) at `P` (Pa) and `T` (K), and its slope in P (kg/Pa)."""
    thermal = properties.GAS_CONSTANT * T
    hard = thermal + SECOND_VIRIAL * P
    return volume * P / hard, volume * thermal / (hard * hard)


@kernel
def side_mass(volume: float, P: float, T: float, mass: Array) -> tuple[float, float]:
    """Return what the line and the passes hold (kg), and the slope at constant temperatures (kg/Pa)."""
    in_line, in_line_P = line_mass(volume, P, T)
    in_passes, in_passes_P = density_and_slope(mass, 0, supply_at(P))
    return in_line + in_passes, in_line_P + in_passes_P


@kernel
def side_pressure(volume: float, M: float, T: float, mass: Array) -> float:
    """Return the pressure (Pa) at which line and passes hold `M` (kg); they hold the more, the higher it is.

    Newton's method with real numbers, and a last step that carries derivatives along.
    """
    M = at_least(M, 0.0)
    real = mass.real.copy()
    full, _ = side_mass(volume, ISOBAR_PRESSURE, T.real, real)
    P = ISOBAR_PRESSURE * M.real / full
    if P <= 0.0:
        return 0.0 * M * T
    for _ in range(MOST_STEPS):
        found, slope = side_mass(volume, P, T.real, real)
        step = (M.real - found) / slope
        P = max(P + step, 0.5 * P)  # below 5 bar cold passes give more helium for a bar than above
        if abs(step) <= 1e-9 * P:
            break
    found, slope = side_mass(volume, P + 0.0 * M, T, mass)
    return P + (M - found) / slope


@kernel
def hold_passes(at: Supply, pipes: PipedPasses, held: Held) -> None:
    """Write what follows from pressure and temperatures into `held.cells`."""
    for k in range(len(pipes.exchangers)):
        first, last = pipes.first[k], pipes.first[k + 1]
        hold_cells(pipes.exchangers[k], at, held.cubics[first:last], held.cells[first:last])
    held.cells[pipes.coil, H] = cubic(held.cubics[pipes.coil], 0, at.bar)


@kernel
def _march_cold(heat: Array, cold: Streams, pipes: PipedPasses, cells: Array, forwards: Array) -> Passing:
    """Return the flow out of NEF6 as it is affine in dP/dt, and write that through the coil; `heat` as `dx` below."""
    none, coil = 0.0 * cold.m_jt, pipes.coil
    out = Passing(cold.m_jt, none, cold.h_jt)
    for k in range(len(pipes.before)):
        first, last = pipes.first[k], pipes.first[k + 1]
        tapped = cold.m_t if k == NEF34 else none
        out = march_flows(
            heat[first:last], out, tapped, cells[pipes.before[k], H], forwards[first:last], cells[first:last]
        )
    cells[coil, M_IN], cells[coil, M_IN_P] = out.m, out.slope
    return Passing(out.m, out.slope, cells[coil - 1, H] if forwards[pipes.first[NEF34]] else cells[coil, H])


@kernel
def fill_passes(
    P: float, gained: float, T_hot: float, cold: Streams, leaving: LowPressureFlow, volume: float, pipes: PipedPasses,
    held: Held, helium: Helium, x: Array, supply: float, dx: Array,
) -> tuple[Filling, Precooling]:  # fmt: skip
    """Write the rates of the pre-cooler, and replace the heats (W) of cells in `dx` by those of their temperatures.

    `P` (Pa) is from `side_pressure`, `gained` (kg/s) by the whole high-pressure side, whose line has `volume` (m3) and
    `T_hot` (K). `cold` are the flows at the cold ends, `leaving` flows from the cold box to NEF6; `supply` is 1 with
    nitrogen in the tank, 0 without. `held` is from `read_passes`; its cells are overwritten. `dx` are the rates of the
    states `x`, with the heats that the cells of the cold box give at the places of their states.
    """
    at, cells, nef6, coil = supply_at(P), held.cells, pipes.first[NEF6], pipes.coil
    hold_passes(at, pipes, held)
    hot = np.empty(CUBICS, dx.dtype)
    supply_cubics(T_hot + 0.0 * P, helium, hot)
    _, in_line_P = line_mass(volume, P, T_hot)
    h_hot, forwards, none = cubic(hot, 0, at.bar), np.ones(coil, np.bool_), 0.0 * P
    flows = np.zeros(coil + 1 - nef6, dx.dtype)
    for k in range(MOST_PASSES):
        if k > 0:
            cooling = precooler_flows(
                x[nef6 : coil + 3], T_hot, flows, leaving, supply, pipes.precooler, dx[nef6 : coil + 3]
            )
        else:  # as if NEF6 rested: its flows then come close to those that follow
            for i in range(nef6, coil):
                dx[i] = (cold.m_jt + cold.m_t) * ((cells[i - 1, H] if i > nef6 else h_hot) - cells[i, H])
        for turns in range(MOST_TURNS + 1):
            if k == 0 or turns > 0:
                out = _march_cold(dx, cold, pipes, cells, forwards)
            entering = march_flows(dx[nef6:coil], out, none, h_hot, forwards[nef6:coil], cells[nef6:coil])
            dP = (gained + cold.m_jt + cold.m_t - entering.m) / (in_line_P + entering.slope)
            if not turn_flows(dP, cells, forwards):
                break
        change = 0.0
        for i in range(coil + 1 - nef6):
            flow = cells[nef6 + i, M_IN] + cells[nef6 + i, M_IN_P] * dP
            change = max(change, abs(flow.real - flows[i].real))
            flows[i] = flow
        if k > 0 and change <= SAME_FLOW:
            break
    m, h = cold.m_jt, cold.h_jt
    for k in range(NEF6):
        first, last = pipes.first[k], pipes.first[k + 1]
        m, h = pass_rates(m, h, cold.m_t if k == NEF34 else none, dP, cells[first:last], dx[first:last])
    dx[coil] = (m * (out.h - h) - dx[coil]) / pipes.precooler.nef5.capacity
    pass_rates(m, out.h, none, dP, cells[nef6:coil], dx[nef6:coil])
    return Filling(P, dP, entering.m + entering.slope * dP, entering.h, cells), cooling


@kernel
def start_gains(cells: Array) -> Gains:
    """Begin to keep account of a step with its first stage, `Filling.cells`, and the weight 1."""
    gains = Gains(cells, np.zeros((cells.shape[0], 2)))
    add_gains(gains, cells, 1.0)
    return gains


@kernel
def add_gains(gains: Gains, cells: Array, weight: float) -> None:
    """Add what the cells gain at a stage."""
    for i in range(FIRST, cells.shape[0] - 1):
        gains.gained[i, 0] += weight * cells[i, INFLOW]
        gains.gained[i, 1] += weight * cells[i, GAIN]


@kernel
def settle_passes(
    M: float, gains: Gains, weight: float, T_hot: float, volume: float, pipes: PipedPasses, x: Array, helium: Helium
) -> None:
    """Correct the temperatures of the cells in `x` (48) so that they hold what the stages of a step brought.

    The flow into a cell is corrected with them by what its mass is off, and carries what it does in `march_flows`.

    After the step line and passes hold `M` (kg); the line has `volume` (m3) and `T_hot` (K). `weight` (s) is that of a
    stage whose weight in `gains` is 1.
    """
    coil, T_coil, hot = pipes.coil, x[pipes.coil], np.empty(CUBICS)
    supply_cubics(T_hot, helium, hot)
    for _ in range(MOST_CORRECTIONS):
        held = read_passes(x, pipes, helium)
        at = supply_at(side_pressure(volume, M, T_hot, held.mass))
        hold_passes(at, pipes, held)
        cells, flow, h_out, worst = held.cells, 0.0, 0.0, 0.0
        for k in range(len(pipes.exchangers)):
            first = pipes.first[k]
            if k == NEF6:
                x[coil] = T_coil + flow * (cells[coil - 1, H] - h_out) / pipes.precooler.nef5.capacity
                h_out = cells[coil - 1, H]
            h_hot = cubic(hot, 0, at.bar) if k == NEF6 else cells[pipes.before[k], H]
            for i in range(pipes.first[k + 1] - 1, first - 1, -1):
                cell, start = cells[i], gains.start[i]
                entering = flow + cell[MASS] - start[MASS] - weight * gains.gained[i, 0]  # beyond that of the stages
                warmth = warmth_of(cell[H], cell[EXPANSION], cells[i - 1, H] if i > first else h_hot)
                missing = start[ENERGY] + weight * gains.gained[i, 1] - cell[ENERGY]
                missing += entering * (cell[H] + warmth) - flow * h_out
                warmer = missing / (cell[CAPACITY] * (1.0 - cell[EXPANSION] * warmth))
                x[i] += warmer
                worst = max(worst, abs(missing))
                flow, h_out = entering + cell[CAPACITY] * cell[EXPANSION] * warmer, cell[H] + warmth
        if worst <= SETTLED_ENERGY:
            break
