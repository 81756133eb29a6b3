"""The exported PLCopen XML: of the schema's structure, and with all that the Structured Text has, to the bit."""

import os
from collections.abc import Iterator, Mapping
from typing import Final
from xml.etree import ElementTree as ET

import pytest

from coldloop.process.settings import InputLimits
from coldloop_export.golden import GoldenVectors, GuardKernels, golden_calls
from coldloop_export.st_files import NAMESPACE, POUS, SECTIONS, XHTML, GuardText, StructuredTextExport, plcopen_xml
from tests.plc_export.st_parser import parsed

pytestmark = pytest.mark.usefixtures("compiles")

SCHEMA = os.environ.get("COLDLOOP_TC6_SCHEMA")
P = f"{{{XHTML}}}p"
KEYWORDS: Final = {tag: keyword for keyword, tag in SECTIONS.items()}
LISTS: Final = {*KEYWORDS, "globalVars"}
"""That may be constant."""
VARIABLES: Final = ("variable*",)
CONTENTS: Final[Mapping[str, tuple[str, ...]]] = {
    "project": ("fileHeader", "contentHeader", "types", "instances"),
    "contentHeader": ("coordinateInfo",), "coordinateInfo": ("fbd", "ld", "sfc"),
    "fbd": ("scaling",), "ld": ("scaling",), "sfc": ("scaling",),
    "types": ("dataTypes", "pous"), "dataTypes": ("dataType*",), "dataType": ("baseType",),
    "array": ("dimension", "baseType"), "pous": ("pou*",), "pou": ("interface", "body", "documentation?"),
    "interface": ("returnType?", "inputVars?", "inOutVars?", "outputVars?", "externalVars*", "localVars*"),
    **dict.fromkeys(KEYWORDS, VARIABLES), "globalVars": VARIABLES,
    "variable": ("type", "initialValue?", "documentation?"), "arrayValue": ("value*",),
    "body": ("ST",), "ST": (P,), "documentation": (P,), "instances": ("configurations",),
    "configurations": ("configuration",), "configuration": ("resource", "globalVars*"), "resource": ("task",),
    "task": ("pouInstance",),
}  # fmt: skip
"""Elements in their order, as the schema has them, of those that are written; ? is one or none, * any number."""
ONE_OF: Final = {
    **dict.fromkeys(("type", "returnType"), ("BOOL", "DINT", "REAL", "LREAL", "derived")),
    **dict.fromkeys(("initialValue", "value"), ("simpleValue", "arrayValue")),
    "baseType": ("BOOL", "DINT", "REAL", "LREAL", "array"),
}  # fmt: skip
ATTRIBUTES: Final = {
    "fileHeader": {"companyName", "productName", "productVersion", "creationDateTime", "contentDescription"},
    "contentHeader": {"name", "modificationDateTime"}, "scaling": {"x", "y"}, "dataType": {"name"},
    "dimension": {"lower", "upper"}, "pou": {"name", "pouType"}, "variable": {"name"}, "derived": {"name"},
    "simpleValue": {"value"}, "configuration": {"name"}, "resource": {"name"},
    "task": {"name", "interval", "priority"}, "pouInstance": {"name", "typeName"}, "globalVars": {"name"},
}  # fmt: skip


@pytest.fixture(scope="module", params=["solver", "output guard"])
def texts(recorded: GoldenVectors, request: pytest.FixtureRequest) -> dict[str, str]:
    """The Structured Text of the output guard, or of the solver with two of the problems."""
    if request.param != "solver":
        return GuardText(GuardKernels(InputLimits()), golden_calls(InputLimits())).files()
    return StructuredTextExport(recorded.method, recorded.vectors[:2]).files()


@pytest.fixture(scope="module")
def project(texts: dict[str, str]) -> ET.Element:
    return ET.fromstring(plcopen_xml(texts.values(), "a solver"))  # noqa: S314 of our own making


def plain(element: ET.Element) -> str:
    return element.tag.removeprefix(f"{{{NAMESPACE}}}")


def matches(names: list[str], order: tuple[str, ...]) -> bool:
    """Return whether elements come in their order, as often as they may."""
    rest = list(names)
    for each in order:
        name, most = each.rstrip("?*"), len(rest) if each.endswith("*") else 1
        found = 0
        while rest and rest[0] == name and found < most:
            rest.pop(0)
            found += 1
        if not found and each == name:
            return False
    return not rest


def test_elements_and_attributes_are_those_of_the_schema_in_its_order(project: ET.Element) -> None:
    for element in project.iter():
        name, within = plain(element), [plain(child) for child in element]
        if name in ONE_OF:
            assert [each for each in ONE_OF[name] if [each] == within], name
        else:
            assert matches(within, CONTENTS.get(name, ())), (name, within[:9])
        assert set(element.attrib) - ({"constant"} if name in LISTS else set()) == ATTRIBUTES.get(name, set()), name
        assert all(element.attrib.values()), name


@pytest.mark.parametrize(
    ("names", "fits"),
    [(["a", "b", "b"], True), (["a"], True), (["b"], False), (["a", "b", "c"], False), (["a", "b", "a"], False)],
)
def test_the_check_of_the_order_finds_what_is_missing_or_out_of_place(names: list[str], *, fits: bool) -> None:
    assert matches(names, ("a", "c?", "b*")) is fits


@pytest.mark.skipif(not SCHEMA, reason="COLDLOOP_TC6_SCHEMA does not name PLCopen's tc6_xml_v201.xsd")
def test_the_schema_itself_says_so(texts: dict[str, str]) -> None:
    etree = pytest.importorskip("lxml.etree")
    schema = etree.XMLSchema(etree.parse(SCHEMA))
    schema.assertValid(etree.fromstring(plcopen_xml(texts.values(), "a solver").encode()))


# -- read back ---------------------------------------------------------------------------------------------------------


def child(element: ET.Element, path: str) -> ET.Element:
    found = element.find("/".join(f"{{{NAMESPACE}}}{name}" for name in path.split("/")))
    assert found is not None, path
    return found


def type_in(element: ET.Element) -> str:
    kind = element[0]
    return kind.get("name", "") if plain(kind) == "derived" else plain(kind)


def value_in(element: ET.Element) -> str:
    held = element[0]
    if plain(held) == "simpleValue":
        return held.get("value", "")
    return f"[{', '.join(map(value_in, held))}]"


def declarations(listed: ET.Element, keyword: str) -> Iterator[str]:
    yield keyword + " CONSTANT" * (listed.get("constant") == "true")
    for variable in listed:
        initial = variable.find(f"{{{NAMESPACE}}}initialValue")
        value = "" if initial is None else f" := {value_in(initial)}"
        yield f"{variable.get('name')} : {type_in(child(variable, 'type'))}{value};"
    yield "END_VAR"


def text_of(project: ET.Element) -> str:
    """Return Structured Text from the elements, as an importer makes it."""
    lines = []
    for data_type in child(project, "types/dataTypes"):
        array = child(data_type, "baseType/array")
        size = child(array, "dimension")
        kind = type_in(child(array, "baseType"))
        bounds = f"{size.get('lower')}..{size.get('upper')}"
        lines += ["TYPE", f"{data_type.get('name')} : ARRAY [{bounds}] OF {kind};", "END_TYPE"]
    for pou in child(project, "types/pous"):
        keyword = next(each for each, kind in POUS.items() if kind == pou.get("pouType"))
        result = pou.find(f"{{{NAMESPACE}}}interface/{{{NAMESPACE}}}returnType")
        lines.append(f"{keyword} {pou.get('name')}{'' if result is None else f' : {type_in(result)}'}")
        for listed in child(pou, "interface"):
            if plain(listed) != "returnType":
                lines += declarations(listed, KEYWORDS[plain(listed)])
        lines += [child(pou, "body/ST")[0].text or "", f"END_{keyword}"]
    configuration = child(project, "instances/configurations/configuration")
    lines.append(f"CONFIGURATION {configuration.get('name')}")
    resource, *lists = configuration
    for listed in lists:
        lines += declarations(listed, "VAR_GLOBAL")
    task = resource[0]
    lines += [
        f"RESOURCE {resource.get('name')} ON PLC",
        f"TASK {task.get('name')}(INTERVAL := {task.get('interval')}, PRIORITY := {task.get('priority')});",
        f"PROGRAM {task[0].get('name')} WITH {task.get('name')} : {task[0].get('typeName')};",
        "END_RESOURCE", "END_CONFIGURATION",
    ]  # fmt: skip
    return "\n".join(lines)


def test_what_is_read_back_is_the_structured_text(texts: dict[str, str], project: ET.Element) -> None:
    assert parsed(text_of(project)) == parsed(*texts.values())


def test_blocks_and_interfaces_keep_what_is_said_of_them(project: ET.Element) -> None:
    notes = {pou.get("name"): child(pou, "documentation")[0].text for pou in child(project, "types/pous")
             if pou.find(f"{{{NAMESPACE}}}documentation") is not None}  # fmt: skip
    of_guard = "cl_guard_scan" in notes
    kernel, source = ("cg_admit", "output_limits.py") if of_guard else ("cl_excess_by_columns", "qp/costs.py")
    assert source in (notes[kernel] or "")
    assert f"what: {4 if of_guard else 1}" in (notes["cg_self_test" if of_guard else "cl_self_test"] or "")
