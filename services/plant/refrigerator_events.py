"""Events of a refrigerator over time: a compressor trips, nitrogen runs out, helium leaks, the weather changes."""

from bisect import bisect_right
from collections.abc import Sequence
from enum import StrEnum
from math import pi, sin
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from coldloop.process import TICK_S


class EventTarget(StrEnum):
    """What an event changes."""

    NC1 = "nc1"
    """1: the compressor runs, 0: it has tripped."""
    NC2 = "nc2"
    NITROGEN = "nitrogen"
    """1: there is nitrogen in the tank, 0: there is none."""
    LEAK = "leak"
    """From the high-pressure line, g/s at 16 bar."""
    AMBIENT = "ambient"
    """Temperature of the surroundings, K."""


RANGES = {
    EventTarget.NC1: (0.0, 1.0),
    EventTarget.NC2: (0.0, 1.0),
    EventTarget.NITROGEN: (0.0, 1.0),
    EventTarget.LEAK: (0.0, 50.0),
    EventTarget.AMBIENT: (270.0, 320.0),
}


class RefrigeratorEvent(BaseModel):
    """From a time on, something is otherwise."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    at_s: Annotated[float, Field(ge=0, le=1e9)]
    """Plant time, in multiples of 0.25 s."""
    target: EventTarget
    value: float

    @model_validator(mode="after")
    def _is_possible(self) -> "RefrigeratorEvent":
        low, high = RANGES[self.target]
        if not low <= self.value <= high:
            raise ValueError(f"{self.target} = {self.value:g} is outside {low:g} to {high:g}")
        if self.target in {EventTarget.NC1, EventTarget.NC2, EventTarget.NITROGEN} and self.value not in {0.0, 1.0}:
            raise ValueError(f"{self.target} = {self.value:g}: write 0 or 1")
        if self.at_s % TICK_S:
            raise ValueError(f"{self.at_s:g} s is not a multiple of {TICK_S} s")
        return self

    @property
    def tick(self) -> int:
        """The first tick that it concerns."""
        return round(self.at_s / TICK_S)


class Surroundings(NamedTuple):
    """What is not the refrigerator's to decide, at one tick."""

    ambient: float
    """K."""
    leak: float
    """kg/s at 16 bar."""
    nitrogen: bool
    nc1: bool
    nc2: bool


class EventSchedule:
    """What holds at each tick.

    Args:
        events: In any order; of two for one time and target the later in the list holds.
        ambient: Temperature without an event, K.
        daily_swing: Amplitude of the ambient temperature over a day, K; its first six hours are the warmer.
    """

    def __init__(self, events: Sequence[RefrigeratorEvent], ambient: float, daily_swing: float) -> None:
        self._swing = daily_swing
        ordered = sorted(events, key=lambda event: event.tick)
        values = {EventTarget.NC1: 1.0, EventTarget.NC2: 1.0, EventTarget.NITROGEN: 1.0, EventTarget.LEAK: 0.0}
        values[EventTarget.AMBIENT] = ambient
        self._ticks = [0]
        self._held = [dict(values)]
        for event in ordered:
            values[event.target] = event.value
            self._ticks.append(event.tick)
            self._held.append(dict(values))

    def at(self, tick: int) -> Surroundings:
        """Return what holds from `tick` (0 or later) to the next."""
        held = self._held[bisect_right(self._ticks, tick) - 1]
        swing = self._swing * sin(2.0 * pi * tick * TICK_S / 86_400.0) if self._swing else 0.0
        return Surroundings(
            held[EventTarget.AMBIENT] + swing,
            1e-3 * held[EventTarget.LEAK],
            held[EventTarget.NITROGEN] > 0.0,
            held[EventTarget.NC1] > 0.0,
            held[EventTarget.NC2] > 0.0,
        )
