"""The cool-down of a plant with a bath: a sequence of steps from a warm plant to a filled bath.

    TURBINE   until the turbine's outlet is at its set point
    BATH      until there is liquid
    FILLING   until the level is in its band
    SETTLING  until level and outlet have stayed in their bands for a while

The level of the cold box is L1, the turbine's outlet T5.

Pure: measured outputs in, wanted inputs out. How far the turbine may open is its governor's decision.
"""

from collections.abc import Collection, Sequence
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field

from coldloop.process.limits import InputLimits
from coldloop.process.loaded import PROCESS
from coldloop.process.signals import BATH, CONTROLLED, INPUT_NAMES, OUTPUT_NAMES, TICK_S
from coldloop.registers.control_plc import CoolDownStep
from coldloop.safety.sequence import Inputs

LEVEL, TEMPERATURE, TURBINE_OUTLET = (
    map(OUTPUT_NAMES.index, (BATH.level, BATH.temperature, BATH.turbine_outlet)) if BATH else (0, 0, 0)
)
BANDS: Final = dict(zip(CONTROLLED, PROCESS.bands, strict=True))
"""By output."""
FEED, HEATER, TURBINE_VALVE = map(INPUT_NAMES.index, BATH.inputs) if BATH else (0, 0, 0)


class CoolDownSettings(BaseModel):
    """When the cool-down begins, and when its steps end."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
        self._has_begun = BATH is None or step is not CoolDownStep.FINISHED
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
                return LEVEL, TURBINE_OUTLET
            case CoolDownStep.BATH | CoolDownStep.FILLING:
                return (LEVEL,)
            case _:
                return ()

    @property
    def standing(self) -> Collection[int]:
        """Outputs that may be constant for long without being frozen: all without a band once the bath fills."""
        if not self.is_active:
            return ()
        filling = self.step in (CoolDownStep.FILLING, CoolDownStep.SETTLING)
        return [output for output in range(len(OUTPUT_NAMES)) if not (filling and output in CONTROLLED)]

    def observe(self, tick: int, y: Sequence[float]) -> bool:
        """Take the outputs measured at `tick`; return whether the step has changed."""
        before, self.step = self.step, self._next(tick, y)
        self._has_begun = True
        return self.step is not before

    def _next(self, tick: int, y: Sequence[float]) -> CoolDownStep:
        if not self._has_begun:
            warm = y[TEMPERATURE] > self._settings.warm_k and y[LEVEL] < self._settings.liquid_pct
            return CoolDownStep.TURBINE if warm else CoolDownStep.FINISHED
        match self.step:
            case CoolDownStep.TURBINE if y[TURBINE_OUTLET] <= self._outputs[TURBINE_OUTLET]:
                return CoolDownStep.BATH
            case CoolDownStep.BATH if y[LEVEL] >= self._settings.liquid_pct:
                return CoolDownStep.FILLING
            case CoolDownStep.FILLING if y[LEVEL] >= BANDS[LEVEL].low:
                return CoolDownStep.SETTLING
            case CoolDownStep.SETTLING if self._has_settled(tick, y):
                return CoolDownStep.FINISHED
        return self.step

    def _has_settled(self, tick: int, y: Sequence[float]) -> bool:
        inside = all(BANDS[output].low <= y[output] <= BANDS[output].high for output in (LEVEL, TURBINE_OUTLET))
        if not inside or self._settled_since is None or tick < self._settled_since:
            self._settled_since = tick if inside else None
        return inside and (tick - (self._settled_since or 0)) * TICK_S >= self._settings.settled_s

    def wanted(self, by_loops: Inputs) -> Inputs:
        """Return the wanted inputs, where the closed loops want `by_loops`; the output guard moves towards them."""
        row = list(by_loops)
        if self.step in (CoolDownStep.TURBINE, CoolDownStep.BATH):
            row[FEED] = self._limits.high[FEED]
        else:
            row[FEED] = self._inputs[FEED]
        if LEVEL in self.open_loops:
            row[HEATER] = self._limits.low[HEATER]
        if TURBINE_OUTLET in self.open_loops:
            row[TURBINE_VALVE] = self._inputs[TURBINE_VALVE]
        return tuple(row)
