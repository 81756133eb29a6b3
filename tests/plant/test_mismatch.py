"""A plant that is not as its model, and sensors that show too much."""

import numpy as np
import pytest

from coldloop.errors import ConfigurationError
from coldloop.process.cold_box import OUTPUT_NAMES
from coldloop.process.load_profile import LoadProfile
from coldloop.process.model_file import read_header
from coldloop.process.settings import DEFAULT_MODEL_FILE, SHIPPED_MODELS
from coldloop_plant.kinds import plant_maker
from coldloop_plant.program import MeasurementNoise, PlantProgram
from coldloop_plant.settings import MismatchSettings, PlantKind, PlantSection, SensorSettings

HEADER = read_header(DEFAULT_MODEL_FILE)
LEVEL = OUTPUT_NAMES.index("L1")


def made(**sections: object) -> PlantProgram:
    return plant_maker(HEADER, PlantSection(**sections))(LoadProfile((0,), (HEADER.w0,)), 1)  # type: ignore[arg-type]


def level_after(minutes: int, **factors: float) -> float:
    plant = made(mismatch=MismatchSettings(**factors))
    for _ in range(minutes * 240):
        plant.advance()
    return plant.measure()[LEVEL]


def test_without_mismatch_it_stays_at_rest() -> None:
    assert level_after(5) == pytest.approx(60.0, abs=1e-6)


@pytest.mark.parametrize("parameter", ["heat_transfer", "turbine_efficiency"])
def test_what_makes_a_better_refrigerator_fills_the_bath(parameter: str) -> None:
    assert level_after(5, **{parameter: 0.9}) < 59.9
    assert level_after(5, **{parameter: 1.1}) > 60.05


def test_wider_valves_pass_more_gas() -> None:
    """P2 is the supply; the turbine's pressure P6 is below it by what the inlet valve takes."""
    reference, wide = made(), made(mismatch=MismatchSettings(turbine_valve=1.2))
    assert wide.measure()[OUTPUT_NAMES.index("P6")] > 1.05 * reference.measure()[OUTPUT_NAMES.index("P6")]
    assert level_after(5, jt_valve=1.2) != pytest.approx(60.0, abs=0.1)


def test_a_heater_and_a_load_that_are_more_than_they_are_believed_to_be_empty_the_bath() -> None:
    assert level_after(5, heater=1.2) < 59.9
    assert level_after(5, load=1.05) < 59.9
    loaded = made(mismatch=MismatchSettings(load=1.05))
    assert loaded.load == HEADER.w0, "what is announced"


def test_a_gauge_shows_another_level_and_changes_nothing_else() -> None:
    exact, wrong = made(), made(mismatch=MismatchSettings(level_gauge=1.01))
    for plant in (exact, wrong):
        plant.apply([50.0, 75.0, 36.0])
        for _ in range(20):
            plant.advance()
    assert wrong.measure()[LEVEL] == pytest.approx(1.01 * exact.measure()[LEVEL])
    np.testing.assert_array_equal(wrong.measure()[1:], exact.measure()[1:])


def test_inputs_act_as_many_ticks_later() -> None:
    """In one tick the delayed plant has moved as far as the other had two ticks ago; before that it rests."""
    prompt, late = made(), made(mismatch=MismatchSettings(delay_ticks=2))
    states = [prompt.state]
    for tick in range(12):
        for plant in (prompt, late):
            plant.apply([45.0 + tick, 75.0, 36.0])
            plant.advance()
        states.append(prompt.state)
        expected = states[max(0, len(states) - 3)]
        np.testing.assert_allclose(late.state, expected, rtol=1e-6)


def test_a_bias_is_shown_and_changes_nothing_else() -> None:
    exact, biased = made(), made(sensors=SensorSettings(level_bias=0.2, temperature_bias=-0.1, pressure_bias=0.005))
    for _ in range(10):
        more = np.array(biased.measure()) - np.array(exact.measure())
        np.testing.assert_allclose(more, [0.2, 0.0, *[-0.1] * 10, *[0.005] * 10], atol=1e-12)
        exact.advance()
        biased.advance()
    assert biased.state == exact.state


def test_a_refrigerator_is_as_its_model() -> None:
    section = PlantSection(kind=PlantKind.REFRIGERATOR, mismatch=MismatchSettings(jt_valve=1.1))
    with pytest.raises(ConfigurationError, match=r"plant\.mismatch: for a cold box alone; set plant\.kind to cold-box"):
        plant_maker(read_header(SHIPPED_MODELS["refrigerator"]), section)


@pytest.mark.parametrize("biases", [(0.1,), (float("nan"),) * 22])
def test_a_wrong_bias_is_refused(biases: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="biases"):
        MeasurementNoise((0.0,) * 22, 1, biases)
