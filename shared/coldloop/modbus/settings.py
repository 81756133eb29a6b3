"""How a server is set up."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field


class ServerSettings(BaseModel):
    """Where a server listens, whom it answers and how many.

    Args:
        host: Address to listen on.
        port: TCP port; 0 takes any free one.
        unit_ids: Unit ids that are answered. Clients that talk to the server itself use 255, 0 or 1.
        unknown_unit: Other unit ids are refused with exception 0x0B, or left without an answer.
        connection_limit: Connections served at a time; a further one replaces the one that has been idle longest.
        idle_timeout_s: A connection without a whole request for this long is closed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    port: int = Field(ge=0, le=0xFFFF)
    unit_ids: frozenset[Annotated[int, Field(ge=0, le=255)]] = frozenset({0, 1, 255})
    unknown_unit: Literal["refuse", "silence"] = "refuse"
    connection_limit: int = Field(default=32, ge=1)
    idle_timeout_s: float = Field(default=300.0, gt=0)
