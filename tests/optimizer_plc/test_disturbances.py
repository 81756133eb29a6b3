"""Constant errors of the sensors' readings, estimated beside the states: what they are, and what the control gains."""

from collections.abc import Iterator

import numpy as np
import pytest
import scipy.linalg
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.process.cold_box import COLD_BOX, OUTPUT_NAMES, T5
from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.computing_settings import EstimatorKind, EstimatorSettings, signals_of
from coldloop_optimizer_plc.estimator import (
    begin_prediction,
    check_detectability,
    correct,
    estimator_of,
    no_belief,
    predict,
    stationary_gains,
)
from coldloop_optimizer_plc.qp.linear_algebra import respond
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_rig import simulate
from coldloop_rig.testing import LiveRig, up

Array = NDArray[np.float64]

ALL = EstimatorSettings(disturbances=("outputs",))
SENSORS = np.concatenate([[0.01, 1.0], np.full(10, 0.02), np.full(10, 1e-3)])
"""Standard deviations by default."""


@pytest.fixture(scope="module")
def disturbed(prediction: PredictionModel) -> PredictionModel:
    return prediction.with_disturbances(ALL.disturbed)


def test_all_outputs_but_the_level_may_have_one_and_all_inputs_but_the_heater(disturbed: PredictionModel) -> None:
    assert ALL.disturbed == tuple(range(1, 22))
    assert OUTPUT_NAMES[0] == "L1"
    assert disturbed.n_states == 28 + 21
    assert EstimatorSettings(disturbances=("T5", "V1")).disturbed == (1, T5)
    assert EstimatorSettings(disturbances=("inputs", "V1")).disturbed == (1, 22, 24)
    assert EstimatorSettings.model_validate({"disturbances": "outputs"}) == ALL


def test_names_that_are_no_signals_are_refused() -> None:
    for wrong in (("T55",), ("T5", "T5"), ("outputs", "T5"), ("inputs", "CV155")):
        with pytest.raises(ValueError, match=r"disturbances are a list, each once, of outputs, inputs, L1, .* CV156"):
            EstimatorSettings(disturbances=wrong)
    with pytest.raises(ValueError, match="state-feedback estimates no disturbances"):
        EstimatorSettings(kind=EstimatorKind.STATE_FEEDBACK, disturbances=("T5",))


@pytest.mark.parametrize(
    ("names", "worst"),
    [(("L1",), "L1"), (("L1", "T5"), "L1"), (tuple(OUTPUT_NAMES), "L1"), (("NCR22_A",), "NCR22_A")],
)
def test_what_no_sensor_tells_apart_is_refused(prediction: PredictionModel, names: tuple[str, ...], worst: str) -> None:
    """A constant error of the level is no other than helium, one of the heater no other than the load."""
    chosen = EstimatorSettings(disturbances=names)
    with pytest.raises(ConfigurationError, match=rf"no sensor tells a constant error of {worst} from .* leave it out"):
        estimator_of(prediction.with_disturbances(chosen.disturbed), chosen)


@given(names=st.sets(st.sampled_from(signals_of(COLD_BOX)), min_size=1))
@example(names={"CV155", "CV156"})
@example(names=set(OUTPUT_NAMES[1:]))
@example(names=set(OUTPUT_NAMES[1:]) | {"CV155"})
def test_what_the_sensors_tell_apart_is_accepted(prediction: PredictionModel, names: set[str]) -> None:
    """As many constants as outputs, the load among them, but for that of the integrator and that which is a load."""
    chosen = EstimatorSettings(disturbances=tuple(names))
    model = prediction.with_disturbances(chosen.disturbed)
    if names & {"L1", "NCR22_A"} or len(names) + 1 > len(OUTPUT_NAMES):
        with pytest.raises(ConfigurationError, match="leave it out"):
            check_detectability(model)
    else:
        check_detectability(model)


@pytest.mark.parametrize("ticks", [2, 8, 20])
def test_the_gain_is_that_of_the_riccati_equation(disturbed: PredictionModel, ticks: int) -> None:
    drift = np.full(50, 0.05)
    drift[0], drift[1], drift[28:49], drift[49] = 50.0, 1e-5, 3.0 * SENSORS[1:], 3.0
    A = np.eye(50)
    A[:49, :49], A[:49, 49] = disturbed.transitions[ticks].A, disturbed.transitions[ticks].F[:, 0]
    C = np.hstack([disturbed.C, disturbed.G])
    A, C = A * drift / drift[:, None], C * drift  # states in units of their walk
    R = np.diag(SENSORS**2)
    P = scipy.linalg.solve_discrete_are(A.T, C.T, np.eye(50) * ticks / 20, R)
    expected = drift[:, None] * (P @ C.T @ np.linalg.inv(C @ P @ C.T + R))
    found = stationary_gains(disturbed, ALL).gains[ticks - 1].T
    size = np.abs(expected).max(axis=1, keepdims=True)
    assert np.abs((found - expected) / size).max() < 1e-4


within_ten_sigmas = arrays(np.float64, 21, elements=st.floats(-10.0, 10.0))


@settings(max_examples=20)
@given(errors=within_ten_sigmas, unseen=st.floats(-60.0, 60.0), ticks=st.sampled_from([4, 10, 20]))
def test_constant_errors_are_found_and_leave_no_offset(
    model: LtiModel, disturbed: PredictionModel, errors: Array, unseen: float, ticks: int
) -> None:
    """On a plant as its model but for these errors, and a load that no sensor sees."""
    p, plant = np.concatenate([[0.0], errors * SENSORS[1:]]), model.discretised(ticks * 0.25)
    estimator, belief = estimator_of(disturbed, ALL), no_belief(disturbed.n_states, 22)
    x, u = np.zeros(28), np.array([0.5, -3.0, 0.2])
    for _ in range(6000 // ticks):
        y = model.C @ x + model.D @ u + model.G * unseen + p
        seen = respond(*disturbed.outputs.transposed(), belief.predicted, u, belief.numbers[0]["w"])
        correct(estimator, belief, u + model.u0, model.w0, y + model.y0, np.zeros(49))
        begin_prediction(belief)
        predict(estimator, belief, u, ticks)
        x = plant.A @ x + plant.B @ u + plant.F * unseen
    assert np.abs((y - seen) / SENSORS).max() < 0.05
    assert belief.numbers[0]["mismatch"] == pytest.approx(unseen, abs=0.5)
    assert np.abs((belief.x[28:] - p[1:]) / SENSORS[1:]).max() < 0.5


@settings(max_examples=20)
@given(errors=arrays(np.float64, 2, elements=st.floats(-3.0, 3.0)))
def test_a_plant_with_other_valves_comes_to_rest_at_the_operating_point(
    model: LtiModel, prediction: PredictionModel, errors: Array
) -> None:
    """Valves that act like so much more: the estimates find them, and the unconstrained optimum takes them off."""
    chosen = EstimatorSettings(disturbances=("inputs",), input_walk=(0.5, 5.0, 0.5))
    valves = prediction.with_disturbances(chosen.disturbed)
    problem = PredictiveProblem(valves, ControlDesign(), InputLimits())
    estimator, belief, plant = estimator_of(valves, chosen), no_belief(30, 22), model.discretised(5.0)
    off = np.array([errors[0], 0.0, errors[1]])
    x, u = np.zeros(28), np.zeros(3)
    for _ in range(400):
        y = model.C @ x + model.D @ (u + off)
        correct(estimator, belief, u + model.u0, model.w0, y + model.y0, np.zeros(30))
        begin_prediction(belief)
        predict(estimator, belief, u, 20)
        qp = problem.at(QpParameters(belief.predicted, float(belief.numbers[0]["w"]), u))
        free = problem.n_inputs
        z = np.linalg.solve(2.0 * qp.Phi[:free, :free], -qp.phi[:free])
        x = plant.A @ x + plant.B @ (u + off)
        u = z[:3] * problem.input_scale
    assert np.abs(belief.x[28:] - errors).max() < 1e-3
    assert np.abs(u + off).max() < 1e-3
    assert np.abs(y / SENSORS).max() < 0.05
    assert np.isclose(z @ qp.Phi[:free, :free] @ z + z @ qp.phi[:free] + qp.constant, 0.0, atol=1e-6)


def test_the_problem_keeps_the_reading_of_t5_within_its_band(
    disturbed: PredictionModel, prediction: PredictionModel
) -> None:
    """An error of T5 moves its rows by as much, and changes neither the cost nor the rows of L1."""
    plain, extended = (PredictiveProblem(one, ControlDesign(), InputLimits()) for one in (prediction, disturbed))
    x = np.zeros(49)
    x[28 + ALL.disturbed.index(T5)] = 0.4
    x[28 + ALL.disturbed.index(T5) + 1] = 7.0
    before, after = (
        problem.at(QpParameters(state, 0.0, np.zeros(3))) for problem, state in ((plain, x[:28]), (extended, x))
    )
    assert np.array_equal(after.Phi, before.Phi)
    assert np.array_equal(after.phi, before.phi)
    shift = after.gamma - before.gamma
    rows = shift[:56].reshape(-1, 2, 2)  # instants, outputs, sides
    assert np.all(rows[:, 0] == 0.0)
    assert np.allclose(rows[:, 1, 0], -rows[:, 1, 1])
    assert np.allclose(np.abs(rows[:, 1]), 0.4 * extended.predicted.row_gains[2])
    assert np.all(shift[56:] == 0.0)


@pytest.mark.usefixtures("compiles")
def test_the_level_stays_within_its_band_on_a_plant_whose_valves_pass_less() -> None:
    off = {"mismatch": {"jt_valve": 0.9, "turbine_valve": 0.9}}
    outside = [
        simulate(
            load="a", duration_s=900, plant=off, optimizer_plc={"program": {"estimator": {"disturbances": chosen}}}
        ).summary["L1_outside_band_pct"]
        for chosen in ([], ["outputs"])
    ]
    assert outside[0] > 50.0
    assert outside[1] == 0.0


@pytest.fixture
def live_rig() -> Iterator[LiveRig]:
    off = {"mismatch": {"jt_valve": 0.9, "turbine_valve": 0.9}}
    estimator = {"disturbances": ["inputs"], "input_walk": [0.2, 2.0, 0.2]}
    with up(load="a", plant=off, optimizer_plc={"program": {"estimator": estimator}}) as one:
        yield one


@pytest.mark.night  # with a rig that is up
def test_the_registers_say_what_the_plant_needs_more_than_its_model(live_rig: LiveRig) -> None:
    """Valves that pass 10 % less, at 43 % and 36 %: like 4.3 and 3.6 % less of the inputs."""
    live_rig.advance(600)
    found = live_rig.optimizer_plc.read_block("model deviation")
    assert found.u[0] == pytest.approx(-4.3, abs=1.0)
    assert found.u[2] == pytest.approx(-3.6, abs=1.0)
    assert found.u[1] == 0.0
    assert not any(found.y)
