"""Configuration of metrics and telemetry of a service, checked when it is made and immutable after."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, Field, PositiveFloat, field_validator, model_validator

from coldloop.errors import ConfigurationError
from coldloop.text import read_text


class MetricsSettings(BaseModel, frozen=True, extra="forbid"):
    """Address at which a service serves its registers as metrics.

    Args:
        host: Address to listen on.
        port: TCP port; 0 is off.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=0xFFFF)] = 0


class TelemetrySettings(BaseModel, frozen=True, extra="forbid"):
    """Settings of the broker to publish to."""

    broker: str = ""
    """Host of the broker; empty is off."""
    port: Annotated[int, Field(ge=1, le=65535)] = 1883
    """Its TCP port."""
    username: str = ""
    """Name at the broker; empty is a broker that asks for none."""
    password_file: Path | None = None
    """File that holds the password for it, on one line. It is read at each connection; without TLS it is sent as it
    is, so this is for a private network."""
    prefix: Annotated[str, Field(pattern=r"^[^#+]+$")] = "coldloop"
    """Prefix of topics; a rig at other ports than the usual ones adds its first port, unless this is set."""
    period_s: PositiveFloat = 1.0
    """Real time between snapshots."""
    queue: Annotated[int, Field(ge=1)] = 100
    """Snapshots kept while the broker is away; the oldest go first."""
    timeout_s: PositiveFloat = 5.0
    """How long connecting may take, s."""

    @field_validator("broker")
    @classmethod
    def _is_a_host(cls, value: str) -> str:
        if value.count(":") == 1 or set("/[]") & set(value):
            raise ValueError("name its host alone; the port is telemetry.port")
        return value

    @model_validator(mode="after")
    def _password_belongs_to_a_name(self) -> Self:
        if self.password_file and not self.username:
            raise ValueError("a password needs a name: set telemetry.username")
        return self

    def password(self) -> str | None:
        """Return the password, if one is set (ConfigurationError: the file cannot be read)."""
        if self.password_file is None:
            return None
        return read_text(self.password_file, "telemetry.password_file names it", ConfigurationError).rstrip("\r\n")
