"""What an operator's commands read of the configuration; it imports no service, for they are to answer at once."""

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
    """What a client has to know of a service; its other keys are the service's."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    word_order: WordOrder = WordOrder.HIGH_FIRST


class OperatorSettings(RootSettings):
    """What an operator's client reads of a configuration."""

    limits: InputLimits = Field(default_factory=InputLimits)
    plant: ServerPlace = ServerPlace()
    control_plc: ServerPlace = ServerPlace()
    optimizer_plc: ServerPlace = ServerPlace()
    rig: RigSection = RigSection()
