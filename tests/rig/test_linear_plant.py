"""The linear model in the place of the plant: nothing is there that the optimiser's model does not know."""

from collections.abc import Callable

import numpy as np
import pytest

from coldloop.errors import ConfigurationError
from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import load as load_model
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder, Recording
from coldloop_rig.settings import Settings
from coldloop_studies.request import LinearRig
from coldloop_studies.settings import settings_of

pytestmark = pytest.mark.usefixtures("compiles")

MODEL = load_model(Settings().model.file)
STEP = LoadProfile((0, 40), (MODEL.w0, MODEL.w0 + 80.0))


def ten_minutes(make: Callable[[Settings], OneProcessRig], *assignments: str) -> Recording:
    recorder = Recorder(2400)
    make(settings_of(assignments)).run(Scenario(2400, STEP, 2.5, 1), recorder)
    return recorder.recording()


@pytest.fixture(scope="module")
def linear() -> Recording:
    return ten_minutes(LinearRig)


def test_a_load_step_leaves_no_mismatch_on_a_linear_plant_and_some_on_the_cold_box(linear: Recording) -> None:
    found = [max(abs(row.load_mismatch) for row in run.updates) for run in (linear, ten_minutes(OneProcessRig))]
    assert found[0] < 1e-3
    assert found[1] > 1.0


def test_it_moves_as_the_model_says(linear: Recording) -> None:
    """Ticks are those of the model file's matrices; what is recorded is rounded to single precision."""
    m, x = MODEL, np.zeros(len(MODEL.x0))
    for tick in range(400):
        np.testing.assert_allclose(linear.x[tick], m.x0 + x, rtol=1e-5)
        x = m.A_tick @ x + m.B_tick @ (linear.u[tick] - m.u0) + m.F_tick * (linear.load[tick] - m.w0)


def test_a_linear_plant_that_differs_from_its_model_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="without mismatch"):
        LinearRig(settings_of(("plant.mismatch.jt_valve=0.9",)))
