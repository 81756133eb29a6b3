"""The Python source of a plant: of a file beside the process file, or of a package that is installed."""

from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from coldloop.errors import UsageError

GROUP: Final = "coldloop.plants"
"""Of entry points: classes with the equations of a plant."""


def source_of(folder: Path, place: str) -> tuple[str, str]:
    """Return the text of the file that `file.py:NAME` names, and the name.

    Raises:
        UsageError: It cannot be read.
    """
    file, _, name = place.partition(":")
    try:
        return (folder / file).read_text(encoding="utf-8"), name
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder / file}: {error}; a plant's file is looked for beside the process file") from None


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
        return Path(spec.origin).read_text(encoding="utf-8"), point.attr
    except Exception as error:
        said = " ".join(str(error).split())
        raise UsageError(
            f"plant.installed: {name}, {point.value}, has no source: {type(error).__name__}: {said}"
        ) from error
