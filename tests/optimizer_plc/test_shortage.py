"""What the load is above or below what can be held, by hand: from what the model holds at the bounds of its inputs."""

import numpy as np
import pytest

from coldloop.process.lti_model import LtiModel
from coldloop.process.signals import INPUT_NAMES
from optimizer_plc.program import OptimizerProgram
from optimizer_plc.scheme import Constants, shortage
from optimizer_plc.settings import ProgramSettings
from tests.optimizer_plc.test_target import LIMITS

CV155, HEATER, CV156 = range(len(INPUT_NAMES))
PER_CENT_W = (9.48784, -1.0, -0.209227)
"""What a per cent of CV155, a watt of the heater and a per cent of CV156 hold at rest, W."""
RESERVE_W = ProgramSettings().capacity_reserve_w
LEAST, LARGEST = ProgramSettings().holdable_load_w


@pytest.fixture(scope="module")
def c(model: LtiModel) -> Constants:
    """An optimiser that knows constant errors of the inputs."""
    settings = {"estimator": {"disturbances": ["inputs", "T5"]}}
    return OptimizerProgram(model, ProgramSettings.model_validate(settings), LIMITS).constants


def short(c: Constants, estimated: float, load: float, limit: float = 60.0, error: float = 0.0) -> float:
    """Return the shortage by an estimated and a measured load (W), the limit of CV155 and its constant error (%)."""
    x = np.zeros(c.estimator.steps.A.shape[-1])
    x[c.target.constants[CV155]] = error
    most_open = (limit - c.estimator.u0[CV155]) / c.input_scale[CV155]
    return float(shortage(c, x, estimated - c.estimator.w0, load, most_open, 0.0))


def held(c: Constants, limit: float) -> float:
    """Return the load that the model holds with CV155 at a limit, the heater off and CV156 closed as far as it goes."""
    at = np.array([limit, LIMITS.low[HEATER], LIMITS.low[CV156]])
    return float(c.estimator.w0 + (at - c.estimator.u0) @ PER_CENT_W)


@pytest.mark.parametrize("limit", [50.0, 52.5, 60.0])
def test_an_estimate_is_too_much_from_the_reserve_below_what_the_model_holds_with_cv155_at_its_limit(
    c: Constants, limit: float
) -> None:
    most = held(c, limit) - RESERVE_W
    assert short(c, most - 0.1, 400.0, limit) == 0.0
    assert short(c, most + 7.0, 400.0, limit) == pytest.approx(7.0, abs=0.1)


def test_the_limit_does_not_open_cv155_beyond_its_bound(c: Constants) -> None:
    assert short(c, held(c, 60.0) - RESERVE_W + 7.0, 400.0, 99.0) == pytest.approx(7.0, abs=0.1)


def test_a_valve_that_passes_less_holds_less(c: Constants) -> None:
    most = held(c, 55.0 - 2.0) - RESERVE_W
    assert short(c, most - 0.1, 400.0, 55.0, -2.0) == 0.0
    assert short(c, most + 7.0, 400.0, 55.0, -2.0) == pytest.approx(7.0, abs=0.1)


def test_a_load_that_is_measured_counts_by_what_the_plant_holds_that_is_as_its_model(c: Constants) -> None:
    assert short(c, 400.0, LARGEST - 0.1) == short(c, 400.0, LEAST + 0.1) == 0.0
    assert short(c, 400.0, LARGEST + 7.0) == pytest.approx(7.0)
    assert short(c, 400.0, LEAST - 7.0) == pytest.approx(-7.0)


def test_an_estimate_below_the_least_load_is_too_little(c: Constants) -> None:
    assert short(c, LEAST - 7.0, 400.0) == pytest.approx(-7.0)
