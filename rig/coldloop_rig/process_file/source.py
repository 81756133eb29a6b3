"""The Python source of a plant: of a file beside the process file, or of a package that is installed."""

from importlib.metadata import entry_points
from importlib.util import decode_source, find_spec
from pathlib import Path
from typing import Final

from coldloop.errors import UsageError
from coldloop.text_file import read_bytes

GROUP: Final = "coldloop.plants"
"""Of entry points: classes with the equations of a plant."""


def source_of(folder: Path, place: str) -> tuple[str, str]:
    """Return the text of the file that `file.py:NAME` names, and the name.

    Raises:
        UsageError: It cannot be read.
    """
    file, _, name = place.partition(":")
    data = read_bytes(folder / file, "a plant's file is looked for beside the process file")
    try:
        return decode_source(data), name  # as Python reads it: byte order mark, declared encoding
    except (SyntaxError, UnicodeDecodeError) as error:
        raise UsageError(f"{folder / file}: {error}; save it as UTF-8") from None


def installed_source(name: str) -> tuple[str, str]:
    """Return the text of the module of an entry point, and the name of its class.

    Raises:
        UsageError: There is none, or it has no source.
    """
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
