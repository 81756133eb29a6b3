"""Configuration of the metrics of a service, checked when it is made and immutable after."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class MetricsSettings(BaseModel):
    """Address at which a service serves its registers as metrics.

    Args:
        host: Address to listen on.
        port: TCP port; 0 is off.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=0xFFFF)] = 0
