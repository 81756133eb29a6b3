from typing import NamedTuple

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coldloop.process.cold_box import L1
from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import Update
from coldloop_optimizer_plc.computing_settings import EstimatorKind, EstimatorSettings, NoiseReference
from coldloop_optimizer_plc.estimator import begin_at_rest, begin_prediction, correct, estimator_of, no_belief, predict
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.linear_algebra import respond
from coldloop_optimizer_plc.qp.prediction import PredictionModel, rest_map
from coldloop_optimizer_plc.settings import ProgramSettings

Array = NDArray[np.float64]

SETTINGS = EstimatorSettings()
FEEDBACK = EstimatorSettings(kind=EstimatorKind.STATE_FEEDBACK)


class Estimate(NamedTuple):
    """State and load as deviations from the operating point, and the share of the load that no sensor saw."""

    x: Array
    w: float
    mismatch: float


class Estimating:
    """An estimator with its belief."""

    def __init__(self, prediction: PredictionModel, settings: EstimatorSettings) -> None:
        self._constants = estimator_of(prediction, settings)
        self._belief = no_belief(prediction.n_states, 22)

    def correct(self, update: Update) -> Estimate:
        u_before, y, x = (np.array(values) for values in (update.u_before, update.y, update.x))
        correct(self._constants, self._belief, u_before, update.load, y, x)
        w, mismatch, _ = self._belief.numbers[0].tolist()
        return Estimate(self._belief.x.copy(), w, mismatch)

    def predict(self, segments: list[tuple[Array, int]]) -> Array:
        begin_prediction(self._belief)
        for u, ticks in segments:
            predict(self._constants, self._belief, u, ticks)
        return self._belief.predicted.copy()


def noise(settings: EstimatorSettings, ticks: int) -> tuple[Array, Array]:
    """Return the variances of the 29 states in so many ticks, and of the 22 sensors, from the settings."""
    walk = np.full(29, settings.temperature_noise_k)
    walk[0], walk[1], walk[28] = settings.pressure_noise_pa, settings.volume_noise_m3, settings.load_walk_w
    sensors = np.concatenate(
        [
            [settings.level_sensor, settings.speed_sensor],
            np.full(10, settings.temperature_sensor),
            np.full(10, settings.pressure_sensor),
        ]
    )
    return walk**2 * ticks / 20, sensors**2


def augmented(model: LtiModel, seconds: float) -> tuple[Array, Array]:
    """Return the transition of states and load mismatch, and the outputs of both."""
    discrete = model.discretised(seconds)
    A = np.eye(29)
    A[:28, :28], A[:28, 28] = discrete.A, discrete.F
    return A, np.hstack([model.C, model.G[:, None]])


def told(model: LtiModel, x: Array, u: Array, y: Array, load: float, number: int = 0) -> Update:
    """Return an update with everything given as deviations from the operating point."""
    inputs = tuple((u + model.u0).tolist())
    return Update(
        session=1,
        update=number,
        tick=number,
        playing=0,
        load=load + model.w0,
        u_before=inputs,
        u=inputs,
        y=tuple((y + model.y0).tolist()),
        x=tuple((x + model.x0).tolist()),
    )


@pytest.mark.parametrize("ticks", [2, 5, 10, 20])
def test_the_stationary_gain_is_that_of_the_riccati_equation(
    model: LtiModel, prediction: PredictionModel, ticks: int
) -> None:
    A, C = augmented(model, ticks * 0.25)
    process, sensors = noise(SETTINGS, ticks)
    P = scipy.linalg.solve_discrete_are(A.T, C.T, np.diag(process), np.diag(sensors))
    expected = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.diag(sensors))
    nothing = np.zeros(3)
    gain = np.zeros_like(expected)
    estimator = Estimating(prediction, SETTINGS)
    mismatch = 0.0
    for output, seen in enumerate(np.eye(22)):
        x = estimator.predict([(nothing, ticks)])
        y = respond(*prediction.outputs.transposed(), x, nothing, mismatch) + seen
        estimate = estimator.correct(told(model, np.zeros(28), nothing, y, 0.0))
        gain[:, output] = np.append(estimate.x - x, estimate.mismatch - mismatch)
        mismatch = estimate.mismatch
    assert np.linalg.norm(gain - expected) < 1e-6 * np.linalg.norm(expected)
    # pressures in Pa and volumes in m3 are 12 orders of magnitude apart: measure each row by its own largest gain, too
    size = np.abs(expected).max(axis=1, keepdims=True)
    assert np.abs((gain - expected) / size).max() < 1e-4


class World:
    """A plant that is the model itself under a load that no sensor sees."""

    def __init__(self, model: LtiModel, ticks: int, unseen: float) -> None:
        self._model = model
        self._discrete = model.discretised(ticks * 0.25)
        self._ticks = ticks
        self._unseen = unseen
        self.x = np.zeros(28)
        self._number = 0

    def measured(self, u: Array, known: float, u_before: Array) -> Update:
        m = self._model
        y = m.C @ self.x + m.D @ u_before + m.G * (known + self._unseen)
        update = told(m, self.x, u, y, known, self._number)
        return update._replace(u_before=tuple((u_before + m.u0).tolist()))

    def move(self, u: Array, known: float) -> None:
        d = self._discrete
        self.x = d.A @ self.x + d.B @ u + d.F * (known + self._unseen)
        self._number += 1


def test_noise_per_time_weighs_a_measurement_by_the_time_since_the_last(prediction: PredictionModel) -> None:
    """At 1.25 s a sensor that shows 0.01 % over 5 s shows 0.02 %; at 5 s nothing changes."""
    sensors = ("level_sensor", "speed_sensor", "temperature_sensor", "pressure_sensor")
    doubled = SETTINGS.model_copy(update={name: 2.0 * getattr(SETTINGS, name) for name in sensors})
    by_time = SETTINGS.model_copy(update={"noise_reference": NoiseReference.TIME})
    usual, twice, found = (estimator_of(prediction, one).stationary.gains for one in (SETTINGS, doubled, by_time))
    assert found[19] == pytest.approx(usual[19], rel=1e-5, abs=1e-9 * np.abs(usual[19]).max())
    assert found[4] == pytest.approx(twice[4], rel=1e-5, abs=1e-9 * np.abs(twice[4]).max())
    assert np.abs(found[4] - usual[4]).max() > 1e-3 * np.abs(usual[4]).max()


@pytest.mark.parametrize("ticks", [5, 20])
@pytest.mark.parametrize("unseen", [40.0, -25.0])
def test_a_load_that_no_sensor_sees_is_found_and_leaves_no_offset(
    model: LtiModel, prediction: PredictionModel, ticks: int, unseen: float
) -> None:
    rng = np.random.default_rng(21)
    world, estimator = World(model, ticks, unseen), Estimating(prediction, SETTINGS)
    u_before = np.zeros(3)
    known = 0.0
    for step in range(8000 // ticks):
        u, known = rng.uniform(-1, 1, 3), 60.0 if step % 40 < 20 else -30.0
        estimate = estimator.correct(world.measured(u, known, u_before))
        world.move(u, known)
        predicted = estimator.predict([(u, ticks)])
        u_before = u
    assert estimate.mismatch == pytest.approx(unseen, rel=1e-2)
    assert estimate.w == pytest.approx(known + estimate.mismatch)
    scale = np.concatenate([[2000.0, 0.002], np.ones(26)])
    assert np.abs((predicted - world.x) / scale).max() < 0.02


def test_without_noise_and_mismatch_the_estimate_is_the_truth_from_the_first_instant(
    model: LtiModel, prediction: PredictionModel
) -> None:
    world, estimator = World(model, 20, 0.0), Estimating(prediction, SETTINGS)
    u = np.array([1.0, 5.0, -1.0])
    before = np.zeros(3)
    for _ in range(50):
        estimate = estimator.correct(world.measured(u, 20.0, before))
        assert estimate.mismatch == pytest.approx(0.0, abs=1e-6)
        assert np.allclose(estimate.x, world.x, rtol=1e-9, atol=1e-7)
        world.move(u, 20.0)
        estimator.predict([(u, 20)])
        before = u


def test_state_feedback_returns_the_state_and_believes_the_known_load(
    model: LtiModel, prediction: PredictionModel
) -> None:
    world, estimator = World(model, 10, 30.0), Estimating(prediction, FEEDBACK)
    u = np.array([0.5, 0.0, -0.5])
    for _ in range(5):
        estimate = estimator.correct(world.measured(u, 15.0, u))
        assert np.allclose(estimate.x, world.x, rtol=1e-12, atol=1e-9)
        assert estimate.w == pytest.approx(15.0)
        assert estimate.mismatch == 0.0
        world.move(u, 15.0)
    step = prediction.transitions[10].transposed()
    assert np.allclose(estimator.predict([(u, 10)]), respond(*step, estimate.x, u, estimate.w))


def test_a_prediction_may_be_cut_into_segments_of_any_length(model: LtiModel, prediction: PredictionModel) -> None:
    rng = np.random.default_rng(22)
    x, u, w = rng.normal(size=28) * [2000.0, 0.002, *np.ones(26)], rng.normal(size=3), 50.0
    whole = model.discretised(7.75)
    expected = whole.A @ x + whole.B @ u + whole.F * w
    for cut in ([31], [20, 11], [1] * 31, [3, 25, 3]):
        estimator = Estimating(prediction, FEEDBACK)
        estimator.correct(World(model, 1, 0.0).measured(u, w, u)._replace(x=tuple((x + model.x0).tolist())))
        reached = estimator.predict([(u, ticks) for ticks in cut])
        assert np.allclose(reached, expected, rtol=1e-9, atol=1e-9)


def test_a_load_that_is_not_measured_is_estimated(model: LtiModel, prediction: PredictionModel) -> None:
    """A plant as its model, with 100 W more that nobody tells: all of it becomes mismatch."""
    settings = EstimatorSettings(load_known=False, load_walk_w=30.0)
    kalman, deaf = Estimating(prediction, settings), Estimating(prediction, settings)
    x, u = np.zeros(28), np.zeros(3)
    for number in range(60):
        y = respond(*prediction.outputs.transposed(), x, u, 100.0)
        estimate = kalman.correct(told(model, x, u, y, 100.0, number))
        again = deaf.correct(told(model, x, u, y, -55.0, number))
        assert estimate.w == estimate.mismatch == again.w
        for one in (kalman, deaf):
            one.predict([(u, 20)])
        x = respond(*prediction.transitions[20].transposed(), x, u, 100.0)
    assert estimate.w == pytest.approx(100.0, rel=0.02)


def test_a_load_that_is_not_measured_neither_interrupts_nor_goes_with_state_feedback() -> None:
    unknown = EstimatorSettings(load_known=False)
    with pytest.raises(ValueError, match="interrupting_load_step_w needs a load that is measured"):
        ProgramSettings(estimator=unknown, interrupting_load_step_w=10.0)
    with pytest.raises(ValueError, match="state-feedback estimates no load; choose kind = kalman"):
        EstimatorSettings(kind=EstimatorKind.STATE_FEEDBACK, load_known=False)


@given(
    u=st.tuples(*[st.floats(-20.0, 20.0)] * 3),
    load=st.none() | st.floats(-300.0, 300.0),
    level=st.floats(-5.0, 5.0),
)
def test_a_filter_without_a_past_begins_where_the_plant_rests_with_its_inputs_and_level(
    prediction: PredictionModel, u: tuple[float, ...], load: float | None, level: float
) -> None:
    """What load that takes is the mismatch where none is measured; one that is measured may have stepped just now."""
    belief = no_belief(prediction.n_states, 22)
    begin_at_rest(rest_map(prediction), belief, np.array(u), load or 0.0, load is not None, level)
    x, (_, mismatch, _) = belief.predicted, belief.numbers[0].tolist()
    step, applied = prediction.sample, np.array(u)
    moved = x - respond(*step.transposed(), x, applied, 0.0)
    acting = float(np.linalg.lstsq(step.F, moved, rcond=None)[0][0])
    assert np.allclose(step.F[:, 0] * acting, moved, atol=1e-7 * (1.0 + np.abs(x).max()))
    y = respond(*prediction.outputs.transposed(), x, applied, acting)
    assert y[L1] == pytest.approx(level, abs=1e-5)
    assert mismatch == pytest.approx(acting if load is None else 0.0, abs=1e-5)


def test_an_optimiser_that_begins_within_a_session_believes_that_the_plant_rests(
    model: LtiModel, prediction: PredictionModel
) -> None:
    """Its first update has what sensors say at rest with inputs that others have set: nothing is to be corrected."""
    moved, rest = np.array([2.0, -3.0, 40.0]), no_belief(prediction.n_states, 22)
    begin_at_rest(rest_map(prediction), rest, moved, 0.0, load_known=True, level=1.0)
    y = respond(*prediction.outputs.transposed(), rest.predicted, moved, 0.0)
    program = OptimizerProgram(model, ProgramSettings(), InputLimits())
    program.restart(0.0)
    u, outputs = tuple((model.u0 + moved).tolist()), tuple((model.y0 + y).tolist())
    program.plan(Update(1, 0, 1000, 77, load=model.w0, u_before=u, u=u, y=outputs, x=tuple(model.x0.tolist())))
    believed = respond(*prediction.outputs.transposed(), program.state.belief.x[: len(rest.x)], moved, 0.0)
    assert np.allclose(believed, y, rtol=1e-3, atol=1e-3 * np.abs(y).max())
