"""Structured Text as one PLCopen XML file (TC6, version 2.01), which tools import: made from the text that is printed.

It takes the text of this package alone: a declaration a line, sections and units that begin and end at a line's start.
"""

import re
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Final
from xml.etree import ElementTree as ET

from coldloop import __version__

NAMESPACE: Final = "http://www.plcopen.org/xml/tc6_0201"
XHTML: Final = "http://www.w3.org/1999/xhtml"
SECTIONS: Final = {
    "VAR_INPUT": "inputVars", "VAR_OUTPUT": "outputVars", "VAR_IN_OUT": "inOutVars", "VAR_EXTERNAL": "externalVars",
    "VAR": "localVars",
}  # fmt: skip
POUS: Final = {"FUNCTION": "function", "FUNCTION_BLOCK": "functionBlock", "PROGRAM": "program"}
ELEMENTARY: Final = ("BOOL", "DINT", "REAL", "LREAL")

_COMMENT = r"\(\*((?:(?!\*\)).)*)\*\)"
_UNIT = re.compile(
    rf"(?:^{_COMMENT}\n)?^(FUNCTION_BLOCK|FUNCTION|PROGRAM) (\w+)(?: : (\w+))?\n(.*?)^END_\2$", re.MULTILINE | re.DOTALL
)
_SECTION = re.compile(r"^(VAR\w*)( CONSTANT)?\n(.*?)^END_VAR\n", re.MULTILINE | re.DOTALL)
_DECLARATION = re.compile(rf"^    (\w+) : (\w+)(?: := ([^;]+?))?(?: {_COMMENT})?;\n", re.MULTILINE)
_ARRAY = re.compile(r"^    (\w+) : ARRAY \[(\d+)\.\.(\d+)\] OF (\w+);\n", re.MULTILINE)
_CONFIGURATION = re.compile(
    r"^CONFIGURATION (\w+)\n(.*?)^RESOURCE (\w+) ON PLC\n(.*?)^END_RESOURCE", re.MULTILINE | re.DOTALL
)
_TASK = re.compile(r"TASK (\w+)\(INTERVAL := T#(\w+), PRIORITY := (\d+)\);\n    PROGRAM (\w+) WITH \1 : (\w+);")


def plcopen_xml(texts: Iterable[str], content: str) -> str:
    """Return a project with all types, functions, function blocks, programs, constants and the configuration.

    Args:
        texts: Structured Text as this package prints it.
        content: What is in it.
    """
    text = "\n".join(texts)
    project = ET.Element("project", xmlns=NAMESPACE)
    made = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"
    ET.SubElement(project, "fileHeader", companyName="Coldloop", productName="Coldloop", productVersion=__version__,
                  creationDateTime=made, contentDescription=content)  # fmt: skip
    header = ET.SubElement(project, "contentHeader", name="coldloop", modificationDateTime=made)
    coordinates = ET.SubElement(header, "coordinateInfo")
    for language in ("fbd", "ld", "sfc"):
        ET.SubElement(ET.SubElement(coordinates, language), "scaling", x="1", y="1")
    types = ET.SubElement(project, "types")
    ET.SubElement(types, "dataTypes").extend(map(_array_type, _ARRAY.finditer(text)))
    ET.SubElement(types, "pous").extend(map(_pou, _UNIT.finditer(text)))
    ET.SubElement(ET.SubElement(project, "instances"), "configurations").append(_configuration(text))
    ET.indent(project, " ")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(project, encoding="unicode")}\n'


def _array_type(found: re.Match[str]) -> ET.Element:
    name, first, last, kind = found.groups()
    data_type = ET.Element("dataType", name=name)
    array = ET.SubElement(ET.SubElement(data_type, "baseType"), "array")
    ET.SubElement(array, "dimension", lower=first, upper=last)
    ET.SubElement(array, "baseType").append(_type(kind))
    return data_type


def _pou(found: re.Match[str]) -> ET.Element:
    note, kind, name, result, text = found.groups()
    pou = ET.Element("pou", name=name, pouType=POUS[kind])
    interface = ET.SubElement(pou, "interface")
    if result:
        ET.SubElement(interface, "returnType").append(_type(result))
    interface.extend(_sections(text))
    body = re.sub(r"^ {4}", "", _SECTION.sub("", text), flags=re.MULTILINE)
    _write(ET.SubElement(ET.SubElement(pou, "body"), "ST"), body)
    if note:
        _write(ET.SubElement(pou, "documentation"), note.strip())
    return pou


def _sections(text: str) -> Iterator[ET.Element]:
    """Yield the declarations of each section of a unit."""
    for keyword, constant, declared in _SECTION.findall(text):
        yield _variables(SECTIONS[keyword], declared, constant=bool(constant))


def _variables(tag: str, declared: str, *, constant: bool, **attributes: str) -> ET.Element:
    """Return declarations as a list of variables."""
    listed = ET.Element(tag, attributes | ({"constant": "true"} if constant else {}))
    for name, kind, value, note in _DECLARATION.findall(declared):
        variable = ET.SubElement(listed, "variable", name=name)
        ET.SubElement(variable, "type").append(_type(kind))
        if value:
            ET.SubElement(variable, "initialValue").append(_value(value))
        if note:
            _write(ET.SubElement(variable, "documentation"), note.strip())
    return listed


def _type(name: str) -> ET.Element:
    return ET.Element(name) if name in ELEMENTARY else ET.Element("derived", name=name)


def _value(text: str) -> ET.Element:
    """Return a number, or an array of numbers."""
    if not text.startswith("["):
        return ET.Element("simpleValue", value=text)
    array = ET.Element("arrayValue")
    for each in text.strip("[]").split(","):
        ET.SubElement(array, "value").append(_value(each.strip()))
    return array


def _configuration(text: str) -> ET.Element:
    """Return the configuration: its task with what runs in it, and the lists of constants."""
    found = _CONFIGURATION.search(text)
    assert found  # noqa: S101 the text is of this package
    name, declared, resource, tasks = found.groups()
    configuration = ET.Element("configuration", name=name)
    within = ET.SubElement(configuration, "resource", name=resource)
    for task, interval, priority, instance, program in _TASK.findall(tasks):
        running = ET.SubElement(within, "task", name=task, interval=f"T#{interval}", priority=priority)
        ET.SubElement(running, "pouInstance", name=instance, typeName=program)
    for number, (_, constant, listed) in enumerate(_SECTION.findall(declared), 1):
        configuration.append(
            _variables("globalVars", listed, constant=bool(constant), name=f"{name[:3]}constants_{number}")
        )
    return configuration


def _write(element: ET.Element, text: str) -> None:
    """Write text into an element as a paragraph."""
    ET.SubElement(element, "p", xmlns=XHTML).text = text
