"""The plant as a program."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.process.cold_box import OUTPUT_NAMES
from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import LtiModel
from coldloop_plant.cold_box import ColdBoxProgram
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.program import MeasurementNoise, PlantProgram

LEVEL_AND_T5 = tuple(0.01 if name in ("L1", "T5") else 0.0 for name in OUTPUT_NAMES)


def program(model: LtiModel, **changes: Any) -> PlantProgram:  # noqa: ANN401
    arguments: dict[str, Any] = {
        "box": REFERENCE,
        "x0": model.x0.tolist(),
        "u0": model.u0.tolist(),
        "load": LoadProfile((0,), (model.w0,)),
    }
    return ColdBoxProgram(**(arguments | changes))


def test_at_the_operating_point_nothing_moves(model: LtiModel) -> None:
    plant = program(model)
    assert plant.measure() == pytest.approx(tuple(model.y0), rel=1e-12)
    for _ in range(400):
        plant.advance()
    assert plant.tick == 400
    assert plant.measure() == pytest.approx(tuple(model.y0), rel=1e-9)


def test_inputs_are_held_until_others_are_applied(model: LtiModel) -> None:
    stepped, repeated = program(model), program(model)
    stepped.apply((45.0, 75.0, 36.0))
    for _ in range(40):
        repeated.apply((45.0, 75.0, 36.0))
        stepped.advance()
        repeated.advance()
    assert stepped.state == repeated.state
    assert stepped.measure()[0] != pytest.approx(model.y0[0], abs=1e-6)


def test_an_input_acts_from_the_tick_at_which_it_is_applied(model: LtiModel) -> None:
    plant = program(model)
    before = plant.measure()
    plant.apply((45.0, 75.0, 50.0))
    assert plant.measure() == before
    plant.advance()
    assert plant.measure() != before


@pytest.mark.parametrize(
    ("beyond", "limit"),
    [((120.0, 75.0, 36.0), (100.0, 75.0, 36.0)), ((-5.0, -9.0, -1.0), (0.0, 0.0, 0.0))],
)
def test_actuators_saturate(model: LtiModel, beyond: tuple[float, ...], limit: tuple[float, ...]) -> None:
    pushed, held = program(model, u0=beyond), program(model, u0=limit)
    for _ in range(20):
        pushed.advance()
        held.advance()
    assert pushed.state == held.state


def test_more_load_boils_off_the_bath_and_less_fills_it(model: LtiModel) -> None:
    levels = []
    for change in (-100.0, 0.0, 100.0):
        plant = program(model, load=LoadProfile((0, 8), (model.w0, model.w0 + change)))
        for _ in range(400):
            plant.advance()
        assert plant.load == model.w0 + change
        levels.append(plant.measure()[0])
    assert levels[0] > levels[1] > levels[2]


def test_noise_repeats_with_its_seed_and_touches_only_its_outputs(model: LtiModel) -> None:
    one, two, other = (program(model, noise=MeasurementNoise(LEVEL_AND_T5, seed)) for seed in (1, 1, 2))
    exact = program(model)
    for _ in range(20):
        one.measure()  # reading more often must not change the noise
        assert one.measure() == two.measure() != other.measure()
        quiet = [k for k, sigma in enumerate(LEVEL_AND_T5) if sigma == 0.0]
        assert [one.measure()[k] for k in quiet] == [exact.measure()[k] for k in quiet]
        for plant in (one, two, other, exact):
            plant.advance()
    assert one.state == exact.state


def test_noise_has_its_standard_deviation(model: LtiModel) -> None:
    plant = program(model, noise=MeasurementNoise(LEVEL_AND_T5, 7))
    errors = []
    for _ in range(1000):
        errors.append(plant.measure()[0] - model.y0[0])
        plant.advance()
    assert np.std(errors) == pytest.approx(0.01, rel=0.1)


@given(data=st.data())
def test_a_load_profile_holds_its_steps(data: st.DataObject) -> None:
    later = data.draw(st.sets(st.integers(1, 1000), max_size=8))
    times = (0, *sorted(later))
    watts = tuple(float(k) for k in range(len(times)))
    tick = data.draw(st.integers(0, 2000))
    assert LoadProfile(times, watts).value(tick) == max(k for k, start in enumerate(times) if start <= tick)


@pytest.mark.parametrize(
    ("times", "watts"),
    [
        ((), ()),
        ((1,), (5.0,)),
        ((0, 4), (1.0,)),
        ((0, 4, 4), (1.0, 2.0, 3.0)),
        ((0,), (float("nan"),)),
    ],
)
def test_a_wrong_load_profile_is_refused(times: tuple[int, ...], watts: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"load|times"):
        LoadProfile(times, watts)


@pytest.mark.parametrize("deviations", [(0.1,), (-0.1,) * 22, (float("inf"),) * 22])
def test_wrong_noise_is_refused(model: LtiModel, deviations: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="standard deviations"):
        program(model, noise=MeasurementNoise(deviations, 1))


@pytest.mark.parametrize("wrong", [{"x0": [1.0]}, {"u0": [43.0, float("nan"), 36.0]}])
def test_a_program_checks_its_arguments(model: LtiModel, wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="finite"):
        program(model, **wrong)


def test_inputs_that_are_no_numbers_are_refused_and_change_nothing(model: LtiModel) -> None:
    plant = program(model)
    with pytest.raises(ValueError, match="finite inputs"):
        plant.apply((float("inf"), 75.0, 36.0))
    plant.advance()
    assert plant.state == pytest.approx(tuple(model.x0), rel=1e-12)
