"""The settings of a study's runs: the paper's, and what a request changes of them."""

from functools import lru_cache
from typing import Final

from coldloop.config import load_configuration
from coldloop_rig.settings import Settings

PAPER: Final = ("model.file=cold-box", "optimizer_plc.program.preset=paper")


@lru_cache(maxsize=1024)
def settings_of(assignments: tuple[str, ...]) -> Settings:
    """Return the settings of a request, of the cold box unless it names a model; the environment does not count."""
    return load_configuration(Settings, environment={}, assignments=(*PAPER, *assignments)).settings
