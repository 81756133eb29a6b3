"""Where a client finds a server."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat

from coldloop.modbus.settings import TlsSettings
from coldloop.registers.codec import WordOrder

PLANT_PORT = 5020
CONTROL_PORT = 5021
OPTIMIZER_PORT = 5022


class Endpoint(BaseModel):
    """Address of a Modbus/TCP server."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    """Name or address."""
    port: Annotated[int, Field(ge=1, le=65535)]
    """TCP port."""
    word_order: WordOrder = WordOrder.HIGH_FIRST
    timeout_s: PositiveFloat = 3.0
    """How long an answer may take."""
    tls: TlsSettings | None = None
    """Modbus/TCP Security instead of plain Modbus/TCP."""
