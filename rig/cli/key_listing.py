"""Keys of the files that users write, as Markdown, from the models that check them; `docs/keys.md` is made of it."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from pydantic import BaseModel

from coldloop.config import as_toml
from rig.text_tables import markdown_table

Schema = Mapping[str, Any]
"""A JSON schema, or a part of one."""

HEADER: Final = ("key", "value", "if not given", "meaning")
NEEDED: Final = "*needed*"
WORDS: Final = {"integer": "whole number", "number": "number", "string": "text", "object": "table"}
LIMITS: Final = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}


def key_listing(model: type[BaseModel]) -> str:
    """Return a table of the keys of each section, those of nested ones with their headings."""
    schema = model.model_json_schema()
    return "\n".join(_tables(schema, schema.get("$defs", {}), ""))


def _tables(section: Schema, sections: Schema, place: str) -> Iterator[str]:
    """Yield the table of a section, and of those within it, whose names begin with `place`."""
    keys: Schema = section["properties"]
    rows = [
        (f"`{key}`", _value(said), NEEDED if key in section.get("required", ()) else _default(said), _meaning(said))
        for key, said in keys.items()
    ]
    yield f"{markdown_table(HEADER, rows)}\n"
    for key, said in keys.items():
        name = _section(said)
        if name:
            heading = f"[[{place}{key}]]" if _one(said)["type"] == "array" else f"[{place}{key}]"
            yield f"### `{heading}`\n\n{sections[name]['description'].splitlines()[0]}\n"
            yield from _tables(sections[name], sections, f"{place}{key}.")


def _one(said: Schema) -> Schema:
    """Return what is said of a value where it is given."""
    kinds = [kind for kind in said.get("anyOf", (said,)) if kind.get("type") != "null"]
    return {"type": "object", **kinds[0]}


def _section(said: Schema) -> str:
    """Return the name of the section that a key holds, or a list of; empty where it holds none."""
    one = _one(said)
    return str(one.get("items", one).get("$ref", "")).rpartition("/")[2]


def _value(said: Schema) -> str:
    """Return type and range of a value."""
    one = _one(said)
    if _section(said):
        return "sections" if one["type"] == "array" else "section"
    if one["type"] != "array":
        limits = (f"{word} {one[limit]:g}" for limit, word in LIMITS.items() if limit in one)
        return ", ".join([WORDS[one["type"]], *limits])
    if "prefixItems" in one:
        return "two numbers, [low, high]"
    return f"list: {_value(one['items'])}"


def _default(said: Schema) -> str:
    default = said.get("default")
    return "" if _section(said) or default in (None, "", [], {}) else f"`{as_toml(default)}`"


def _meaning(said: Schema) -> str:
    return " ".join(str(said.get("description", "")).split())
