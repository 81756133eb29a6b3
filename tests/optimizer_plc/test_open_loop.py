"""The watched reading (L1): stuck behind its noise, frozen, spiking; what was learnt from it is taken back."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.process.cold_box import L1, OUTPUT_NAMES, TICK_S
from coldloop_optimizer_plc.computing_settings import Arithmetic
from coldloop_optimizer_plc.estimator import begin_prediction, correct, estimator_of, no_belief, predict
from coldloop_optimizer_plc.plausibility import (
    STUCK,
    has_moved,
    is_expected_to_move,
    none_apart,
    note_movement,
    plausibility_of,
    suspects_of,
    watched_output,
)
from coldloop_optimizer_plc.qp.linear_algebra import DOUBLE, Real, real_of, respond
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.settings import Preset, ProgramSettings

Array = NDArray[np.float64]

SETTINGS = ProgramSettings()
LIMITS = SETTINGS.plausibility.model_copy(update={"movement_sigmas": 6.0})
SENSORS = SETTINGS.estimator.sensors
TICKS = 10
MINUTE = round(60.0 / (TICKS * TICK_S))
"""Updates."""
STEP_W = 60.0


class Bath:
    """A filter, and a plant that is its model, whose load steps up and down each minute; sensors are noisy."""

    def __init__(self, prediction: PredictionModel, real: Real = DOUBLE) -> None:
        model = prediction.with_disturbances(SETTINGS.estimator.disturbed)
        self.c = estimator_of(model, SETTINGS.estimator, real, LIMITS)
        self.belief, self.plant = (no_belief(model.n_states, 22, real) for _ in range(2))
        self.real, self.rng, self.u = real, np.random.default_rng(3), np.zeros(3, real)
        self.load, self.done = STEP_W, 0
        self.held = self.shown = float("nan")
        self.error = 0.0

    def updates(self, number: int, fault: str = "") -> None:
        c, belief, real = self.c, self.belief, self.real
        for _ in range(number):
            load = self.load if self.done // MINUTE % 2 else -self.load
            self.true = respond(*c.outputs, self.plant.predicted, self.u, real(load))
            noise = np.array(SENSORS) * self.rng.normal(size=len(OUTPUT_NAMES))
            y = self.true + noise
            if not fault:
                self.held, self.shown = self.true[L1], y[L1]
            faults = {"held": self.held + noise[L1], "frozen": self.shown, "dead": np.nan}
            y[L1] = faults.get(fault, y[L1]) + self.error
            correct(c, belief, c.u0, real(c.w0 + load), c.y0 + y.astype(real), np.zeros(28, real))
            begin_prediction(belief)
            predict(c, belief, self.u, TICKS)
            self.plant.numbers[0]["w"] = load
            predict(c, self.plant, self.u, TICKS)
            self.done += 1

    @property
    def suspects(self) -> list[str]:
        mask = suspects_of(self.belief.readings)
        return [name for i, name in enumerate(OUTPUT_NAMES) if mask >> i & 1]

    @property
    def mismatch(self) -> float:
        return float(self.belief.numbers[0]["mismatch"])

    @property
    def level(self) -> float:
        """Return the level that the filter believes, as a deviation."""
        b = self.belief
        return float(respond(*self.c.outputs, b.x, self.u, b.numbers[0]["w"])[L1])


@pytest.fixture
def bath(prediction: PredictionModel) -> Bath:
    settled = Bath(prediction)
    settled.updates(4 * MINUTE)
    return settled


def test_variances_are_those_of_readings_and_of_predictions_about_their_trend(prediction: PredictionModel) -> None:
    p = plausibility_of(LIMITS, prediction.with_disturbances(SETTINGS.estimator.disturbed), SENSORS, 5.0, DOUBLE)
    rng, w = np.random.default_rng(1), none_apart(1, DOUBLE).watch[0]
    elapsed = rng.choice([0.5, 2.5, 5.0], 40)
    ages, shown = np.cumsum(elapsed), rng.normal(size=40)
    expected = 3.0 + 0.2 * ages + np.sin(ages)
    for age, since, y, e in zip(ages, elapsed, shown, expected, strict=True):
        w["age_s"] = age
        note_movement(w, 1.0, y, e, since)
    root = np.sqrt(elapsed)
    line = np.stack([root, root * ages], axis=1)
    integral = np.linalg.lstsq(line, root * expected)[1][0]
    assert w["spread"] == pytest.approx(shown.var())
    assert (w["movement"] - w["trend"] ** 2 / w["span"]) * w["weight_s"] == pytest.approx(integral)
    assert p.movement == pytest.approx((6.0 * 0.01) ** 2 * 60.0)
    for factor, moves in ((0.99, False), (1.01, True)):
        w["movement"] = w["trend"] ** 2 / w["span"] + factor * p.movement / w["weight_s"]
        assert is_expected_to_move(p, w) == moves
        w["spread"] = factor * 1e-4 * (1.5 + 5.0 * np.sqrt(2.0 / 40))
        assert has_moved(p, w) == moves


@pytest.mark.parametrize("real", [DOUBLE, real_of(Arithmetic.FLOAT32)], ids=["double", "single"])
def test_a_level_stuck_behind_its_noise_is_found_and_what_it_taught_taken_back(
    prediction: PredictionModel, real: Real
) -> None:
    bath = Bath(prediction, real)
    bath.updates(4 * MINUTE + MINUTE // 2)
    before = bath.mismatch
    bath.updates(5 * MINUTE, "held")
    assert bath.suspects == ["L1"]
    assert bath.belief.readings[L1]["state"] == STUCK
    assert bath.mismatch == pytest.approx(before, abs=3.0)
    assert bath.level == pytest.approx(bath.true[L1], abs=0.1)
    bath.updates(40 * MINUTE, "held")
    assert bath.suspects == ["L1"], "it is not believed again before it moves"
    bath.updates(3 * MINUTE)
    assert bath.suspects == ["L1"], "after so long what the others say of it is vague, and does not agree"
    bath.updates(round(LIMITS.longest_s / 60.0) * MINUTE)
    assert bath.suspects == []


def test_a_sound_level_that_moves_or_rests_is_never_suspected(bath: Bath) -> None:
    for load in (STEP_W, 0.0, 5.0):
        bath.load = load
        for _ in range(20):
            bath.updates(MINUTE)
            assert bath.suspects == []


def test_a_frozen_level_teaches_no_more_than_a_dead_one(prediction: PredictionModel) -> None:
    found = []
    for fault in ("frozen", "dead"):
        bath = Bath(prediction)
        bath.updates(4 * MINUTE + 5)
        bath.updates(8, fault)
        bath.updates(MINUTE, "dead")
        found.append((bath.mismatch, bath.level))
    (mismatch, level), (of_dead, level_of_dead) = found
    assert mismatch == pytest.approx(of_dead, abs=0.3)
    assert level == pytest.approx(level_of_dead, abs=0.02)


def test_spikes_of_a_level_do_not_reach_the_estimate_and_a_jump_is_suspected(bath: Bath) -> None:
    for k in range(6 * MINUTE):
        bath.error = 5.0 * (-1) ** k if k % 12 == 0 else 0.0
        bath.updates(1)
        assert bath.suspects == []
        assert bath.level == pytest.approx(bath.true[L1], abs=0.05)
    bath.error = 5.0
    bath.updates(4)
    assert bath.suspects == ["L1"]


def test_many_spikes_make_a_level_suspect(bath: Bath) -> None:
    for k in range(MINUTE):
        bath.error = 5.0 if k % 3 == 0 else 0.0
        bath.updates(1)
    assert bath.suspects == ["L1"]


def test_a_bath_that_runs_dry_is_not_judged(bath: Bath) -> None:
    bath.plant.predicted[:] = bath.belief.predicted[:] = 0.0
    bath.c = bath.c._replace(y0=bath.c.y0 - np.eye(len(OUTPUT_NAMES))[L1] * 56.0)
    bath.updates(10 * MINUTE, "held")
    assert bath.suspects == []


def test_only_a_level_without_a_constant_error_is_watched(prediction: PredictionModel) -> None:
    tuned = prediction.with_disturbances(SETTINGS.estimator.disturbed)
    assert watched_output(LIMITS, tuned) == L1
    assert watched_output(ProgramSettings(preset=Preset.PAPER).plausibility, tuned) == -1
    assert watched_output(LIMITS.model_copy(update={"movement_sigmas": 0.0}), tuned) == -1
