"""The settings of a study's runs: the paper's, and what a request changes; digests of outside parts they name."""

import hashlib
import sys
from functools import lru_cache
from pathlib import Path
from typing import Final

from coldloop.config import load_configuration
from coldloop_optimizer_plc.computing_settings import OutsideSettings, Part, loaded
from coldloop_rig.settings import Settings

PAPER: Final = ("model.file=cold-box", "optimizer_plc.program.preset=paper")


@lru_cache(maxsize=1024)
def settings_of(assignments: tuple[str, ...]) -> Settings:
    """Return the settings of a request, of the cold box unless it names a model; the environment does not count."""
    return load_configuration(Settings, environment={}, assignments=(*PAPER, *assignments)).settings


def outside_digests(settings: OutsideSettings) -> dict[str, str]:
    """Return the digest of each outside part that the settings name, by `part name`.

    Raises ConfigurationError if a part is not installed, or cannot be imported.
    """
    names = {part: getattr(settings, part) for part in Part}
    return {f"{part} {name}": _digest(part, name) for part, name in names.items() if name}


@lru_cache(maxsize=64)
def _digest(part: Part, name: str) -> str:
    """Return the digest of all Python files of the package, or of the module if it is in none."""
    made = loaded(part, name)
    module = sys.modules[getattr(made, "__module__", type(made).__module__).partition(".")[0]]
    folders = [Path(folder) for folder in getattr(module, "__path__", ())]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    own = getattr(module, "__file__", None)
    content = hashlib.sha256(f"{made.__module__}.{getattr(made, '__qualname__', '')}".encode())
    for file in files or ([Path(own)] if own else []):
        content.update(file.read_bytes())
    return content.hexdigest()[:20]
