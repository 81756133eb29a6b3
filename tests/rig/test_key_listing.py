"""Keys of a file as a table, compared with one that was written by hand."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat

from coldloop_rig.cli.listings import key_listing


class _Section(BaseModel):
    model_config = ConfigDict(use_attribute_docstrings=True)


class Valve(_Section):
    """A valve.

    Of any kind.
    """

    span: tuple[float, float] = (0.0, 100.0)
    """Of its
    opening."""


class Line(_Section):
    """A line."""

    name: str
    """Its name."""
    length_m: PositiveFloat | None = None
    """Unknown if not given."""
    drop: float = 0.0
    """Of pressure."""
    bends: Annotated[tuple[Annotated[int, Field(ge=0, lt=360)], ...], Field(max_length=3)] = ()
    """In degrees."""
    valves: tuple[Valve, ...] = ()
    """On it."""
    main: Valve | None = None
    """At its beginning."""


def test_each_section_has_a_table() -> None:
    assert (
        key_listing(Line)
        == """\
| key | value | if not given | meaning |
|---|---|---|---|
| `name` | text | *needed* | Its name. |
| `length_m` | number, above 0 |  | Unknown if not given. |
| `drop` | number | `0.0` | Of pressure. |
| `bends` | list: whole number, at least 0, below 360 |  | In degrees. |
| `valves` | sections |  | On it. |
| `main` | section |  | At its beginning. |

### `[[valves]]`

A valve.

| key | value | if not given | meaning |
|---|---|---|---|
| `span` | two numbers, [low, high] | `[0.0, 100.0]` | Of its opening. |

### `[main]`

As `[[valves]]`.
"""
    )


class Kind(StrEnum):
    """What it is."""

    WATER = "water"
    HELIUM = "helium"


class Tank(BaseModel):
    """A tank.

    Args:
        level: Where it stands,
            in the middle.
    """

    level: float = 0.5
    kind: Kind = Kind.HELIUM
    open: bool = False
    map: Path = Path("/somewhere/map.json")
    spans: tuple[float, float, float] = (1.0, 2.0, 3.0)
    """Its sides."""


def test_what_is_said_of_a_key_is_found_below_it_among_arguments_or_at_what_it_holds() -> None:
    rows = key_listing(Tank).splitlines()[2:]
    assert rows == [
        "| `level` | number | `0.5` | Where it stands, in the middle. |",
        '| `kind` | `water`, `helium` | `"helium"` | What it is. |',
        "| `open` | true or false | `false` |  |",
        "| `map` | file | `map.json`, shipped |  |",
        "| `spans` | three numbers | `[1.0, 2.0, 3.0]` | Its sides. |",
    ]
