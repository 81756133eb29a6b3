"""The shipped tables agree with CoolProp, away from their nodes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant.helium import properties as helium_at
from plant.helium.properties import Helium, load_helium

HELIUM: Helium = load_helium()
bath_pressures = st.floats(0.9e5, 1.9e5)
superheats = st.floats(0.02, 100.0)


def coolprop(name: str, first: str, x: float, second: str, y: float) -> float:
    library = pytest.importorskip("CoolProp.CoolProp")  # only here: to load it takes longer than the tests
    return float(library.PropsSI(name, first, x, second, y, "Helium"))


@pytest.mark.exhaustive
@given(T=st.floats(4.0, 300.0))
def test_the_16_bar_isobar_agrees(T: float) -> None:
    pytest.importorskip("CoolProp.CoolProp")
    from plant.helium.tabulate import aluminium_heat_capacity  # noqa: PLC0415 loads CoolProp

    h, rho = helium_at.supply_enthalpy_and_density(16e5, T, HELIUM)
    h_cell, rho_cp, c_wall = helium_at.supply_cell(16e5, T, HELIUM)
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


@given(P=bath_pressures, superheat=superheats)
def test_the_end_of_an_isentropic_expansion_agrees(P: float, superheat: float) -> None:
    T = helium_at.saturation(P, HELIUM).T + superheat
    h, cp, s = (coolprop(name, "P", P, "T", T) for name in ("H", "C", "S"))
    assert helium_at.enthalpy_after_isentropic_expansion(P, s, HELIUM) == pytest.approx(h, abs=2e-3 * cp)


@given(P=st.floats(1e5, 16e5), h=st.floats(36e3, 528e3))
def test_entropy_at_the_turbine_inlet_agrees(P: float, h: float) -> None:
    s = coolprop("S", "P", P, "H", h)
    assert helium_at.entropy_before_expansion(P, h, HELIUM) == pytest.approx(s, abs=5e-3)


@given(P=bath_pressures, share=st.floats(0.2, 0.999))
def test_an_expansion_into_wet_vapour_follows_the_lever_rule(P: float, share: float) -> None:
    s = share * coolprop("S", "P", P, "Q", 1.0) + (1.0 - share) * coolprop("S", "P", P, "Q", 0.0)
    h = coolprop("H", "P", P, "S", s)
    assert helium_at.enthalpy_after_isentropic_expansion(P, s, HELIUM) == pytest.approx(h, abs=0.5)
    sat = helium_at.saturation(P, HELIUM)
    assert helium_at.vapour_temperature(P, h, sat, HELIUM) == sat.T


@pytest.mark.parametrize("P", [0.5e5, 3e5])
def test_arguments_outside_the_tables_are_held_at_the_edge(P: float) -> None:
    edge = min(max(P, 0.9e5), 1.9e5)
    assert helium_at.saturation(P, HELIUM) == helium_at.saturation(edge, HELIUM)
