"""The shipped tables agree with CoolProp, away from their nodes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop_plant import helium as helium_at
from coldloop_plant.helium import Helium, load_helium

HELIUM: Helium = load_helium()
bath_pressures = st.floats(0.9e5, 1.9e5)
superheats = st.floats(0.02, 100.0)


def coolprop(name: str, first: str, x: float, second: str, y: float) -> float:
    library = pytest.importorskip("CoolProp.CoolProp")  # only here: to load it takes longer than the tests
    return float(library.PropsSI(name, first, x, second, y, "Helium"))


@pytest.mark.night
@given(T=st.floats(4.0, 300.0))
def test_the_16_bar_isobar_agrees(T: float) -> None:
    pytest.importorskip("CoolProp.CoolProp")
    from coldloop_plant.helium.tabulate import aluminium_heat_capacity  # noqa: PLC0415 loads CoolProp

    h, rho = helium_at.supply_enthalpy_and_density(16e5, T, HELIUM)
    h_cell, rho_cp, c_wall = helium_at.supply_cell(16e5, T, HELIUM.isobar, HELIUM.departure)
    density, cp = coolprop("D", "P", 16e5, "T", T), coolprop("C", "P", 16e5, "T", T)
    assert h_cell == h == pytest.approx(coolprop("H", "P", 16e5, "T", T), abs=4e-7 * cp)
    assert rho == pytest.approx(density, rel=1e-7)
    assert rho_cp == pytest.approx(density * cp, rel=1e-7)
    assert c_wall == pytest.approx(aluminium_heat_capacity(T), rel=1e-5)


@given(P=bath_pressures)
def test_saturation_agrees(P: float) -> None:
    sat = helium_at.saturation(P, HELIUM)
    assert pytest.approx(coolprop("T", "P", P, "Q", 0.0), abs=1e-7) == sat.T
    assert sat.rho_l == pytest.approx(coolprop("D", "P", P, "Q", 0.0), rel=5e-7)
    assert sat.rho_v == pytest.approx(coolprop("D", "P", P, "Q", 1.0), rel=5e-7)
    assert sat.h_l == pytest.approx(coolprop("H", "P", P, "Q", 0.0), abs=4e-3)
    assert sat.h_v == pytest.approx(coolprop("H", "P", P, "Q", 1.0), abs=4e-3)
    assert sat.s_v == pytest.approx(coolprop("S", "P", P, "Q", 1.0), abs=1e-3)


@pytest.mark.usefixtures("compiles")
@given(P=st.floats(0.91e5, 1.89e5))
def test_saturation_slopes_are_the_derivatives_of_saturation(P: float) -> None:
    above, below = helium_at.saturation(P + 10.0, HELIUM), helium_at.saturation(P - 10.0, HELIUM)
    slopes = helium_at.saturation_slopes(P, HELIUM)
    for slope, high, low in zip(slopes, above, below, strict=True):
        assert slope == pytest.approx((high - low) / 20.0, rel=1e-4)


@given(P=bath_pressures, superheat=superheats)
def test_vapour_agrees(P: float, superheat: float) -> None:
    sat = helium_at.saturation(P, HELIUM)
    T = sat.T + superheat
    h, cp = (coolprop(name, "P", P, "T", T) for name in ("H", "C"))
    table_h, table_cp = helium_at.vapour_enthalpy_and_cp(P, T, sat.T, HELIUM.vapour)
    assert table_h == pytest.approx(h, abs=2e-5 * cp)
    assert table_cp == pytest.approx(cp, rel=2e-3)
    assert helium_at.vapour_temperature(P, h, sat, HELIUM) == pytest.approx(T, abs=2e-5)


@pytest.mark.usefixtures("compiles")
@given(P=bath_pressures, superheat=superheats)
def test_the_end_of_an_isentropic_expansion_agrees(P: float, superheat: float) -> None:
    T = helium_at.saturation(P, HELIUM).T + superheat
    h, cp, s = (coolprop(name, "P", P, "T", T) for name in ("H", "C", "S"))
    assert helium_at.enthalpy_after_isentropic_expansion(P, s, HELIUM) == pytest.approx(h, abs=2e-3 * cp)


@given(P=st.floats(1e5, 16e5), h=st.floats(36e3, 528e3))
def test_entropy_at_the_turbine_inlet_agrees(P: float, h: float) -> None:
    s = coolprop("S", "P", P, "H", h)
    assert helium_at.entropy_before_expansion(P, h, HELIUM) == pytest.approx(s, abs=5e-3)


@pytest.mark.usefixtures("compiles")
@given(P=bath_pressures, share=st.floats(0.2, 0.999))
def test_an_expansion_into_wet_vapour_follows_the_lever_rule(P: float, share: float) -> None:
    s = share * coolprop("S", "P", P, "Q", 1.0) + (1.0 - share) * coolprop("S", "P", P, "Q", 0.0)
    h = coolprop("H", "P", P, "S", s)
    assert helium_at.enthalpy_after_isentropic_expansion(P, s, HELIUM) == pytest.approx(h, abs=0.5)
    sat = helium_at.saturation(P, HELIUM)
    assert helium_at.vapour_temperature(P, h, sat, HELIUM) == sat.T


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize(("P", "edge"), [(0.2e5, 0.3e5), (2.26e5, 2.25e5)])
def test_the_saturation_line_goes_on_straight_outside_its_table(P: float, edge: float) -> None:
    at_edge, slopes = helium_at.saturation(edge, HELIUM), helium_at.saturation_slopes(P, HELIUM)
    for value, start, slope in zip(helium_at.saturation(P, HELIUM), at_edge, slopes, strict=True):
        assert value == pytest.approx(start + (P - edge) * slope, rel=1e-9)


# -- beyond what hours of operation read -------------------------------------------------------------------------------

outer_pressures = st.one_of(st.floats(0.3e5, 0.9e5), st.floats(1.9e5, 2.2e5))


def vapour_density(P: float, h: float) -> float:
    sat, slopes = helium_at.saturation(P, HELIUM), helium_at.saturation_slopes(P, HELIUM)
    return helium_at.vapour_density(P, h - sat.h_v, sat, slopes, HELIUM)[0]


@given(T=st.floats(2.5, 4.0))
def test_the_isobar_agrees_down_to_its_coldest_end(T: float) -> None:
    h, rho_cp, _ = helium_at.supply_cell(16e5, T, HELIUM.isobar, HELIUM.departure)
    density, cp = coolprop("D", "P", 16e5, "T", T), coolprop("C", "P", 16e5, "T", T)
    assert h == pytest.approx(coolprop("H", "P", 16e5, "T", T), abs=4e-7 * cp)
    assert rho_cp == pytest.approx(density * cp, rel=1e-6)


@pytest.mark.usefixtures("compiles")
@given(P=outer_pressures, superheat=superheats)
def test_bath_and_return_agree_from_a_vacuum_to_the_critical_point(P: float, superheat: float) -> None:
    sat = helium_at.saturation(P, HELIUM)
    assert pytest.approx(coolprop("T", "P", P, "Q", 0.0), abs=5e-6) == sat.T
    assert sat.rho_l == pytest.approx(coolprop("D", "P", P, "Q", 0.0), rel=5e-5)
    assert sat.rho_v == pytest.approx(coolprop("D", "P", P, "Q", 1.0), rel=5e-5)
    T = sat.T + superheat
    h, cp, s, rho = (coolprop(name, "P", P, "T", T) for name in ("H", "C", "S", "D"))
    assert helium_at.vapour_enthalpy_and_cp(P, T, sat.T, HELIUM.vapour)[0] == pytest.approx(h, abs=3e-4 * cp)
    assert helium_at.vapour_temperature(P, h, sat, HELIUM) == pytest.approx(T, abs=2e-3)
    assert vapour_density(P, h) == pytest.approx(rho, rel=1e-3)
    assert helium_at.enthalpy_after_isentropic_expansion(P, s, HELIUM) == pytest.approx(h, abs=0.03 * cp)


@pytest.mark.usefixtures("compiles")
@given(P=st.floats(0.4e5, 2.2e5), T=st.floats(115.0, 295.0))
def test_an_expansion_of_warm_gas_and_its_density_agree(P: float, T: float) -> None:
    h, s, rho = (coolprop(name, "P", P, "T", T) for name in ("H", "S", "D"))
    assert helium_at.enthalpy_after_isentropic_expansion(P, s, HELIUM) == pytest.approx(h, abs=0.1 * 5193.0)
    assert vapour_density(P, h) == pytest.approx(rho, rel=4e-3)


@given(P=st.floats(3e5, 19e5), h=st.one_of(st.floats(8e3, 36e3), st.floats(528e3, 1570e3)))
def test_entropy_agrees_from_a_cold_turbine_to_a_warm_one(P: float, h: float) -> None:
    s = coolprop("S", "P", P, "H", h)
    assert helium_at.entropy_before_expansion(P, h, HELIUM) == pytest.approx(s, abs=0.2)


@given(P=st.floats(1e5, 12e5), h=st.floats(4e3, 6e3))
def test_entropy_goes_on_nearly_as_it_does_where_helium_is_colder_than_its_table(P: float, h: float) -> None:
    s = coolprop("S", "P", P, "H", h)
    assert helium_at.entropy_before_expansion(P, h, HELIUM) == pytest.approx(s, abs=40.0)


@given(P=st.floats(5e5, 19e5), T=st.floats(4.0, 80.0))
def test_the_supply_away_from_16_bar_is_as_close_as_it_says(P: float, T: float) -> None:
    h, rho_cp, _ = helium_at.supply_cell(P, T, HELIUM.isobar, HELIUM.departure)
    _, rho = helium_at.supply_enthalpy_and_density(P, T, HELIUM)
    density, cp = coolprop("D", "P", P, "T", T), coolprop("C", "P", P, "T", T)
    near_its_peak = T < 10.0
    assert h == pytest.approx(coolprop("H", "P", P, "T", T), abs=(0.11 if near_its_peak else 0.03) * cp)
    assert rho == pytest.approx(density, rel=0.05 if near_its_peak else 0.03)
    assert rho_cp == pytest.approx(density * cp, rel=0.19 if near_its_peak else 0.06)
