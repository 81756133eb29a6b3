"""The classical control: a PI loop for each output that has one; other inputs are held (paper, section IV-A).

Of the cold box T5 is controlled by the turbine valve CV156, the level L1 by the actuator part of the heater NCR22, and
CV155 is fixed where it is. The loops of another process come with it.

Pure: measured outputs and applied inputs in, wanted inputs out. The output guard has the last word.
"""

import math
from collections.abc import Collection, Sequence
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, FiniteFloat, PositiveFloat, model_validator

from coldloop.process.cold_box import LEVEL_LOOP, T5_LOOP
from coldloop.process.sections import Band, Loop
from coldloop.process.settings import InputLimits, ProcessSettings, declared, within
from coldloop.process.updating_periods import whole_ticks
from coldloop.safety.writers import Inputs


class PiSettings(BaseModel):
    """One PI loop, u = gain (e + 1/T_i integral of e) with e = setpoint - y: the gain has the sign of the process."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gain: FiniteFloat
    """K, in the unit of the input per unit of the output."""
    integral_time_s: PositiveFloat
    """T_i, s."""
    setpoint_offset: FiniteFloat = 0.0
    """Setpoint less the output at the operating point of the model file, in the unit of the output."""


def _declared(loop: Loop, band: Band) -> PiSettings:
    return PiSettings(gain=loop.gain, integral_time_s=loop.integral_time_s, setpoint_offset=band.setpoint_offset)


class TemperatureLoop(PiSettings):
    """T5 (K) by CV156 (%): gain in % per K."""

    gain: FiniteFloat = T5_LOOP.gain
    integral_time_s: PositiveFloat = T5_LOOP.integral_time_s


class LevelLoop(PiSettings):
    """L1 (%) by NCR22_A (W): gain in W per %."""

    gain: FiniteFloat = LEVEL_LOOP.gain
    integral_time_s: PositiveFloat = LEVEL_LOOP.integral_time_s


class ClassicalSettings(ProcessSettings):
    """The tuning of loops by the quantity of their output, as the cold box declares it; of others it is declared."""

    temperature: TemperatureLoop = TemperatureLoop()
    level: LevelLoop = LevelLoop()
    period_s: Annotated[float, within(lambda process: (process.tick_s, process.sampling_period_s))] = declared(
        lambda process: process.sampling_period_s
    )
    """How often the loops are executed: a whole number of ticks, and no longer than the window of the rate limits."""

    @property
    def pairs(self) -> "tuple[tuple[str, str, PiSettings], ...]":
        """Output, input and tuning of each loop."""
        return tuple(
            (output.name, loop.input, getattr(self, output.quantity) if output.quantity else _declared(loop, band))
            for output, band in zip(self.process.banded, self.process.bands, strict=True)
            if (loop := band.loop) is not None
        )

    @property
    def period_ticks(self) -> int:
        """The period, in ticks."""
        return round(self.period_s / self.process.tick_s)

    @model_validator(mode="after")
    def _whole_ticks(self) -> Self:
        if whole_ticks(self.period_s, self.process.tick_s) is None:
            raise ValueError(f"period_s must be a multiple of the tick, {self.process.tick_s} s")
        return self


LONGEST_GAP = 3
"""Periods; of a longer gap between two executions no more counts for the integral."""


class PiController:
    """A discrete PI controller for an input with bounds and a rate limit.

    It computes what to add to the input that is really applied: du = K (e_k - e_{k-1} + T/T_i e_k). This is the PI
    whose integral is reset before each execution such that its last output is the applied input (tracking with the
    shortest time constant; Astrom and Murray, Feedback Systems, section on anti-windup). So nothing winds up,
    whatever limits the input, and a start from any input is bumpless.

    Args:
        settings: Gain K, integral time T_i.
        setpoint: Wanted output.
        period_s: Nominal time T between executions, s.
        low: Lower bound of the input.
        high: Upper bound of the input.
        reach: Largest change of the input in one execution, up or down.
    """

    def __init__(
        self, settings: PiSettings, *, setpoint: float, period_s: float, low: float, high: float, reach: float
    ) -> None:
        self._gain = settings.gain
        self._period_s = period_s
        self._integral_time_s = settings.integral_time_s
        self._setpoint = setpoint
        self._low, self._high, self._reach = low, high, reach
        self._error: float | None = None

    def restart(self) -> None:
        """Forget the last error: the next execution continues from the input applied, without proportional kick."""
        self._error = None

    def execute(self, measured: float, applied: float, elapsed_s: float | None = None) -> float:
        """Return the wanted input for a measured output.

        Args:
            measured: The output. NaN leaves the input unchanged.
            applied: The input applied until now.
            elapsed_s: Time since the execution before, s; the nominal time by default.
        """
        if not math.isfinite(measured):
            self.restart()
            return applied
        error = self._setpoint - measured
        share = (self._period_s if elapsed_s is None else elapsed_s) / self._integral_time_s
        change = self._gain * (error - (error if self._error is None else self._error) + share * error)
        if not math.isfinite(change):  # beyond all numbers: as good as none
            self.restart()
            return applied
        self._error = error
        return min(max(applied + change, applied - self._reach, self._low), applied + self._reach, self._high)


class ClassicalLoops:
    """The loops; inputs that none moves are held.

    Args:
        settings: Tuning.
        limits: Bounds and rates of the inputs.
        operating_outputs: The outputs at the operating point, from which setpoints count.
    """

    def __init__(self, settings: ClassicalSettings, limits: InputLimits, operating_outputs: Sequence[float]) -> None:
        process = settings.process

        def loop(tuning: PiSettings, output: int, actuator: int) -> PiController:
            return PiController(
                tuning,
                setpoint=operating_outputs[output] + tuning.setpoint_offset,
                period_s=settings.period_s,
                low=limits.low[actuator],
                high=limits.high[actuator],
                reach=limits.rate[actuator] * settings.period_s / process.sampling_period_s,
            )

        self._period, self._tick_s = settings.period_ticks, process.tick_s
        self._seen: int | None = None
        self._executed: int | None = None
        places = (
            (process.output_names.index(y), process.input_names.index(u), tuning) for y, u, tuning in settings.pairs
        )
        self._loops = [(output, actuator, loop(tuning, output, actuator)) for output, actuator, tuning in places]

    def restart(self) -> None:
        """Forget what was measured: the loops take over from whatever is applied next."""
        self._seen = self._executed = None
        for _, _, loop in self._loops:
            loop.restart()

    def wanted(self, tick: int, y: Sequence[float], applied: Inputs, *, without: Collection[int] = ()) -> Inputs:
        """Return the inputs wanted at `tick`, from the newest outputs y and the inputs applied until now.

        A loop whose output is among those to do `without` is left: its input stays.

        Between executions they are the applied ones. Executions are at multiples of the period, so that with 5 s and
        no sequence before each of them has its own rate window and may use it in full. Where the scan at such a
        tick was missed the next one executes, with the time that has passed.
        """
        if not self._is_due(tick):
            return applied
        elapsed_s = (
            None if self._executed is None else min(tick - self._executed, LONGEST_GAP * self._period) * self._tick_s
        )
        self._executed = tick
        inputs = list(applied)
        for output, actuator, loop in self._loops:
            measured = math.nan if output in without else y[output]
            inputs[actuator] = loop.execute(measured, applied[actuator], elapsed_s)
        return tuple(inputs)

    def _is_due(self, tick: int) -> bool:
        seen, self._seen = self._seen, tick
        if self._executed is not None and tick <= self._executed:  # this scan was begun before, or time has gone back
            self._executed = min(self._executed, tick)
            return False
        return tick % self._period == 0 or (seen is not None and tick // self._period > seen // self._period)
