"""Where a refrigerator loses exergy: the rows sum, none is negative, and some are what a calculation by hand gives."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.cold_box import L1, OUTPUT_NAMES, STATION_SIGNAL_NAMES, T5
from coldloop.process.settings import InputLimits
from coldloop_plant.helium import GAS_CONSTANT, load_helium
from coldloop_plant.settings import LqWeights
from coldloop_refrigerator.exergy import (
    LIQUID_NITROGEN,
    NITROGEN_VAPOUR,
    ExergyBalance,
    entropy,
    exergy_balance,
    supply_entropy,
)
from coldloop_refrigerator.model import Rest, refrigerator_operating_point
from coldloop_refrigerator.physics import evaluated
from coldloop_refrigerator.plant_file import REFERENCE_REFRIGERATOR, read_refrigerator
from coldloop_refrigerator.program import SHIPPED, read_refrigerator_file

HELIUM = load_helium()
EFFICIENT = read_refrigerator(Path(__file__).parents[2] / "examples" / "efficient_refrigerator.toml", InputLimits())


def coolprop(name: str, *point: object, fluid: str = "Helium") -> float:
    return float(pytest.importorskip("CoolProp.CoolProp").PropsSI(name, *point, fluid))


@pytest.fixture(scope="module")
def reference() -> Rest:
    file = read_refrigerator_file(SHIPPED)
    x, u, v = np.array(file.x0), np.array(file.u0), np.array(file.v0)
    d = np.array([file.w0, 300.0, 0.0, 1.0, 1.0, 1.0])
    return Rest(x, u, v, d, *evaluated(x, u, v, d, REFERENCE_REFRIGERATOR, HELIUM)[1:], 0.0)


@pytest.fixture(scope="module")
def efficient() -> Rest:
    return refrigerator_operating_point(EFFICIENT, HELIUM, LqWeights())[0]


@pytest.fixture(scope="module")
def balances(reference: Rest, efficient: Rest) -> list[ExergyBalance]:
    plants = (REFERENCE_REFRIGERATOR, EFFICIENT.refrigerator)
    return [exergy_balance(rest, plant, HELIUM) for rest, plant in zip((reference, efficient), plants, strict=True)]


@pytest.mark.usefixtures("compiles")
def test_what_is_destroyed_is_what_is_put_in_less_what_is_useful(balances: list[ExergyBalance]) -> None:
    for balance in balances:
        assert sum(balance.destroyed.values()) == pytest.approx(balance.put_in - balance.useful, abs=1e-3)
        assert min(balance.destroyed.values()) > -1e-3


@pytest.mark.usefixtures("compiles")
def test_heat_at_the_temperature_of_the_bath_loses_nothing_there(balances: list[ExergyBalance]) -> None:
    for balance in balances:
        assert balance.destroyed["bath"] == pytest.approx(0.0, abs=0.5)


@pytest.mark.usefixtures("compiles")
def test_the_bypass_loses_the_isothermal_work_of_its_flow(reference: Rest, balances: list[ExergyBalance]) -> None:
    """By hand: m R T0 ln(16/1.05) = 0.01337 kg/s x 623.2 kJ/kg x 2.724 = 22.7 kW."""
    flow = 1e-3 * reference.signals[STATION_SIGNAL_NAMES.index("M_CV956")]
    assert balances[0].destroyed["bypass"] == pytest.approx(flow * GAS_CONSTANT * 300.0 * np.log(16.0 / 1.05), rel=5e-3)
    assert balances[0].destroyed["bypass"] == pytest.approx(22.7e3, rel=0.01)


@pytest.mark.usefixtures("compiles")
def test_the_throttle_loses_the_entropy_that_coolprop_has_before_and_behind_it(
    reference: Rest, balances: list[ExergyBalance]
) -> None:
    y = dict(zip(OUTPUT_NAMES, reference.y.tolist(), strict=True))
    h = coolprop("H", "P", 16e5, "T", y["T2"])
    before, behind = coolprop("S", "P", 16e5, "T", y["T2"]), coolprop("S", "P", 1e5 * y["P1"], "H", h)
    heat_of_evaporation = coolprop("H", "P", 1e5 * y["P1"], "Q", 1.0) - h
    flow = (reference.d[0] + reference.u[1]) / heat_of_evaporation
    assert balances[0].destroyed["CV155"] == pytest.approx(300.0 * flow * (behind - before), rel=1e-4)


@pytest.mark.usefixtures("compiles")
def test_the_reference_takes_too_much_power_and_the_efficient_one_what_such_machines_take(
    efficient: Rest, balances: list[ExergyBalance]
) -> None:
    assert balances[0].specific_power == pytest.approx(767.0, abs=0.5)
    assert 450.0 < balances[1].specific_power < 600.0
    assert balances[1].useful / balances[1].electricity > 1.5 * balances[0].useful / balances[0].electricity
    assert 59.0 < efficient.y[L1] < 61.0
    assert 9.0 < efficient.y[T5] < 16.0
    assert efficient.u.tolist() == [43.0, 75.0, 36.0]
    assert efficient.v[0] < 15.0


def test_nitrogen_is_worth_what_coolprop_says() -> None:
    def exergy(*point: object) -> float:
        h, s = (coolprop(name, *point, fluid="Nitrogen") for name in "HS")
        h0, s0 = (coolprop(name, "T", 300.0, "P", 101325.0, fluid="Nitrogen") for name in "HS")
        return h - h0 - 300.0 * (s - s0)

    assert exergy("T", 80.0, "P", 2.5e5) == pytest.approx(LIQUID_NITROGEN, rel=1e-3)
    assert exergy("P", 1.05e5, "Q", 1.0) == pytest.approx(NITROGEN_VAPOUR, rel=1e-3)


@given(P=st.floats(0.5e5, 2.2e5), share=st.floats(0.0, 1.0))
def test_entropy_of_wet_helium_agrees(P: float, share: float) -> None:
    h = coolprop("H", "P", P, "Q", share)
    assert entropy(P, h, HELIUM) == pytest.approx(coolprop("S", "P", P, "Q", share), abs=0.02)


@given(P=st.floats(0.9e5, 2.0e5), superheat=st.one_of(st.floats(0.01, 2.0), st.floats(2.0, 330.0)))
def test_entropy_of_vapour_agrees(P: float, superheat: float) -> None:
    T = coolprop("T", "P", P, "Q", 1.0) + superheat
    h = coolprop("H", "P", P, "T", T)
    assert entropy(P, h, HELIUM) == pytest.approx(coolprop("S", "P", P, "T", T), abs=0.2)


@given(P=st.floats(5e5, 19e5), T=st.floats(10.0, 345.0))
def test_entropy_of_the_supply_agrees(P: float, T: float) -> None:
    h = coolprop("H", "P", P, "T", T)
    assert entropy(P, h, HELIUM) == pytest.approx(coolprop("S", "P", P, "T", T), abs=0.1)


@given(P=st.floats(8e5, 19e5), T=st.floats(4.4, 10.0))
def test_entropy_of_the_cold_supply_agrees_as_its_enthalpy_does(P: float, T: float) -> None:
    cp = coolprop("C", "P", P, "T", T)
    within = cp * (0.1 if 6.0 <= T <= 8.0 else 0.035) / T
    assert supply_entropy(P, T, HELIUM) == pytest.approx(coolprop("S", "P", P, "T", T), abs=within + 1.0)
