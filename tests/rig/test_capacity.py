"""The alarm `capacity`: a load that no inputs hold is said before a band is left, and one that they hold is not."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from coldloop.process.limits import LEVEL_BAND, T5_BAND, InputLimits
from coldloop.process.signals import T5
from coldloop.service.event_text import alarm_cause
from optimizer_plc.settings import ProgramSettings
from plant.cold_box.equilibrium import NoEquilibriumError, find_equilibrium
from plant.cold_box.physics import REFERENCE
from plant.helium.properties import load_helium
from rig import Simulation, simulate

STEP_S = 60.0
LIMITS = InputLimits()
LEAST, LARGEST = ProgramSettings().holdable_load_w


def with_load(watts: float, folder: Path, minutes: int, **factors: float) -> Simulation:
    """Return a run with a load of 340 W for a minute and then another one."""
    file = folder / "load.csv"
    file.write_text(f"time_s,load_w\n0,340\n{STEP_S:g},{watts:g}\n", encoding="utf-8")
    return simulate(load=file, duration_s=60.0 * minutes, plant={"mismatch": factors})


def raised(run: Simulation) -> Mapping[str, object] | None:
    """Return the first alarm `capacity` of a run."""
    found = [
        event
        for event in run.events.arrow.to_pylist()
        if event["kind"] == "alarm raised" and event["subject"] == "capacity"
    ]
    return found[0] if found else None


@pytest.mark.parametrize("factors", [{}, {"jt_valve": 0.9, "turbine_valve": 0.9}, {"heat_transfer": 0.9}], ids=str)
def test_an_overload_is_said_before_the_band_is_left(factors: dict[str, float], tmp_path: Path) -> None:
    run = with_load(570.0, tmp_path, 20, **factors)
    alarm, columns = raised(run), run.trace.to_dict()
    assert alarm is not None
    below = [time for time, L1 in zip(columns["time_s"], columns["L1"], strict=True) if LEVEL_BAND[0] > L1]
    assert below, "an overload that is none"
    assert STEP_S < float(str(alarm["time_s"])) < below[0] - 60.0
    assert "reduce the load by" in str(alarm["cause"])


@pytest.mark.parametrize("watts", [200.0, 440.0])
def test_a_load_that_is_held_raises_nothing(watts: float, tmp_path: Path) -> None:
    run = with_load(watts, tmp_path, 20)
    assert raised(run) is None
    assert run.summary["L1_outside_band_pct"] == 0.0


def test_a_load_that_is_too_small_is_said_too(tmp_path: Path) -> None:
    alarm = raised(with_load(50.0, tmp_path, 3))
    assert alarm is not None
    assert "raise the load by" in str(alarm["cause"])


def test_the_cause_is_the_shortage_in_words() -> None:
    assert alarm_cause(20, 47) == "reduce the load by 47 W, or the bath will run dry"
    assert alarm_cause(20, 0x8000 | 12) == "raise the load by 12 W, or the bath will flood"


def test_the_loads_that_can_be_held_are_those_of_the_steady_states_of_the_plant() -> None:
    """Proof over a grid of the valves, with the heater at the end that helps."""
    helium = load_helium()
    loads = []
    for heater in (LIMITS.low[1], LIMITS.high[1]):
        for cv155 in (20.0, 24.0, 26.0, 50.0, 54.0, 56.0, 58.0, 60.0):
            for cv156 in (20.0, 24.0, 50.0, 60.0):
                try:
                    rest = find_equilibrium(np.array([cv155, heater, cv156]), sum(LEVEL_BAND) / 2, REFERENCE, helium)
                except NoEquilibriumError:
                    continue
                if T5_BAND[0] <= rest.y[T5] <= T5_BAND[1]:
                    loads.append(rest.w)
    assert min(loads) == pytest.approx(LEAST, abs=3.0)
    assert max(loads) == pytest.approx(LARGEST, abs=3.0)
