"""Files of this package with places for what is computed: `@NAME@`."""

from collections.abc import Mapping
from importlib.resources import files


def template(name: str) -> str:
    """Return a file of this package, by its path in it."""
    return files("coldloop_rig.plc_export").joinpath(name).read_text(encoding="ascii")


def filled(text: str, parts: Mapping[str, str]) -> str:
    """Return a template with its parts."""
    for name, part in parts.items():
        text = text.replace(f"@{name}@", part)
    return text
