"""The drawing of a process for the operator's page: an SVG file in which texts such as {h1} name signals.

Whatever is not drawing is left out, where an editor has written it, or refused, where it would act.
"""

import math
import re
from collections.abc import Collection, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

from coldloop.errors import UsageError
from coldloop.text_file import read_text

SVG: Final = "{http://www.w3.org/2000/svg}"
XLINK_HREF: Final = "{http://www.w3.org/1999/xlink}href"
ELEMENTS: Final = frozenset((
    "svg", "g", "defs", "symbol", "use", "title", "desc", "path", "rect", "circle", "ellipse", "line", "polyline",
    "polygon", "text", "tspan", "clipPath", "mask", "marker", "pattern", "linearGradient", "radialGradient", "stop",
))  # fmt: skip
TEXTS: Final = (f"{SVG}text", f"{SVG}tspan")
SIGNAL, FILL, ENDS = "data-signal", "data-fill", ("data-low", "data-high")
"""Attributes: a signal whose value a text or a tag shows, one that fills a rectangle, and the ends of its bar."""
NAMED: Final = re.compile(r"\{(\w+)\}")
OUTSIDE: Final = re.compile(r"\\|url\((?!\s*['\"]?#)|(?:src|image|image-set)\(", re.IGNORECASE)
"""Pattern of references to outside the drawing; a backslash may encode any of them."""
INSIDE: Final = re.compile(r"url\(\s*(['\"]?)#([^'\")\s]*)\1\s*\)", re.IGNORECASE)
LONGEST: Final = 500_000
"""Characters: the drawing is in the model file."""
DEEPEST: Final = 100
"""Levels of elements within elements, and of what they use."""
MOST_DRAWN: Final = 50_000
"""Elements, each counted as often as it is used: more keep a browser busy for minutes."""
VIEW_BOX: Final = 4
"""Numbers: left, top, width, height."""
QUOTED: Final = 60
"""Characters of a value in a message."""
PREFIX: Final = "mimic-"
"""Prefix of the ids of its elements, which keeps them apart from those of the page."""


def drawing_of(path: Path, signals: Collection[str]) -> str:
    """Return the drawing of an SVG file as it is in the model file; it may show these signals.

    Raises:
        UsageError: One line that names file, element and remedy.
    """
    root = _parsed(path)
    named = {one.get("id"): one for one in root.iter()}
    if sum(1 for _ in islice(_drawn(root, path, named, _referring(root)), MOST_DRAWN + 1)) > MOST_DRAWN:
        raise UsageError(f"{path}: more than {MOST_DRAWN} elements, as often as they are used; draw less")
    _keep_drawing(root, path)
    for one in [each for each in root.iter() if each.tag in TEXTS]:
        _show_named(one)
    for one in root.iter():
        _check_bound(one, path, signals)
    size = [_number(part) for part in root.get("viewBox", "").replace(",", " ").split()]
    if len(size) != VIEW_BOX or not all(each is not None and math.isfinite(each) for each in size):
        raise UsageError(f"{path}: no viewBox of 4 numbers, so the page would not know its size; save it as plain SVG")
    for length in ("width", "height"):
        root.attrib.pop(length, None)
    ET.register_namespace("", SVG.strip("{}"))
    return ET.tostring(root, encoding="unicode")


def _parsed(path: Path) -> ET.Element:
    text = read_text(path, "mimic names an SVG file beside the process file")
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
    return root


def _referring(root: ET.Element) -> dict[ET.Element, frozenset[str]]:
    """Return the names that each element refers to, as paint, marker, mask, clip path or original.

    What an element refers to counts for all within it, as paints and markers are inherited.
    """
    found: dict[ET.Element, frozenset[str]] = {}
    left: list[tuple[ET.Element, frozenset[str]]] = [(root, frozenset())]
    while left:
        one, above = left.pop()
        inherited = above | {name for value in one.attrib.values() for _, name in INSIDE.findall(value)}
        original = one.get("href", one.get(XLINK_HREF, "#"))[1:]
        found[one] = inherited | {original} if original else inherited
        left += [(each, inherited) for each in one]
    return found


def _drawn(
    one: ET.Element, path: Path, named: Mapping[str | None, ET.Element],
    referring: Mapping[ET.Element, frozenset[str]], level: int = 1, given: frozenset[str] = frozenset(),
) -> Iterator[ET.Element]:  # fmt: skip
    """Yield an element and all within it, each time that it is used; what is used inherits what is `given`."""
    if level > DEEPEST:
        raise UsageError(f"{path}: elements within elements on more than {DEEPEST} levels; ungroup some")
    yield one
    for each in one:
        yield from _drawn(each, path, named, referring, level + 1, given)
    passed = referring[one] | given if one.tag == f"{SVG}use" else frozenset()
    original = one.get("href", one.get(XLINK_HREF, "#"))[1:]
    for name in sorted((referring[one] | given) & {key for key in named if key}):
        used = passed - {original} if name == original else frozenset()
        yield from _drawn(named[name], path, named, referring, level + 1, used)


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
        if key.startswith("data-") and key not in (SIGNAL, FILL, *ENDS):
            continue
        if key.lower().startswith("on") or (key == "href" and not value.startswith("#")) or OUTSIDE.search(value):
            raise UsageError(f'{path}: {key}="{value[:QUOTED]}" reaches outside the drawing; remove it')
        found[key] = PREFIX + value if key == "id" else INSIDE.sub(rf"url(#{PREFIX}\2)", value)
    if "href" in found:
        found["href"] = f"#{PREFIX}{found['href'][1:]}"
    return found


def _show_named(text: ET.Element) -> None:
    """Make {h1}, a text or a part of it, one that shows this signal."""
    named = NAMED.fullmatch((text.text or "").strip())
    if named is not None and not len(text):
        text.text = ""
        text.set(SIGNAL, named[1])
        return
    children = list(text)
    words = [text.text or "", *(child.tail or "" for child in children)]
    text.text, text[:] = "", []
    for child, piece in zip([None, *children], words, strict=True):
        before, *named_and_after = NAMED.split(piece)
        if child is None:
            text.text = before
        else:
            child.tail = before
            text.append(child)
        for name, after in zip(named_and_after[::2], named_and_after[1::2], strict=True):
            ET.SubElement(text, f"{SVG}tspan", {SIGNAL: name}).tail = after


def _check_bound(one: ET.Element, path: Path, signals: Collection[str]) -> None:
    """Check that an element that shows a signal can, and that there is this signal."""
    for name in {SIGNAL, FILL} & set(one.attrib):
        signal = one.attrib[name]
        if signal not in signals:
            raise UsageError(f"{path}: {signal[:QUOTED]} is no signal of this process: {', '.join(signals)}")
        what = f'{path}: <{one.tag.removeprefix(SVG)} {name}="{signal}">'
        if name == SIGNAL and one.tag not in TEXTS and "tag" not in one.get("class", "").split():
            raise UsageError(f'{what}: a value is shown by a text, or by <g class="tag">')
        if name == FILL and (one.tag != f"{SVG}rect" or None in map(_number, (one.get("y", "0"), one.get("height")))):
            raise UsageError(f"{what}: what is filled is a rect, with y and height in plain numbers")
        ends = [_number(one.get(end, default)) for end, default in zip(ENDS, ("-inf", "inf"), strict=True)]
        if None in ends or ends[0] == ends[1]:
            raise UsageError(f"{what}: data-low and data-high are two different numbers")


def _number(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return None if math.isnan(number) else number
