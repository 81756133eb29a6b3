"""What the study of plants that are off says of the controllers, against cases done by hand."""

import numpy as np
import pytest

from coldloop.config import load_configuration
from coldloop_rig.settings import Settings
from coldloop_studies.controllers import (
    CONTROLLER_CONDITIONS,
    CONTROLLERS,
    DEFAULT,
    ESTIMATED,
    LINEAR,
    NOMINAL,
    HoursUnder,
    comparison,
    controllers_remarks,
    holding,
    over_own,
)
from coldloop_studies.settings import settings_of
from coldloop_studies.study import StudyOptions

PAPER, FIXED = "paper, Algorithm 1", "tuned, fixed 2.5 s"
HOURS = StudyOptions(ticks=60, loads=("a", "c"), seeds=1)
Key = tuple[str, str]
Hours = tuple[list[float], list[float], list[float]]
"""J_BF, and how long L1 and T5 are outside, of the hours a and c."""


def found(changed: dict[Key, Hours]) -> dict[Key, HoursUnder]:
    """Two hours that cost 100 and 200 without leaving a band, but for what is changed."""
    usual: Hours = ([100.0, 200.0], [0.0, 0.0], [0.0, 0.0])
    return {
        (condition, controller): HoursUnder(*map(np.array, changed.get((condition, controller), usual)))
        for condition in CONTROLLER_CONDITIONS for controller in CONTROLLERS
    }  # fmt: skip


def test_a_band_is_held_if_the_mean_share_outside_is_one_per_cent_at_most() -> None:
    said = holding(
        found({
            ("valves -20 %", DEFAULT): ([1e4, 2e4], [0.5, 1.5], [0.0, 0.0]),
            ("valves +20 %", DEFAULT): ([1e4, 2e4], [0.0, 2.2], [0.0, 0.0]),
            ("UA +10 %", DEFAULT): ([1e4, 2e4], [0.0, 0.0], [6.0, 0.0]),
        })
    )  # fmt: skip
    every = len(CONTROLLER_CONDITIONS)
    assert (
        f"- `{DEFAULT}` in {every - 2} of {every}; not under UA +10 % (0.0 / 3.0), valves +20 % (1.1 / 0.0).\n" in said
    )
    assert said.endswith(f"- `{PAPER}` in {every} of {every}.\n- `{FIXED}` in {every} of {every}.")


def test_a_cost_is_less_or_more_only_where_the_interval_is_clear_of_one() -> None:
    """Half and three times in both hours; half in one and twice in the other is undecided, as is what is the same."""
    said = comparison(
        found({
            ("UA -10 %", DEFAULT): ([50.0, 100.0], [0.0, 0.0], [0.0, 0.0]),
            ("UA -20 %", DEFAULT): ([300.0, 600.0], [0.0, 0.0], [0.0, 0.0]),
            ("UA +20 %", DEFAULT): ([50.0, 400.0], [0.0, 0.0], [0.0, 0.0]),
            ("UA -20 %", FIXED): ([300.0, 600.0], [0.0, 0.0], [0.0, 0.0]),
        })
    )  # fmt: skip
    every = len(CONTROLLER_CONDITIONS)
    assert f"- of `{PAPER}`: less under UA -10 % (0.5); more under UA -20 % (3); undecided in {every - 2} of" in said
    assert f"- of `{FIXED}`: less under UA -10 % (0.5); more under no condition; undecided in {every - 1} of" in said


def test_what_being_off_costs_is_over_the_same_controller_on_its_model() -> None:
    """Twice and eight times are four times, 6683 times either way; the worst hour is named."""
    hours = found({
        ("sensor bias", DEFAULT): ([200.0, 1600.0], [1.0, 2.0], [0.0, 0.5]),
        (NOMINAL, FIXED): ([1000.0, 1000.0], [0.0, 0.0], [0.0, 0.0]),
    })  # fmt: skip
    mean, by_hour = over_own(hours, "sensor bias", DEFAULT)
    assert by_hour.tolist() == [2.0, 8.0]
    assert mean == pytest.approx((4.0, 4.0 / 2**12.7062, 4.0 * 2**12.7062), rel=1e-4)
    *_, costs, ratios = controllers_remarks(HOURS, hours)
    assert "| sensor bias | 4 [0.000599 to 2.67e+04] (8: c) | 1 [1 to 1] (1: a) | 0.141 " in ratios
    assert f"| {NOMINAL} | 1 [1 to 1] (1: a) | 1 [1 to 1] (1: a) | 1 [1 to 1] (1: a) |" in ratios
    (row,) = (line for line in costs.splitlines() if line.startswith("| sensor bias |"))
    assert row.startswith("| sensor bias | 900 [")
    assert "]; 1.5 / 0.2 | 150 [" in row


def test_conditions_are_what_they_are_called() -> None:
    default = load_configuration(Settings, environment={}).settings
    assert settings_of(CONTROLLERS[DEFAULT][1]) == default, "the first controller is the default"
    under = {condition: settings_of(changes) for condition, changes in CONTROLLER_CONDITIONS.items()}
    distinct = {settings.model_dump_json() for settings in under.values()}
    assert len(distinct) == len(CONTROLLER_CONDITIONS) - len(LINEAR), "a linear plant is no setting"
    reckoned = under[NOMINAL].optimizer_plc.program.estimator
    for condition, factor in {"sensor noise": 1.0, "sensor noise doubled": 2.0}.items():
        sensors = under[condition].plant.sensors
        assert (sensors.level, sensors.speed) == (factor * reckoned.level_sensor, factor * reckoned.speed_sensor)
        assert sensors.temperature == factor * reckoned.temperature_sensor
        assert sensors.pressure == factor * reckoned.pressure_sensor
    tuned = settings_of((*CONTROLLERS[DEFAULT][1], *CONTROLLER_CONDITIONS[ESTIMATED])).optimizer_plc.program.estimator
    assert tuned.disturbances == default.optimizer_plc.program.estimator.disturbances, "whether or not it is measured"
