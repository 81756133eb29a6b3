"""Targets: where the estimated plant rests at the least cost, by priorities; costs are about them; nothing is off."""

from typing import Final

import daqp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.optimize import linprog

from coldloop.process.cold_box import COLD_BOX, L1, OUTPUT_NAMES, T5
from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.computing_settings import Arithmetic, EstimatorSettings
from coldloop_optimizer_plc.estimator import begin_prediction, correct, estimator_of, no_belief, predict
from coldloop_optimizer_plc.qp.costs import quadratic_cost
from coldloop_optimizer_plc.qp.linear_algebra import DOUBLE, Real, real_of
from coldloop_optimizer_plc.qp.prediction import (
    PredictionModel,
    TargetSearch,
    find_target,
    rest_of,
    state_weights,
    target_search,
)
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from coldloop_optimizer_plc.settings import ControlDesign, Preset, ProgramSettings, Target
from coldloop_rig import simulate

Array = NDArray[np.float64]

LIMITS: Final = InputLimits()
SINGLE: Final = real_of(Arithmetic.FLOAT32)
DESIGN: Final = ControlDesign(target=Target.LOAD, band_margin=(0.1, 0.1))
ALL: Final = EstimatorSettings(disturbances=("outputs",), load_walk_w=1.0)
INPUTS: Final = EstimatorSettings(disturbances=("inputs", "T5"))
assert COLD_BOX.bath is not None
BATH = COLD_BOX.bath


@pytest.fixture(scope="module")
def outputs_off(prediction: PredictionModel) -> PredictionModel:
    return prediction.with_disturbances(ALL.disturbed)


@pytest.fixture(scope="module")
def inputs_off(prediction: PredictionModel) -> PredictionModel:
    return prediction.with_disturbances(INPUTS.disturbed)


def found(search: TargetSearch, x: Array, w: float, mismatch: float = 0.0, most_open: float = np.inf) -> Array:
    """Return the target, scaled."""
    real = search.low.dtype.type
    target = np.zeros(3, real)
    find_target(search, x.astype(real), real(w), real(mismatch), real(most_open), -1, real(0.0), target)
    return target


# -- against independent solvers ---------------------------------------------------------------------------------------


class Reference:
    """The same target by a linear and a quadratic program, one after the other."""

    def __init__(self, model: PredictionModel) -> None:
        rest, n, scale = rest_of(model, DESIGN, BATH), len(model.model.x0), np.array(DESIGN.input_scale)
        self.states, self.held = rest.states[:, :n], rest.states[:, -1]
        self.temperature = rest.temperature
        Q = np.diag(state_weights(model.model, DESIGN))
        self.cost = self.states @ Q @ self.states.T + np.diag(scale**2 * DESIGN.input_weight)
        self.low, self.high = ((np.array(bound) - model.u0) / scale for bound in (LIMITS.low, LIMITS.high))
        band = DESIGN.output_low[1] + 0.1 - model.y0[T5], DESIGN.output_high[1] - 0.1 - model.y0[T5]
        self.band = np.array(band)

    def target(self, off: Array, error: float, w: float, most_open: float) -> Array:
        """Return it for constants of the scaled inputs (3,) and of T5."""
        low, high = self.low + off, self.high + off
        high[0] = max(min(self.high[0], most_open), self.low[0]) + off[0]
        ends = np.sort(np.vstack([self.held * low, self.held * high]), axis=0).sum(axis=1)
        load = np.clip(w, *ends)
        # u and what T5 misses its band by
        missed = linprog(
            [0.0, 0.0, 0.0, 1.0], A_eq=[[*self.held, 0.0]], b_eq=[load],
            A_ub=[[*self.temperature, -1.0], [*-self.temperature, -1.0]],
            b_ub=[self.band[1] - error, error - self.band[0]], bounds=[*zip(low, high, strict=True), (0.0, None)],
        )  # fmt: skip
        assert missed.status == 0
        room = missed.x[3] + 1e-7
        rows = np.vstack([self.held, self.temperature])
        above = np.array([*high, load, self.band[1] - error + room])
        below = np.array([*low, load, self.band[0] - error - room])
        u, _, flag, _ = daqp.solve(
            2.0 * self.cost, np.zeros(3), rows, above, below, np.zeros(5, np.int32), primal_tol=1e-9
        )
        assert flag == 1
        return np.array(u)


def compare(model: PredictionModel, cases: int, real: Real, tolerance: float) -> None:
    """Compare targets of random cases: constants of CV155, CV156 and T5, loads far beyond what can be held."""
    reference, search = Reference(model), target_search(model, DESIGN, LIMITS, real)
    rng, n = np.random.default_rng(5), len(model.model.x0)
    places = [n + model.disturbances.index(signal) for signal in (len(OUTPUT_NAMES), len(OUTPUT_NAMES) + 2, T5)]
    binding = np.zeros(3, int)
    for _ in range(cases):
        x = rng.normal(size=model.n_states)
        x[places] = rng.normal(0.0, 4.0), rng.normal(0.0, 4.0), rng.normal(0.0, 1.5)
        w, most_open = rng.uniform(-500.0, 400.0), rng.uniform(0.0, 2.0)
        off = np.array([x[places[0]] / 10.0, 0.0, x[places[1]] / 10.0])
        u, expected = found(search, x, w, most_open=most_open), reference.target(off, x[places[2]], w, most_open)
        held, T5_off = reference.held @ (u - expected), reference.temperature @ (u - expected)
        assert abs(held) < 200.0 * tolerance
        assert abs(T5_off) < 10.0 * tolerance
        assert expected @ reference.cost @ expected == pytest.approx(
            u @ reference.cost @ u, rel=tolerance, abs=tolerance
        )
        assert np.abs(u - expected).max() < 10.0 * tolerance
        error = x[places[2]] + reference.temperature @ expected
        binding += (
            abs(reference.held @ expected - w) > 1.0,
            not reference.band[0] - 1e-3 < error < reference.band[1] + 1e-3,
            reference.band[0] + 1e-3 < error < reference.band[1] - 1e-3,
        )
    assert binding.min() > cases / 50, "cases of one kind only"


@pytest.mark.parametrize(("real", "tolerance"), [(DOUBLE, 1e-3), (SINGLE, 1e-2)])
def test_targets_are_those_of_independent_solvers(inputs_off: PredictionModel, real: Real, tolerance: float) -> None:
    compare(inputs_off, 300, real, tolerance)


@pytest.mark.night
def test_targets_are_those_of_independent_solvers_in_10_000_cases(inputs_off: PredictionModel) -> None:
    compare(inputs_off, 10_000, DOUBLE, 1e-3)
    compare(inputs_off, 10_000, SINGLE, 1e-2)


# -- what a target is --------------------------------------------------------------------------------------------------


def test_the_plant_as_its_model_rests_at_its_operating_point(outputs_off: PredictionModel) -> None:
    search = target_search(outputs_off, DESIGN, LIMITS)
    assert not found(search, np.zeros(49), 0.0).any()


def test_a_load_that_is_measured_moves_the_target_only_where_it_counts(outputs_off: PredictionModel) -> None:
    of_mismatch = target_search(outputs_off, DESIGN.model_copy(update={"target": Target.MISMATCH}), LIMITS)
    of_load = target_search(outputs_off, DESIGN, LIMITS)
    x = np.zeros(49)
    assert not found(of_mismatch, x, 80.0).any()
    assert found(of_load, x, 80.0).any()
    assert found(of_mismatch, x, 80.0, mismatch=30.0) == pytest.approx(found(of_load, x, 30.0))


def test_without_targets_there_is_none(outputs_off: PredictionModel) -> None:
    search = target_search(outputs_off, ControlDesign(), LIMITS)
    assert not found(search, np.ones(49), 80.0, mismatch=30.0).any()
    assert ProgramSettings(preset=Preset.PAPER).design.target is Target.OPERATING_POINT


@pytest.mark.parametrize(("real", "tolerance"), [(DOUBLE, 1e-9), (SINGLE, 1e-3)])
def test_the_cost_is_of_deviations_from_the_target(
    outputs_off: PredictionModel, model: LtiModel, real: Real, tolerance: float
) -> None:
    """Summed sample by sample."""
    problem = PredictiveProblem(outputs_off, DESIGN, LIMITS, real)
    rng, Q, R = np.random.default_rng(3), state_weights(model, DESIGN), np.array(DESIGN.input_weight)
    A, B, F = outputs_off.sample
    for _ in range(10):
        x = np.concatenate([rng.normal(size=28), rng.normal(size=21)])
        x[0], x[1] = 2000.0 * x[0], 1e-3 * x[1]
        target, w, z = rng.normal(size=3), rng.uniform(-100.0, 100.0), rng.normal(size=problem.size)
        z[problem.n_inputs :] = 0.0
        rest = rest_of(outputs_off, DESIGN, BATH).states[:, :28].T @ target
        parameters = QpParameters(x.astype(real), real(w), np.zeros(3, real), target=target.astype(real))
        qp = problem.at(parameters)
        inputs = (problem.knots_to_samples @ z[: problem.n_inputs].reshape(-1, 3)) * problem.input_scale
        expected = 0.0
        for u in inputs:
            x = A @ x + B @ u + F[:, 0] * w
            off, moved = x[:28] - rest, u - target * problem.input_scale
            expected += off @ (Q * off) + moved @ (R * moved)
        cost = quadratic_cost(qp.Phi, qp.phi, z.astype(real)) + qp.constant
        assert float(cost) == pytest.approx(expected, rel=tolerance)


# -- no offset ---------------------------------------------------------------------------------------------------------


@settings(max_examples=8)
@given(
    errors=arrays(np.float64, 21, elements=st.floats(-10.0, 10.0)),
    unseen=st.floats(-40.0, 40.0),
    gains=arrays(np.float64, 3, elements=st.floats(0.8, 1.2)),
    lag=st.floats(0.8, 1.2),
)
def test_l1_rests_at_its_operating_point_whatever_is_constant(
    model: LtiModel, outputs_off: PredictionModel, errors: Array, unseen: float, gains: Array, lag: float
) -> None:
    """Constant errors of the readings, valves and heater with other gains, a plant that is faster or slower."""
    problem = PredictiveProblem(outputs_off, DESIGN, LIMITS)
    search, estimator = target_search(outputs_off, DESIGN, LIMITS), estimator_of(outputs_off, ALL)
    belief, plant = no_belief(49, 22), model.discretised(5.0 * lag)
    p = np.concatenate([[0.0], errors * np.array([1.0, *[0.02] * 10, *[1e-3] * 10])])
    x, u, off = np.zeros(28), np.zeros(3), np.array([4.3, 7.5, 3.6])
    for _ in range(500):
        acting = gains * u + (gains - 1.0) * off
        y = model.C @ x + model.D @ acting + model.G * unseen + p
        correct(estimator, belief, u + model.u0, model.w0, y + model.y0, np.zeros(49))
        begin_prediction(belief)
        predict(estimator, belief, u, 20)
        w = float(belief.numbers[0]["w"])
        target = found(search, belief.predicted, w, w)
        qp = problem.at(QpParameters(belief.predicted, w, u, target=target))
        free = problem.n_inputs
        z = np.linalg.solve(2.0 * qp.Phi[:free, :free], -qp.phi[:free])
        x = plant.A @ x + plant.B @ acting + plant.F * unseen
        u = z[:3] * problem.input_scale
    assert abs(y[L1]) < 0.005
    assert u == pytest.approx(target * problem.input_scale, abs=0.05)
    low, high = DESIGN.output_low[1], DESIGN.output_high[1]
    assert low < model.y0[T5] + y[T5] < high


@pytest.mark.usefixtures("compiles")
def test_l1_comes_to_rest_nearer_to_its_operating_point_with_valves_that_pass_less() -> None:
    off = []
    for target in (Target.OPERATING_POINT, Target.MISMATCH):
        run = simulate(
            load="a", solver="ode", duration_s=1200, plant={"mismatch": {"jt_valve": 0.9, "turbine_valve": 0.9}},
            optimizer_plc={"program": {"design": {"target": target.value}}},
        )  # fmt: skip
        off.append(abs(np.mean(run.trace.to_dict()["L1"][2400:]) - 60.0))
    assert off[1] < off[0] - 0.05
