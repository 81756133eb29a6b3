"""Which prediction model a PLC runs."""

from pathlib import Path
from typing import Annotated, Final

from pydantic import BaseModel, BeforeValidator, ConfigDict

from coldloop.process.loaded import FILE as PROCESS_FILE

_DATA: Final = Path(__file__).parent / "data"
DEFAULT_MODEL_FILE: Final = PROCESS_FILE or _DATA / "cold_box_model.json"
"""Of the process that programs are loaded with."""
SHIPPED_MODELS: Final = {"cold-box": _DATA / "cold_box_model.json", "refrigerator": _DATA / "refrigerator_model.json"}
"""Models that have a name: of the cold box alone, and of the refrigerator with its pressure loop closed."""


def _named(value: object) -> object:
    return SHIPPED_MODELS.get(value, value) if isinstance(value, str) else value


class ModelSettings(BaseModel):
    """The LTI model file, downloaded into both PLCs."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    file: Annotated[Path, BeforeValidator(_named)] = DEFAULT_MODEL_FILE
    """A file, or `cold-box` or `refrigerator` for one that is shipped."""
