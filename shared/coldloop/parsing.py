"""JSON and TOML from outside, read within bounds.

How deep a text the standard library's parsers can read depends on the version of Python, and what they return can be
too deep for code that descends into it. All that is read from a file, a peer or a user is therefore read here, and has
at most `MOST_LEVELS` levels.
"""

import json
import tomllib
from collections.abc import Callable, Iterable
from typing import Any, Final, TypeVar

T = TypeVar("T")

MOST_LEVELS: Final = 32
"""Objects (tables) and arrays within one another, at most."""
TOO_DEEP: Final = f"nested too deeply: more than {MOST_LEVELS} levels"
TOO_MANY_DIGITS: Final = "a number has too many digits"


def parsed_json(text: str | bytes, *, parse_constant: Callable[[str], object] | None = None) -> Any:  # noqa: ANN401
    """Return what a JSON text holds.

    Args:
        text: The text; bytes are UTF-8, UTF-16 or UTF-32.
        parse_constant: What `NaN`, `Infinity` and `-Infinity` are read by; floats by default.

    Raises:
        ValueError: It is not JSON, or beyond what can be read: a number of thousands of digits, too many levels.
    """
    try:
        return _bounded(json.loads(text, parse_constant=parse_constant))  # noqa: TID251
    except RecursionError:
        raise ValueError(TOO_DEEP) from None


def parsed_toml(text: str) -> dict[str, Any]:
    """Return what a TOML text holds.

    Raises:
        ValueError: It is not TOML, or beyond what can be read: a number of thousands of digits, too many levels.
    """
    try:
        tree = tomllib.loads(text)  # noqa: TID251
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:
        raise ValueError(TOO_MANY_DIGITS) from None
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    return _bounded(tree)


def _bounded(tree: T) -> T:
    """Return a document that is not too deep."""
    level: list[object] = [tree]
    for _ in range(MOST_LEVELS):
        level = [part for one in level for part in _parts(one) if isinstance(part, dict | list)]
        if not level:
            return tree
    raise ValueError(TOO_DEEP)


def _parts(value: object) -> Iterable[object]:
    if isinstance(value, dict):
        return value.values()
    return value if isinstance(value, list) else ()
