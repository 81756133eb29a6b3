"""The cool-down of a plant with a bath: a sequence of steps from a warm plant to a filled bath.

    TURBINE   until the turbine's outlet is at its set point
    BATH      until there is liquid
    FILLING   until the level is in its band
    SETTLING  until level and outlet have stayed in their bands for a while

The level of the cold box is L1, the turbine's outlet T5.

Pure: measured outputs in, wanted inputs out. How far the turbine may open is its governor's decision.
"""

from collections.abc import Collection, Sequence
from typing import Annotated

from pydantic import BaseModel, Field

from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import CoolDownStep
from coldloop.safety.writers import Inputs


class CoolDownSettings(BaseModel, frozen=True, extra="forbid"):
    """Settings of the cool-down: when it begins, and when its steps end."""

    warm_k: Annotated[float, Field(ge=5, le=300)] = 20.0
    """Its temperature at the beginning of a session, or after a restart, above which a bath without liquid is cooled
    down."""
    liquid_pct: Annotated[float, Field(gt=0, lt=50)] = 1.0
    """Level from which on there is liquid, and the bath is filled."""
    settled_s: Annotated[float, Field(ge=0, le=36_000)] = 600.0
    """How long level and turbine's outlet have to stay in their bands until the optimiser is invited, plant time."""


class CoolDown:
    """The sequence of a session; it begins with the first measurement of a warm plant, or never, or is under way.

    Args:
        settings: Its limits.
        limits: Bounds of the inputs.
        inputs: At the operating point.
        outputs: At the operating point.
        step: Which it had reached before a restart.
    """

    def __init__(
        self,
        settings: CoolDownSettings,
        limits: InputLimits,
        inputs: Sequence[float],
        outputs: Sequence[float],
        step: CoolDownStep = CoolDownStep.FINISHED,
    ) -> None:
        self._settings, self._limits = settings, limits
        self._inputs, self._outputs = inputs, outputs
        process = limits.process
        self._process, self._bands = process, dict(zip(process.controlled, process.bands, strict=True))
        if process.bath is not None:
            named = (process.bath.level, process.bath.temperature, process.bath.turbine_outlet)
            self._level, self._temperature, self._turbine_outlet = map(process.output_names.index, named)
            self._feed, self._heater, self._turbine_valve = map(process.input_names.index, process.bath.inputs)
        self._has_begun = process.bath is None or step is not CoolDownStep.FINISHED
        self._settled_since: int | None = None
        self.step = step

    @property
    def is_active(self) -> bool:
        """Whether the plant is being cooled down."""
        return self.step is not CoolDownStep.FINISHED

    @property
    def open_loops(self) -> Collection[int]:
        """Outputs whose loops are open."""
        match self.step:
            case CoolDownStep.TURBINE:
                return self._level, self._turbine_outlet
            case CoolDownStep.BATH | CoolDownStep.FILLING:
                return (self._level,)
            case _:
                return ()

    @property
    def standing(self) -> Collection[int]:
        """Outputs that may be constant for long without being frozen: all without a band once the bath fills."""
        if not self.is_active:
            return ()
        filling = self.step in (CoolDownStep.FILLING, CoolDownStep.SETTLING)
        return [output for output in range(len(self._process.outputs)) if not (filling and output in self._bands)]

    def observe(self, tick: int, y: Sequence[float]) -> bool:
        """Take the outputs measured at `tick`; return whether the step has changed."""
        before, self.step = self.step, self._next(tick, y)
        self._has_begun = True
        return self.step is not before

    def _next(self, tick: int, y: Sequence[float]) -> CoolDownStep:
        if not self._has_begun:
            warm = y[self._temperature] > self._settings.warm_k and y[self._level] < self._settings.liquid_pct
            return CoolDownStep.TURBINE if warm else CoolDownStep.FINISHED
        match self.step:
            case CoolDownStep.TURBINE if y[self._turbine_outlet] <= self._outputs[self._turbine_outlet]:
                return CoolDownStep.BATH
            case CoolDownStep.BATH if y[self._level] >= self._settings.liquid_pct:
                return CoolDownStep.FILLING
            case CoolDownStep.FILLING if y[self._level] >= self._bands[self._level].low:
                return CoolDownStep.SETTLING
            case CoolDownStep.SETTLING if self._has_settled(tick, y):
                return CoolDownStep.FINISHED
        return self.step

    def _has_settled(self, tick: int, y: Sequence[float]) -> bool:
        bands = ((output, self._bands[output]) for output in (self._level, self._turbine_outlet))
        inside = all(band.low <= y[output] <= band.high for output, band in bands)
        if not inside or self._settled_since is None or tick < self._settled_since:
            self._settled_since = tick if inside else None
        return inside and (tick - (self._settled_since or 0)) * self._process.tick_s >= self._settings.settled_s

    def wanted(self, by_loops: Inputs) -> Inputs:
        """Return the wanted inputs, where the closed loops want `by_loops`; the output guard moves towards them."""
        row = list(by_loops)
        if self.step in (CoolDownStep.TURBINE, CoolDownStep.BATH):
            row[self._feed] = self._limits.high[self._feed]
        else:
            row[self._feed] = self._inputs[self._feed]
        if self._level in self.open_loops:
            row[self._heater] = self._limits.low[self._heater]
        if self._turbine_outlet in self.open_loops:
            row[self._turbine_valve] = self._inputs[self._turbine_valve]
        return tuple(row)
