"""A session: one run of the rig from tick 0, in lock-step or in real time."""

from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class TimeMode(StrEnum):
    """What advances plant time."""

    LOCKSTEP = "lockstep"
    """The control PLC, as fast as the optimiser answers."""
    REALTIME = "realtime"
    """The clock."""


class SessionSettings(BaseModel):
    """What a service does when it starts, before the first command."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    autostart: bool = False
    """Begin session 1 at once instead of waiting for an operator."""
    mode: TimeMode = TimeMode.LOCKSTEP
    factor: Annotated[float, Field(ge=0.01, le=10_000)] = 1.0
    """Seconds of plant time in one second of real time, in real time."""
