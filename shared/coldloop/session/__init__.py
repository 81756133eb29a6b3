"""A session: one run of the rig from tick 0, in lock-step or in real time, and its time base."""

from enum import StrEnum
from typing import Annotated, NamedTuple

from pydantic import BaseModel, Field


class TimeMode(StrEnum):
    """Mode in which plant time advances."""

    LOCKSTEP = "lockstep"
    """The control PLC, as fast as the optimiser answers."""
    REALTIME = "realtime"
    """The clock."""


class SessionSettings(BaseModel, frozen=True, extra="forbid"):
    """Settings of the session that a service begins when it starts, before the first command."""

    autostart: bool = False
    """Begin session 1 at once instead of waiting for an operator."""
    mode: TimeMode = TimeMode.LOCKSTEP
    factor: Annotated[float, Field(ge=0.01, le=10_000)] = 1.0
    """Seconds of plant time in one second of real time, in real time."""


class TimeBase(NamedTuple):
    """Time base of a session; in lock-step the factor has no meaning."""

    realtime: bool
    factor: float
    """Seconds of plant time in one second of real time."""
    paused: bool = False
    """In real time: plant time is stopped until it is resumed."""
