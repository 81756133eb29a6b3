"""The alarm `capacity`: a load that no inputs hold is said before a band is left, and one that they hold is not."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from coldloop.process.cold_box import LEVEL_BAND, T5_BAND
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.settings import ProgramSettings
from coldloop_plant.cold_box import evaluated
from coldloop_plant.cold_box.model import LOOP_MARGIN, held_loads
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.helium import load_helium
from coldloop_rig import Simulation, simulate

pytestmark = pytest.mark.usefixtures("compiles")

STEP_S = 60.0
NOISE = {"level": 0.01, "speed": 1.0, "temperature": 0.02, "pressure": 0.001}
"""As the filter reckons with."""
LIMITS = InputLimits()
LEAST, LARGEST = ProgramSettings().holdable_load_w


def with_load(
    watts: float,
    folder: Path,
    minutes: int,
    program: Mapping[str, object] | None = None,
    sensors: Mapping[str, float] | None = None,
    **factors: float,
) -> Simulation:
    """Return a run with a load of 340 W for a minute and then another one."""
    file = folder / "load.csv"
    file.write_text(f"time_s,load_w\n0,340\n{STEP_S:g},{watts:g}\n", encoding="utf-8")
    optimizer = {"program": program or {}}
    plant = {"mismatch": factors, "sensors": sensors or {}}
    return simulate(load=file, duration_s=60.0 * minutes, plant=plant, optimizer_plc=optimizer)


def of_capacity(run: Simulation) -> list[Mapping[str, object]]:
    """Return the events of the alarm `capacity`."""
    return [event for event in run.events.arrow.to_pylist() if event["subject"] == "capacity"]


def raised(run: Simulation) -> Mapping[str, object] | None:
    """Return the first alarm `capacity` of a run."""
    return next((event for event in of_capacity(run) if event["kind"] == "alarm raised"), None)


@pytest.mark.parametrize("factors", [{}, pytest.param({"heat_transfer": 0.9}, marks=pytest.mark.night)], ids=str)
def test_an_overload_is_said_before_the_band_is_left(factors: dict[str, float], tmp_path: Path) -> None:
    run = with_load(570.0, tmp_path, 20, **factors)
    alarm, columns = raised(run), run.trace.to_dict()
    assert alarm is not None
    below = [time for time, L1 in zip(columns["time_s"], columns["L1"], strict=True) if LEVEL_BAND[0] > L1]
    assert below, "an overload that is none"
    assert STEP_S < float(str(alarm["time_s"])) < below[0] - 60.0
    assert "reduce" in str(alarm["cause"])
    assert float(str(alarm["value"])) > 0.0


@pytest.mark.parametrize(
    ("watts", "factors"),
    [
        pytest.param(490.0, {"turbine_efficiency": 0.9}, marks=pytest.mark.night),
        pytest.param(490.0, {"heat_transfer": 0.8}, marks=pytest.mark.night),
        (520.0, {"jt_valve": 0.8, "turbine_valve": 0.8}),
    ],
    ids=str,
)
def test_a_load_that_only_a_better_plant_holds_is_said_before_the_band_is_left(
    watts: float, factors: dict[str, float], tmp_path: Path
) -> None:
    """They are held by a plant as its model; these hold up to 474, 467 and 503 W."""
    run = with_load(watts, tmp_path, 10, **factors)
    alarm, columns = raised(run), run.trace.to_dict()
    below = [time for time, L1 in zip(columns["time_s"], columns["L1"], strict=True) if LEVEL_BAND[0] > L1]
    assert alarm is not None
    assert STEP_S < float(str(alarm["time_s"])) < min(below)
    assert "reduce" in str(alarm["cause"])


def test_noise_does_not_delay_the_alarm_nor_end_it(tmp_path: Path) -> None:
    """By the readings themselves it came after the band was left, and its shortage changed its sign all the time."""
    run = with_load(540.0, tmp_path, 40, sensors=NOISE)
    below = [
        time for time, L1 in zip(run.trace.to_dict()["time_s"], run.trace.to_dict()["L1"], strict=True) if L1 < 58.96
    ]
    (alarm,) = of_capacity(run)
    assert alarm["kind"] == "alarm raised"
    assert float(str(alarm["time_s"])) < below[0] - 120.0


@pytest.mark.parametrize(("watts", "is_held"), [(LARGEST - 10.0, True), (LARGEST + 15.0, False)])
def test_the_largest_load_is_held_by_the_loop_and_more_is_not(watts: float, is_held: bool, tmp_path: Path) -> None:  # noqa: FBT001
    run = with_load(watts, tmp_path, 80, sensors=NOISE)
    assert (run.summary["L1_outside_dead_band_pct"] == 0.0) == is_held
    assert run.summary["T5_outside_dead_band_pct"] == 0.0


@pytest.mark.parametrize("watts", [150.0, 440.0])
def test_a_load_that_is_held_raises_nothing(watts: float, tmp_path: Path) -> None:
    run = with_load(watts, tmp_path, 20)
    assert raised(run) is None
    assert run.summary["L1_outside_band_pct"] == 0.0


def test_a_load_that_is_too_small_is_said_and_stays_so_though_the_estimate_is_higher(tmp_path: Path) -> None:
    """What the linear model is off by there, the filter takes for a load."""
    run = with_load(115.0, tmp_path, 30)
    assert [(event["kind"], event["cause"]) for event in of_capacity(run)] == [
        ("alarm raised", "too little load: raise it, or the turbine gets too cold and the bath floods")
    ]


def test_a_load_with_which_a_better_turbine_gets_too_cold_is_said(tmp_path: Path) -> None:
    """It holds 265 W and more; a plant as its model holds this."""
    run = with_load(225.0, tmp_path, 15, turbine_efficiency=1.2)
    alarm, columns = raised(run), run.trace.to_dict()
    assert min(columns["T5"]) < T5_BAND[0]
    assert alarm is not None
    assert STEP_S <= float(str(alarm["time_s"])) < STEP_S + 30.0, "with its delay of 20 s"
    assert "raise it" in str(alarm["cause"])


@pytest.mark.night
def test_the_loads_that_can_be_held_are_those_of_the_steady_states_of_the_plant() -> None:
    """Proof over a grid of the valves, with the heater at the end that helps."""
    openings, turbine = (20.0, 23.0, 24.0, 25.0, 26.0, 50.0, 54.0, 56.0, 58.0, 60.0), (20.0, 22.0, 24.0, 50.0, 60.0)
    heater = LIMITS.low[1], LIMITS.high[1]
    found = least, largest = held_loads(
        REFERENCE, load_helium(), sum(LEVEL_BAND) / 2, openings, heater, turbine, T5_BAND
    )
    assert least.w == pytest.approx(LEAST, abs=3.0)
    assert largest.w - LOOP_MARGIN == pytest.approx(LARGEST, abs=3.0)
    assert (least.u[1], largest.u[1]) == (heater[1], heater[0])
    for rest in found:
        assert np.abs(evaluated(rest.x, rest.u, rest.w, REFERENCE, load_helium())[0]).max() < 1e-4


def test_a_load_near_the_capacity_is_held_because_cv155_is_not_opened_too_far(tmp_path: Path) -> None:
    """Linear, the model expects ever more of CV155; the plant cools most at some 52 %, where T2 leaves T1."""
    limited, free = (
        with_load(500.0, tmp_path, 50, {"cold_end": {"approach_k": kelvin}, "adaptive": {"rule": "algorithm-1"}})
        for kelvin in (0.3, 0.0)
    )  # fmt: skip
    opening, opening_free = (run.trace.to_dict()["CV155"] for run in (limited, free))
    assert max(opening) < 55.0
    assert min(opening_free[-600:]) == LIMITS.high[0]
    assert limited.summary["L1_outside_band_pct"] == 0.0
    assert free.summary["L1_outside_band_pct"] > 5.0
    assert limited.summary["J_BF"] < 0.7 * free.summary["J_BF"]
