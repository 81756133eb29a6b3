"""Penalties and presets: what is set comes first, weights do what they say, and the first knot can be sent."""

from typing import TYPE_CHECKING

import numpy as np
import pytest
from pydantic import ValidationError

from coldloop.process.cold_box import COLD_BOX
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.computing_settings import (
    PENALTY_WEIGHT,
    EstimatorKind,
    EstimatorSettings,
    OdeSettings,
    PlausibilitySettings,
)
from coldloop_optimizer_plc.qp.costs import augmented_cost, indicators
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from coldloop_optimizer_plc.settings import ControlDesign, PenaltySettings, Preset, ProgramSettings, presets_of
from coldloop_optimizer_plc.solvers.ode import ode_solver

if TYPE_CHECKING:
    from tests.optimizer_plc.conftest import Optimum, PenalisedOptimum, Situations

PHYSICAL = (100.0, 2500.0, 100.0)
SOLVERS = ("ode", "qpoases", "osqp", "fast_gradient", "interior_point", "daqp")


def as_printed_problem(prediction: PredictionModel) -> PredictiveProblem:
    penalties = ProgramSettings(preset=Preset.AS_PRINTED).penalties
    return PredictiveProblem(prediction, ControlDesign(), InputLimits(), penalties=penalties)


# -- settings ----------------------------------------------------------------------------------------------------------


def test_the_tuned_preset_is_the_default_and_differs_from_the_paper_s_in_the_estimator() -> None:
    chosen, paper = ProgramSettings(preset=Preset.TUNED), ProgramSettings(preset=Preset.PAPER)
    assert chosen == ProgramSettings()
    assert (chosen.penalties, chosen.ode) == (paper.penalties, paper.ode) == (PenaltySettings(), OdeSettings())
    assert (chosen.estimator.disturbances, paper.estimator) == (("outputs",), EstimatorSettings())


def test_state_feedback_estimates_no_disturbances_whatever_the_preset() -> None:
    chosen = ProgramSettings.model_validate({"estimator": {"kind": "state-feedback"}})
    assert chosen.estimator == EstimatorSettings(kind=EstimatorKind.STATE_FEEDBACK)
    assert chosen.plausibility == PlausibilitySettings()
    assert list(chosen.notes) == ["estimator.disturbances", "estimator.load_walk_w", "plausibility.sigmas"]


def test_a_preset_holds_where_the_load_is_not_measured_with_a_walk_of_its_own() -> None:
    chosen, usual = ProgramSettings.model_validate({"estimator": {"load_known": False}}), ProgramSettings()
    assert chosen.estimator == EstimatorSettings(load_known=False, disturbances=("outputs",), load_walk_w=10.0)
    assert chosen.model_copy(update={"estimator": usual.estimator}) == usual
    own = ProgramSettings.model_validate({"estimator": {"load_known": False, "load_walk_w": 30.0}})
    assert own.estimator.load_walk_w == 30.0
    assert not chosen.notes


def test_what_a_preset_has_is_checked_with_the_rest() -> None:
    with pytest.raises(ValidationError, match="band_margin, that of the preset too"):
        ProgramSettings.model_validate({"design": {"output_low": (59.95, 9.0), "output_high": (60.05, 16.0)}})


def test_a_preset_fills_what_is_not_set() -> None:
    chosen = ProgramSettings.model_validate({"preset": "as-printed", "ode": {"cost_scale": 0.5}})
    assert chosen.ode.cost_scale == 0.5, "what is set comes before the preset's"
    assert not chosen.ode.look_ahead_rows
    assert chosen.penalties == PenaltySettings(output_rows=1, rate_rows=PHYSICAL, box=1, first_knot_in_box=False)


def test_what_is_set_to_the_default_of_its_key_is_set_too() -> None:
    chosen = ProgramSettings.model_validate({"preset": "as-printed", "penalties": {"output_rows": 30.0}})
    assert chosen.penalties.output_rows == 30.0


@pytest.mark.parametrize("preset", Preset)
def test_a_preset_names_keys_that_there_are(preset: Preset) -> None:
    chosen = ProgramSettings(preset=preset)
    for section, values in presets_of(COLD_BOX)[preset].items():
        assert {key: getattr(getattr(chosen, section), key) for key in values} == {
            key: tuple(value) if isinstance(value, list) else value for key, value in values.items()
        }


def test_alpha_follows_from_the_weight_of_a_violation_for_all_solvers_alike() -> None:
    usual, heavy = ProgramSettings(), ProgramSettings(design=ControlDesign(violation_weight=(200.0, 400.0)))
    own = ProgramSettings.model_validate({"osqp": {"alpha": 7.0}})
    assert {getattr(usual, name).alpha for name in SOLVERS} == {PENALTY_WEIGHT}
    assert {getattr(heavy, name).alpha for name in SOLVERS} == {30.0 * 400.0}
    assert (own.osqp.alpha, own.ode.alpha) == (7.0, PENALTY_WEIGHT)


@pytest.mark.parametrize("wrong", [{"output_rows": 0}, {"rate_rows": [1, 0, 1]}, {"box": -1}, {"rates": 1}])
def test_weights_that_penalise_nothing_are_rejected(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        PenaltySettings.model_validate(wrong)


# -- what the weights do -----------------------------------------------------------------------------------------------


def test_penalties_scale_rows_and_change_no_exact_problem(
    prediction: PredictionModel, problem: PredictiveProblem, situations: "Situations", optimum: "Optimum"
) -> None:
    situation = situations(np.random.default_rng(3))
    one, other = (each.at(situation) for each in (problem, as_printed_problem(prediction)))
    assert optimum(one) == pytest.approx(optimum(other), abs=1e-6)
    z = np.random.default_rng(4).normal(size=49)
    violations = [
        indicators(each, qp, z, situation).violation
        for each, qp in ((problem, one), (as_printed_problem(prediction), other))
    ]
    assert violations[0] == pytest.approx(violations[1], rel=1e-12), "in % and K, whatever the rows are multiplied by"


def test_rate_rows_as_printed_are_in_percent_and_watt(prediction: PredictionModel) -> None:
    rows = as_printed_problem(prediction).Gamma[56:, :21].reshape(38, 7, 3)
    assert np.abs(rows).max(axis=(0, 1)).tolist() == [10.0, 50.0, 10.0], "input_scale: one row unit is 1 % or 1 W"


def test_a_row_keeps_its_share_of_a_violation(
    prediction: PredictionModel, penalised_optimum: "PenalisedOptimum"
) -> None:
    """A band that cannot be reached is missed by v; slack and row share it as 1 to 1 / output_rows."""
    for factor in (1.0, 3.0):
        penalties = PenaltySettings(output_rows=factor)
        problem = PredictiveProblem(prediction, ControlDesign(), InputLimits(), penalties=penalties)
        x = np.zeros(prediction.n_states)
        x[1] = -4.0 / prediction.model.C[0, 1]  # the level is 3 % below its band, at the first instant
        situation = QpParameters(x, 0.0, np.zeros(3))
        qp = problem.at(situation)
        z = penalised_optimum(qp, factor * 100.0)
        first, last = problem.outputs(z, situation)[[0, -1], 0]
        assert first < 57.5 < last, "it comes back"
        row = float(qp.Gamma[0] @ z - qp.gamma[0])
        assert 59.0 - first == pytest.approx(row + z[21], rel=1e-6)
        assert row / z[21] == pytest.approx(1.0 / factor, rel=0.1), "the slack is piecewise affine: nearly so"


def test_the_output_of_the_smaller_weight_has_a_softer_row(prediction: PredictionModel) -> None:
    design = ControlDesign(violation_weight=(100.0, 25.0))
    problem = PredictiveProblem(prediction, design, InputLimits())
    assert np.unique(problem.predicted.row_gains[:56].reshape(14, 2, 2), axis=0).tolist() == [[[1.0, 1.0], [0.5, 0.5]]]


# -- devices of the solver ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", Preset)
def test_the_cost_never_rises_whatever_the_preset(
    preset: Preset, prediction: PredictionModel, situations: "Situations", penalised_optimum: "PenalisedOptimum"
) -> None:
    chosen = ProgramSettings(preset=preset)
    problem = PredictiveProblem(prediction, chosen.design, InputLimits(), penalties=chosen.penalties)
    rng = np.random.default_rng(5)
    for _ in range(5):
        qp = problem.at(situations(rng))
        solver = ode_solver(chosen.ode, chosen.penalties)
        answer = solver.solve(qp, np.zeros(49), range(61))
        costs = answer.costs.tolist()
        assert (answer.points >= qp.low).all()
        assert (answer.points <= qp.high).all()
        assert costs == sorted(costs, reverse=True)
        best = float(augmented_cost(qp, penalised_optimum(qp, solver.alpha), solver.alpha)) + qp.constant
        assert best * (1 - 1e-9) <= costs[-1] + qp.constant <= 1.5 * best + 1.0


@pytest.mark.parametrize(
    "change", [{"look_ahead_rows": False}, {"hold_at_bounds": False}], ids=["look-ahead rows", "held at bounds"]
)
def test_each_device_changes_what_a_few_iterations_reach(
    change: dict[str, bool], problem: PredictiveProblem, situations: "Situations"
) -> None:
    qp = problem.at(situations(np.random.default_rng(6)))
    reached = [
        ode_solver(settings).solve(qp, np.zeros(49), (6,)).cost
        for settings in (OdeSettings(), OdeSettings(**change))  # type: ignore[arg-type]
    ]
    assert reached[0] != reached[1]


def test_a_first_knot_that_is_no_box_is_moved_within_its_rate_before_it_is_sent(
    prediction: PredictionModel, problem: PredictiveProblem, situations: "Situations"
) -> None:
    free = as_printed_problem(prediction)
    situation = situations(np.random.default_rng(7))
    wide, narrow = free.at(situation), problem.at(situation)
    assert (wide.low[:3] < narrow.low[:3]).all()
    assert (wide.high[:3] > narrow.high[:3]).all()
    z = wide.high.copy()
    z[21:] = 0.0
    sent = free.within_first_rate(z, situation)
    assert sent[:3].tolist() == narrow.high[:3].tolist()
    assert sent[3:].tolist() == z[3:].tolist()
    inside = np.clip(z, narrow.low, narrow.high)
    assert problem.within_first_rate(inside, situation).tolist() == inside.tolist(), "to the bit"


def test_the_box_is_penalised_as_it_is_printed(problem: PredictiveProblem, situations: "Situations") -> None:
    """It acts where the middle stage of a step is outside the box; iterates are inside, so J has nothing of it."""
    qp = problem.at(situations(np.random.default_rng(8)))
    reached = []
    for box in (0.0, 1.0):
        solver = ode_solver(OdeSettings(hold_at_bounds=False), PenaltySettings(box=box))
        reached.append(solver.solve(qp, np.zeros(49), (8,)).z)
    assert not np.array_equal(*reached)
