"""The prediction model of the refrigerator with its pressure loop closed."""

import numpy as np
import pytest

from coldloop.process.cold_box import OUTPUT_NAMES, STATE_NAMES
from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import load
from coldloop.process.settings import SHIPPED_MODELS, ModelSettings
from coldloop_optimizer_plc.qp.prediction import state_weights
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_plant.settings import StationSettings
from coldloop_refrigerator.model import prediction_model
from coldloop_refrigerator.program import SHIPPED, EventSchedule, RefrigeratorProgram, read_refrigerator_file

MODEL = load(SHIPPED_MODELS["refrigerator"])
FILE = read_refrigerator_file(SHIPPED)


def test_it_says_for_which_plant_it_was_made() -> None:
    assert MODEL.plant == "refrigerator"
    assert load(SHIPPED_MODELS["cold-box"]).plant == "cold-box"
    assert ModelSettings.model_validate({"file": "refrigerator"}).file == SHIPPED_MODELS["refrigerator"]


@pytest.mark.usefixtures("compiles")
def test_the_shipped_model_is_that_of_the_shipped_refrigerator() -> None:
    rebuilt = prediction_model(FILE)
    assert pytest.approx(MODEL.A, rel=1e-6, abs=1e-9) == rebuilt.A
    assert rebuilt.parameters_digest == MODEL.parameters_digest


def test_all_but_the_level_decays_when_the_pressure_loop_is_closed() -> None:
    real = np.sort(np.linalg.eigvals(MODEL.A).real)[::-1]
    assert abs(real[0]) < 1e-9
    assert real[1] < -5e-4


def test_only_the_cold_box_s_states_weigh() -> None:
    weights = state_weights(MODEL, ControlDesign())
    n = len(STATE_NAMES)
    assert np.array_equal(weights[:n] > 0, np.ones(n, bool))
    assert np.all(weights[n:] == 0.0)


@pytest.mark.parametrize(("u", "w"), [((1.0, 0.0, 0.0), 0.0), ((0.0, 20.0, 0.0), 0.0), ((0.0, 0.0, 0.0), 30.0)])
def test_it_foretells_the_closed_loop_of_the_refrigerator_for_100_s(u: tuple[float, ...], w: float) -> None:
    program = RefrigeratorProgram(
        file=FILE,
        u0=FILE.u0,
        load=LoadProfile((0,), (FILE.w0 + w,)),
        station=StationSettings(),
        events=EventSchedule((), 300.0, 0.0),
    )
    program.apply(np.array(FILE.u0) + np.array(u))
    for _ in range(400):
        program.advance()
    step = MODEL.discretised(100.0)
    linear = MODEL.C @ (step.B @ np.array(u) + step.F * w) + MODEL.D @ np.array(u) + MODEL.G * w
    change = np.array(program.measure()) - MODEL.y0
    for name, smallest in {"L1": 0.02, "T5": 0.02}.items():
        k = OUTPUT_NAMES.index(name)
        if abs(change[k]) > smallest:
            assert change[k] == pytest.approx(linear[k], rel=0.15), name
