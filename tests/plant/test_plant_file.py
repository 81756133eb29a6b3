"""A plant file is the cold box that it describes, and so is the model file that is made of it."""

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from coldloop.config import flattened
from coldloop.errors import ConfigurationError, LoadFileError, ModelFileError
from coldloop.process.cold_box import COLD_BOX, T5
from coldloop.process.lti_model import load
from coldloop.process.model_file import read_document, read_header, write_document
from coldloop.process.settings import DEFAULT_MODEL_FILE, SHIPPED_MODELS, InputLimits
from coldloop_plant.cold_box.model import build_model, model_at, operating_point, parameters_digest
from coldloop_plant.cold_box.plant_file import REFERENCE, BoxParameters, PlantFile
from coldloop_plant.helium import load_helium
from coldloop_plant.kinds import own_header, plant_maker
from coldloop_plant.load import find_load
from coldloop_plant.settings import MismatchSettings, PlantSection
from coldloop_refrigerator.plant_file import (
    REFERENCE_REFRIGERATOR,
    WARM_SECTIONS,
    RefrigeratorPlantFile,
    read_plant_file,
)

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "smaller_turbine.toml"
KEYS = [key for key in flattened(PlantFile().model_dump()) if not key.startswith("operating_point")]


def leaves(value: object) -> list[object]:
    return [leaf for part in value for leaf in leaves(part)] if isinstance(value, tuple) else [value]


def write_model(file: Path, parameters: object, digest: str, shipped: str = "cold-box") -> Path:
    """Write a model file that is not at rest, which only a run would find."""
    document = read_document(SHIPPED_MODELS[shipped])
    write_document(file, {**document, "plant_parameters": parameters, "parameters_digest": digest})
    return file


def test_the_defaults_are_the_reference_plant_to_the_bit(tmp_path: Path) -> None:
    file = tmp_path / "box.toml"
    file.write_text("")
    plant = read_plant_file(file, InputLimits())
    assert plant == PlantFile()
    assert (plant.box, plant.parameters) == (REFERENCE, {})
    whole = read_plant_file(file, InputLimits(), whole=True)
    assert isinstance(whole, RefrigeratorPlantFile)
    assert (whole.refrigerator, whole.parameters) == (REFERENCE_REFRIGERATOR, {})


def test_the_file_on_the_page_has_every_key_with_its_default_and_its_range() -> None:
    page = (ROOT / "docs" / "your-refrigerator.md").read_text(encoding="utf-8")
    box, warm = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert flattened(tomllib.loads(box)) == flattened(PlantFile().model_dump())
    assert flattened(tomllib.loads(box + warm)) == flattened(RefrigeratorPlantFile().model_dump())
    told = re.findall(r"^(\w+) = .*# ([\d. ]+?) to ([\d. ]+\d)", box + warm, re.MULTILINE)
    schema = RefrigeratorPlantFile.model_json_schema()["$defs"]
    ranges = {
        (key, each["minimum"], each["maximum"])
        for section in schema.values() for key, each in section["properties"].items()
    }  # fmt: skip
    assert len(told) > 35
    assert {(key, float(low.replace(" ", "")), float(high.replace(" ", ""))) for key, low, high in told} <= ranges


def test_every_parameter_of_a_refrigerator_but_the_numbers_of_cells_has_a_key_and_every_key_a_parameter() -> None:
    usual, reached = leaves(REFERENCE_REFRIGERATOR), set()
    defaults = RefrigeratorPlantFile().model_dump()
    for section, keys in defaults.items():
        for name in keys if section in WARM_SECTIONS else ():
            part = {**keys, name: 1.05 * keys[name]}
            changed = leaves(RefrigeratorPlantFile.model_validate({section: part}).refrigerator)
            moved = {place for place, pair in enumerate(zip(usual, changed, strict=True)) if len(set(pair)) > 1}
            assert len(moved) == (0 if name == "buffer_bar" else 1), f"{section}.{name}"
            reached |= moved
    box = len(leaves(REFERENCE))
    assert {usual[place] for place in range(box, len(usual)) if place not in reached} == {8}


def test_every_parameter_but_the_numbers_of_cells_has_a_key_and_every_key_a_parameter() -> None:
    usual, reached = leaves(REFERENCE), set()
    for key in KEYS:
        changed = leaves(PlantFile().scaled(key, 1.1))
        moved = {place for place, (before, after) in enumerate(zip(usual, changed, strict=True)) if before != after}
        assert len(moved) == 1, key
        reached |= moved
    assert {usual[place] for place in range(len(usual)) if place not in reached} == {8, 6, 12}


@pytest.mark.usefixtures("compiles")
def test_a_plant_like_the_reference_leaves_the_same_model_and_no_parameters(tmp_path: Path) -> None:
    helium = load_helium()
    model = model_at(operating_point(PlantFile(), helium), REFERENCE, helium, PlantFile().parameters)
    assert model.digest == build_model().digest
    model.save(tmp_path / "model.json")
    assert set(read_document(tmp_path / "model.json")) == set(read_document(DEFAULT_MODEL_FILE))


def test_a_model_file_carries_its_plant(tmp_path: Path) -> None:
    plant = read_plant_file(EXAMPLE, InputLimits())
    assert plant.box != REFERENCE
    file = write_model(tmp_path / "box.json", plant.parameters, parameters_digest(plant.box, load_helium()))
    header = own_header(file)
    assert BoxParameters.model_validate(header.plant_parameters).box == plant.box
    assert load(file).digest == header.digest

    section = PlantSection(mismatch=MismatchSettings(turbine_efficiency=1.1, jt_valve=0.9))
    made, off = (
        plant_maker(header, each)(find_load("a", header.w0, COLD_BOX), 1) for each in (PlantSection(), section)
    )
    assert made.box == plant.box
    assert off.box.turbine.efficiency == 1.1 * 0.74
    assert off.box.jt_valve.flow_area == 0.9 * plant.box.jt_valve.flow_area
    assert off.box.nef34 == plant.box.nef34
    with pytest.raises(ConfigurationError, match=r"mismatch.turbine_efficiency.* 1.04"):
        plant_maker(header, PlantSection(mismatch=MismatchSettings(turbine_efficiency=1.4)))


def example_with(**changes: object) -> dict[str, Any]:
    parameters: dict[str, Any] = json.loads(json.dumps(read_plant_file(EXAMPLE, InputLimits()).parameters))
    for key, value in changes.items():
        section, name = key.split("__")
        parameters[section][name] = value
    return parameters


TAMPERED: dict[str, tuple[Callable[[], object], str]] = {
    "another value": (lambda: example_with(nef1__ua_w_per_k=1500.0), "another plant"),
    "out of range": (lambda: example_with(turbine__efficiency=1.5), "turbine.efficiency: input should be less"),
    "a text": (lambda: example_with(bath__volume_m3="0.2"), "bath.volume_m3"),
    "unknown key": (lambda: example_with(nef2__ua=1.0), "nef2.ua: no such key; did you mean nef2.ua_w_per_k"),
    "unknown section": (lambda: {"precooler": {}}, "precooler: no such key"),
    "a number": (lambda: 5, "plant_parameters|TypeError"),
    "a list": (lambda: ["bath"], "model file"),
    "null": (lambda: None, "plant_parameters: Input should be a valid dictionary"),
    "nothing": (dict, "plant_parameters: Dictionary should have at least 1 item"),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_a_model_file_with_other_parameters_is_refused(name: str, tmp_path: Path) -> None:
    parameters, part = TAMPERED[name]
    digest = parameters_digest(read_plant_file(EXAMPLE, InputLimits()).box, load_helium())
    file = write_model(tmp_path / "box.json", parameters(), digest)
    with pytest.raises(ModelFileError, match=part) as refused:
        own_header(file)
    assert str(refused.value).startswith(f"{file}: ")
    assert "\n" not in str(refused.value)


def test_a_refrigerator_of_other_parameters_than_its_model_is_refused(tmp_path: Path) -> None:
    digest = read_header(SHIPPED_MODELS["refrigerator"]).parameters_digest
    file = write_model(tmp_path / "box.json", example_with(), digest, "refrigerator")
    with pytest.raises(ModelFileError, match="another plant"):
        own_header(file)


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("size", [0.05, 10.0])
def test_a_box_in_proportion_rests_in_proportion(size: float) -> None:
    intensive = ("_pct", "_bar", "efficiency", "_k", "per_kg")
    parts = PlantFile().model_dump()
    for section in parts.values():
        for key in section:
            if key.startswith("nozzle") or key == "ua_w_per_k" or not key.endswith(intensive):
                section[key] *= size
    usual, found = (operating_point(PlantFile.model_validate(each), load_helium()) for each in ({}, parts))
    assert found.w == pytest.approx(size * usual.w, rel=0.15)
    assert found.y[T5] == pytest.approx(usual.y[T5], abs=0.3)


def test_another_supply_pressure_counts_its_tables() -> None:
    helium = load_helium()
    other = helium._replace(departure=helium.departure._replace(nodes=1.1 * helium.departure.nodes))
    lower = REFERENCE._replace(P_HP=15e5)
    assert parameters_digest(REFERENCE, helium) == parameters_digest(REFERENCE, other)
    assert parameters_digest(lower, helium) != parameters_digest(lower, other)


def test_a_named_load_that_would_go_below_nothing_is_refused() -> None:
    assert min(find_load("a", 60.0, COLD_BOX).watts) == 0.0
    with pytest.raises(LoadFileError, match=r"load 2h: would go down to -40 W about 60 W.*CSV file"):
        find_load("2h", 60.0, COLD_BOX)
