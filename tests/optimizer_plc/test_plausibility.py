"""Readings that prediction and other readings contradict: suspected, left out, and taken back."""

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.process.cold_box import L1, OUTPUT_NAMES, OUTPUT_UNITS, T5, TICK_S
from coldloop_optimizer_plc.computing_settings import Arithmetic, PlausibilitySettings
from coldloop_optimizer_plc.estimator import (
    Belief,
    Estimator,
    begin_prediction,
    correct,
    estimator_of,
    no_belief,
    predict,
)
from coldloop_optimizer_plc.plausibility import MISSING, USED, new_readings, suspects_of, wanders_off
from coldloop_optimizer_plc.qp.linear_algebra import DOUBLE, Real, real_of, respond
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.settings import Preset, ProgramSettings

Array = NDArray[np.float64]

N_Y = len(OUTPUT_NAMES)
SETTINGS = ProgramSettings()
LIMITS = SETTINGS.plausibility
TICKS = 10
MINUTE = round(60.0 / (TICKS * TICK_S))
"""Updates."""
SPIKE = 3
"""Updates after which a reading that contradicts the others is a suspect."""
SIGMA = np.array([0.01, 1.0, *[0.02] * 10, *[0.001] * 10])
JUMP = np.array([{"%": 0.6, "Hz": 100.0, "K": 0.5, "bar": 0.05}[unit] for unit in OUTPUT_UNITS])
SINGLE = real_of(Arithmetic.FLOAT32)


class World:
    """A filter, and a plant that rests where its model does, with noisy sensors."""

    def __init__(self, prediction: PredictionModel, real: Real = DOUBLE, limits: PlausibilitySettings = LIMITS) -> None:
        model = prediction.with_disturbances(SETTINGS.estimator.disturbed)
        self.c: Estimator = estimator_of(model, SETTINGS.estimator, real, limits)
        self.belief: Belief = no_belief(model.n_states, 22, real)
        self.real = real
        self.rng = np.random.default_rng(1)
        self.error = np.zeros(N_Y)
        """What the sensors show too much; not a number: nothing."""

    def updates(self, number: int, ticks: int = TICKS) -> None:
        c, belief, real = self.c, self.belief, self.real
        for _ in range(number):
            y = c.y0 + (SIGMA * self.rng.normal(size=N_Y) + self.error).astype(real)
            correct(c, belief, c.u0, real(c.w0), y.astype(real), np.zeros(28, real))
            begin_prediction(belief)
            predict(c, belief, np.zeros(3, real), ticks)

    def states(self) -> list[int]:
        return [int(state) for state in self.belief.readings["state"]]

    @property
    def suspects(self) -> list[str]:
        mask = suspects_of(self.belief.readings)
        return [name for i, name in enumerate(OUTPUT_NAMES) if mask >> i & 1]

    def shown(self) -> Array:
        """Return the outputs as the filter believes them, as deviations."""
        b = self.belief
        return np.array(respond(*self.c.outputs, b.x, np.zeros(3, self.real), b.numbers[0]["w"]), float)


@pytest.fixture
def world(prediction: PredictionModel) -> World:
    settled = World(prediction)
    settled.updates(MINUTE + 20)
    return settled


def test_noise_makes_no_reading_suspect(world: World) -> None:
    for ticks in (2, 5, 10, 20):
        world.updates(500, ticks)
        assert world.suspects == []
    assert set(world.states()) == {USED}


@pytest.mark.parametrize("real", [DOUBLE, SINGLE], ids=["double", "single"])
def test_a_jump_of_any_sensor_is_its_own_at_once_and_moves_nothing_else(
    prediction: PredictionModel, real: Real
) -> None:
    for output in range(N_Y):
        world = World(prediction, real)
        world.updates(MINUTE + 20)
        before = world.shown()
        world.error[output] = JUMP[output]
        world.updates(SPIKE)
        assert world.suspects == [OUTPUT_NAMES[output]]
        world.updates(10)
        assert world.suspects == [OUTPUT_NAMES[output]]
        moved = np.abs(world.shown() - before)
        assert moved[output] < 0.3 * JUMP[output]
        assert (moved < 10.0 * SIGMA).all()


def test_without_the_limit_the_filter_follows_the_sensor(prediction: PredictionModel) -> None:
    world = World(prediction, limits=PlausibilitySettings())
    world.updates(MINUTE + 20)
    world.error[L1] = 0.6
    world.updates(20)
    assert world.suspects == []
    assert world.shown()[L1] == pytest.approx(0.6, abs=0.05)


def test_a_new_reading_is_not_judged_for_a_minute(prediction: PredictionModel) -> None:
    world = World(prediction)
    world.error = 0.4 * JUMP
    world.updates(MINUTE - 1)
    assert world.suspects == []


def test_a_suspect_that_agrees_again_is_taken_back_a_minute_later(world: World) -> None:
    world.error[T5] = 0.5
    world.updates(MINUTE)
    world.error[T5] = 0.0
    world.updates(MINUTE - 2)
    assert world.suspects == ["T5"]
    world.updates(4)
    assert world.suspects == []
    assert abs(world.shown()[T5]) < 0.2


@pytest.mark.parametrize("output", [L1, T5], ids=["L1", "T5"])
def test_one_that_does_not_agree_is_believed_after_half_an_hour(world: World, output: int) -> None:
    """What the others say of it is then no better. One with a constant error moves nothing by that."""
    world.error[output] = JUMP[output]
    world.updates(round(LIMITS.longest_s / (TICKS * TICK_S)))
    assert world.suspects == [OUTPUT_NAMES[output]]
    level = world.shown()[L1]
    world.updates(4)
    assert set(world.states()) == {USED}
    world.updates(10)
    assert world.shown()[output] == pytest.approx(JUMP[output], abs=10.0 * SIGMA[output])
    if output != L1:
        assert world.shown()[L1] == pytest.approx(level, abs=0.03)


@pytest.mark.parametrize(
    ("jump", "jumped_to", "difference", "shown", "wanders"),
    [
        (0.2, 60.2, 0.39, 60.39, False),  # not as far again
        (0.2, 60.2, 0.41, 60.41, True),
        (-0.2, 59.8, -0.41, 59.59, True),
        (0.2, 60.2, -0.01, 59.99, True),  # back, and as far again to the other side
        (0.2, 60.2, 0.41, 60.2, False),  # stuck: the others moved
        (0.2, 60.2, 0.41, 60.0, False),
        (0.2, 60.2, 0.6, 60.41, True),  # half of it by itself
        (0.2, 60.2, 0.6, 60.39, False),
        (0.2, 60.2, 0.2, 65.0, False),  # too much by a constant, and the process moved
        (0.01, 60.0, 0.1, 60.09, False),  # as far as noise moves it
        (0.01, 60.0, 0.12, 60.11, True),
    ],
)
def test_a_suspect_wanders_off_as_far_again_as_it_had_jumped_and_by_itself(
    jump: float, jumped_to: float, difference: float, shown: float, *, wanders: bool
) -> None:
    reading = new_readings(22, DOUBLE)[0]
    reading["jump"], reading["jumped_to"], reading["difference"] = jump, jumped_to, difference
    assert wanders_off(reading, shown, 0.1) == wanders


@pytest.mark.parametrize("output", [L1, T5], ids=["L1", "T5"])
def test_a_sound_sensor_of_a_plant_that_is_no_longer_as_its_model_is_soon_believed(world: World, output: int) -> None:
    world.error[output] = JUMP[output]
    world.updates(SPIKE)
    assert world.suspects == [OUTPUT_NAMES[output]]
    for _ in range(20):
        world.error[output] += 0.08 * JUMP[output]
        world.updates(SPIKE)
    assert world.suspects == []
    world.updates(10)
    assert world.shown()[output] == pytest.approx(world.error[output], abs=0.1 * JUMP[output])


def test_one_that_jumps_about_is_not_believed(world: World) -> None:
    for k in range(4 * MINUTE):
        world.error[L1] = JUMP[L1] * (2.0 + k % 5) * (-1) ** (k // 3)
        world.updates(SPIKE)
        assert world.suspects == ["L1"]
    assert abs(world.shown()[L1]) < 0.3 * JUMP[L1]


def test_a_sensor_that_was_dead_for_long_is_not_suspected_when_it_shows_something_else(world: World) -> None:
    world.error[T5] = np.nan
    world.updates(MINUTE)
    assert world.states()[T5] == MISSING
    world.error[T5] = 2.0
    world.updates(MINUTE // 2)
    assert world.states()[T5] == USED
    assert world.shown()[T5] == pytest.approx(2.0, abs=0.1)
    world.error[T5] = 2.5
    world.updates(MINUTE)
    assert world.states()[T5] == USED, "not judged yet when it jumped"


def test_two_that_fail_together_are_both_found(world: World) -> None:
    for name in ("T5", "P3"):
        output = OUTPUT_NAMES.index(name)
        world.error[output] = JUMP[output]
    world.updates(SPIKE)
    assert world.suspects == ["T5", "P3"]


def test_when_more_contradict_the_prediction_than_can_fail_it_is_the_plant(world: World) -> None:
    world.error[2 : 2 + LIMITS.most + 1] = 0.6
    world.updates(SPIKE)
    assert world.suspects == []


def test_while_the_model_does_not_hold_suspects_are_taken_back_and_no_other_reading_becomes_one(world: World) -> None:
    """The gauges of the supply see a compressor trip, of which a cold box's model knows nothing."""
    world.error[L1] = JUMP[L1]
    world.updates(SPIKE)
    assert world.suspects == ["L1"]
    for name in ("P2", "P4", "P6", "P9"):
        world.error[OUTPUT_NAMES.index(name)] = -1.0
    world.updates(3)
    assert world.suspects == []
    world.error[T5] = JUMP[T5]
    world.updates(SPIKE)
    assert world.suspects == []
    world.updates(8 * MINUTE)
    world.error[T5] = 2.0 * JUMP[T5]
    world.updates(SPIKE)
    assert world.suspects == ["T5"], "the filter has learnt how the plant is now"


def test_one_reading_against_the_model_brings_no_wrong_level_back_and_two_do(world: World) -> None:
    """One may be wrong itself, by too little to be suspected."""
    world.error[L1] = 5.0
    world.updates(5)
    for number, name in enumerate(("T3", "T8"), start=1):
        world.belief.surprise[OUTPUT_NAMES.index(name)] = 25.0
        world.updates(1)
        assert ("L1" in world.suspects) == (number < 2)


def test_a_loose_contact_hides_no_other_fault(world: World) -> None:
    """A reading that is never used for a minute cannot be judged, and does not judge the model either."""
    loose = OUTPUT_NAMES.index("T8")
    for k in range(3 * MINUTE):
        world.error[loose] = np.nan if k % 12 == 0 else 0.6 * (-1) ** k
        world.updates(1)
    world.error[L1] = JUMP[L1]
    world.updates(SPIKE)
    assert world.suspects == ["L1"]


def test_sensors_that_are_dead_leave_the_others_judged(world: World) -> None:
    for name in ("P2", "T10", "P9"):
        world.error[OUTPUT_NAMES.index(name)] = np.nan
    world.updates(1)
    world.error[L1] = JUMP[L1]
    world.updates(SPIKE)
    assert world.suspects == ["L1"]


def test_after_a_longer_gap_than_the_filter_is_for_no_reading_becomes_suspect(world: World) -> None:
    predict(world.c, world.belief, np.zeros(3), 40)
    world.error[T5] = JUMP[T5]
    world.updates(SPIKE)
    assert world.suspects == []


def test_the_largest_residual_is_what_all_lose_without_that_output(world: World) -> None:
    """So the wrong one of several readings is found: no other one explains as much."""
    rng, J = np.random.default_rng(2), world.c.stationary.inverse_covariances[TICKS - 1]
    S = np.linalg.inv(J)
    for _ in range(20):
        e = rng.multivariate_normal(np.zeros(N_Y), S)
        for i in range(N_Y):
            others = np.arange(N_Y) != i
            lost = e @ J @ e - e[others] @ np.linalg.solve(S[np.ix_(others, others)], e[others])
            assert (J[i] @ e) ** 2 / J[i, i] == pytest.approx(lost, rel=1e-6, abs=1e-9)


def test_the_state_is_detectable_with_l1_alone_and_not_without(prediction: PredictionModel) -> None:
    """So any others may be left out; L1 for a time only, in which its integrator is not corrected (Hautus' test)."""
    A, F = prediction.sample.A, prediction.sample.F
    n = len(A)
    whole = np.block([[A, F], [np.zeros((1, n)), np.ones((1, 1))]])
    outputs = np.hstack([prediction.C, prediction.G])
    slow = [value for value in np.linalg.eigvals(whole) if abs(value) > 1.0 - 1e-6]
    assert len(slow) == 2, "level and load integrate"

    def detectable(rows: list[int]) -> bool:
        scale = np.linalg.norm(np.vstack([whole, outputs]), axis=0)
        modes = np.vstack([whole - np.eye(n + 1), outputs[rows]]) / scale
        return bool(np.linalg.svd(modes, compute_uv=False)[-1] > 1e-9)

    assert detectable([L1])
    assert not detectable([i for i in range(N_Y) if i != L1])


def test_the_preset_paper_believes_every_number() -> None:
    assert ProgramSettings(preset=Preset.PAPER).plausibility.sigmas == 0.0
    assert LIMITS.sigmas > 0.0
