"""The running configuration in registers: what a client reads is what the service was given."""

from typing import Any

import pytest

from coldloop.config import selected
from coldloop.registers.bank import RegisterBank
from coldloop.registers.codec import WordOrder
from coldloop.registers.common import (
    LINE_CHARACTERS,
    LINES,
    ConfigurationDigest,
    ConfigurationLine,
    configuration_of,
    lines_of,
    publish_configuration,
)
from coldloop_plant.settings import SHOWN, PlantSection, PlantSettings, SensorSettings
from tests.harness.records import PLANT_MAP


def read(values: dict[str, Any]) -> dict[str, Any]:
    bank = RegisterBank(PLANT_MAP, WordOrder.HIGH_FIRST)
    publish_configuration(bank, values)
    digest = bank.get(ConfigurationDigest)
    return configuration_of(digest, [bank.get(ConfigurationLine, row) for row in range(lines_of(digest.length))])


@pytest.mark.parametrize("values", [{}, {"a": 1}, {"a.b": [0.1, -5.0], "c": None, "d": "Ĵ", "e": {}, "f": "x  "}])
def test_what_is_read_is_what_was_shown(values: dict[str, Any]) -> None:
    assert read(values) == values


def test_a_section_is_shown_with_all_that_is_in_it_and_nothing_else() -> None:
    settings = PlantSettings(plant=PlantSection(sensors=SensorSettings(level=0.5)))
    shown = read(selected(settings, SHOWN))
    assert shown["plant.sensors.level"] == 0.5
    assert shown["plant.clock_error_ppm"] == 0.0
    assert not [key for key in shown if key.startswith(("plant.server", "plant.retain", "model"))]


def test_a_text_that_is_cut_off_is_not_taken() -> None:
    with pytest.raises(ValueError, match="digest"):
        read({"long": "x" * LINES * LINE_CHARACTERS})


def test_a_text_that_was_changed_is_not_taken() -> None:
    bank = RegisterBank(PLANT_MAP, WordOrder.HIGH_FIRST)
    publish_configuration(bank, {"solver": "ode"})
    digest = bank.get(ConfigurationDigest)
    publish_configuration(bank, {"solver": "osq"})
    with pytest.raises(ValueError, match="digest"):
        configuration_of(digest, [bank.get(ConfigurationLine, 0)])
