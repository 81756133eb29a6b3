"""Events of a refrigerator over time: a compressor trips, nitrogen runs out, helium leaks, a valve is stuck."""

from collections.abc import Sequence
from enum import StrEnum
from math import pi, sin
from operator import itemgetter
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from coldloop.process.cold_box import TICK_S
from coldloop.registers.plant import Surroundings


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
    TURBINE = "turbine"
    """1: the turbine may run, 0: it is tripped."""
    CV155 = "cv155"
    """1: the valve follows what is asked, 0: it is stuck where it is."""
    CV156 = "cv156"
    HEATER = "heater"
    """1: the heater follows what is asked, 0: it is off, 2: fully on."""
    BLOCKED_NEF1 = "blocked_nef1"
    """Share of the exchanger that impurities block in an hour; below 0 it is cleaned."""
    BLOCKED_NEF2 = "blocked_nef2"
    BLOCKED_NEF34 = "blocked_nef34"
    BLOCKED_NEF6 = "blocked_nef6"


BLOCKING = (EventTarget.BLOCKED_NEF1, EventTarget.BLOCKED_NEF2, EventTarget.BLOCKED_NEF34, EventTarget.BLOCKED_NEF6)
RANGES = {
    EventTarget.NC1: (0.0, 1.0),
    EventTarget.NC2: (0.0, 1.0),
    EventTarget.NITROGEN: (0.0, 1.0),
    EventTarget.LEAK: (0.0, 50.0),
    EventTarget.AMBIENT: (270.0, 320.0),
    EventTarget.TURBINE: (0.0, 1.0),
    EventTarget.CV155: (0.0, 1.0),
    EventTarget.CV156: (0.0, 1.0),
    EventTarget.HEATER: (0.0, 2.0),
} | dict.fromkeys(BLOCKING, (-10.0, 10.0))
MEASURED = {EventTarget.LEAK, EventTarget.AMBIENT, *BLOCKING}
"""What has a value; the others are in one of a few states, numbered from 0."""


class RefrigeratorEvent(BaseModel):
    """From a time on, something is otherwise."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    at_s: Annotated[float, Field(ge=0, le=1e9)]
    """Plant time, in multiples of 0.25 s."""
    target: EventTarget
    value: float
    """What it is from then on, in the unit of the target."""

    @model_validator(mode="after")
    def _is_possible(self) -> "RefrigeratorEvent":
        low, high = RANGES[self.target]
        if not low <= self.value <= high:
            raise ValueError(f"{self.target} = {self.value:g} is outside {low:g} to {high:g}")
        if self.target not in MEASURED and not self.value.is_integer():
            states = "0 or 1" if high == 1.0 else "0, 1 or 2"
            raise ValueError(f"{self.target} = {self.value:g}: write {states}")
        if self.at_s % TICK_S:
            raise ValueError(f"{self.at_s:g} s is not a multiple of {TICK_S} s")
        return self

    @property
    def tick(self) -> int:
        """The first tick that it concerns."""
        return round(self.at_s / TICK_S)


class EventSchedule:
    """What holds at each tick.

    Args:
        events: In any order; of two for one time and target the later in the list holds.
        ambient: Temperature without an event, K.
        daily_swing: Amplitude of the ambient temperature over a day, K; its first six hours are the warmer.
    """

    def __init__(self, events: Sequence[RefrigeratorEvent], ambient: float, daily_swing: float) -> None:
        self._swing = daily_swing
        self._given = Surroundings(ambient=ambient)
        self._changes = sorted(((event.tick, event.target, event.value) for event in events), key=itemgetter(0))
        """Tick, what, and its value, in the order in which they are made."""
        self._put: list[tuple[int, Surroundings]] = []

    def put(self, tick: int, given: Surroundings) -> None:
        """Let something hold from `tick` on, until an event that is planned for later."""
        self._put.append((tick, given))

    @property
    def puts(self) -> list[tuple[int, Surroundings]]:
        """What `put` has taken."""
        return list(self._put)

    def at(self, tick: int) -> Surroundings:
        """Return what is given from `tick` (0 or later) to the next, the day's swing left out."""
        since, given = next(((at, put) for at, put in reversed(self._put) if at <= tick), (-1, self._given))
        for at, target, value in self._changes:
            if since < at <= tick:
                changed: dict[str, Any] = {target.value: value if target in MEASURED else int(value)}
                given = given._replace(**changed)
        return given

    def ambient(self, tick: int) -> float:
        """Return the temperature of the surroundings (K) with the day's swing."""
        swing = self._swing * sin(2.0 * pi * tick * TICK_S / 86_400.0) if self._swing else 0.0
        return self.at(tick).ambient + swing
