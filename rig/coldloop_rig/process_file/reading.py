"""Reads a process file and what it names: sources of plants, courses of disturbances, a drawing; or makes its model."""

import math
import re
import signal
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from importlib.metadata import entry_points
from importlib.util import decode_source, find_spec
from itertools import islice, pairwise
from keyword import iskeyword
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree as ET

from coldloop import config, table
from coldloop.errors import ColdloopError, ConfigurationError, UsageError
from coldloop.kernels.cache import find_cache_folder
from coldloop.process import declaration, sections
from coldloop.text import read_bytes, read_text
from coldloop_rig.interruption import SIGNALS

LISTING: Final = "`coldloop docs keys` lists all keys"
RESERVED: Final = frozenset((
    "tick", "session", "holder", "generation", "crc", "mode", "update", "u", "time_s", "load", "load_w", "cause",
    "driver", "bad_sensors", "stage_cost", "tau_u_s", "iterations", "j", "model_range", "none", "no_load",
))  # fmt: skip
"""Fields of registers and columns of a trace, in small letters."""
OWN: Final = ("plants", "shipped_mimic", "iterations", "forecasts", "drawing")
"""Keys of the cold box, and what is found with a model: no file of a user gives them."""


def read_process_file(path: Path) -> declaration.Process:
    """Return what a process file says. Raises ConfigurationError: one line that names file, key and remedy."""
    file = config.load_configuration(
        declaration.Process, file=path, environment={}, option="FILE", listing=LISTING
    ).settings
    if wrong := _wrong(file):
        raise ConfigurationError(f"{path}: {wrong}")
    return file


def _wrong(file: declaration.Process) -> str:  # noqa: PLR0911 a return for each
    """Return what is wrong with a process that is still without its model; empty where nothing is."""
    if own := [str(key) for key in OWN if key in file.model_fields_set]:
        return f"{own[0]}: is found with the model, or the cold box's own; leave it out"
    if own := [one.name for one in file.outputs if one.quantity]:
        return f"{own[0]}: a quantity is the cold box's own; leave it out"
    plant, signals = file.plant, (*file.inputs, *file.outputs, *file.outside)
    names = [each.name for each in signals]
    lower = [name.lower() for name in names]
    reserved = RESERVED.intersection(lower) | {name for name in names if iskeyword(name) or iskeyword(name.lower())}
    if plant == type(plant)():
        return "plant: is missing; say where it comes from, as in `coldloop docs your-plant`"
    if twice := [name for name in names if lower.count(name.lower()) > 1]:
        return f"{twice[0]}: two signals have this name (small and capital letters are the same)"
    if reserved:
        return f"{min(reserved)}: a register, a column or Python has this name already; choose another"
    if file.prediction.step_test and (plant.matrices or plant.step_test):
        return "prediction.step_test: plant.matrices and plant.step_test are a model already; keep one"
    if plant.fmu is None and (named := [one.name for one in signals if one.variable]):
        return f"{named[0]}: variable is for an FMU"
    return ""


GROUP: Final = "coldloop.plants"
"""Group of entry points: classes with the equations of a plant."""


def source_of(folder: Path, place: str) -> tuple[str, str]:
    """Return the text of the file that `file.py:NAME` names, and the name. Raises UsageError: it cannot be read."""
    file, _, name = place.partition(":")
    data = read_bytes(folder / file, "a plant's file is looked for beside the process file")
    try:
        return decode_source(data), name  # as Python reads it: byte order mark, declared encoding
    except (SyntaxError, UnicodeDecodeError) as error:
        raise UsageError(f"{folder / file}: {error}; save it as UTF-8") from None


def installed_source(name: str) -> tuple[str, str]:
    """Return the text of an entry point's module, and the name of its class. Raises UsageError: there is no source."""
    there = entry_points(group=GROUP)
    if name not in there.names:
        known = ", ".join(sorted(there.names)) or "none is installed"
        raise UsageError(f"plant.installed: no plant '{name}' among the entry points {GROUP}: {known}")
    point = there[name]
    try:
        spec = find_spec(point.module)
        if spec is None or spec.origin is None:
            raise ImportError(f"no module {point.module}")  # noqa: TRY301 told as the others
        return decode_source(Path(spec.origin).read_bytes()), point.attr
    except Exception as error:
        said = " ".join(str(error).split())
        raise UsageError(
            f"plant.installed: {name}, {point.value}, has no source: {type(error).__name__}: {said}"
        ) from error


def courses_of(file: declaration.Process, folder: Path) -> dict[str, Any]:
    """Return what a model file says of the disturbances among the plant's parameters; nothing if there are none.

    Raises UsageError: a course cannot be read, or leaves the span: one line.
    """
    if not file.disturbances:
        return {}
    found = []
    for one in file.disturbances:
        ticks, values = ([0], [one.at]) if one.course is None else _steps(one, folder / one.course, file.tick_s)
        found.append({"ticks": ticks, "values": values, "measured": one.noise is not None})
    return {"disturbances": found}


def forecasts_of(file: declaration.Process, folder: Path) -> tuple[sections.Forecast, ...]:
    """Return what the optimiser expects. Raises UsageError: a forecast cannot be read, or leaves the span: one line."""
    return tuple(
        sections.Forecast(name=one.name, ticks=tuple(ticks), values=tuple(values))
        for one in file.outside
        if one.forecast is not None
        for ticks, values in [_steps(one, folder / one.forecast, file.tick_s)]
    )


def _steps(one: sections.Load | sections.Disturbance, path: Path, tick_s: float) -> tuple[list[int], list[float]]:
    """Return ticks and values of a CSV file with time_s and the name of a signal."""
    wanted = (table.TIME, one.name)
    times, values = table.read_table(path, wanted, "name a CSV file beside the process file").columns(wanted)
    ticks = [round(time / tick_s) for time in times]
    if ticks[0] != 0:
        raise UsageError(f"{path}: {table.TIME} begins at {times[0]:g}; it begins at 0, which is when a session begins")
    at = next((at for at, (before, tick) in zip(times[1:], pairwise(ticks), strict=True) if tick <= before), None)
    if at is not None:
        raise UsageError(f"{path}: {table.TIME} = {at:g}: it rises by at least a tick, {tick_s:g} s, from line to line")
    low, high = one.span
    wrong = next((value for value in values if not low <= value <= high), None)
    if wrong is not None:
        raise UsageError(f"{path}: {one.name} = {wrong:g} is outside its span, {low:g} to {high:g}")
    return ticks, values


def text_of_child(path: Path, work: Callable[[], str], limit_s: int) -> str:
    """Return what a child process returns that does this work. Raises ColdloopError: as the work, or it ends early."""
    import multiprocessing  # noqa: PLC0415 a model file is read without

    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    with tempfile.TemporaryDirectory(prefix="coldloop-") as folder:  # whatever ends the child, nothing is left

        def in_child() -> None:
            tempfile.tempdir = folder
            for number in (*SIGNALS, signal.SIGALRM):
                signal.signal(number, signal.SIG_DFL)
            signal.alarm(limit_s)  # it ends this process, whatever runs in it and whether its parent is still there
            try:
                sender.send(work())
            except ColdloopError as error:
                sender.send(error)

        child = context.Process(target=in_child)
        child.start()
        sender.close()
        try:
            found: str | ColdloopError = receiver.recv()
        except EOFError:
            found = ""
        child.join()
    code = child.exitcode or 0
    if code == -signal.SIGALRM:
        found = UsageError(
            f"{path}: its plant has not come to an end within {limit_s} s; mend it, or give it longer with `coldloop "
            "process FILE --limit SECONDS --out MODEL`, and then --process MODEL"
        )
    elif not found:
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        found = UsageError(f"{path}: its plant has ended the process that it ran in ({how}); mend it")
    if isinstance(found, ColdloopError):
        raise found
    return found


def model_file_of(path: Path, *, in_child: bool = False) -> tuple[Path, list[str]]:
    """Return the model file of a process file or a model file, and warnings; that of a process file is made now.

    With `in_child` the plant runs in a process of its own, which ends it when it takes too long. Raises ColdloopError:
    there is no such file, or no model can be made of it.
    """
    if not path.is_file():
        raise UsageError(f"{path}: no such file; name a process file or a model file")
    if path.suffix != ".toml":
        return path.resolve(), []

    def work() -> str:
        from coldloop_rig.process_file import judgement, making  # noqa: PLC0415 a model file is read without

        made = making.made_from(path)
        out = find_cache_folder("processes") / f"{path.stem}-{made.model.digest[:12]}.json"
        made.model.save(out)
        return f"{out}\n{judgement.described(made)}"

    out, *lines = (text_of_child(path, work, limit_s=300) if in_child else work()).splitlines()
    return Path(out), [line for line in lines if line.startswith("warning")]


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
LONGEST: Final = 500_000  # characters: the drawing is in the model file
DEEPEST: Final = 100  # levels of elements within elements, and of what they use
MOST_DRAWN: Final = 50_000  # elements, each counted as often as it is used: more keep a browser busy for minutes
VIEW_BOX: Final = 4  # numbers: left, top, width, height
QUOTED: Final = 60  # characters of a value in a message
PREFIX: Final = "mimic-"
"""Prefix of the ids of its elements, which keeps them apart from those of the page."""


def drawing_of(path: Path, signals: Collection[str]) -> str:
    """Return the drawing of an SVG file as it is in the model file; texts such as {h1} in it show these signals.

    Whatever is not drawing is left out, where an editor has written it, or refused, where it would act. Raises
    UsageError: one line that names file, element and remedy.
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
