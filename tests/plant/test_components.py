"""Each component conserves mass and energy, and behaves at its limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.components.expansion import CRITICAL_RATIO, expand, return_flow, turbine_flow, valve_mass_flow
from coldloop_plant.components.heat_exchanger import (
    HighPressureFlow,
    LowPressureFlow,
    driving_difference,
    exchange,
    take_up,
)
from coldloop_plant.components.phase_separator import content, level, separate
from coldloop_plant.helium import (
    load_helium,
    saturation,
    supply_cell,
    supply_enthalpy_and_density,
    vapour_enthalpy_and_cp,
)

HELIUM = load_helium()
VALVE = REFERENCE.jt_valve
BATH = REFERENCE.separator
TURBINE = REFERENCE.turbine
flows = st.floats(0.005, 0.1)


@given(opening=st.floats(-50.0, 0.0))
def test_a_closed_valve_passes_nothing(opening: float) -> None:
    assert valve_mass_flow(VALVE, opening, 150.0, 16e5, 1.2e5) == 0.0


@given(opening=st.floats(100.0, 500.0))
def test_a_valve_opens_no_further_than_fully(opening: float) -> None:
    assert valve_mass_flow(VALVE, opening, 150.0, 16e5, 1.2e5) == valve_mass_flow(VALVE, 100.0, 150.0, 16e5, 1.2e5)


def test_a_valve_passes_nothing_against_the_pressure() -> None:
    assert valve_mass_flow(VALVE, 50.0, 150.0, 1e5, 2e5) == 0.0


@given(opening=st.floats(1.0, 100.0), T=st.floats(10.0, 80.0))
def test_turbine_valve_and_nozzle_pass_the_same_flow(opening: float, T: float) -> None:
    _, rho = supply_enthalpy_and_density(16e5, T, HELIUM)
    flow, P_between = turbine_flow(TURBINE, opening, 16e5, T, rho)
    behind = max(P_between, CRITICAL_RATIO * 16e5)  # with less the valve is choked
    assert flow == pytest.approx(valve_mass_flow(TURBINE.inlet_valve, opening, rho, 16e5, behind), rel=1e-6)
    assert flow == pytest.approx(TURBINE.nozzle * P_between / np.sqrt(T), rel=1e-12)


def test_a_shut_turbine_neither_flows_nor_turns() -> None:
    h, rho = supply_enthalpy_and_density(16e5, 19.0, HELIUM)
    flow, P_between = turbine_flow(TURBINE, 0.0, 16e5, 19.0, rho)
    assert (flow, P_between) == (0.0, 0.0)
    exhaust = expand(TURBINE, flow, h, P_between, 1.15e5, HELIUM)
    assert (exhaust.h_out, exhaust.speed) == (h, 0.0)


@given(P_in=st.floats(3e5, 16e5), T=st.floats(12.0, 80.0))
def test_a_turbine_takes_its_share_of_the_isentropic_drop(P_in: float, T: float) -> None:
    h, _ = supply_enthalpy_and_density(16e5, T, HELIUM)
    exhaust = expand(TURBINE, 0.05, h, P_in, 1.15e5, HELIUM)
    drop = (exhaust.speed / TURBINE.speed_coefficient) ** 2
    assert 0.0 < drop < h
    assert h - exhaust.h_out == pytest.approx(TURBINE.efficiency * drop, rel=1e-9)


@given(P_bath=st.floats(1.0e5, 1.9e5), exhaust=st.floats(0.0, 0.1))
def test_the_pressure_drops_of_the_return_line_add_up(P_bath: float, exhaust: float) -> None:
    line = REFERENCE.return_line
    flow, P_mix = return_flow(line, P_bath, 1.05e5, exhaust, 1.0)
    assert flow >= 0.0
    assert P_mix == pytest.approx(1.05e5 + line.warm_resistance * (flow + exhaust) ** 2)
    if exhaust < 0.023:  # near rest a laminar part adds to the drop of the vapour's way
        assert P_bath - P_mix >= line.cold_resistance * flow**2 - 1e-4 or flow < 1e-12
    elif flow > 1e-12:  # less is the rounding of a root
        assert P_bath - P_mix == pytest.approx(line.cold_resistance * flow**2, abs=1e-4)
    else:
        assert P_mix >= P_bath or P_mix == pytest.approx(P_bath)


@pytest.mark.usefixtures("compiles")
@given(m_high=flows, m_low=flows, T_high=st.floats(15.0, 80.0), T_low=st.floats(4.6, 14.0))
def test_what_an_exchanger_takes_from_one_stream_it_gives_to_the_other(
    m_high: float, m_low: float, T_high: float, T_low: float
) -> None:
    exchanger = REFERENCE.nef2
    T = np.linspace(T_high - 1.0, T_low + 0.5, exchanger.cells)
    h_low, _ = vapour_enthalpy_and_cp(1.15e5, T_low, saturation(1.15e5, HELIUM).T, HELIUM.vapour)
    entering = LowPressureFlow(m_low, 1.15e5, T_low, h_low)
    dT = np.empty(exchanger.cells)
    high = HighPressureFlow(m_high, T_high, 16e5)
    leaving = exchange(exchanger, T, high, entering, HELIUM, dT, is_supply_held=True)
    stored = 0.0
    for T_cell, rate in zip(T, dT, strict=True):
        _, rho_cp, c_wall = supply_cell(16e5, T_cell, HELIUM.isobar, HELIUM.departure)
        stored += (exchanger.volume * rho_cp + exchanger.aluminium * c_wall) / exchanger.cells * rate
    h_in, _ = supply_enthalpy_and_density(16e5, T_high, HELIUM)
    h_out, _ = supply_enthalpy_and_density(16e5, T[-1], HELIUM)
    gained = m_low * (leaving.h - entering.h)
    assert stored == pytest.approx(m_high * (h_in - h_out) - gained, rel=1e-9, abs=1e-6)
    assert T_low <= leaving.T <= T_high


@pytest.mark.parametrize(("boiled", "dry"), [(0.5, False), (2.0, True)])
def test_wet_vapour_boils_dry_before_it_warms_up(boiled: float, dry: bool) -> None:  # noqa: FBT001
    sat = saturation(1.2e5, HELIUM)
    wet = LowPressureFlow(0.05, 1.2e5, sat.T, sat.h_v - 2000.0)
    UA = boiled * 0.05 * 2000.0 / 3.0
    T, h, _ = take_up(wet, 1e4, 3.0, UA, sat, HELIUM.vapour)
    assert (T > sat.T, h > sat.h_v) == (dry, dry)
    assert 0.05 * (h - wet.h) <= UA * 3.0 * (1.0 + 1e-9)


def test_saturated_vapour_that_is_cooled_becomes_wet() -> None:
    sat = saturation(1.2e5, HELIUM)
    T, h, _ = take_up(LowPressureFlow(0.05, 1.2e5, sat.T, sat.h_v), 1e4, -0.5, 200.0, sat, HELIUM.vapour)
    assert T == sat.T
    assert h < sat.h_v


def test_no_cell_is_driven_below_the_stream_that_cools_it() -> None:
    assert driving_difference(6.0, 5.0, 4.5) == 1.0
    assert driving_difference(9.0, 4.5, 4.5) == 0.0
    assert driving_difference(9.0, 4.0, 4.5) == -0.5


@given(
    P=st.floats(0.35e5, 2.2e5),
    share=st.floats(0.05, 0.95),
    inflow=st.floats(0.0, 0.1),
    outflow=st.floats(0.0, 0.1),
    heat=st.floats(0.0, 1000.0),
)
def test_the_bath_stores_the_mass_and_energy_that_enter(
    P: float, share: float, inflow: float, outflow: float, heat: float
) -> None:
    V_l, h_in, dt = share * BATH.volume, 7600.0, 1e-2
    h_v = saturation(P, HELIUM).h_v
    dP, dV = separate(content(BATH, P, V_l, HELIUM), inflow, h_in, outflow, h_v, heat)
    after = content(BATH, P + dP * dt / 2, V_l + dV * dt / 2, HELIUM)
    before = content(BATH, P - dP * dt / 2, V_l - dV * dt / 2, HELIUM)
    assert (after.mass - before.mass) / dt == pytest.approx(inflow - outflow, abs=1e-7)
    assert (after.energy - before.energy) / dt == pytest.approx(inflow * h_in - outflow * h_v + heat, abs=1e-2)


@given(V_l=st.floats(-0.1, 0.3))
def test_the_level_gauge_reads_0_to_100(V_l: float) -> None:
    assert 0.0 <= level(BATH, V_l) <= 100.0
