"""The whole refrigerator at its operating point, around it, and over a day."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from coldloop.process.cold_box import OUTPUT_NAMES
from coldloop_plant.cold_box import advance
from coldloop_plant.cold_box.model import Equilibrium, build_model
from coldloop_plant.helium import WARM_CP, load_helium
from coldloop_plant.numeric import RealArray
from coldloop_refrigerator.model import Rest, find_refrigerator_equilibrium, jacobian, lq_gains, rate_scales
from coldloop_refrigerator.physics import (
    COMMAND_NAMES,
    DISTURBANCE_NAMES,
    SIGNAL_NAMES,
    STATE_NAMES,
    advance_refrigerator,
    evaluated,
)
from coldloop_refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_refrigerator.program import SHIPPED, read_refrigerator_file, refrigerator_digest

HELIUM = load_helium()
PLANT = REFERENCE_REFRIGERATOR
FILE = read_refrigerator_file(SHIPPED)


class Point(NamedTuple):
    x: RealArray
    u: RealArray
    v: RealArray
    d: RealArray


@pytest.fixture(scope="module")
def rest() -> Point:
    d = np.array([FILE.w0, 300.0, 0.0, 1.0, 1.0, 1.0])
    return Point(np.array(FILE.x0), np.array([43.0, 75.0, 36.0]), np.array(FILE.v0), d)


def signals_of(point: Point) -> dict[str, float]:
    _, _, signals = evaluated(*point, PLANT, HELIUM)
    return dict(zip(SIGNAL_NAMES, signals.tolist(), strict=True))


def outputs_of(point: Point) -> dict[str, float]:
    _, y, _ = evaluated(*point, PLANT, HELIUM)
    return dict(zip(OUTPUT_NAMES, y.tolist(), strict=True))


def simulate(point: Point, seconds: float, dt: float = 0.25) -> Point:
    x = point.x
    for _ in range(round(seconds / dt)):
        x = advance_refrigerator(x, *point[1:], dt, PLANT, HELIUM)
    return point._replace(x=x)


@pytest.mark.usefixtures("compiles")
def test_the_operating_point_is_at_rest(rest: Point) -> None:
    assert np.max(np.abs(evaluated(*rest, PLANT, HELIUM)[0] / rate_scales(PLANT))) < 1e-9


def test_the_cold_box_feels_what_it_feels_alone(rest: Point) -> None:
    y, s = outputs_of(rest), signals_of(rest)
    alone = {"T1": 4.438, "T5": 10.382, "T6": 19.098, "T9": 80.0, "T10": 76.95, "P1": 1.2317, "P9": 16.0, "P10": 1.05}
    for name, value in alone.items():
        assert y[name] == pytest.approx(value, abs=5e-3), name
    assert s["M12"] == pytest.approx(36.2 + 57.3, abs=0.1)
    assert rest.d[0] + 75.0 == pytest.approx(459.74, abs=0.05)


def test_electrical_power_leaves_as_heat_but_for_what_warms_the_gas(rest: Point) -> None:
    s = signals_of(rest)
    warmed = 1e-6 * s["M_NC"] * (WARM_CP * 5.0 + 2.953e-3 * 14.95e5)
    assert s["E_NC"] - s["Q_NC"] == pytest.approx(warmed, rel=1e-6)


@pytest.mark.night
def test_the_shipped_file_is_that_of_the_reference_refrigerator(rest: Point) -> None:
    assert FILE.parameters_digest == refrigerator_digest(PLANT)
    model = build_model()
    cold = Equilibrium(model.x0, model.u0, model.w0, model.y0, 0.0)
    found: Rest = find_refrigerator_equilibrium(cold, PLANT, HELIUM)
    assert found.x == pytest.approx(rest.x, rel=1e-6, abs=1e-9)
    gains = lq_gains(jacobian(*found[:4], PLANT, HELIUM), PLANT.station.actuator.lag, FILE.weights)
    assert gains == pytest.approx(np.array(FILE.gains), rel=1e-6)


MOVES = {
    "CV155": ("u", 0, 1.0),
    "NCR22": ("u", 1, 20.0),
    "CV156": ("u", 2, 2.0),
    "CV956": ("v", COMMAND_NAMES.index("CV956"), 1.0),
    "CV952": ("v", COMMAND_NAMES.index("CV952"), 1.0),
    "CV953": ("v", COMMAND_NAMES.index("CV953"), 1.0),
    "CV167": ("v", COMMAND_NAMES.index("CV167"), 5.0),
    "load": ("d", DISTURBANCE_NAMES.index("NCR22_HL"), 20.0),
    "ambient": ("d", DISTURBANCE_NAMES.index("T_ambient"), 1.0),
    "leak": ("d", DISTURBANCE_NAMES.index("leak"), 5e-4),
}


def moved_by(rest: Point, name: str) -> Point:
    what, place, size = MOVES[name]
    vector = getattr(rest, what).copy()
    vector[place] += size
    return rest._replace(**{what: vector})


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("name", MOVES)
def test_the_linear_model_follows_the_refrigerator_for_100_s(rest: Point, name: str) -> None:
    moved = moved_by(rest, name)
    after = simulate(moved, 100.0)
    y, s = outputs_of(after), signals_of(after)
    linear = rest_of_linear(rest, moved, 100.0)
    y0, s0 = outputs_of(rest), signals_of(rest)
    tells = {"CV167": ("L_N2",)}.get(name, ("P11", "P12", "L1", "T5"))
    for signal in tells:
        change = (y | s)[signal] - (y0 | s0)[signal]
        if abs(change) > SMALLEST[signal]:
            assert change == pytest.approx(linear[signal], rel=0.15), signal


SMALLEST = {"P11": 5e-4, "P12": 0.01, "L1": 0.02, "T5": 0.02, "L_N2": 0.1}
"""Changes that are worth comparing, in bar, % and K."""


def rest_of_linear(rest: Point, moved: Point, seconds: float) -> dict[str, float]:
    """Return the changes that the linear model foretells."""
    n = len(STATE_NAMES)
    J = jacobian(*rest, PLANT, HELIUM)
    push = np.concatenate([moved.u - rest.u, moved.v - rest.v, moved.d - rest.d])
    solved = solve_ivp(
        lambda _t, x: J[:n, :n] @ x + J[:n, n:] @ push, (0.0, seconds), np.zeros(n), "Radau", rtol=1e-8, atol=1e-10
    )
    changes = J[n:, :n] @ solved.y[:, -1] + J[n:, n:] @ push
    return dict(zip((*OUTPUT_NAMES, *SIGNAL_NAMES), changes.tolist(), strict=True))


def reference_integration(point: Point, seconds: float) -> RealArray:
    solved = solve_ivp(
        lambda _, x: evaluated(x, *point[1:], PLANT, HELIUM)[0],
        (0.0, seconds),
        point.x,
        "LSODA",
        rtol=1e-10,
        atol=1e-11,
    )
    assert solved.success
    end: RealArray = solved.y[:, -1]
    return end


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("name", ["CV155", "CV956", "load", "leak"])
def test_a_step_of_a_tick_is_as_good_as_a_reference_integration(rest: Point, name: str) -> None:
    moved = moved_by(rest, name)
    error = np.abs(simulate(moved, 60.0).x - reference_integration(moved, 60.0)) / rate_scales(PLANT)
    assert np.max(error) < 1e-4, STATE_NAMES[int(np.argmax(error))]


@pytest.mark.usefixtures("compiles")
def test_a_trip_is_integrated_well_too(rest: Point) -> None:
    tripped = rest._replace(d=rest.d - np.array([0, 0, 0, 0, 1, 0]))
    error = np.abs(simulate(tripped, 30.0).x - reference_integration(tripped, 30.0)) / rate_scales(PLANT)
    assert np.max(error) < 0.05, STATE_NAMES[int(np.argmax(error))]


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize(("ambient", "run", "nitrogen"), [(275.0, (0.0, 1.0), 1.0), (320.0, (1.0, 1.0), 0.0)])
def test_the_refrigerator_stays_finite_far_from_rest(
    rest: Point, ambient: float, run: tuple[float, float], nitrogen: float
) -> None:
    far = rest._replace(d=np.array([rest.d[0] + 100.0, ambient, 5e-3, nitrogen, *run]))
    after = simulate(far, 1800.0)
    assert np.all(np.isfinite(after.x))
    s = signals_of(after)
    assert 0.5 < s["P11"] < 1.75
    assert 1.0 < s["P12"] < 19.0


@pytest.mark.usefixtures("compiles")
def test_the_cold_box_in_it_is_the_cold_box(rest: Point) -> None:
    """At 16 bar, 1.05 bar and 80 K the same equations are solved."""
    box = PLANT.box
    x = rest.x[:28]
    alone = advance(x, rest.u, rest.d[0], 0.25, box._replace(T_in=float(rest.x[36])), HELIUM)
    joined = advance_refrigerator(rest.x, *rest[1:], 0.25, PLANT, HELIUM)[:28]
    assert joined == pytest.approx(alone, rel=1e-12)
