"""The loop without a PLC's limits."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import load as load_model
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_rig.cosim.one_process import Solved, run_ideal_loop
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder, Recording
from coldloop_studies.request import Outcome, perform
from coldloop_studies.settings import settings_of
from coldloop_studies.study import Load

Array = NDArray[np.float64]
SETTINGS = settings_of(())
MODEL = load_model(Path(SETTINGS.model.file))
STEP = LoadProfile((0, 40), (MODEL.w0, MODEL.w0 + 100.0))


def run(profile: LoadProfile, length: int, ticks: int = 1, solved: Solved | None = None) -> Recording:
    recorder = Recorder(length)
    run_ideal_loop(SETTINGS, Scenario(length, profile, 0.0, 1), recorder, ticks, solved)
    return recorder.recording()


def test_at_rest_it_does_nothing() -> None:
    recording = run(LoadProfile((0,), (MODEL.w0,)), 40)
    np.testing.assert_allclose(recording.u, np.tile(MODEL.u0, (40, 1)), atol=1e-3)


def test_it_answers_a_load_step_in_the_tick_in_which_it_comes() -> None:
    recording = run(STEP, 60)
    moved = np.abs(np.diff(recording.u, axis=0)).max(axis=1) > 0.05
    assert int(np.argmax(moved)) + 1 == 40


def test_its_inputs_keep_bounds_and_the_slew_limit() -> None:
    u = run(STEP, 200).u
    limits = SETTINGS.limits
    assert (u >= limits.low).all()
    assert (u <= limits.high).all()
    for apart in range(1, limits.slew_ticks):
        assert (np.abs(u[apart:] - u[:-apart]) <= np.array(limits.rate) * (1 + 1e-6)).all()


def test_between_instants_the_inputs_are_held() -> None:
    u = run(STEP, 200, ticks=20).u
    changes = np.flatnonzero(np.abs(np.diff(u, axis=0)).max(axis=1) > 0) + 1
    assert len(changes) > 3
    assert set(changes % 20) == {0}


def test_it_tells_each_problem_with_its_optimum() -> None:
    """No guess costs less than the optimum, and the guess of the next problem is the shifted optimum of this one."""
    told: list[tuple[QuadraticProblem, Array, Array]] = []
    run(STEP, 100, ticks=20, solved=lambda *one: told.append(one))
    assert len(told) == 5
    for qp, guess, optimum in told:
        inside = np.clip(guess, qp.low, qp.high)
        assert augmented_cost(qp, optimum, 3000.0) <= augmented_cost(qp, inside, 3000.0) + 1e-6


def test_a_bias_of_the_sensors_is_not_taken_for_a_cost() -> None:
    """At rest, exact, nothing costs anything; 1.5 % too much on the level would be 0.5 % outside the band."""
    load = Load("rest", 1, LoadProfile((0,), (MODEL.w0,)), 60)
    biased = Outcome.from_json(perform(load.request(5.0, "plant.sensors.level_bias=1.5")))
    assert biased.indicators.outside_band_pct["L1"] == 0.0
    assert biased.trace_sha256 != Outcome.from_json(perform(load.request(5.0))).trace_sha256
    noisy = Outcome.from_json(perform(load.request(5.0, "plant.sensors.level=1.5")))
    assert noisy.indicators.outside_band_pct["L1"] == pytest.approx(50.0, abs=25.0)
