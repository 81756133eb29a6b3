"""Which prediction model a PLC runs."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict

DEFAULT_MODEL_FILE = Path(__file__).parent / "data" / "cold_box_model.json"


class ModelSettings(BaseModel):
    """The LTI model file, downloaded into both PLCs."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    file: Path = DEFAULT_MODEL_FILE
