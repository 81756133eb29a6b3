"""Processes whose end is known in closed form, and the second law in states drawn at random."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_plant.cold_box import OUTPUTS, evaluate
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.components.expansion import CHOKED, Valve, cold_valve_flow, expand, gas_valve_flow
from coldloop_plant.components.phase_separator import content, separate
from coldloop_plant.helium import (
    GAS_CONSTANT,
    WARM_CP,
    load_helium,
    saturation,
    supply_cell,
    supply_enthalpy_and_density,
)
from coldloop_plant.numeric import RealArray
from coldloop_refrigerator.exergy import entropy, supply_entropy
from coldloop_refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_refrigerator.warm import (
    BOILING_POINT,
    LATENT_HEAT,
    LIQUID_DENSITY,
    SECOND_VIRIAL,
    GasVolume,
    boil,
    gas_mass,
    gas_pressure,
    nitrogen_level,
)

HELIUM = load_helium()
BATH = REFERENCE.separator
GAMMA = 5.0 / 3.0
STATES = 10_000


def coolprop(name: str, *point: object) -> float:
    return float(pytest.importorskip("CoolProp.CoolProp").PropsSI(name, *point, "Helium"))


@pytest.mark.usefixtures("compiles")
def test_a_vessel_blows_down_through_a_choked_valve_as_the_closed_form_says() -> None:
    """With dM/dt = -k P and P V = M (R T + B P), k R T t / V = [ln(P/(1 + bP)) + 1/(1 + bP)], b = B/(R T)."""
    vessel, valve, T, dt = GasVolume(20.0), Valve(4.0e-5), 300.0, 1.0
    RT = GAS_CONSTANT * T
    k = (
        valve.flow_area
        * np.sqrt(GAMMA)
        * (2.0 / (GAMMA + 1.0)) ** ((GAMMA + 1.0) / (2.0 * (GAMMA - 1.0)))
        / np.sqrt(RT)
    )

    def primitive(P: float) -> float:
        thick = 1.0 + SECOND_VIRIAL * P / RT
        return float(np.log(P / thick) + 1.0 / thick)

    def rate(mass: float) -> float:
        return -gas_valve_flow(valve, 100.0, gas_pressure(vessel, mass, T), 1e5, T)

    mass, seconds = gas_mass(vessel, 12e5, T), 0.0
    while gas_pressure(vessel, mass, T) > 3e5:
        half = rate(mass + 0.5 * dt * rate(mass))
        mass, seconds = mass + dt * half, seconds + dt
    P = gas_pressure(vessel, mass, T)
    assert seconds > 100.0
    assert seconds == pytest.approx(vessel.volume / (k * RT) * (primitive(12e5) - primitive(P)), rel=1e-4)


def test_the_choked_flow_is_that_of_a_monatomic_gas_by_hand() -> None:
    """0.7262 = sqrt(5/3) (3/4)^2: 34 mm2 at 16 bar and 300 K pass 50.0 g/s."""
    assert pytest.approx(np.sqrt(GAMMA) * 0.75**2, rel=1e-3) == CHOKED
    assert gas_valve_flow(Valve(3.4e-5), 100.0, 16e5, 1.05e5, 300.0) == pytest.approx(0.0500, rel=2e-3)


@given(P=st.floats(1e5, 1.7e5), share=st.floats(0.1, 0.9), heat=st.floats(0.0, 2000.0))
def test_a_boiling_bath_of_constant_pressure_loses_the_liquid_that_its_heat_evaporates(
    P: float, share: float, heat: float
) -> None:
    """Vapour Q/L, less what stays in the room of the liquid that is gone: dV_l = -Q/(rho_l L)."""
    V_l = share * BATH.volume
    sat = saturation(P, HELIUM)
    latent = sat.h_v - sat.h_l
    leaving = heat / latent * (1.0 - sat.rho_v / sat.rho_l)
    dP, dV = separate(content(BATH, P, V_l, HELIUM), 0.0, 0.0, leaving, sat.h_v, heat)
    assert dV == pytest.approx(-heat / (sat.rho_l * latent), rel=1e-5, abs=1e-15)
    assert dP == pytest.approx(0.0, abs=1e-3)


def test_the_nitrogen_bath_lasts_as_long_as_its_latent_heat() -> None:
    """While the coil is wet the heat is constant: t = dM L / Q, 19 min from 60 to 30 % with 93 g/s at 82.3 K."""
    bath, mass, seconds = REFERENCE_REFRIGERATOR.precooler.nef5, 0.6 * 30e-3 * LIQUID_DENSITY, 0.0
    C = 0.0934 * WARM_CP
    heat = C * (82.3 - BOILING_POINT) * (1.0 - np.exp(-bath.UA / C))
    while nitrogen_level(bath, mass) > 30.0:
        mass -= 0.25 * boil(bath, mass, 0.0934, WARM_CP, 82.3, 80.0, 0.0, 1.0).boil_off
        seconds += 0.25
    assert seconds == pytest.approx((0.6 * 30e-3 * LIQUID_DENSITY - mass) * LATENT_HEAT / heat, abs=0.25)
    assert seconds / 60.0 == pytest.approx(21.2, abs=0.5)


@given(P=st.floats(3e5, 8e5), T=st.floats(70.0, 100.0), efficiency=st.floats(0.3, 0.9))
def test_warm_gas_gives_a_turbine_the_work_of_a_perfect_gas(P: float, T: float, efficiency: float) -> None:
    """h1 - h2 = eta cp T (1 - r^0.4)."""
    h = coolprop("H", "P", P, "T", T)
    turbine = REFERENCE.turbine._replace(efficiency=efficiency)
    work = h - expand(turbine, 0.05, h, P, 1.15e5, HELIUM).h_out
    assert work == pytest.approx(efficiency * WARM_CP * T * (1.0 - (1.15e5 / P) ** 0.4), rel=0.01)
    h_isentropic = coolprop("H", "P", 1.15e5, "S", coolprop("S", "P", P, "T", T))
    assert work == pytest.approx(efficiency * (h - h_isentropic), rel=1e-4)


@given(T=st.floats(4.4, 11.9), opening=st.floats(1.0, 100.0))
def test_a_valve_of_cold_helium_passes_what_bernoulli_says(T: float, opening: float) -> None:
    density = coolprop("D", "P", 16e5, "T", T)
    flow = cold_valve_flow(Valve(3.9e-6), opening, T, density, 16e5, 1.2e5)
    assert flow == pytest.approx(3.9e-8 * opening * np.sqrt(2.0 * density * 14.8e5), rel=1e-12)


# -- the second law ----------------------------------------------------------------------------------------------------


def entropy_produced(x: RealArray, u: RealArray, w: float) -> float:
    """Return what the cold box makes of entropy (W/K): what it stores and lets out less what it takes in.

    Of the bath dS = (dU - g dM)/T, with g = h_v - T s_v the free enthalpy of both phases; a cell of gas and wall stores
    C dT/T.
    """
    dx, y = np.empty_like(x), np.empty(OUTPUTS)
    s, warm, relief, _ = evaluate(x, u, w, REFERENCE, HELIUM, dx, y)
    sat, heat = saturation(x[0], HELIUM), u[1] + w
    mass = s.m_jt - s.m_v - relief
    energy = s.m_jt * s.h_jt - (s.m_v + relief) * sat.h_v + heat
    stored = (energy - (sat.h_v - sat.T * sat.s_v) * mass) / sat.T
    first = 2
    for exchanger in (REFERENCE.nef1, REFERENCE.nef2, REFERENCE.nef34):
        for i in range(first, first + exchanger.cells):
            _, rho_cp, c_wall = supply_cell(16e5, x[i], HELIUM.isobar, HELIUM.departure)
            stored += (exchanger.volume * rho_cp + exchanger.aluminium * c_wall) / exchanger.cells * dx[i] / x[i]
        first += exchanger.cells
    leaving = (s.m_v + s.m_t) * entropy(warm.P, warm.h, HELIUM) + relief * sat.s_v
    return float(stored + leaving - (s.m_jt + s.m_t) * supply_entropy(16e5, REFERENCE.T_in, HELIUM) - heat / sat.T)


def test_ten_thousand_states_about_the_operating_point_make_entropy() -> None:
    draw, rest = np.random.default_rng(11), read_header(DEFAULT_MODEL_FILE)
    x0 = np.array(rest.x0)
    least = np.inf
    for _ in range(STATES):
        x = x0.copy()
        x[0] *= draw.uniform(0.95, 1.15)
        x[1] *= draw.uniform(0.3, 1.5)
        x[2:] *= draw.uniform(0.9, 1.2) * draw.uniform(0.98, 1.02, 26)
        x[2:] = np.maximum(x[2:], saturation(x[0], HELIUM).T)
        least = min(
            least, entropy_produced(x, draw.uniform([20.0, 0.0, 20.0], [60.0, 150.0, 60.0]), draw.uniform(0.0, 800.0))
        )
    assert least > 0.0


def test_ten_thousand_expansions_and_throttlings_make_entropy() -> None:
    draw = np.random.default_rng(12)
    for _ in range(STATES):
        P, T, P_out = draw.uniform(4e5, 16e5), draw.uniform(8.0, 100.0), draw.uniform(1.0e5, 1.6e5)
        h, _ = supply_enthalpy_and_density(16e5, T, HELIUM)
        before = entropy(P, h, HELIUM)
        assert before > supply_entropy(16e5, T, HELIUM) - 0.1
        turbine = REFERENCE.turbine._replace(efficiency=draw.uniform(0.2, 0.99))
        exhaust = expand(turbine, draw.uniform(0.001, 0.1), h, P, P_out, HELIUM)
        assert entropy(P_out, exhaust.h_out, HELIUM) > before - 0.1
