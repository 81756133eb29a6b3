"""Outputs without a good measurement: the Kalman filter corrects by the others, as a filter of those would."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pytest
import scipy.linalg
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coldloop.process.cold_box import L1, OUTPUT_NAMES
from coldloop.process.lti_model import LtiModel
from coldloop_optimizer_plc.computing_settings import Arithmetic, EstimatorKind, EstimatorSettings
from coldloop_optimizer_plc.estimator import (
    Belief,
    Estimator,
    correct,
    estimator_of,
    no_belief,
    stationary_gains,
)
from coldloop_optimizer_plc.plausibility import imputed, note_surprise
from coldloop_optimizer_plc.qp.linear_algebra import DOUBLE, Real, add_transposed_product, real_of, respond
from coldloop_optimizer_plc.qp.prediction import PredictionModel

Array = NDArray[np.float64]

N_Y = len(OUTPUT_NAMES)
P1 = OUTPUT_NAMES.index("P1")
EVERY = frozenset(range(N_Y))
TICKS = 10
SINGLE = real_of(Arithmetic.FLOAT32)
ESTIMATORS = [EstimatorSettings(), EstimatorSettings(disturbances=("outputs",), load_walk_w=1.0)]
by_estimator = pytest.mark.parametrize("chosen", ESTIMATORS, ids=["paper", "tuned"])
some_outputs = st.sets(st.sampled_from(range(N_Y)))


def without(values: Array, bad: Iterable[int]) -> Array:
    """Return outputs of which some are no number."""
    result = values.copy()
    result[list(bad)] = np.nan
    return result


class Filter(NamedTuple):
    """A filter before a measurement, in units of the standard deviations of the sensors."""

    P: Array
    """Covariance of the state, (n, n)."""
    C: Array
    """Shape (22, n)."""

    def correction(self, innovation: Array, outputs: list[int]) -> Array:
        """Return that of the state by these outputs alone: the textbook's formula with the other rows left out."""
        C = self.C[outputs]
        return self.P @ C.T @ np.linalg.solve(C @ self.P @ C.T + np.eye(len(outputs)), innovation[outputs])

    @property
    def inverse_covariance(self) -> Array:
        return np.linalg.inv(self.C @ self.P @ self.C.T + np.eye(N_Y))


@st.composite
def filters(draw: st.DrawFn) -> Filter:
    """Draw covariances of any rank, of directions whose variances differ by four orders of magnitude."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    n, rank = draw(st.integers(1, 30)), draw(st.integers(1, 30))
    root = rng.normal(size=(n, rank)) * 10.0 ** rng.uniform(-1.0, 1.0, rank)
    return Filter(root @ root.T, rng.normal(size=(N_Y, n)))


@given(drawn=filters(), bad=some_outputs, seed=st.integers(0, 2**32))
@example(drawn=Filter(np.eye(3), np.ones((N_Y, 3))), bad=EVERY, seed=1)
@example(drawn=Filter(np.eye(3), np.ones((N_Y, 3))), bad=EVERY - {0}, seed=1)
@example(drawn=Filter(np.eye(3), np.ones((N_Y, 3))), bad={N_Y - 1}, seed=1)
def test_the_gain_for_all_outputs_then_corrects_as_that_for_the_others(drawn: Filter, bad: set[int], seed: int) -> None:
    innovation, J = np.random.default_rng(seed).normal(size=N_Y), drawn.inverse_covariance
    found = drawn.P @ drawn.C.T @ J @ imputed(without(innovation, bad), J)
    expected = drawn.correction(innovation, sorted(EVERY - bad))
    size = max(1.0, np.abs(drawn.correction(innovation, sorted(EVERY))).max())
    assert np.abs(found - expected).max() <= 1e-6 * size  # covariances of a condition of 2e5 are inverted, twice


def test_one_output_has_the_mean_that_its_row_says() -> None:
    rng = np.random.default_rng(5)
    J = Filter(np.eye(7), rng.normal(size=(N_Y, 7))).inverse_covariance
    innovation = rng.normal(size=N_Y)
    for i in range(N_Y):
        found = imputed(without(innovation, [i]), J)
        others = np.arange(N_Y) != i
        assert found[i] == pytest.approx(-(J[i, others] @ innovation[others]) / J[i, i], rel=1e-12)
        assert np.array_equal(found[others], innovation[others])


@given(drawn=filters(), seed=st.integers(0, 2**32))
def test_an_output_surprises_by_what_the_others_do_not_say_over_its_standard_deviation(
    drawn: Filter, seed: int
) -> None:
    innovation, J = np.random.default_rng(seed).normal(size=N_Y), drawn.inverse_covariance
    surprise = np.zeros(N_Y)
    note_surprise(surprise, innovation, J, 1.0)
    S = np.linalg.inv(J)
    for i in range(N_Y):
        others = np.arange(N_Y) != i
        weights = np.linalg.solve(S[np.ix_(others, others)], S[others, i])
        variance = S[i, i] - S[i, others] @ weights
        assert surprise[i] == pytest.approx((innovation[i] - weights @ innovation[others]) ** 2 / variance, rel=1e-4)


def test_surprises_are_averaged_over_a_minute_and_an_imputed_output_is_none() -> None:
    J, surprise = np.eye(N_Y), np.zeros(N_Y)
    innovation = np.full(N_Y, 3.0)
    innovation[P1] = 0.0
    for _ in range(12):
        note_surprise(surprise, innovation, J, 1.0 / 12.0)
    assert surprise[L1] == pytest.approx(9.0 * (1.0 - (11.0 / 12.0) ** 12))
    assert surprise[P1] == 0.0
    note_surprise(surprise, innovation, J, 5.0)
    assert surprise[L1] == 9.0


@by_estimator
@pytest.mark.parametrize("ticks", [2, 20])
def test_the_inverse_covariance_is_that_of_the_riccati_equation(
    prediction: PredictionModel, chosen: EstimatorSettings, ticks: int
) -> None:
    model = prediction.with_disturbances(chosen.disturbed)
    n, sensors = model.n_states, np.concatenate([[0.01, 1.0], np.full(10, 0.02), np.full(10, 1e-3)])
    drift = np.full(n + 1, 0.05)
    drift[0], drift[1], drift[28:n], drift[n] = 50.0, 1e-5, 3.0 * sensors[list(chosen.disturbed)], chosen.load_walk_w
    A = np.eye(n + 1)
    A[:n, :n], A[:n, n] = model.transitions[ticks].A, model.transitions[ticks].F[:, 0]
    A, C = A * drift / drift[:, None], np.hstack([model.C, model.G]) * drift / sensors[:, None]
    P = scipy.linalg.solve_discrete_are(A.T, C.T, np.eye(n + 1) * ticks / 20, np.eye(N_Y))
    found = stationary_gains(model, chosen).inverse_covariances[ticks - 1] * sensors * sensors[:, None]
    assert np.abs(found - Filter(P, C).inverse_covariance).max() < 1e-6


def after(c: Estimator, y: Array, real: Real = DOUBLE) -> Belief:
    """Return the belief after a measurement (a deviation) that follows a prediction over ten ticks from the origin."""
    belief = no_belief(c.steps.A.shape[1], 22, real)
    belief.numbers[0]["since"] = TICKS
    correct(c, belief, c.u0, real(c.w0), y.astype(real) + c.y0, np.zeros(28, real))
    return belief


def correction_in(belief: Belief) -> Array:
    return np.append(belief.x, belief.numbers[0]["mismatch"]).astype(float)


@by_estimator
@settings(max_examples=20)
@given(bad=some_outputs, seed=st.integers(0, 2**32))
@example(bad=EVERY, seed=1)
def test_an_update_corrects_by_the_measurements_that_are_numbers(
    prediction: PredictionModel, chosen: EstimatorSettings, bad: set[int], seed: int
) -> None:
    c = estimator_of(prediction.with_disturbances(chosen.disturbed), chosen)
    y, others = np.random.default_rng(seed).normal(size=N_Y), sorted(EVERY - bad)
    found = correction_in(after(c, without(y, bad)))
    K, J = c.stationary.gains[TICKS - 1].T, c.stationary.inverse_covariances[TICKS - 1]
    S = np.linalg.inv(J)  # K S is P C', whose columns of the other outputs a filter of those has, too
    expected = (K @ S)[:, others] @ np.linalg.solve(S[np.ix_(others, others)], y[others])
    size = np.abs(K).max(axis=1)
    assert np.abs((found - expected) / size).max() < 1e-8


@by_estimator
def test_an_update_with_all_measurements_has_the_bits_of_the_plain_filter(
    prediction: PredictionModel, chosen: EstimatorSettings
) -> None:
    c = estimator_of(prediction.with_disturbances(chosen.disturbed), chosen)
    rng = np.random.default_rng(3)
    for _ in range(10):
        y = rng.normal(size=N_Y)
        zero = np.zeros(c.steps.A.shape[1])
        expected = np.zeros(len(zero) + 1)
        innovation = (y + c.y0 - c.y0) - respond(*c.outputs, zero, np.zeros(3), 0.0)
        add_transposed_product(c.stationary.gains[TICKS - 1], innovation, expected)
        assert np.array_equal(correction_in(after(c, y)), expected)


@by_estimator
def test_single_precision_loses_little_of_it(prediction: PredictionModel, chosen: EstimatorSettings) -> None:
    model = prediction.with_disturbances(chosen.disturbed)
    exact, rough = estimator_of(model, chosen), estimator_of(model, chosen, SINGLE)
    rng = np.random.default_rng(4)
    for bad in ({P1}, EVERY - set(range(P1)), EVERY - {L1}, rng.choice(N_Y, 11, replace=False)):
        y = without(rng.normal(size=N_Y), bad)
        found, expected = (correction_in(after(c, y, real)) for c, real in ((rough, SINGLE), (exact, DOUBLE)))
        assert np.abs((found - expected) / np.abs(exact.stationary.gains[TICKS - 1]).max(axis=0)).max() < 1e-3


@pytest.mark.usefixtures("compiles")
def test_state_feedback_does_not_look_at_outputs(model: LtiModel, prediction: PredictionModel) -> None:
    c = estimator_of(prediction, EstimatorSettings(kind=EstimatorKind.STATE_FEEDBACK))
    x = np.random.default_rng(6).normal(size=28)
    belief = no_belief(28, 22)
    correct(c, belief, model.u0, model.w0, without(model.y0, EVERY), x + model.x0)
    assert np.allclose(belief.x, x)
