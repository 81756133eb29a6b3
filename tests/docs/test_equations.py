"""The page of the plant's equations has each name that the software shows with its unit, and each parameter's value."""

import re
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from coldloop.process import cold_box
from coldloop_refrigerator.physics import COMMAND_NAMES, DISTURBANCE_NAMES, STATE_NAMES, STATE_UNITS
from coldloop_refrigerator.plant_file import REFERENCE_REFRIGERATOR

PAGE = (Path(__file__).parents[2] / "docs" / "equations.md").read_text(encoding="utf-8")
PACKAGES = ("coldloop_plant", "coldloop_plant.components", "coldloop_refrigerator")


def rows(text: str) -> list[list[str]]:
    return [line[2:-2].split(" | ") for line in text.splitlines() if line.startswith("| ") and line.endswith(" |")]


def tags(heading: str) -> dict[str, str]:
    """Return the units of the names in a table of tags; `T_nef2_1` to `T_nef2_6` are six names."""
    section = PAGE.partition(f"### {heading}\n")[2].partition("\n### ")[0]
    found: dict[str, str] = {}
    for name, unit, meaning in rows(section)[1:]:
        ends = re.findall(r"`(\w+)`", name)
        stem, _, first = ends[0].rpartition("_")
        numbers = range(int(first), int(ends[1].rpartition("_")[2]) + 1) if len(ends) > 1 else ()
        found |= dict.fromkeys([f"{stem}_{number}" for number in numbers] or ends, unit)
        assert meaning
    return found


@pytest.mark.parametrize(
    ("heading", "names", "units"),
    [
        ("Inputs and load", (*cold_box.INPUT_NAMES, "NCR22_HL"), (*cold_box.INPUT_UNITS, "W")),
        ("Outputs", cold_box.OUTPUT_NAMES, cold_box.OUTPUT_UNITS),
        ("Signals of station and pre-cooler", cold_box.STATION_SIGNAL_NAMES, cold_box.STATION_SIGNAL_UNITS),
        ("States", STATE_NAMES, STATE_UNITS),
        ("Commands and disturbances", (*COMMAND_NAMES, *DISTURBANCE_NAMES), ("%",) * 4 + ("W", "K", "kg/s", *"111")),
    ],
)
def test_every_name_is_in_its_table_with_its_unit(heading: str, names: tuple[str, ...], units: tuple[str, ...]) -> None:
    assert tags(heading) == dict(zip(names, units, strict=True))


def test_every_tag_has_a_place_in_the_diagram() -> None:
    diagram = PAGE.partition("## Where everything is\n")[2].partition("\n## ")[0].split("```")[1]
    shown = {
        *cold_box.INPUT_NAMES,
        *cold_box.OUTPUT_NAMES,
        *cold_box.STATION_SIGNAL_NAMES,
        *COMMAND_NAMES,
        "NC1",
        "NC2",
    }
    assert shown <= set(re.findall(r"\w+", diagram))


def parameters(value: Any, path: str) -> Iterator[str]:  # noqa: ANN401 - any nesting of tuples
    if not isinstance(value, tuple):
        yield path
        return
    for name in value._fields:
        yield from parameters(getattr(value, name), f"{path}.{name}" if path else name)


def value_of(path: str) -> float:
    first, *rest = path.split(".")
    value: Any = getattr(REFERENCE_REFRIGERATOR, first, None)
    if not hasattr(value, rest[0]):
        value = import_module(next(f"{each}.{first}" for each in PACKAGES if find_spec(f"{each}.{first}")))
    for name in rest:
        value = getattr(value, name)
    return float(value)


def test_the_parameters_have_the_values_of_the_reference_plant() -> None:
    written: dict[str, float] = {}
    for row in (row for row in rows(PAGE) if len(row) > 3 and row[3].startswith("`")):
        paths = re.findall(r"`([\w.]+)`", row[3])
        values = [float(value) for value in row[1].split(", ")]
        written |= dict(zip(paths, values if len(values) > 1 else values * len(paths), strict=True))
    assert written == pytest.approx({path: value_of(path) for path in written}, rel=1e-5)
    assert set(parameters(REFERENCE_REFRIGERATOR, "")) <= set(written)


def test_its_links_to_sections_lead_to_sections() -> None:
    docs = Path(__file__).parents[2] / "docs"
    for page in docs.glob("*.md"):
        text = page.read_text(encoding="utf-8")
        for target, anchor in re.findall(r"\]\(([\w.-]*)#([\w-]+)\)", text):
            if page.name == "equations.md" or target == "equations.md":
                assert anchor in anchors(docs / (target or page.name)), f"{page.name}: {target}#{anchor}"


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings}
