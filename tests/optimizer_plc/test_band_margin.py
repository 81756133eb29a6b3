"""Rows of the problem may be a margin inside the bands: soft rows let an output rest a little beyond them."""

import numpy as np
import pytest
from pydantic import ValidationError

from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.qp.costs import indicators
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters
from coldloop_optimizer_plc.settings import ControlDesign, Preset, ProgramSettings
from coldloop_rig import simulate

LIMITS = InputLimits()


def test_both_rows_of_a_band_move_inwards_and_nothing_else(
    prediction: PredictionModel, problem: PredictiveProblem
) -> None:
    inside = PredictiveProblem(prediction, ControlDesign(band_margin=(0.1, 0.3)), LIMITS)
    at_rest = QpParameters(np.zeros(28), 0.0, np.zeros(3))
    wide, narrow = problem.at(at_rest), inside.at(at_rest)
    moved = ((wide.gamma - narrow.gamma) / problem.predicted.row_gains)[:56].reshape(
        -1, 2, 2
    )  # instants, outputs, sides
    assert moved[:, 0] == pytest.approx(0.1)
    assert moved[:, 1] == pytest.approx(0.3)
    assert (wide.gamma[56:] == narrow.gamma[56:]).all()
    assert all(np.array_equal(a, b) for a, b in zip(wide[:3], narrow[:3], strict=True))


def test_a_violation_is_counted_from_the_band_and_not_from_the_margin(
    prediction: PredictionModel, problem: PredictiveProblem
) -> None:
    inside = PredictiveProblem(prediction, ControlDesign(band_margin=(0.9, 0.3)), LIMITS)
    x = np.zeros(28)
    x[1] = 0.95 / prediction.C[0, 1]
    parameters = QpParameters(x, 0.0, np.zeros(3))
    costs = [indicators(one, one.at(parameters), one.hold(np.zeros(3)), parameters) for one in (problem, inside)]
    assert costs[0].j_cst == costs[1].j_cst
    assert costs[0].violation < costs[1].violation


@pytest.mark.parametrize("margin", [(-0.1, 0.0), (0.0, -0.1), (1.1, 0.0), (0.0, 3.6)])
def test_a_margin_is_at_most_half_of_its_band(margin: tuple[float, float]) -> None:
    """L1 has 2 %, T5 7 K."""
    with pytest.raises(ValidationError, match="at most half of its band"):
        ControlDesign(band_margin=margin)


def test_it_belongs_to_the_default_and_not_to_the_paper() -> None:
    assert min(ProgramSettings().design.band_margin) > 0.0
    assert ProgramSettings(preset=Preset.PAPER).design == ControlDesign()


@pytest.mark.usefixtures("compiles")
def test_an_output_that_rests_at_its_limit_rests_within_the_band() -> None:
    """A better turbine: T5 rests at 9 K."""
    outside = [
        simulate(
            load="a", solver="ode", duration_s=600, plant={"mismatch": {"turbine_efficiency": 1.1}},
            optimizer_plc={"program": {"design": {"band_margin": margin}}},
        ).summary["T5_outside_band_pct"]
        for margin in ((0.0, 0.0), ProgramSettings().design.band_margin)
    ]  # fmt: skip
    assert outside[0] > 20.0
    assert outside[1] == 0.0
