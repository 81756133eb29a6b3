"""Settings that an operator's commands read; no service is imported, so that they answer at once."""

from pydantic import BaseModel, ConfigDict, Field

from coldloop.modbus.settings import TlsSettings
from coldloop.process.settings import InputLimits, RootSettings
from coldloop.registers.codec import WordOrder

OTHERS = ("session", "telemetry", "hmi")
"""Sections that a configuration may have and an operator's client does not read."""


class RigSection(BaseModel):
    """Section `rig` of the configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tls: TlsSettings | None = None
    """The operator's certificate, for servers with TLS."""


class ServerPlace(BaseModel):
    """Keys of a service that its clients need; the other keys are the service's own."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    word_order: WordOrder = WordOrder.HIGH_FIRST


class OperatorSettings(RootSettings):
    """Keys of a configuration that an operator's client reads."""

    limits: InputLimits = Field(default_factory=InputLimits)
    plant: ServerPlace = ServerPlace()
    control_plc: ServerPlace = ServerPlace()
    optimizer_plc: ServerPlace = ServerPlace()
    rig: RigSection = RigSection()
