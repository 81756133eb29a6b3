"""The drawing of a process for the operator's page: an SVG file in which texts such as {h1} name signals.

Whatever is not drawing is left out, where an editor has written it, or refused, where it would act.
"""

import re
from collections.abc import Collection
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

from coldloop.errors import UsageError

SVG: Final = "{http://www.w3.org/2000/svg}"
XLINK_HREF: Final = "{http://www.w3.org/1999/xlink}href"
ELEMENTS: Final = frozenset((
    "svg", "g", "defs", "symbol", "use", "title", "desc", "path", "rect", "circle", "ellipse", "line", "polyline",
    "polygon", "text", "tspan", "clipPath", "mask", "marker", "pattern", "linearGradient", "radialGradient", "stop",
))  # fmt: skip
BINDINGS: Final = ("data-signal", "data-fill")
"""Attributes that name a signal: whose value a text or a tag shows, or how far a rectangle is filled."""
NAMED: Final = re.compile(r"\s*\{([A-Za-z]\w*)\}\s*")
REFERENCE: Final = re.compile(r"url\(\s*['\"]?(?!#)")
LONGEST: Final = 500_000
"""Characters: the drawing is in the model file."""
PREFIX: Final = "mimic-"
"""Of the names of its elements, which are others than those of the page."""


def drawing_of(path: Path, signals: Collection[str]) -> str:
    """Return the drawing as it is in the model file.

    Args:
        path: An SVG file.
        signals: Names that it may show.

    Raises:
        UsageError: One line that names file, element and remedy.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: {error}; mimic names an SVG file beside the process file") from None
    if len(text) > LONGEST:
        raise UsageError(f"{path}: {len(text)} characters; a drawing has {LONGEST} at most")
    if "<!ENTITY" in text:
        raise UsageError(f"{path}: it declares entities; save it as plain SVG")
    try:
        root = ET.fromstring(text)  # noqa: S314 nothing is fetched, and entities are refused above
    except ET.ParseError as error:
        raise UsageError(f"{path}: not an SVG file: {error}") from None
    if root.tag != f"{SVG}svg":
        raise UsageError(f"{path}: not an SVG file: it begins with {root.tag}")
    _keep_drawing(root, path)
    for one in root.iter():
        _bind(one, path, signals)
    if "viewBox" not in root.attrib:
        raise UsageError(f"{path}: no viewBox: the page would not know its size; save it as plain SVG, or add one")
    for size in ("width", "height"):
        root.attrib.pop(size, None)
    ET.register_namespace("", SVG.strip("{}"))
    return ET.tostring(root, encoding="unicode")


def _keep_drawing(parent: ET.Element, path: Path) -> None:
    """Leave out what editors add; refuse what acts."""
    parent.attrib = _attributes(parent, path)
    for child in list(parent):
        space, _, name = str(child.tag).rpartition("}")
        if f"{space}}}" != SVG or name == "metadata":
            parent.remove(child)
        elif name not in ELEMENTS:
            raise UsageError(f"{path}: <{name}> has no place in a drawing of the page; remove it, or draw it otherwise")
        else:
            _keep_drawing(child, path)


def _attributes(element: ET.Element, path: Path) -> dict[str, str]:
    """Return the attributes of an element: its style as such, as the page has no styles but its own."""
    found = {}
    styled = (part.partition(":") for part in element.attrib.get("style", "").split(";"))
    given = [*element.attrib.items(), *((name.strip(), value.strip()) for name, _, value in styled if value)]
    for name, value in given:
        key = "href" if name == XLINK_HREF else name
        if key.startswith("{") or key == "style" or not re.fullmatch(r"[A-Za-z][A-Za-z0-9-]*", key):
            continue
        if key.lower().startswith("on") or (key == "href" and not value.startswith("#")) or REFERENCE.search(value):
            raise UsageError(f'{path}: {key}="{value}" reaches outside the drawing; remove it')
        found[key] = PREFIX + value if key == "id" else value.replace("url(#", f"url(#{PREFIX}")
    if "href" in found:
        found["href"] = f"#{PREFIX}{found['href'][1:]}"
    return found


def _bind(one: ET.Element, path: Path, signals: Collection[str]) -> None:
    """Make a text such as {h1} one that shows this signal, and check names."""
    named = NAMED.fullmatch(one.text or "")
    if named is not None and not len(one):
        one.text = ""
        one.set("data-signal", named[1])
    for attribute in BINDINGS:
        name = one.get(attribute)
        if name is not None and name not in signals:
            raise UsageError(f"{path}: {name} is no signal of this process: {', '.join(signals)}")
