"""Pages of the documentation that are made from the code, as Markdown: all commands, and the keys of users' files.

`docs/commands.md`, `docs/keys.md` and `docs/configuration.md` are made of them.
"""

import argparse
import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np
from pydantic import BaseModel

from coldloop import config, errors
from coldloop.process.cold_box import L1, T5
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.model_file import COLD_BOX
from coldloop.process.settings import InputLimits
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_plant.cold_box import ColdBox, plant_file
from coldloop_plant.cold_box import model as cold_box
from coldloop_plant.helium import load_helium
from coldloop_plant.kinds import kind_named
from coldloop_plant.settings import StationSettings
from coldloop_rig import cli, text_tables

Schema = Mapping[str, Any]
"""A JSON schema, or a part of one."""

WORDS: Final = {
    "integer": "whole number", "number": "number", "string": "text", "object": "table", "boolean": "true or false",
}  # fmt: skip
ARGUMENT: Final = re.compile(r"^    (\w+): (.*(?:\n     +.*)*)", re.MULTILINE)
"""Pattern of an argument in a docstring."""
FORMATS: Final = {"path": "file", "ipvanynetwork": "address or network"}
COUNTS: Final = {1: "one number", 2: "two numbers", 3: "three numbers"}
LIMITS: Final = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}


def key_listing(model: type[BaseModel]) -> str:
    """Return a table of the keys of each section, those of nested ones with their headings."""
    schema = model.model_json_schema()
    sections = schema.get("$defs", {})
    for name, one in {model.__name__: model, **_models_within(model)}.items():
        section = sections.get(name, schema)
        texts = _attribute_docstrings(one)
        for key, said in section["properties"].items():
            said.setdefault("description", texts.get(key, ""))
    return "\n".join(_tables(schema, sections, "", {}))


def _models_within(model: type[BaseModel]) -> dict[str, type[BaseModel]]:
    """Return the models that the fields of a model hold, and those within, by name."""
    found: dict[str, type[BaseModel]] = {}
    left = [field.annotation for field in model.model_fields.values()]
    while left:
        kind = left.pop()
        left += get_args(kind)
        if isinstance(kind, type) and issubclass(kind, BaseModel) and kind.__name__ not in found:
            found[kind.__name__] = kind
            left += [field.annotation for field in kind.model_fields.values()]
    return found


def _attribute_docstrings(model: type[BaseModel]) -> dict[str, str]:
    """Return the text below each field of a model and of those that it is made from, or among their arguments."""
    texts: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        if kind.__module__.partition(".")[0] in ("pydantic", "builtins"):
            continue
        for name, text in ARGUMENT.findall(inspect.getdoc(kind) or ""):
            texts[name] = " ".join(text.split())
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        for field, text in pairwise(getattr(body, "body", ())):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
                texts[field.target.id] = inspect.cleandoc(str(getattr(text.value, "value", "")))
    return texts


def _tables(section: Schema, declared: Schema, place: str, told: dict[str, str]) -> Iterator[str]:
    """Yield the table of a section, and of those within it, whose names begin with `place`; each kind once."""
    keys: Schema = section["properties"]
    rows = []
    for key, said in keys.items():
        default = "*needed*" if key in section.get("required", ()) else _default(said, declared)
        held = str(_declared(said, declared).get("description", "")).partition("\n\n")[0]
        meaning = " ".join(str(said.get("description") or held).split())
        rows.append((f"`{key}`", _value(said, declared), default, meaning))
    yield f"{text_tables.markdown_table(('key', 'value', 'if not given', 'meaning'), rows)}\n"
    for key, said in keys.items():
        within = _section(said, declared)
        if within is not None:
            heading = f"[[{place}{key}]]" if _one(said)["type"] == "array" else f"[{place}{key}]"
            if within["title"] in told:
                yield f"### `{heading}`\n\nAs `{told[within['title']]}`.\n"
                continue
            told[within["title"]] = heading
            yield f"### `{heading}`\n\n{within['description'].splitlines()[0]}\n"
            yield from _tables(within, declared, f"{place}{key}.", told)


def _one(said: Schema) -> Schema:
    """Return what is said of a value where it is given."""
    kinds = [kind for kind in said.get("anyOf", (said,)) if kind.get("type") != "null"]
    return {"type": "object", **kinds[0]}


def _declared(said: Schema, declared: Schema) -> Schema:
    """Return what is declared elsewhere of a value, or of each in a list."""
    one = _one(said)
    found: Schema = declared.get(str(one.get("items", one).get("$ref", "")).rpartition("/")[2], {})
    return found


def _section(said: Schema, declared: Schema) -> Schema | None:
    """Return the section that a key holds, or a list of; None where it holds none."""
    found = _declared(said, declared)
    return found if "properties" in found else None


def _value(said: Schema, declared: Schema) -> str:
    """Return type and range of a value."""
    one = {**_one(said), **({} if "items" in _one(said) else _declared(said, declared))}
    if _section(said, declared):
        return "sections" if one["type"] == "array" else "section"
    if "enum" in one:
        return ", ".join(f"`{each}`" for each in one["enum"])
    if one["type"] != "array":
        limits = (f"{word} {one[limit]:g}" for limit, word in LIMITS.items() if limit in one)
        return ", ".join([FORMATS.get(one.get("format", ""), WORDS[one["type"]]), *limits])
    if "prefixItems" in one:
        count = len(one["prefixItems"])
        return f"{COUNTS[count]}{', [low, high]' * (count == 2)}"
    if "each" in one:
        return f"{COUNTS[one['maxItems']]}, one for each {one['each']}"
    return f"list: {_value(one['items'], declared)}"


def _default(said: Schema, declared: Schema) -> str:
    default = said.get("default")
    if _one(said).get("format") == "path" and default:
        return f"`{Path(default).name}`, shipped"
    return "" if _section(said, declared) or default in (None, "", [], {}) else f"`{config.as_toml(default)}`"


def command_listing() -> str:
    """Return a section for each group of commands, with a table of the options of each."""
    parts = []
    for group, commands in cli.command_groups().items():
        parts.append(f"## {group[0].upper()}{group[1:]}\n")
        for name in commands:
            parts += _of_command(_subparsers(cli.make_parser(name))[name], f"coldloop {name}", "###")
    return "\n".join(parts)


def _of_command(parser: argparse.ArgumentParser, name: str, level: str) -> Iterator[str]:
    summary = (parser.description or "").partition(": ")[2] or parser.description or ""
    yield f"{level} `{name}`\n"
    if summary.strip():
        yield f"{_cell(summary.strip()[0].upper() + summary.strip()[1:])}\n"
    rows = [
        (_written(each), _cell(each.help or ""))
        for each in parser._actions  # noqa: SLF001 argparse has no other way
        if each.dest != "help" and each.help != argparse.SUPPRESS
        and not isinstance(each, argparse._SubParsersAction)  # noqa: SLF001
    ]  # fmt: skip
    if rows:
        yield f"{text_tables.markdown_table(('option', 'meaning'), rows)}\n"
    for sub, one in _subparsers(parser).items():
        yield from _of_command(one, f"{name} {sub}", f"{level}#")


def _subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    found: dict[str, argparse.ArgumentParser] = {}
    for each in parser._actions:  # noqa: SLF001
        if isinstance(each, argparse._SubParsersAction):  # noqa: SLF001
            found |= each.choices
    return found


def _written(action: argparse.Action) -> str:
    """Return how an option or an argument is written, with its value."""
    value = action.metavar or ("|".join(map(str, action.choices)) if action.choices else action.dest.upper())
    values = " ".join(value) if isinstance(value, tuple) else value
    if not action.option_strings:
        return f"`{values}`".replace("|", "\\|")
    shown = (f"{option} {values}" if action.nargs != 0 else option for option in action.option_strings)
    return f"`{', '.join(shown)}`".replace("|", "\\|")


def _cell(text: str) -> str:
    return " ".join(text.replace("%%", "%").split()).replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(command_listing())


DEFAULT_CONTROL: Final = StationSettings()
HORIZON_S = 100.0
"""Time after which the gains are given: the level integrates, so there are no final ones."""


def describe_model(
    in_use: Path, plant: plant_file.PlantFile, design: ControlDesign, control: StationSettings = DEFAULT_CONTROL
) -> tuple[LtiModel, str, ColdBox]:
    """Solve for the operating point and linearise there; return the model and its description.

    The cold box with them has the temperature after the pre-cooler that it has at steady state.

    Args:
        in_use: Model file that is configured, which is compared by its digest.
        plant: The cold box or the refrigerator, and its operating point.
        design: Whose bands the outputs at rest are compared with.
        control: Of a refrigerator's pressures; its weights decide the gains.

    Raises:
        NoEquilibriumError: The plant does not come to rest there; one line that says why.
    """
    helium = load_helium()
    if plant.kind == COLD_BOX:
        found = cold_box.operating_point(plant, helium)
        at_rest = cold_box.AtRest(found, plant.box, cold_box.model_at(found, plant.box, helium, plant.parameters))
    else:
        at_rest = kind_named(plant.kind).at_rest(plant, control)
    rest, box, model, lines_of_kind = at_rest
    error = cold_box.linearisation_error(rest.x, rest.u, rest.w, box, helium)
    values = sorted(np.linalg.eigvals(model.A), key=lambda value: -value.real)
    texts = [f"{v.real:.4f}" if abs(v.imag) < 1e-12 else f"{v.real:.4f}{v.imag:+.4f}i" for v in values]
    held = model.discretised(HORIZON_S)
    effects = np.column_stack([model.C @ held.B + model.D, model.C @ held.F + model.G])
    given = zip(model.input_names, rest.u, model.input_units, strict=True)
    inputs = ", ".join(f"{name} {value:g} {unit}" for name, value, unit in given)
    found_outputs = zip(model.output_names, rest.y, model.output_units, strict=True)
    outputs = [f"{name} {value:.4f} {unit}" for name, value, unit in found_outputs]
    signals = zip((*model.input_names, model.load_name), (*model.input_units, model.load_unit), strict=True)
    kink = "kink       derivatives differ on both sides: the second law limits cells of NEF1 or NEF2; less UA there"
    lines = [
        f"operating point: {inputs}, load {rest.w:.2f} W; cold power {rest.w + rest.u[1]:.2f} W",
        f"residual   {rest.residual:.2e} per second (2 kPa, 1 % of level, 1 K)",
        *(f"outputs    {'  '.join(outputs[i : i + 6])}" for i in range(0, len(outputs), 6)), *lines_of_kind,
        *(f"eigenvalues {'  '.join(texts[i : i + 10])} /s" for i in range(0, len(texts), 10)),
        f"derivatives within {error:.1e} of extrapolated central differences (scaled)",
        *(f"after {HORIZON_S:g} s of +1 {unit} {name}: L1 {effects[L1, i]:+.5f} %, T5 {effects[T5, i]:+.5f} K"
          for i, (name, unit) in enumerate(signals)),
        *([kink] if error >= 1e-3 else []), *_band_lines(rest, design), f"model      sha256 {model.digest}",
    ]  # fmt: skip
    with suppress(errors.ModelFileError):  # the command then says what is wrong with it
        configured = load(in_use)
        lines.append(f"in use     sha256 {configured.digest} ({in_use})")
        lines += [f"           {errors.printable(configured.note)}"] if configured.note else []
    return model, "\n".join(lines) + "\n", box


def held_line(box: ColdBox, level: float, design: ControlDesign, limits: InputLimits) -> str:
    """Return which loads are held with L1 as in its file and T5 within its band: some seconds of computing."""
    openings = [np.linspace(limits.low[k], limits.high[k], count) for k, count in ((0, 21), (2, 3))]  # CV155, CV156
    heater, warmth = (limits.low[1], limits.high[1]), (design.output_low[1], design.output_high[1])
    try:
        with np.errstate(all="ignore"):
            least, largest = cold_box.held_loads(box, load_helium(), level, openings[0], heater, openings[1], warmth)
    except ValueError:
        return "holds      no load with T5 within its band\n"
    loads = f"[{max(least.w, 0.0):.0f},{max(largest.w - cold_box.LOOP_MARGIN, 0.0):.0f}]"
    return f"holds      loads of {loads} W at least: --set optimizer_plc.program.holdable_load_w={loads}\n"


def _band_lines(rest: cold_box.Equilibrium, design: ControlDesign) -> list[str]:
    """Return the settings to change where a steady-state output is outside its band."""
    bands = zip((L1, T5), ("L1", "T5"), ("%", "K"), design.output_low, design.output_high, strict=True)
    return [
        f"outside    {name} rests at {rest.y[k]:.2f} {unit}, its band is {low:g} to {high:g} {unit}: set"
        " optimizer_plc.program.design.output_low and output_high, and the bands of control_plc.alarms"
        for k, name, unit, low, high in bands
        if not low <= rest.y[k] <= high
    ]
