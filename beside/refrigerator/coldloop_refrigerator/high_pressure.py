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
from coldloop_plant.cold_box import ColdBox, Streams
from coldloop_plant.components.heat_exchanger import HeatExchanger, LowPressureFlow
from coldloop_plant.helium import (
    GAS_CONSTANT,
    HIGHEST_DEPARTURE,
    HIGHEST_SUPPLY,
    ISOBAR_PRESSURE,
    LOWEST_DEPARTURE,
    LOWEST_SUPPLY,
    Helium,
    supply_cubics,
)
from coldloop_plant.numeric import Array, at_least
from coldloop_refrigerator.precooler import Precooler, Precooling, precooler_flows
from coldloop_refrigerator.station import SECOND_VIRIAL

CUBICS = 18
"""Columns of `supply_cubics`."""
H, CAPACITY, EXPANSION, COMPRESSION, WORK, MASS, ENERGY, M_IN, M_IN_P, H_IN, INFLOW, GAIN = range(12)
COLUMNS = 12
"""Number of columns of a cell: h (J/kg), C (J/K), v rho_T/C (kg/J), v rho_P (kg/Pa), v (1 - rho h_P) (J/Pa), M (kg), U
(J); m_in at constant pressure (kg/s), its slope in dP/dt (kg/Pa), h_in (J/kg); dM/dt (kg/s), dU/dt (W)."""
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
    exchanger: HeatExchanger, heat: Array, leaving: Passing, tapped: float, h_before: float, forwards: Array,
    cells: Array,
) -> Passing:  # fmt: skip
    """Return what enters at the hot end of an exchanger, and write that of each cell into `cells`.

    `heat` (W) is what each cell gives to the low-pressure gas. `leaving` passes the cold end, and `tapped` (kg/s)
    leaves there beside it as the last cell is. `h_before` (J/kg) is the enthalpy before the first cell; `forwards` says
    whether the flow into each cell comes from its hot side. `cells` is from `hold_cells`.
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


FIRST: Final = 2
"""Index of the first cell among the states."""
COARSE_PRESSURE: Final = 20.0
COARSE_CELL: Final = 0.0004
"""Pa and K; where a step moves the pressure and all cells by less, nothing is corrected."""
MOST_STEPS: Final = 40
"""Largest number of steps of Newton's method for the pressure."""
MOST_CORRECTIONS: Final = 30
"""Largest number of corrections of the temperatures after a step; one to three are enough but where the tables end, at
5 and 19 bar."""
SETTLED_ENERGY: Final = 1e-4
"""J that was missing in a cell, from which on the correction for it is the last: it leaves a hundredth or so."""
MOST_TURNS: Final = 6
"""Within which the directions of the flows are found."""
MOST_PASSES: Final = 6
SAME_FLOW: Final = 5e-4
"""kg/s; the heats of NEF6 are those of flows that differ by less. Each pass comes some hundred times closer."""


class PipedPasses(NamedTuple):
    """Exchangers and their places among the states."""

    box: ColdBox
    precooler: Precooler
    nef2: int
    """Index of the first cell; NEF1 begins at `FIRST`."""
    nef34: int
    nef6: int
    coil: int


class Held(NamedTuple):
    """Properties of the gas in the passes."""

    cubics: Array
    """Coefficients for cells and coil, `supply_cubics`, shape (states up to the coil, 18)."""
    mass: Array
    """Cubic of the mass in all passes in bar from 16 bar, kg, shape (4,)."""
    cells: Array
    """Columns from `H` on, shape (states up to the coil, 12)."""


class Filling(NamedTuple):
    """Flows of helium into and out of the high-pressure side."""

    P: float
    """Pa."""
    P_rate: float
    """Pa/s."""
    entering: float
    """Flow from the line into NEF6, kg/s; below 0 the passes give back."""
    h: float
    """Enthalpy that this carries, J/kg."""
    cells: Array
    """Content and gains of the cells, see `Held`."""


class Gains(NamedTuple):
    """Content of the cells at the start of a step, and the sums of their weighted gains over its stages."""

    start: Array
    """Columns from `H` on at the first stage."""
    gained: Array
    """Mass (kg/s) and energy (W) of each cell, shape (states up to the coil, 2)."""


@kernel
def piped(box: ColdBox, precooler: Precooler) -> PipedPasses:
    """Return the passes of a refrigerator."""
    nef2 = FIRST + box.nef1.cells
    nef34 = nef2 + box.nef2.cells
    nef6 = nef34 + box.nef34.cells
    return PipedPasses(box, precooler, nef2, nef34, nef6, nef6 + precooler.nef6.cells)


@kernel
def read_passes(x: Array, pipes: PipedPasses, helium: Helium) -> Held:
    """Return what follows from the temperatures in the state `x` alone; `cells` comes empty."""
    box, nef2, nef34, nef6, coil = pipes.box, pipes.nef2, pipes.nef34, pipes.nef6, pipes.coil
    cubics, mass = np.empty((coil + 1, CUBICS), x.dtype), np.zeros(4, x.dtype)
    read_cells(box.nef1, x[FIRST:nef2], helium, cubics[FIRST:nef2], mass)
    read_cells(box.nef2, x[nef2:nef34], helium, cubics[nef2:nef34], mass)
    read_cells(box.nef34, x[nef34:nef6], helium, cubics[nef34:nef6], mass)
    read_cells(pipes.precooler.nef6, x[nef6:coil], helium, cubics[nef6:coil], mass)
    supply_cubics(x[coil], helium, cubics[coil])
    return Held(cubics, mass, np.empty((coil + 1, COLUMNS), x.dtype))


@kernel
def line_mass(volume: float, P: float, T: float) -> tuple[float, float]:
    """Return what a line of `volume` (m3) holds (kg) at `P` (Pa) and `T` (K), and its slope in P (kg/Pa)."""
    thermal = GAS_CONSTANT * T
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
    box, nef2, nef34, nef6, coil = pipes.box, pipes.nef2, pipes.nef34, pipes.nef6, pipes.coil
    cubics, cells = held.cubics, held.cells
    hold_cells(box.nef1, at, cubics[FIRST:nef2], cells[FIRST:nef2])
    hold_cells(box.nef2, at, cubics[nef2:nef34], cells[nef2:nef34])
    hold_cells(box.nef34, at, cubics[nef34:nef6], cells[nef34:nef6])
    hold_cells(pipes.precooler.nef6, at, cubics[nef6:coil], cells[nef6:coil])
    cells[coil, H] = cubic(cubics[coil], 0, at.bar)


class _Ends(NamedTuple):
    """Flows at the cold ends of the exchangers, and through the coil."""

    nef1: Passing
    nef2: Passing
    nef34: Passing
    coil: Passing
    nef6: Passing


@kernel
def _march_cold(heat: Array, cold: Streams, pipes: PipedPasses, cells: Array, forwards: Array) -> _Ends:
    """Return the flows up to the coil as they are affine in dP/dt; `heat` as in `fill_passes`."""
    box, nef2, nef34, nef6, coil = pipes.box, pipes.nef2, pipes.nef34, pipes.nef6, pipes.coil
    none = 0.0 * cold.m_jt
    out_1 = Passing(cold.m_jt, none, cold.h_jt)
    out_2 = march_flows(
        box.nef1, heat[FIRST:nef2], out_1, none, cells[nef34 - 1, H], forwards[FIRST:nef2], cells[FIRST:nef2]
    )
    out_34 = march_flows(
        box.nef2, heat[nef2:nef34], out_2, none, cells[nef6 - 1, H], forwards[nef2:nef34], cells[nef2:nef34]
    )
    out_5 = march_flows(
        box.nef34, heat[nef34:nef6], out_34, cold.m_t, cells[coil, H], forwards[nef34:nef6], cells[nef34:nef6]
    )
    out_6 = Passing(out_5.m, out_5.slope, cells[coil - 1, H] if forwards[nef34] else cells[coil, H])
    return _Ends(out_1, out_2, out_34, out_5, out_6)


@kernel
def _turned(dP: float, pipes: PipedPasses, cells: Array, forwards: Array) -> bool:
    """Write the directions of the flows at `dP` (Pa/s); return whether one differs from what was written."""
    box, nef2, nef34, nef6, coil = pipes.box, pipes.nef2, pipes.nef34, pipes.nef6, pipes.coil
    turned = turn_flows(box.nef1, dP, cells[FIRST:nef2], forwards[FIRST:nef2])
    turned |= turn_flows(box.nef2, dP, cells[nef2:nef34], forwards[nef2:nef34])
    turned |= turn_flows(box.nef34, dP, cells[nef34:nef6], forwards[nef34:nef6])
    turned |= turn_flows(pipes.precooler.nef6, dP, cells[nef6:coil], forwards[nef6:coil])
    return turned


@kernel
def fill_passes(
    P: float, gained: float, T_hot: float, cold: Streams, leaving: LowPressureFlow, volume: float, pipes: PipedPasses,
    held: Held, helium: Helium, x: Array, supply: float, dx: Array,
) -> tuple[Filling, Precooling]:  # fmt: skip
    """Write the rates of the pre-cooler, and replace the heats (W) of cells in `dx` by those of their temperatures.

    Args:
        P: From `side_pressure`, Pa.
        gained: By the whole high-pressure side, kg/s.
        T_hot: Temperature of the line, K.
        cold: Flows at the cold ends.
        leaving: Flow from the cold box to NEF6.
        volume: Volume of the line, m3.
        pipes: The passes.
        held: From `read_passes`; its cells are overwritten.
        helium: Tables.
        x: States.
        supply: 1 with nitrogen in the tank, 0 without.
        dx: Rates, with the heats that the cells of the cold box give at the places of their states.
    """
    box, nef2, nef34, nef6, coil = pipes.box, pipes.nef2, pipes.nef34, pipes.nef6, pipes.coil
    at, cells = supply_at(P), held.cells
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
                ends = _march_cold(dx, cold, pipes, cells, forwards)
            entering = march_flows(
                pipes.precooler.nef6, dx[nef6:coil], ends.nef6, none, h_hot, forwards[nef6:coil], cells[nef6:coil]
            )
            dP = (gained + cold.m_jt + cold.m_t - entering.m) / (in_line_P + entering.slope)
            if not _turned(dP, pipes, cells, forwards):
                break
        if _write_flows(dP, ends.coil, cells[nef6:coil], flows) <= SAME_FLOW and k > 0:
            break
    pass_rates(box.nef1, ends.nef1, none, dP, cells[FIRST:nef2], dx[FIRST:nef2])
    pass_rates(box.nef2, ends.nef2, none, dP, cells[nef2:nef34], dx[nef2:nef34])
    pass_rates(box.nef34, ends.nef34, cold.m_t, dP, cells[nef34:nef6], dx[nef34:nef6])
    pass_rates(pipes.precooler.nef6, ends.nef6, none, dP, cells[nef6:coil], dx[nef6:coil])
    m = ends.coil.m + ends.coil.slope * dP
    dx[coil] = (m * (ends.nef6.h - ends.coil.h) - dx[coil]) / pipes.precooler.nef5.capacity
    return Filling(P, dP, entering.m + entering.slope * dP, entering.h, cells), cooling


@kernel
def _write_flows(dP: float, through_coil: Passing, cells: Array, flows: Array) -> float:
    """Write the flows into the cells of NEF6 and through the coil at `dP` (Pa/s); return the largest change (kg/s)."""
    change, last = 0.0, cells.shape[0]
    for i in range(last + 1):
        flow = through_coil.m + through_coil.slope * dP
        if i < last:
            flow = cells[i, M_IN] + cells[i, M_IN_P] * dP
        change = max(change, abs(flow.real - flows[i].real))
        flows[i] = flow
    return change


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
    nef2, nef34, nef6, coil = pipes.nef2, pipes.nef34, pipes.nef6, pipes.coil
    T_coil = x[coil]
    hot = np.empty(CUBICS)
    supply_cubics(T_hot, helium, hot)
    for _ in range(MOST_CORRECTIONS):
        held = read_passes(x, pipes, helium)
        at = supply_at(side_pressure(volume, M, T_hot, held.mass))
        hold_passes(at, pipes, held)
        cells = held.cells
        flow, h_out, worst_1 = _settled(FIRST, nef2, 0.0, 0.0, cells[nef34 - 1, H], gains, weight, cells, x)
        flow, h_out, worst_2 = _settled(nef2, nef34, flow, h_out, cells[nef6 - 1, H], gains, weight, cells, x)
        flow, h_out, worst_34 = _settled(nef34, nef6, flow, h_out, cells[coil, H], gains, weight, cells, x)
        x[coil] = T_coil + flow * (cells[coil - 1, H] - h_out) / pipes.precooler.nef5.capacity
        h_out, h_hot = cells[coil - 1, H], cubic(hot, 0, at.bar)
        _, _, worst_6 = _settled(nef6, coil, flow, h_out, h_hot, gains, weight, cells, x)
        if max(worst_1, worst_2, worst_34, worst_6) <= SETTLED_ENERGY:
            break


@kernel
def _settled(
    first: int, last: int, flow: float, h_out: float, h_before: float, gains: Gains, weight: float, cells: Array,
    x: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """Correct the cells from `first` to `last` - 1, out of which `flow` (kg) more flows than the stages let out.

    It carries `h_out` (J/kg). Returns what more flows into them (kg), what that carries (J/kg), and the most that was
    missing in one (J).
    """
    worst = 0.0
    for i in range(last - 1, first - 1, -1):
        cell, start = cells[i], gains.start[i]
        entering = flow + cell[MASS] - start[MASS] - weight * gains.gained[i, 0]
        warmth = warmth_of(cell[H], cell[EXPANSION], cells[i - 1, H] if i > first else h_before)
        missing = start[ENERGY] + weight * gains.gained[i, 1] - cell[ENERGY]
        missing += entering * (cell[H] + warmth) - flow * h_out
        warmer = missing / (cell[CAPACITY] * (1.0 - cell[EXPANSION] * warmth))
        x[i] += warmer
        worst = max(worst, abs(missing))
        flow, h_out = entering + cell[CAPACITY] * cell[EXPANSION] * warmer, cell[H] + warmth
    return flow, h_out, worst
