"""The high-pressure passes take and give helium, and take up the work of the pressure."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coldloop_plant.cold_box import OUTPUTS
from coldloop_plant.components.heat_exchanger import HeatExchanger
from coldloop_plant.helium import load_helium, supply_cell, supply_enthalpy_and_density
from coldloop_plant.numeric import Array, RealArray
from coldloop_refrigerator.high_pressure import (
    CAPACITY,
    COLUMNS,
    CUBICS,
    ENERGY,
    FIRST,
    GAIN,
    INFLOW,
    M_IN,
    M_IN_P,
    MASS,
    Filling,
    H,
    Passing,
    PipedPasses,
    hold_cells,
    hold_passes,
    march_flows,
    pass_rates,
    piped,
    read_cells,
    read_passes,
    side_pressure,
    supply_at,
)
from coldloop_refrigerator.model import jacobian
from coldloop_refrigerator.physics import (
    BOX_STATES,
    SIGNALS,
    STATE_NAMES,
    advance_refrigerator,
    evaluate_refrigerator,
    evaluated,
    high_pressure_mass,
    inventory,
)
from coldloop_refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_refrigerator.program import SHIPPED, read_refrigerator_file
from coldloop_refrigerator.warm import gas_mass

pytestmark = pytest.mark.usefixtures("compiles")

HELIUM = load_helium()
PLANT = REFERENCE_REFRIGERATOR
FILE = read_refrigerator_file(SHIPPED)
M_HP, M_LOST = STATE_NAMES.index("M_HP"), STATE_NAMES.index("M_lost")
AMBIENT, HOT = 300.0, 305.0
VOLUME = PLANT.station.hp.volume
REST = np.array(FILE.x0)
INPUTS, VALVES = np.array(FILE.u0), np.array(FILE.v0)
GIVEN = np.array([FILE.w0, AMBIENT, 0.0, 1.0, 1.0, 1.0])
STOPPED = np.array([FILE.w0, AMBIENT, 0.0, 1.0, 0.0, 0.0])
OPEN = np.array([0.0, 100.0, 0.0, 30.0])
"""The high-pressure line empties into the buffer."""
MOVES = {
    "the inputs move": (INPUTS + np.array([3.0, 10.0, 4.0]), VALVES, GIVEN),
    "all compressors stop": (INPUTS, OPEN, STOPPED),
    "the bypass opens": (INPUTS, np.array([100.0, 0.0, 0.0, 30.0]), GIVEN),
}


@cache
def pipes() -> PipedPasses:
    return piped(PLANT.box, PLANT.precooler)


@cache
def cells() -> slice:
    return slice(FIRST, pipes().coil)


def filling(x: RealArray, u: RealArray, v: RealArray, d: RealArray) -> tuple[Filling, RealArray]:
    """Return how the passes fill, and dx/dt."""
    dx = np.empty_like(x)
    crossing = evaluate_refrigerator(x, u, v, d, PLANT, HELIUM, dx, np.empty(OUTPUTS), np.empty(SIGNALS))
    return crossing.filling, dx


def held_by(x: RealArray) -> tuple[float, Array]:
    """Return the pressure (Pa) and what the cells hold."""
    held = read_passes(x, pipes(), HELIUM)
    P = side_pressure(VOLUME, x[M_HP], HOT, held.mass)
    hold_passes(supply_at(P), pipes(), held)
    return P, held.cells[cells(), : ENERGY + 1]


def moved(name: str, seconds: float) -> RealArray:
    """Return the state some time after a move."""
    x = REST
    for _ in range(round(4 * seconds)):
        x = advance_refrigerator(x, *MOVES[name], 0.25, PLANT, HELIUM)
    return x


def test_at_rest_line_and_passes_hold_the_density_of_each_cell() -> None:
    box, nef6 = PLANT.box, PLANT.precooler.nef6
    sizes = [e.volume / e.cells for e in (box.nef1, box.nef2, box.nef34, nef6) for _ in range(e.cells)]
    in_passes = sum(
        size * supply_enthalpy_and_density(16e5, float(T), HELIUM)[1]
        for size, T in zip(sizes, REST[FIRST : pipes().coil], strict=True)
    )
    assert in_passes == pytest.approx(2.1274, abs=1e-4)
    assert REST[M_HP] == pytest.approx(in_passes + gas_mass(PLANT.station.hp, 16e5, HOT), rel=1e-12)


@given(P=st.floats(1e3, 26e5), warmth=st.floats(0.8, 6.0))
def test_the_pressure_is_that_at_which_line_and_passes_hold_their_helium(P: float, warmth: float) -> None:
    x = REST.copy()
    x[FIRST : pipes().coil] *= warmth
    mass = high_pressure_mass(x, P, AMBIENT, PLANT, HELIUM)
    held = read_passes(x, pipes(), HELIUM)
    assert side_pressure(VOLUME, mass, HOT, held.mass) == pytest.approx(P, rel=1e-12)


def test_the_pressure_of_passes_full_of_cold_helium_is_found_below_the_tables() -> None:
    x = REST.copy()
    x[FIRST : pipes().coil - 9] = 3.0
    mass = high_pressure_mass(x, 3e5, AMBIENT, PLANT, HELIUM)
    assert side_pressure(VOLUME, mass, HOT, read_passes(x, pipes(), HELIUM).mass) == pytest.approx(3e5, rel=1e-12)


def test_a_high_pressure_side_without_helium_has_no_pressure() -> None:
    held = read_passes(REST, pipes(), HELIUM)
    assert side_pressure(VOLUME, 0.0, HOT, held.mass) == 0.0
    assert side_pressure(VOLUME, -1e-9, HOT, held.mass) == 0.0
    assert high_pressure_mass(REST, 1.0, AMBIENT, PLANT, HELIUM) == pytest.approx(0.0, abs=1e-4)


@given(P=st.floats(1e5, 25e5), T=st.floats(2.6, 340.0))
def test_what_a_cell_holds_is_what_the_flows_of_the_plant_are_reckoned_with(P: float, T: float) -> None:
    exchanger = HeatExchanger(UA=0.0, volume=1e-3, aluminium=0.0, cells=1)
    cells = held_cells(exchanger, P, T)
    h, rho = supply_enthalpy_and_density(P, T, HELIUM)
    h_cell, _, _ = supply_cell(P, T, HELIUM.isobar, HELIUM.departure)
    assert h == h_cell
    assert cells[0, H] == pytest.approx(h, rel=1e-12)
    assert cells[0, MASS] == pytest.approx(1e-3 * rho, rel=1e-12)
    assert cells[0, ENERGY] == pytest.approx(1e-3 * (rho * h - P), rel=1e-9, abs=1e-9)


def held_cells(exchanger: HeatExchanger, P: float, T: float) -> RealArray:
    """Return what the cells of an exchanger of one temperature hold."""
    cubics, cells = np.empty((exchanger.cells, CUBICS)), np.empty((exchanger.cells, COLUMNS))
    read_cells(exchanger, np.full(exchanger.cells, T), HELIUM, cubics, np.zeros(4))
    hold_cells(exchanger, supply_at(P), cubics, cells)
    return cells


@pytest.mark.parametrize("name", MOVES)
@pytest.mark.parametrize("seconds", [0.0, 20.0, 120.0])
def test_pressure_mass_and_energy_move_as_their_rates_say(name: str, seconds: float) -> None:
    x, dt = moved(name, seconds), 1e-4
    now, dx = filling(x, *MOVES[name])
    P_later, later = held_by(x + dt * dx)
    P_before, before = held_by(x - dt * dx)
    assert (P_later - P_before) / (2.0 * dt) == pytest.approx(now.P_rate, rel=1e-5, abs=1e-3)
    gained = (later - before) / (2.0 * dt)
    assert gained[:, MASS] == pytest.approx(now.cells[cells(), INFLOW], abs=1e-8)
    assert gained[:, ENERGY] == pytest.approx(now.cells[cells(), GAIN], abs=0.02)


@pytest.mark.parametrize("name", MOVES)
def test_the_complex_step_gives_the_derivatives_of_the_rates(name: str) -> None:
    x, (u, v, d) = moved(name, 20.0), MOVES[name]
    J = jacobian(x, u, v, d, PLANT, HELIUM)
    sizes = np.where(np.abs(x) > 1.0, np.abs(x), 1.0) * 1e-6
    for k in (0, *range(FIRST, pipes().coil + 1, 3), M_HP, M_HP + 1):
        step = np.zeros_like(x)
        step[k] = sizes[k]
        above, below = (evaluated(x + sign * step, u, v, d, PLANT, HELIUM)[0] for sign in (1.0, -1.0))
        difference = (above - below) / (2.0 * sizes[k])
        column = J[: len(x), k]
        assert difference == pytest.approx(column, rel=1e-4, abs=1e-5 * np.max(np.abs(column)) + 1e-9), STATE_NAMES[k]


def test_what_the_passes_give_the_compressors_need_not() -> None:
    """The bypass opens: the cold box takes more than enters, by what its passes hold less in the end."""
    u, v, d = MOVES["the bypass opens"]
    x, given = REST, 0.0
    for _ in range(4 * 60):
        first = given_by_passes(x, u, v, d)
        x = advance_refrigerator(x, u, v, d, 0.25, PLANT, HELIUM)
        given += 0.125 * (first + given_by_passes(x, u, v, d))
    assert given > 0.3
    assert held_by(REST)[1][:, MASS].sum() - held_by(x)[1][:, MASS].sum() == pytest.approx(given, abs=1e-4)
    assert inventory(x, PLANT, HELIUM) == pytest.approx(inventory(REST, PLANT, HELIUM), rel=1e-13)


def given_by_passes(x: RealArray, u: RealArray, v: RealArray, d: RealArray) -> float:
    """Return what leaves the passes beyond what enters, kg/s."""
    crossing = evaluate_refrigerator(x, u, v, d, PLANT, HELIUM, np.empty_like(x), np.empty(OUTPUTS), np.empty(SIGNALS))
    return crossing.high.mass_flow - crossing.filling.entering


def test_a_high_pressure_side_blows_off_what_it_loses() -> None:
    """The compressors go on with all valves shut until the relief valve opens, and then all stops with a leak."""
    x, shut = REST, (np.zeros(3), np.zeros(4), GIVEN)
    for _ in range(4 * 60):
        x = advance_refrigerator(x, *shut, 0.25, PLANT, HELIUM)
    assert held_by(x)[0] > 18e5
    assert x[M_LOST] > 0.1
    leaking = np.array([FILE.w0, AMBIENT, 0.1, 1.0, 0.0, 0.0])
    for _ in range(4 * 120):
        x = advance_refrigerator(x, np.zeros(3), np.zeros(4), leaking, 0.25, PLANT, HELIUM)
    assert np.all(np.isfinite(x))
    assert held_by(x)[0] < 5e5
    assert inventory(x, PLANT, HELIUM) + x[M_LOST] == pytest.approx(inventory(REST, PLANT, HELIUM), rel=1e-12)


@pytest.mark.parametrize(("T", "tolerance"), [(300.0, 2e-4), (80.0, 1e-3), (20.0, 1e-2)])
def test_gas_that_blows_down_without_walls_cools_along_its_isentrope(T: float, tolerance: float) -> None:
    """From 16 to 6 bar through the cold end, with nothing that enters and no heat: C dT = V (1 - rho h_P) dP."""
    properties = pytest.importorskip("CoolProp.CoolProp").PropsSI
    exchanger, P, dt, outflow = HeatExchanger(UA=0.0, volume=1e-3, aluminium=0.0, cells=1), 16e5, 1e-3, 1e-3
    s = properties("S", "P", P, "T", T, "Helium")

    def slopes(P: float, T: float) -> tuple[float, float]:
        cells, dT = held_cells(exchanger, P, T), np.zeros(1)
        leaving = Passing(outflow, 0.0, float(cells[0, H]))
        march_flows(dT, leaving, 0.0, float(cells[0, H]), np.ones(1, np.bool_), cells)
        dP = -cells[0, M_IN] / cells[0, M_IN_P]
        pass_rates(leaving.m, leaving.h, 0.0, dP, cells, dT)
        return dP, dT[0]

    while P > 6e5:
        dP, dT = slopes(P, T)
        dP, dT = slopes(P + 0.5 * dt * dP, T + 0.5 * dt * dT)
        P, T = P + dt * dP, T + dt * dT
    assert pytest.approx(properties("T", "P", P, "S", s, "Helium"), rel=tolerance) == T


def test_cells_keep_their_heat_capacity_at_all_pressures() -> None:
    for P in (0.5e5, 4.9e5, 5.1e5, 16e5, 24e5):
        assert held_by_at(P)[:, CAPACITY].min() > 0.0


def held_by_at(P: float) -> Array:
    """Return what the cells hold at a pressure, the temperatures of the operating point."""
    held = read_passes(REST, pipes(), HELIUM)
    hold_passes(supply_at(P), pipes(), held)
    return held.cells[cells()]


@given(at=st.floats(0.0, 30.0))
@settings(max_examples=3)
def test_helium_flows_back_into_the_line_while_its_pressure_falls(at: float) -> None:
    """For the first minute: then the cold passes, which cool, draw what there is."""
    now, _ = filling(moved("all compressors stop", 20.0 + at), *MOVES["all compressors stop"])
    assert now.P_rate < 0.0
    assert now.entering < 0.0
    assert now.h == pytest.approx(float(now.cells[BOX_STATES, H]))
