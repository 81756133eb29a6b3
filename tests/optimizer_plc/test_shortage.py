"""What the load is above or below what can be held, by hand: from what the model holds at the bounds of its inputs."""

import numpy as np
import pytest

from coldloop.process.cold_box import INPUT_NAMES
from coldloop.process.lti_model import LtiModel
from coldloop_optimizer_plc.decisions import shortage
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.scheme import Constants
from coldloop_optimizer_plc.settings import ProgramSettings
from tests.optimizer_plc.test_target import LIMITS

pytestmark = pytest.mark.usefixtures("compiles")  # these kernels are called by others alone

CV155, HEATER, CV156 = range(len(INPUT_NAMES))
PER_CENT_W = (9.48784, -1.0, -0.209227)
"""What a per cent of CV155, a watt of the heater and a per cent of CV156 hold at rest, W."""
PER_CENT_K = (0.146879, 0.0, -0.0776139)
"""What they warm T5 by, K; 1.3835 K below the operating point its band ends."""
RESERVE_W = ProgramSettings().capacity_reserve_w
LEAST, LARGEST = ProgramSettings().holdable_load_w


@pytest.fixture(scope="module")
def c(model: LtiModel) -> Constants:
    """An optimiser that knows constant errors of the inputs."""
    settings = {"estimator": {"disturbances": ["inputs", "T5"]}}
    return OptimizerProgram(model, ProgramSettings.model_validate(settings), LIMITS).constants


def short(
    c: Constants,
    estimated: float,
    load: float,
    limit: float = 60.0,
    error: float = 0.0,
    colder: float = 0.0,
    before: float = 0.0,
) -> float:
    """Return the shortage by an estimated and a measured load (W), the limit of CV155, its error (%) and T5's (K)."""
    x = np.zeros(c.estimator.steps.A.shape[-1])
    x[c.target.constants[CV155]], x[c.target.constants[-1]] = error, -colder
    most_open = (limit - c.estimator.u0[CV155]) / c.input_scale[CV155]
    return float(shortage(c, x, estimated - c.estimator.w0, load, most_open, -1, 0.0, before, 0.0))


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
    assert short(c, LEAST - 7.0, 400.0, colder=-1.0) == pytest.approx(-7.0), "T5 is warm enough"


def test_a_turbine_that_is_colder_needs_more_load(c: Constants) -> None:
    """T5 at rest is 2 K colder than the model says: CV156 closes, then CV155 opens, until its band begins."""
    coldest = c.estimator.w0 - 23.0 * PER_CENT_W[0] - 75.0 + 24.0 * PER_CENT_W[2]
    lacking = 2.0 - 1.3835 + 23.0 * PER_CENT_K[0] - 24.0 * PER_CENT_K[2]
    opened = (lacking + 40.0 * PER_CENT_K[2]) / PER_CENT_K[0]
    least = coldest - 40.0 * PER_CENT_W[2] + opened * PER_CENT_W[0] - 25.0
    assert 20.0 < 20.0 + opened < 60.0
    assert short(c, least + 0.5, 400.0, colder=2.0) == 0.0
    assert short(c, least - 7.0, 400.0, colder=2.0) == pytest.approx(-7.0, abs=0.2)


def test_a_turbine_that_no_inputs_warm_enough_needs_the_load_with_which_it_is_warmest(c: Constants) -> None:
    warmest = c.estimator.w0 + 17.0 * PER_CENT_W[0] - 75.0 - 16.0 * PER_CENT_W[2] - 25.0
    assert short(c, 400.0, 400.0, colder=20.0) == pytest.approx(400.0 - warmest, abs=0.2)


def test_a_shortage_ends_where_twice_the_reserve_is_left(c: Constants) -> None:
    begins, cold = held(c, 55.0) - RESERVE_W, {"colder": 20.0}
    assert short(c, begins - 0.5, 400.0, 55.0) == 0.0
    assert short(c, begins - RESERVE_W + 0.5, 400.0, 55.0, before=3.0) > 0.0
    assert short(c, begins - RESERVE_W - 0.5, 400.0, 55.0, before=3.0) == 0.0
    assert short(c, begins - 0.5, 400.0, 55.0, before=-3.0) == 0.0, "the other shortage gives this one nothing"
    assert short(c, LARGEST - 0.5, LARGEST - 0.5, 60.0, before=-3.0) == 0.0
    assert short(c, 400.0, 400.0, **cold, before=-3.0) == pytest.approx(short(c, 400.0, 400.0, **cold) - RESERVE_W)
    assert short(c, 400.0, LEAST + 0.5, colder=-1.0, before=-3.0) == 0.0, "a load that is measured has no noise"
