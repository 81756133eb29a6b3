from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coldloop.process.cold_box import L1, T5
from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits, RateReference
from coldloop_optimizer_plc.qp import costs
from coldloop_optimizer_plc.qp.costs import augmented_cost, indicators, matrices_of, quadratic_cost
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from coldloop_optimizer_plc.settings import ControlDesign, trivial_design

if TYPE_CHECKING:
    from tests.optimizer_plc.conftest import Optimum, Situations

Array = NDArray[np.float64]

KNOTS = np.array([1, 2, 4, 8, 16, 50, 100])
INSTANTS = (1, 2, 3, 4, 6, 8, 16, 24, 32, 48, 60, 72, 84, 100)
SAMPLES = 100
GAIN = 4.0
"""Of a rate row, per scaled input: the square root of its weight over alpha."""
CONSTRAINED = [L1, T5]
INPUT_SCALE = np.array([10.0, 50.0, 10.0])
R = np.array([1e-2, 4e-4, 1e-2])
RHO = 100.0
LOW, HIGH = np.array([59.0, 9.0]), np.array([61.0, 16.0])
U_LOW, U_HIGH, RATE = np.array([20.0, 0.0, 20.0]), np.array([60.0, 150.0, 60.0]), np.array([0.5, 10.0, 0.1])

seeds = st.integers(0, 2**32 - 1)


def profile(knots: Array) -> Array:
    """Return the piecewise affine profile (100, m) through the knots' values (7, m)."""
    return np.array([np.interp(np.arange(1, SAMPLES + 1), KNOTS, column) for column in knots.T]).T


@dataclass
class Simulation:
    """Step-by-step simulation of a profile z with the model sampled anew at 5 s."""

    u: Array
    v: Array
    x: Array
    y: Array


def simulated(model: LtiModel, z: Array, situation: QpParameters) -> Simulation:
    discrete = model.discretised(5.0)
    u, v = profile(z[:21].reshape(7, 3) * INPUT_SCALE), profile(z[21:].reshape(7, 4))
    x, states = situation.x, []
    for inputs in u:
        x = discrete.A @ x + discrete.B @ inputs + discrete.F * situation.w
        states.append(x)
    y = model.y0 + np.array(states) @ model.C.T + u @ model.D.T + situation.w * model.G
    return Simulation(u, v, np.array(states), y[:, CONSTRAINED])


def state_weights(model: LtiModel) -> Array:
    scale = np.ones(28)
    scale[0], scale[1] = 2000.0, 1.0 / model.C[L1, 1]
    share = np.full(28, 1 / 26)
    share[:2] = 1.0
    return np.asarray(0.1 * share / scale**2)


def random_profile(rng: np.random.Generator) -> Array:
    return np.concatenate([rng.normal(size=21), rng.exponential(size=28)])


# -- sizes ------------------------------------------------------------------------------------------------------------


def test_the_problem_has_the_papers_49_variables_56_output_rows_and_38_rate_rows(problem: PredictiveProblem) -> None:
    assert problem.size == 49
    assert problem.Phi.shape == (49, 49)
    assert problem.Gamma.shape == (94, 49)
    concerns_slacks = (problem.Gamma[:, 21:] != 0).any(axis=1)
    assert concerns_slacks.sum() == 56
    assert (~concerns_slacks).sum() == 38
    assert len(ControlDesign().constraint_instants) * 4 == 56


def test_a_state_of_another_model_is_refused(problem: PredictiveProblem) -> None:
    for states in (27, 49):
        with pytest.raises(ValueError, match=rf"a state of shape \({states},\) for a problem with 28 states"):
            problem.at(QpParameters(np.zeros(states), 0.0, np.zeros(3)))
        with pytest.raises(ValueError, match="for a problem with 28 states"):
            problem.outputs(np.zeros(49), QpParameters(np.zeros(states), 0.0, np.zeros(3)))


def test_only_the_heaters_rate_rows_of_the_last_two_intervals_are_left_out(problem: PredictiveProblem) -> None:
    rate_rows = problem.Gamma[56:, :21]
    concerned = np.zeros((7, 3), dtype=int)
    for row in rate_rows:
        knot, i = divmod(int(np.flatnonzero(row)[-1]), 3)
        concerned[knot, i] += 1
    expected = np.full((7, 3), 2)
    expected[5:, 1] = 0
    assert (concerned == expected).all()
    assert np.allclose(np.abs(rate_rows).max(axis=1), GAIN)


def test_the_trivial_parametrisation_of_the_whole_horizon_has_700_variables_and_1000_rows(
    prediction: PredictionModel,
) -> None:
    problem = PredictiveProblem(prediction, trivial_design(ControlDesign()), InputLimits())
    assert problem.size == 700
    concerns_slacks = (problem.Gamma[:, 300:] != 0).any(axis=1)
    assert (concerns_slacks.sum(), (~concerns_slacks).sum()) == (400, 600)


# -- the optimum ------------------------------------------------------------------------------------------------------


class Uncondensed:
    """The same problem with all states as variables, (z, x_1 / scale, ..., x_100 / scale), built from the paper.

    The equality constraints x_j = A x_{j-1} + B u_j + F w are removed by a sparse factorisation; what remains is solved
    by an interior-point method, which shares nothing with the active-set method that solves the condensed form.
    """

    def __init__(self, model: LtiModel) -> None:
        self._model = model
        discrete = model.discretised(5.0)
        self._scale = np.ones(28)
        self._scale[0], self._scale[1] = 2000.0, 1.0 / model.C[L1, 1]
        self._A = discrete.A * self._scale / self._scale[:, None]
        B, self._F = discrete.B / self._scale[:, None], discrete.F / self._scale
        self._C, self._D, self._G = model.C[CONSTRAINED] * self._scale, model.D[CONSTRAINED], model.G[CONSTRAINED]
        weights = profile(np.eye(7))
        self._u = [np.hstack([np.kron(row, np.diag(INPUT_SCALE)), np.zeros((3, 28))]) for row in weights]
        self._v = [np.hstack([np.zeros((4, 21)), np.kron(row, np.eye(4))]) for row in weights]
        of_z = sum(u.T * R @ u + RHO * v.T @ v for u, v in zip(self._u, self._v, strict=True))
        Q = np.diag(state_weights(model) * self._scale**2)
        self._P = scipy.sparse.block_diag([of_z, *[Q] * SAMPLES], format="csc")
        moves = scipy.sparse.kron(scipy.sparse.eye(SAMPLES), np.eye(28))
        moves -= scipy.sparse.kron(scipy.sparse.eye(SAMPLES, k=-1), self._A)
        self._states = scipy.sparse.linalg.splu(moves.tocsc())
        self._T = np.vstack([np.eye(49), self._states.solve(np.vstack([B @ u for u in self._u]))])
        self._rows = self._constraint_rows()
        self._H = self._T.T @ (self._P @ self._T)

    def _constraint_rows(self) -> scipy.sparse.csr_matrix:
        rows = []
        for j in INSTANTS:
            states = np.zeros((2, 28 * SAMPLES))
            states[:, 28 * (j - 1) : 28 * j] = self._C
            y = np.hstack([self._D @ self._u[j - 1], states])
            slack = np.hstack([self._v[j - 1], np.zeros((4, 28 * SAMPLES))])
            rows += [y - slack[1::2], -y - slack[::2]]
        knots = np.kron(np.eye(7) - np.eye(7, k=-1), np.diag(INPUT_SCALE))
        moves, z = np.zeros((21, 49 + 28 * SAMPLES)), np.zeros((49, 49 + 28 * SAMPLES))
        moves[:, :21], z[:, :49] = knots, np.eye(49)
        return scipy.sparse.csr_matrix(np.vstack([*rows, moves, -moves, z[:21], -z]))

    def _right_hand_side(self, situation: QpParameters) -> Array:
        high, low = (bound - self._model.y0[CONSTRAINED] - self._G * situation.w for bound in (HIGH, LOW))
        longest = np.kron(np.diff(KNOTS, prepend=0), RATE)
        before = np.concatenate([situation.u_before, np.zeros(18)])
        top, bottom = ((bound - self._model.u0) / INPUT_SCALE for bound in (U_HIGH, U_LOW))
        bands = np.tile(np.concatenate([high, -low]), len(INSTANTS))
        inputs = [longest + before, longest - before, np.tile(top, 7), -np.tile(bottom, 7)]
        return np.concatenate([bands, *inputs, np.zeros(28)])

    def solve(self, situation: QpParameters) -> Array:
        start = np.tile(self._F * situation.w, SAMPLES)
        start[:28] += self._A @ (situation.x / self._scale)
        fixed = np.concatenate([np.zeros(49), self._states.solve(start)])
        f = self._T.T @ (self._P @ fixed)  # z' H z + 2 f' z: there is no factor 1/2
        return interior_point(self._H, f, self._rows @ self._T, self._right_hand_side(situation) - self._rows @ fixed)


def interior_point(H: Array, f: Array, G: Array, g: Array) -> Array:
    """Minimise z' H z + 2 f' z under G z <= g by Mehrotra's predictor and corrector."""
    z, room = np.zeros(len(f)), np.maximum(g, 1.0)
    multipliers = np.ones(len(g))
    for _ in range(100):
        dual, primal, gap = H @ z + f + G.T @ multipliers, G @ z + room - g, room * multipliers
        if max(np.abs(dual).max(), np.abs(primal).max(), gap.max()) < 1e-9:
            return polished(H, f, G[multipliers > room], g[multipliers > room])
        factor = scipy.linalg.cho_factor(H + (G.T * (multipliers / room)) @ G)
        target = gap
        for corrector in (False, True):
            step = scipy.linalg.cho_solve(factor, G.T @ ((target - multipliers * primal) / room) - dual)
            to_room = -primal - G @ step
            to_multipliers = -(target + multipliers * to_room) / room
            shrinking = max(float(np.max(-to_room / room)), float(np.max(-to_multipliers / multipliers)))
            length = min(1.0, 0.995 / max(shrinking, 1e-12))
            if not corrector:
                ahead = np.mean((room + length * to_room) * (multipliers + length * to_multipliers))
                target = gap + to_room * to_multipliers - (ahead / gap.mean()) ** 3 * gap.mean()
        z, room, multipliers = z + length * step, room + length * to_room, multipliers + length * to_multipliers
    raise AssertionError("the interior-point method did not converge")


def polished(H: Array, f: Array, G: Array, g: Array) -> Array:
    """Minimise z' H z + 2 f' z under G z = g, the rows that turned out to be active."""
    n, m = len(f), len(g)
    z, *_ = np.linalg.lstsq(np.block([[H, G.T], [G, np.zeros((m, m))]]), np.concatenate([-f, g]))
    return np.asarray(z[:n])


@pytest.fixture(scope="session")
def uncondensed(model: LtiModel) -> Uncondensed:
    return Uncondensed(model)


def test_the_optimum_is_that_of_the_uncondensed_problem_within_1e_6_in_100_random_states(
    problem: PredictiveProblem, uncondensed: Uncondensed, situations: "Situations", optimum: "Optimum"
) -> None:
    rng = np.random.default_rng(20140)
    worst, at_bounds = 0.0, 0
    for _ in range(100):
        situation = situations(rng)
        qp = problem.at(situation)
        z = optimum(qp)
        worst = max(worst, float(np.abs(z - uncondensed.solve(situation)).max()))
        at_bounds += int((qp.Gamma @ z > qp.gamma - 1e-7).sum())
    assert worst < 1e-6
    assert at_bounds > 1000, "states that leave the constraints alone would prove little"


# -- the cost ---------------------------------------------------------------------------------------------------------


@given(seed=seeds)
def test_the_condensed_cost_is_that_of_the_simulated_profile(
    problem: PredictiveProblem, model: LtiModel, situations: "Situations", seed: int
) -> None:
    rng = np.random.default_rng(seed)
    situation, z = situations(rng), random_profile(rng)
    qp = problem.at(situation)
    run = simulated(model, z, situation)
    expected = (run.x**2 @ state_weights(model)).sum() + (run.u**2 @ R).sum() + RHO * (run.v**2).sum()
    assert quadratic_cost(qp.Phi, qp.phi, z) + qp.constant == pytest.approx(expected, rel=1e-9)


@given(seed=seeds)
def test_the_rows_are_the_simulated_outputs_and_moves_against_their_limits(
    problem: PredictiveProblem, model: LtiModel, situations: "Situations", seed: int
) -> None:
    rng = np.random.default_rng(seed)
    situation, z = situations(rng), random_profile(rng)
    qp = problem.at(situation)
    run = simulated(model, z, situation)
    at = np.array(INSTANTS) - 1
    excess = np.concatenate([LOW - run.y[at], run.y[at] - HIGH], axis=1)[:, [0, 2, 1, 3]] - run.v[at]
    assert np.allclose((qp.Gamma @ z - qp.gamma)[:56], excess.ravel(), rtol=0, atol=1e-8)
    knots = z[:21].reshape(7, 3) * INPUT_SCALE
    moves = np.diff(knots, axis=0, prepend=situation.u_before[None]) / np.diff(KNOTS, prepend=0)[:, None]
    rates = (qp.Gamma @ z - qp.gamma)[56:]
    kept = np.ones((7, 3), dtype=bool)
    kept[5:, 1] = False
    assert ((rates[::2] > 1e-9) == (moves > RATE + 1e-9)[kept]).all()
    assert ((rates[1::2] > 1e-9) == (moves < -RATE - 1e-9)[kept]).all()


@given(seed=seeds)
def test_the_indicators_come_from_the_simulated_outputs_and_not_from_the_slacks(
    problem: PredictiveProblem, model: LtiModel, situations: "Situations", seed: int
) -> None:
    rng = np.random.default_rng(seed)
    situation, z = situations(rng), random_profile(rng)
    run = simulated(model, z, situation)
    found = indicators(problem, problem.at(situation), z, situation)
    assert found.j_dev == pytest.approx((run.x**2 @ state_weights(model)).sum() + (run.u**2 @ R).sum(), rel=1e-9)
    violation = np.maximum(run.y - HIGH, 0) + np.maximum(LOW - run.y, 0)
    assert found.j_cst == pytest.approx(RHO * (violation**2).sum(), rel=1e-9)
    other = np.concatenate([z[:21], rng.exponential(size=28)])
    lied = indicators(problem, problem.at(situation), other, situation)
    assert (lied.j_dev, lied.j_cst) == pytest.approx((found.j_dev, found.j_cst), rel=1e-12)


@given(seed=seeds)
def test_the_gradient_of_the_augmented_cost_is_that_of_its_formula(
    problem: PredictiveProblem, situations: "Situations", seed: int
) -> None:
    rng = np.random.default_rng(seed)
    qp = problem.at(situations(rng))
    z, direction = random_profile(rng), rng.normal(size=49)
    alpha, h = 3000.0, 1e-6
    gradient = 2 * qp.Phi @ z + qp.phi + 2 * alpha * qp.Gamma.T @ np.maximum(qp.Gamma @ z - qp.gamma, 0)
    computed, active = np.empty_like(z), np.empty_like(qp.gamma)
    costs.gradient(matrices_of(qp), qp, z, costs.row_excess(qp, z), alpha, computed, active)
    assert computed == pytest.approx(gradient, rel=1e-9, abs=1e-9 * np.abs(gradient).max())
    assert (active > 0).tolist() == (qp.Gamma @ z > qp.gamma).tolist()
    ahead, behind = (augmented_cost(qp, z + step * direction, alpha) for step in (h, -h))
    assert (ahead - behind) / (2 * h) == pytest.approx(gradient @ direction, rel=1e-4, abs=1e-6 * abs(ahead))


def test_the_quadratic_form_is_symmetric_and_well_conditioned(problem: PredictiveProblem) -> None:
    assert np.allclose(problem.Phi, problem.Phi.T, rtol=1e-12, atol=1e-12)
    values = np.linalg.eigvalsh(problem.Phi)
    assert values[0] > 0
    assert values[-1] / values[0] < 1e6, "without scaling it is 8e8 and the ODE solver is useless"


# -- the box ----------------------------------------------------------------------------------------------------------


@given(seed=seeds)
def test_the_first_knot_stays_within_its_rate_of_the_input_before_it(
    problem: PredictiveProblem, model: LtiModel, situations: "Situations", seed: int
) -> None:
    rng = np.random.default_rng(seed)
    situation = situations(rng)
    qp = problem.at(situation)
    low, high = (bound[:3] * INPUT_SCALE for bound in (qp.low, qp.high))
    before = np.clip(situation.u_before + model.u0, U_LOW, U_HIGH) - model.u0
    assert (low <= high).all()
    assert np.allclose(low, np.maximum(situation.u_before - RATE, U_LOW - model.u0))
    assert np.allclose(high, np.minimum(situation.u_before + RATE, U_HIGH - model.u0))
    assert ((low <= before) & (before <= high)).all()
    assert (qp.low[21:] == 0).all()
    assert np.isposinf(qp.high[21:]).all()


@pytest.mark.parametrize(("ticks", "share"), [(2, 0.1), (5, 0.25), (10, 0.5), (20, 1.0), (40, 1.0)])
def test_the_rate_limit_of_an_update_is_whole_or_shrinks_with_the_time_that_passed(
    prediction: PredictionModel, ticks: int, share: float
) -> None:
    situation = QpParameters(np.zeros(28), 0.0, np.array([1.0, -5.0, 2.0]), ticks)
    for reference, used in ((RateReference.PER_UPDATE, 1.0), (RateReference.ELAPSED, share)):
        problem = PredictiveProblem(prediction, ControlDesign(), InputLimits(rate_reference=reference))
        qp = problem.at(situation)
        widths = (qp.high - qp.low)[:3] * INPUT_SCALE
        assert np.allclose(widths, 2 * RATE * used)
        centre = (qp.high + qp.low)[:3] * INPUT_SCALE / 2
        assert np.allclose(centre, situation.u_before)
        first, later = qp.gamma[56:62], qp.gamma[62:68]
        assert np.allclose(first[::2] + first[1::2], 2 * RATE * used / INPUT_SCALE * GAIN)
        assert np.allclose(later, np.repeat(RATE / INPUT_SCALE, 2) * GAIN), "rates between knots stay"


# -- profiles ---------------------------------------------------------------------------------------------------------


@given(seed=seeds)
def test_sent_inputs_follow_the_profile_where_it_keeps_its_rates_and_keep_them_where_it_does_not(
    problem: PredictiveProblem, model: LtiModel, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    gentle = np.cumsum(rng.uniform(-1, 1, (7, 3)) * RATE * np.diff(KNOTS, prepend=0)[:, None], axis=0)
    z = np.concatenate([(gentle / INPUT_SCALE).ravel(), np.zeros(28)])
    assert np.allclose(problem.inputs(z, 12), profile(gentle)[:12] + model.u0)
    wild = problem.inputs(random_profile(rng), 12)
    assert (np.abs(np.diff(wild, axis=0)) <= RATE * (1 + 1e-12)).all()


def test_a_held_input_is_a_constant_profile_without_slack(problem: PredictiveProblem, model: LtiModel) -> None:
    u = np.array([1.0, -20.0, 0.5])
    z = problem.hold(u)
    assert np.allclose(problem.inputs(z, 100), u + model.u0)
    assert (z[21:] == 0).all()
    assert np.allclose(problem.shifted(z, 7), z)
