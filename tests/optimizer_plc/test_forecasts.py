"""What is forecast: changes by parts of the horizon, and the problem that knows them."""

from dataclasses import replace

import numpy as np
import pytest

from coldloop.process.cold_box import COLD_BOX, OUTPUT_NAMES, T5, TICKS_PER_SAMPLE
from coldloop.process.lti_model import LtiModel
from coldloop.process.sections import Forecast
from coldloop.process.settings import InputLimits, settings_of
from coldloop_optimizer_plc.computing_settings import EstimatorSettings
from coldloop_optimizer_plc.estimator import estimator_of
from coldloop_optimizer_plc.program import Forecasts, OptimizerProgram
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import condense, interpolation
from coldloop_optimizer_plc.settings import ControlDesign, ProgramSettings

DESIGN = ControlDesign()
WEIGHTS = interpolation(np.array(DESIGN.decision_instants, float), np.arange(1.0, DESIGN.horizon + 1))
PARTS = (1, 3)
"""Last samples of two parts: of 5 s, and of 10 s."""


def test_a_step_counts_by_how_much_of_a_part_it_has() -> None:
    """By hand: 400 from tick 0, 460 from tick 30; samples of 20 ticks."""
    forecasts = Forecasts(
        COLD_BOX.model_copy(update={"forecasts": (Forecast(name="load", ticks=(0, 30), values=(400.0, 460.0)),)}), PARTS
    )
    assert len(forecasts) == 2
    assert forecasts.changes(0).tolist() == [0.0, 45.0], "of ticks 20 to 60 three quarters"
    assert forecasts.changes(15).tolist() == [15.0, 60.0], "of ticks 15 to 35 a quarter"
    assert forecasts.changes(30).tolist() == [0.0, 0.0], "it has come, and is measured or estimated"
    assert forecasts.changes(100_000).tolist() == [0.0, 0.0]


def test_no_forecast_is_no_state(prediction: PredictionModel) -> None:
    assert len(Forecasts(COLD_BOX, PARTS)) == 0
    assert prediction.with_forecasts((), PARTS) is prediction


def test_the_outputs_predicted_are_those_of_the_model_under_the_load_forecast(
    prediction: PredictionModel, model: LtiModel
) -> None:
    """Simulated sample by sample: the load is 10 W above what it is in the first part, 30 W in the second."""
    ahead = prediction.with_forecasts([-1], PARTS)
    found = condense(ahead, DESIGN, WEIGHTS)
    random = np.random.default_rng(5)
    x, w, changes = random.normal(size=len(model.x0)) * 1e-3, 20.0, np.array([10.0, 30.0])
    predicted = found.outputs_s @ np.array([*x, *changes, w])
    A, _, F = prediction.sample
    G = prediction.G[list(prediction.constrained), 0]
    C = prediction.C[list(prediction.constrained)]
    for sample in range(1, 6):
        load = w + (10.0 if sample == 1 else 30.0 if sample <= 3 else 0.0)
        x = A @ x + F[:, 0] * load
        assert predicted[sample - 1] == pytest.approx(C @ x + G * load, rel=1e-9, abs=1e-12)


def test_the_problem_without_forecast_is_the_same_to_the_bit(prediction: PredictionModel) -> None:
    one, other = (condense(each, DESIGN, WEIGHTS) for each in (prediction, prediction.with_forecasts([-1], PARTS)))
    n = prediction.n_states
    assert np.array_equal(one.Phi, other.Phi)
    kept = np.r_[:n, -1]
    assert np.array_equal(one.phi_map, other.phi_map[kept])
    assert np.array_equal(one.outputs_s, other.outputs_s[:, :, kept])


def test_the_filter_leaves_alone_what_is_forecast(prediction: PredictionModel) -> None:
    plain, ahead = (
        estimator_of(each, EstimatorSettings()) for each in (prediction, prediction.with_forecasts([-1], PARTS))
    )
    n = prediction.n_states
    gains = ahead.stationary.gains
    assert not gains[:, :, n : n + len(PARTS)].any()
    assert np.array_equal(np.delete(gains, [n, n + 1], axis=2), plain.stationary.gains)
    assert gains.shape[0] == TICKS_PER_SAMPLE


def test_what_is_forecast_is_not_said_to_be_an_error_of_a_sensor(
    model: LtiModel,
) -> None:
    """The registers of the model's deviation: T5 reads 0.4 K too much, and the load will rise."""
    rise = Forecast(name=COLD_BOX.load.name, ticks=(0, 30), values=(400.0, 460.0))
    process = COLD_BOX.model_copy(update={"forecasts": (rise,)})
    with settings_of(process):
        settings = ProgramSettings(estimator=EstimatorSettings(disturbances=("T5",)))
        program = OptimizerProgram(replace(model, process=process.model_dump(mode="json")), settings, InputLimits())
    program.state.belief.x[:] = 60.0
    program.state.belief.x[len(model.x0)] = 0.4
    expected = [float(np.float32(0.4)) * (place == T5) for place in range(len(OUTPUT_NAMES))]
    assert program.model_deviation().y == tuple(expected), "in single precision, as registers have it"
