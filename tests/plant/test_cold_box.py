"""The cold box at its operating point, around it, and far from it."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import pytest

from coldloop_plant.cold_box import streams
from coldloop_plant.cold_box.model import (
    build_model,
    find_equilibrium,
    linearisation_error,
    parameters_digest,
    state_scales,
)
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.components.heat_exchanger import HeatExchanger
from coldloop_plant.equilibrium import NoEquilibriumError
from coldloop_plant.helium import (
    saturation,
    supply_enthalpy_and_density,
    vapour_enthalpy_and_cp,
    vapour_temperature,
)
from coldloop_plant.numeric import RealArray

if TYPE_CHECKING:
    from conftest import Plant

Rest: TypeAlias = tuple[RealArray, RealArray, float]


@pytest.mark.usefixtures("compiles")
def test_the_operating_point_is_at_rest(plant: Plant, rest: Rest) -> None:
    assert np.max(np.abs(plant.rates(*rest) / state_scales(REFERENCE))) < 1e-9


@pytest.mark.parametrize(
    ("exchanger", "ends", "true_UA"),
    [
        (REFERENCE.nef1, ("T4", "T2", "T1", "T3", "P1"), 1365.0),
        (REFERENCE.nef2, ("T6", "T4", "T7", "T8", "P7"), 2507.0),
        (REFERENCE.nef34, ("T9", "T6", "T8", "T10", "P8"), 8605.0),
    ],
)
def test_a_chain_of_cells_transfers_what_a_true_counter_flow_of_another_ua_does(
    plant: Plant, rest: Rest, exchanger: HeatExchanger, ends: tuple[str, ...], true_UA: float
) -> None:
    """The integral of dQ/(T_H - T_L) between the ends, with the properties' own temperatures along the way."""
    y, helium, s = plant.outputs(*rest), plant.helium, streams(rest[0], rest[1], REFERENCE, plant.helium)
    hot, cool, cold, warmed, pressure = ends
    flow = s.m_jt + s.m_t * (exchanger is REFERENCE.nef34)
    returning = s.m_v + s.m_t * (exchanger is not REFERENCE.nef1)
    T = np.linspace(4.0, 81.0, 8000)
    h = np.array([supply_enthalpy_and_density(REFERENCE.P_HP, float(one), helium)[0] for one in T])
    h_hot, h_cool = np.interp([y[hot], y[cool]], T, h)
    heat = flow * (h_hot - h_cool) * (np.arange(4000) + 0.5) / 4000
    T_high = np.interp(h_cool + heat / flow, h, T)
    P_low = 1e5 * y[pressure]
    sat = saturation(P_low, helium)
    h_cold, _ = vapour_enthalpy_and_cp(P_low, y[cold], sat.T, helium.vapour)
    T_low = np.array([vapour_temperature(P_low, h_cold + q / returning, sat, helium) for q in heat])
    assert np.mean(1.0 / (T_high - T_low)) * flow * (h_hot - h_cool) == pytest.approx(true_UA, rel=5e-3)
    assert T_low[-1] == pytest.approx(y[warmed], abs=0.02)


def test_the_operating_point_agrees_with_the_feasibility_study(plant: Plant, rest: Rest) -> None:
    y = plant.outputs(*rest)
    study = {"T1": 4.438, "T2": 4.443, "T3": 8.444, "T4": 9.649, "T5": 10.382}
    study |= {"T6": 19.098, "T7": 9.614, "T8": 14.091, "T10": 76.95, "P1": 1.2317, "P6": 11.38}
    for name, value in study.items():
        assert y[name] == pytest.approx(value, abs=5e-3), name
    flows = streams(rest[0], rest[1], REFERENCE, plant.helium)
    assert 1e3 * flows.m_jt == pytest.approx(36.2, abs=0.05)
    assert 1e3 * flows.m_t == pytest.approx(57.3, abs=0.05)
    assert rest[2] + 75.0 == pytest.approx(459.74, abs=0.05)


def test_energy_over_the_whole_box_balances_at_rest(plant: Plant, rest: Rest) -> None:
    x, u, w = rest
    flows = streams(x, u, REFERENCE, plant.helium)
    assert flows.m_jt == pytest.approx(flows.m_v, rel=1e-9)
    T_out = plant.outputs(x, u, w)["T10"]
    h_in = _enthalpy(16e5, REFERENCE.T_in)
    h_out = _enthalpy(flows.P_mix, T_out)
    drop = (flows.exhaust.speed / REFERENCE.turbine.speed_coefficient) ** 2
    shaft = flows.m_t * REFERENCE.turbine.efficiency * drop
    through = (flows.m_jt + flows.m_t) * (h_out - h_in)
    assert through == pytest.approx(u[1] + w - shaft, abs=0.5)


def _enthalpy(P: float, T: float) -> float:
    return float(pytest.importorskip("CoolProp.CoolProp").PropsSI("H", "P", P, "T", T, "Helium"))


def test_one_eigenvalue_integrates_the_level_and_all_others_decay(plant: Plant) -> None:
    real = np.sort(np.linalg.eigvals(plant.model.A).real)[::-1]
    assert abs(real[0]) < 1e-9
    assert np.all(real[1:] < -0.005)
    assert real[1] == pytest.approx(-0.0093, abs=3e-4)
    assert real[-1] == pytest.approx(-1.65, abs=0.05)


def test_the_gains_have_the_signs_and_sizes_of_the_study(plant: Plant) -> None:
    gains, drift = settled_response(plant)
    T5 = plant.model.output_names.index("T5")
    assert gains[T5] == pytest.approx([0.57, -0.045, -0.087], rel=0.05)
    assert 1000.0 * drift[0] == pytest.approx(2.1, rel=0.05)
    assert drift[1] < 0.0


def settled_response(plant: Plant) -> tuple[RealArray, RealArray]:
    """Return the changes of the outputs per input when all but the level has settled, and the level's drift (%/s)."""
    model = plant.model
    settling = np.array(model.A)
    settling[:, 1] = 0.0
    settling[1, 1] = -1.0  # the level's column now solves for its drift
    x = np.linalg.solve(settling, -model.B)
    volume_rate = x[1].copy()
    x[1] = 0.0
    return model.C @ x + model.D, 100.0 * volume_rate / plant.box.separator.volume


@pytest.mark.usefixtures("compiles")
def test_the_linearisation_is_exact(plant: Plant, rest: Rest) -> None:
    assert linearisation_error(*rest, plant.box, plant.helium) < 1e-6


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("moved", [(np.array([2.0, 0.0, 0.0]), 0.0), (np.zeros(3), 100.0)], ids=["CV155", "load"])
def test_the_linear_model_follows_the_plant_for_100_s(plant: Plant, rest: Rest, moved: tuple[RealArray, float]) -> None:
    x, u, w = rest
    du, dw = moved
    y = plant.outputs(plant.simulate(x, u + du, w + dw, 100.0), u + du, w + dw)
    step = plant.model.discretised(100.0)
    linear = plant.model.C @ (step.B @ du + step.F * dw) + plant.model.D @ du + plant.model.G * dw
    for name in ("L1", "T5"):
        k = plant.model.output_names.index(name)
        assert y[name] - plant.model.y0[k] == pytest.approx(linear[k], rel=0.15), name


def integration_error(plant: Plant, rest: Rest, du: list[float], dt: float) -> float:
    """Return the largest error of a temperature (K) 20 s after a move of the inputs."""
    x, u, w = rest
    moved = u + np.array(du)
    exact = plant.simulate(x, moved, w, 20.0, dt=1.0 / 64.0)
    return float(np.max(np.abs(plant.simulate(x, moved, w, 20.0, dt)[2:] - exact[2:])))


@pytest.mark.usefixtures("compiles")
def test_halving_the_step_divides_the_error_by_about_16(plant: Plant, rest: Rest) -> None:
    tick, half = (integration_error(plant, rest, [-3.0, 10.0, 2.0], dt) for dt in (0.25, 0.125))
    assert tick < 1e-8
    assert 12.0 < tick / half < 24.0


@pytest.mark.usefixtures("compiles")
def test_the_error_stays_small_where_the_second_law_limits_a_cell(plant: Plant, rest: Rest) -> None:
    assert integration_error(plant, rest, [5.0, 20.0, -5.0], 0.25) < 5e-5


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("u", [(20.0, 0.0, 20.0), (60.0, 150.0, 60.0)])
@pytest.mark.parametrize("extra", [-200.0, 300.0])
def test_the_plant_stays_finite_at_the_corners_of_its_range(
    plant: Plant, rest: Rest, u: tuple[float, float, float], extra: float
) -> None:
    inputs, load = np.array(u), rest[2] + extra
    x = plant.simulate(rest[0], inputs, load, 1800.0)
    assert np.all(np.isfinite(x))
    y = plant.outputs(x, inputs, load)
    assert 0.0 <= y["L1"] <= 100.0
    warmed = {"T1", "T2"} if y["L1"] == 0.0 else set()  # a dry bath takes up the heat, and warms what enters it
    assert all(4.0 <= y[f"T{k}"] <= (300.0 if f"T{k}" in warmed else 80.0) for k in range(1, 11))


@pytest.mark.usefixtures("compiles")
def test_the_shipped_model_is_that_of_the_reference_plant(plant: Plant) -> None:
    assert plant.model.parameters_digest == parameters_digest(REFERENCE, plant.helium)
    rebuilt = build_model(REFERENCE)
    assert rebuilt.x0 == pytest.approx(plant.model.x0, rel=1e-8)
    assert pytest.approx(plant.model.A, rel=1e-6, abs=1e-6) == rebuilt.A


@pytest.mark.usefixtures("compiles")
def test_without_supply_there_is_no_equilibrium(plant: Plant) -> None:
    with pytest.raises(NoEquilibriumError, match="no equilibrium"):
        find_equilibrium(np.zeros(3), 60.0, REFERENCE, plant.helium)
