"""A refrigerator that begins warm: it holds all its helium, starts without losing any, and cools."""

import numpy as np
import pytest

from coldloop.process.cold_box import OUTPUT_NAMES, STATION_SIGNAL_NAMES
from coldloop.process.load_profile import LoadProfile
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop.registers.plant import StationMode
from coldloop_plant.helium import load_helium
from coldloop_plant.kinds import own_header, plant_maker
from coldloop_plant.settings import PlantSettings
from coldloop_refrigerator.physics import inventory
from coldloop_refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_refrigerator.program import SHIPPED, RefrigeratorProgram, read_refrigerator_file, warm_state

pytestmark = pytest.mark.usefixtures("compiles")

HEADER = own_header(DEFAULT_MODEL_FILE)
REST = read_refrigerator_file(SHIPPED).x0
HELIUM = load_helium()


def warm_plant() -> RefrigeratorProgram:
    section = {"kind": "refrigerator", "refrigerator": {"start": "warm"}}
    plant = plant_maker(HEADER, PlantSettings.model_validate({"plant": section}).plant)(LoadProfile((0,), (0.0,)), 1)
    assert isinstance(plant, RefrigeratorProgram)
    return plant


def signal(plant: RefrigeratorProgram, name: str) -> float:
    return plant.station.signals[STATION_SIGNAL_NAMES.index(name)]


def output(plant: RefrigeratorProgram, name: str) -> float:
    return plant.measure()[OUTPUT_NAMES.index(name)]


@pytest.mark.parametrize("ambient", [280.0, 300.0])
def test_warm_it_holds_the_helium_of_the_operating_point_within_its_relief_pressures(ambient: float) -> None:
    x = warm_state(REST, REFERENCE_REFRIGERATOR, HELIUM, ambient=ambient, low_pressure=1.05e5)
    total = inventory(np.array(REST), REFERENCE_REFRIGERATOR, HELIUM)
    assert inventory(x, REFERENCE_REFRIGERATOR, HELIUM) == pytest.approx(total, rel=1e-14)


def test_everything_is_at_ambient_temperature_and_no_table_is_left() -> None:
    plant = warm_plant()
    temperatures = [output(plant, f"T{i}") for i in (1, 2, 4, 6, 9, 10)]
    assert temperatures == pytest.approx([300.0] * 6, abs=0.05)
    assert signal(plant, "P12") == pytest.approx(signal(plant, "P13"), abs=0.01)
    assert signal(plant, "P13") < 13.0
    assert plant.model_range == 0
    assert plant.station.mode == StationMode.STARTING


def test_one_compressor_starts_and_the_turbine_cools_within_its_governed_speed() -> None:
    plant = warm_plant()
    plant.apply((60.0, 0.0, 36.0))
    before, fastest = signal(plant, "helium"), 0.0
    for _ in range(4 * 1800):
        plant.advance()
        fastest = max(fastest, output(plant, "V1"))
        assert signal(plant, "helium") + signal(plant, "lost") == pytest.approx(before, rel=1e-9)
    assert signal(plant, "lost") == 0.0
    assert fastest < 3100.0
    assert plant.station.mode == StationMode.ONE_COMPRESSOR
    assert signal(plant, "P12") == pytest.approx(16.0, abs=0.05)
    assert output(plant, "T4") < 290.0
    assert plant.model_range == 0
