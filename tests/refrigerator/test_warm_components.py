"""Each component of compression station and nitrogen pre-cooler: balances, signs, monotonicity, limits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from coldloop_plant.components.expansion import (
    CHOKED,
    CRITICAL_RATIO,
    Actuator,
    gas_valve_flow,
    opening_rate,
    relief_flow,
)
from coldloop_plant.components.heat_exchanger import STILL, LowPressureFlow
from coldloop_plant.helium import (
    WARM_CP,
    load_helium,
    saturation,
    supply_enthalpy_and_density,
    vapour_enthalpy_and_cp,
    vapour_temperature,
)
from coldloop_refrigerator.plant_file import REFERENCE_REFRIGERATOR, RefrigeratorParameters
from coldloop_refrigerator.warm import (
    BOILING_POINT,
    LATENT_HEAT,
    LIQUID_DENSITY,
    boil,
    compress,
    exchanged_heat,
    gas_density,
    gas_mass,
    gas_pressure,
    nitrogen_level,
    transfer_warm,
)

HELIUM = load_helium()
STATION = REFERENCE_REFRIGERATOR.station
PRECOOLER = REFERENCE_REFRIGERATOR.precooler
NC = STATION.nc1
BATH = PRECOOLER.nef5
pressures = st.floats(0.5e5, 19e5)
openings = st.floats(0.0, 100.0)


# -- gas volumes -------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("compiles")
@given(P=pressures, T=st.floats(270.0, 320.0))
def test_a_volume_holds_the_mass_that_its_pressure_tells(P: float, T: float) -> None:
    assert gas_pressure(STATION.buffer, gas_mass(STATION.buffer, P, T), T) == pytest.approx(P, rel=1e-12)


@pytest.mark.usefixtures("compiles")
@given(P=pressures)
def test_the_gas_of_a_volume_is_as_dense_as_helium(P: float) -> None:
    density = pytest.importorskip("CoolProp.CoolProp").PropsSI("D", "P", P, "T", 300.0, "Helium")
    assert gas_density(P, 300.0) == pytest.approx(density, rel=2e-5)


def test_an_empty_volume_has_no_pressure() -> None:
    assert gas_pressure(STATION.hp, 0.0, 300.0) == 0.0
    assert gas_pressure(STATION.hp, -1e-9, 300.0) == 0.0


# -- compressors -------------------------------------------------------------------------------------------------------


def test_a_compressor_by_hand() -> None:
    """0.38 m3/s of 0.1684 kg/m3, eta_v = 0.92 - 0.006 x 14.238; eta_iso = 0.55 - 0.05 ln(1.5238)^2; ln r = 2.7238."""
    done = compress(NC, 1.0, 1.05e5, 16e5, 300.0)
    assert done.mass_flow == pytest.approx(0.38 * 0.16841 * 0.83457, rel=1e-4)
    isothermal = 0.38 * 0.16841 * 0.83457 * 2077.26 * 300.0 * 2.7238
    assert done.power == pytest.approx(isothermal / (0.54113 * 0.95), rel=1e-4)


@given(P_in=st.floats(0.5e5, 2e5), P_out=st.floats(2e5, 19e5), speed=st.floats(0.05, 1.0))
def test_a_compressor_takes_more_power_than_the_isothermal_one(P_in: float, P_out: float, speed: float) -> None:
    done = compress(NC, speed, P_in, P_out, 300.0)
    assert done.mass_flow >= 0.0
    assert done.power >= done.mass_flow * 2077.26 * 300.0 * np.log(P_out / P_in)


@given(P_in=st.floats(0.5e5, 2e5), P_out=st.floats(2e5, 18e5), speed=st.floats(0.05, 0.9))
def test_a_compressor_passes_more_from_denser_gas_and_at_speed_and_less_against_pressure(
    P_in: float, P_out: float, speed: float
) -> None:
    flow = compress(NC, speed, P_in, P_out, 300.0).mass_flow
    assert compress(NC, speed, P_in * 1.05, P_out, 300.0).mass_flow > flow
    assert compress(NC, speed * 1.05, P_in, P_out, 300.0).mass_flow > flow
    assert compress(NC, speed, P_in, P_out * 1.05, 300.0).mass_flow < flow


def test_a_compressor_that_stands_neither_passes_gas_nor_takes_power() -> None:
    assert compress(NC, 0.0, 1.05e5, 16e5, 300.0) == (0.0, 0.0)


def test_a_compressor_without_a_pressure_rise_takes_no_power() -> None:
    assert compress(NC, 1.0, 5e5, 1e5, 300.0).power == 0.0


# -- valves ------------------------------------------------------------------------------------------------------------


@given(P=st.floats(2e5, 19e5), share=st.floats(0.01, CRITICAL_RATIO - 1e-3))
def test_a_choked_valve_does_not_feel_the_pressure_behind_it(P: float, share: float) -> None:
    flow = gas_valve_flow(STATION.bypass, 30.0, P, share * P, 300.0)
    assert flow == pytest.approx(0.3 * 3.4e-5 * P * CHOKED / np.sqrt(2077.26 * 300.0), rel=1e-12)


@given(P=st.floats(2e5, 19e5), share=st.floats(CRITICAL_RATIO, 0.99), opening=st.floats(1.0, 90.0))
def test_a_valve_passes_more_when_it_opens_and_less_against_pressure(P: float, share: float, opening: float) -> None:
    flow = gas_valve_flow(STATION.charge, opening, P, share * P, 300.0)
    assert gas_valve_flow(STATION.charge, opening * 1.1, P, share * P, 300.0) > flow
    assert gas_valve_flow(STATION.charge, opening, P, (share + 0.01) * P, 300.0) < flow


def test_the_flow_of_a_valve_is_continuous_where_it_chokes() -> None:
    before, after = (
        gas_valve_flow(STATION.charge, 50.0, 6e5, (CRITICAL_RATIO + d) * 6e5, 300.0) for d in (-1e-9, 1e-9)
    )
    assert before == pytest.approx(after, rel=1e-9)


@given(opening=openings, P=pressures)
def test_gas_does_not_flow_against_the_pressure(opening: float, P: float) -> None:
    assert gas_valve_flow(STATION.charge, opening, P, P, 300.0) == 0.0
    assert gas_valve_flow(STATION.charge, opening, P, 1.5 * P, 300.0) == 0.0


@pytest.mark.usefixtures("compiles")
@given(P=st.floats(0.5e5, 18e5))
def test_a_relief_valve_is_tight_up_to_its_set_pressure(P: float) -> None:
    assert relief_flow(STATION.hp_relief, P, 300.0) == 0.0


@pytest.mark.usefixtures("compiles")
def test_a_relief_valve_blows_off_what_both_compressors_deliver() -> None:
    assert relief_flow(STATION.hp_relief, 19e5, 300.0) > 2.0 * compress(NC, 1.0, 1.05e5, 16e5, 300.0).mass_flow


@pytest.mark.usefixtures("compiles")
@given(opening=openings, command=st.floats(-50.0, 150.0))
def test_an_opening_moves_towards_its_command_no_faster_than_its_drive(opening: float, command: float) -> None:
    actuator = Actuator(lag=1.0, fastest=20.0)
    rate = opening_rate(actuator, opening, command)
    aim = min(max(command, 0.0), 100.0)
    assert abs(rate) <= 20.0
    assert rate == pytest.approx(aim - opening) or abs(rate) == 20.0
    assert 0.0 <= opening + 0.25 * rate <= 100.0


# -- nitrogen ----------------------------------------------------------------------------------------------------------


@given(mass=st.floats(0.0, 25.0), flow=st.floats(0.0, 0.12), T=st.floats(70.0, 300.0), opening=openings)
def test_nitrogen_boils_with_the_heat_of_the_helium_and_cools_it_no_further_than_its_own_temperature(
    mass: float, flow: float, T: float, opening: float
) -> None:
    done = boil(BATH, mass, flow, WARM_CP, T, T, opening, 1.0)
    most = (BATH.UA if flow < STILL else flow * WARM_CP) * (1.0 + 1e-12)  # but for rounding
    assert T == BOILING_POINT or 0.0 <= done.heat / (T - BOILING_POINT) <= most
    assert done.boil_off * LATENT_HEAT == pytest.approx(done.heat + done.feed * 4.9e3, rel=1e-12)


@given(mass=st.floats(0.1, 6.0), opening=openings)
def test_less_nitrogen_cools_less(mass: float, opening: float) -> None:
    more, less = (boil(BATH, share * mass, 0.09, WARM_CP, 85.0, 80.0, opening, 1.0).heat for share in (1.0, 0.8))
    assert less < more or nitrogen_level(BATH, 0.8 * mass) >= BATH.wet_level


def test_without_nitrogen_nothing_is_cooled_or_fed() -> None:
    assert boil(BATH, 0.0, 0.09, WARM_CP, 85.0, 80.0, 50.0, 0.0) == (0.0, 0.0, 0.0)


def test_a_full_bath_takes_what_boils_off_and_no_more() -> None:
    done = boil(BATH, LIQUID_DENSITY * BATH.volume, 0.01, WARM_CP, 85.0, 80.0, 100.0, 1.0)
    assert done.feed == pytest.approx(done.boil_off, rel=1e-12)


# -- the warm exchanger ------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("compiles")
@given(UA=st.floats(10.0, 1e5), C=st.floats(50.0, 600.0), ratio=st.floats(0.2, 5.0))
def test_the_heat_of_an_exchanger_is_that_of_its_textbook_effectiveness(UA: float, C: float, ratio: float) -> None:
    C_high, C_low = C, C * ratio
    small, large = min(C_high, C_low), max(C_high, C_low)
    NTU, mix = UA / small, small / large
    if abs(1.0 - mix) < 1e-3:
        effectiveness = NTU / (1.0 + NTU)
    else:
        decay = np.exp(-NTU * (1.0 - mix))
        effectiveness = (1.0 - decay) / (1.0 - mix * decay)
    assert exchanged_heat(UA, C_high, C_low, 10.0) == pytest.approx(10.0 * small * effectiveness, rel=2e-3)


@pytest.mark.usefixtures("compiles")
def test_the_heat_is_smooth_where_both_streams_are_alike() -> None:
    flows = np.linspace(499.0, 501.0, 401)
    heat = np.array([exchanged_heat(21500.0, 500.0, C, 10.0) for C in flows])
    assert np.all(np.diff(heat) > 0.0)
    assert np.max(np.abs(np.diff(heat, 2))) < 1e-3


@pytest.mark.usefixtures("compiles")
@given(m_high=st.floats(0.01, 0.12), m_low=st.floats(0.01, 0.12), T_low=st.floats(70.0, 90.0))
def test_what_the_warm_exchanger_takes_from_one_stream_it_gives_to_the_other(
    m_high: float, m_low: float, T_low: float
) -> None:
    exchanger = PRECOOLER.nef6
    T = np.linspace(280.0, 85.0, exchanger.cells)
    h_low, _ = vapour_enthalpy_and_cp(1.05e5, T_low, saturation(1.05e5, HELIUM).T, HELIUM.vapour)
    entering = LowPressureFlow(m_low, 1.05e5, T_low, h_low)
    heat = np.empty(exchanger.cells)
    leaving = transfer_warm(exchanger, T, 305.0, np.full(exchanger.cells, m_high), entering, heat)
    assert np.sum(heat) == pytest.approx(m_low * (leaving.h - h_low), rel=1e-9)
    assert np.sum(heat) == pytest.approx(m_low * WARM_CP * (leaving.T - T_low), rel=1e-9)
    assert T_low < leaving.T < 305.0


# -- helium away from the isobar and above the tables ------------------------------------------------------------------


def supply_error(T: float) -> tuple[float, float]:
    """Return the largest errors that the docstring allows: K times cp, share of the density."""
    if 6.0 <= T <= 8.0:
        return 0.1, 0.05
    if T < 10.0:
        return 0.031, 0.03
    if T < 80.0:
        return 0.01, 0.01
    return (1e-5 * T, 1e-5) if T <= 300.0 else (3e-3, 2e-3)


@pytest.mark.parametrize(
    ("low", "high"), [(4.5, 6.0), (6.0, 8.0), (8.0, 10.0), (10.0, 80.0), (80.0, 300.0), (300.0, 340.0)]
)
@given(data=st.data(), P=st.floats(5e5, 19e5))
def test_high_pressure_helium_agrees_within_what_its_docstring_says(
    low: float, high: float, data: st.DataObject, P: float
) -> None:
    properties = pytest.importorskip("CoolProp.CoolProp").PropsSI
    T = data.draw(st.floats(low, high))
    h, rho = supply_enthalpy_and_density(P, T, HELIUM)
    cp = properties("C", "P", P, "T", T, "Helium")
    of_h, of_rho = supply_error(T)
    assert h == pytest.approx(properties("H", "P", P, "T", T, "Helium"), abs=of_h * cp)
    assert rho == pytest.approx(properties("D", "P", P, "T", T, "Helium"), rel=of_rho)


@given(P=st.floats(1e5, 1.5e5), T=st.floats(100.0, 320.0))
def test_low_pressure_helium_is_warm_gas_beyond_the_table(P: float, T: float) -> None:
    sat = saturation(P, HELIUM)
    h, cp = vapour_enthalpy_and_cp(P, T, sat.T, HELIUM.vapour)
    properties = pytest.importorskip("CoolProp.CoolProp").PropsSI
    assert h == pytest.approx(properties("H", "P", P, "T", T, "Helium"), abs=0.02 * cp)
    assert vapour_temperature(P, h, sat, HELIUM) == pytest.approx(T, abs=5e-3)


# -- parameters --------------------------------------------------------------------------------------------------------


BAD = {
    ("station", "hp_volume_m3"): 0.0,
    ("nc1", "displacement_l_per_s"): -1.0,
    ("nc2", "isothermal_efficiency"): 1.2,
    ("nc1", "motor_efficiency"): float("nan"),
    ("station", "cv956_area_mm2"): float("inf"),
    ("station", "valve_lag_s"): 0.01,
    ("hp_relief", "span_bar"): 0.0,
    ("station", "run_down_s"): 0.0,
    ("nef6", "cells"): 12,
    ("nef5", "wet_level_pct"): 0.0,
    ("nef5", "cv167_area_mm2"): -1.0,
}


@pytest.mark.parametrize(("section", "key"), BAD)
def test_a_bad_parameter_is_refused_by_its_name(section: str, key: str) -> None:
    with pytest.raises(ValidationError) as refused:
        RefrigeratorParameters.model_validate({section: {key: BAD[section, key]}})
    assert [error["loc"] for error in refused.value.errors()] == [(section, key)]
