"""What the actuators allow: one setting that the QP, its solvers and the control PLC's guard share."""

from enum import StrEnum
from typing import Annotated, Final, Self

from pydantic import model_validator

from coldloop.process.settings import PerInput, ProcessSettings, declared, within

LARGEST: Final = 1e38
"""Of a bound."""


class RateReference(StrEnum):
    """What the rate limit of an update is measured against; the paper leaves it open (`report/slips.md`, 15)."""

    PER_UPDATE = "per-update"
    """The full limit of a sampling period of 5 s at each update, however soon the next one follows."""
    ELAPSED = "elapsed"
    """The limit scaled by the time since the update before, tau_u / 5 s."""


class InputLimits(ProcessSettings):
    """Bounds and rates of the inputs, in their order: of the cold box CV155 %, NCR22_A W, CV156 % (paper, table I)."""

    low: PerInput = declared(lambda process: tuple(one.low for one in process.inputs))
    """Least value."""
    high: PerInput = declared(lambda process: tuple(one.high for one in process.inputs))
    """Largest value."""
    rate: PerInput = declared(lambda process: tuple(one.rate for one in process.inputs))
    """Largest change in one sampling period, up or down."""
    rate_reference: RateReference = RateReference.PER_UPDATE
    slew_s: Annotated[float, within(lambda process: (process.tick_s, process.sampling_period_s))] = declared(
        lambda process: 2 * process.tick_s
    )
    """Absolute slew limit, however often updates follow one another: within any time shorter than this an input moves
    by at most `rate`. The default is the shortest updating period that there is: it never binds on our optimiser."""

    @property
    def slew_ticks(self) -> int:
        """That time, in ticks."""
        return max(1, round(self.slew_s / self.process.tick_s))

    def rate_share(self, elapsed_ticks: int) -> float:
        """Return the share of `rate` that an update may use, `elapsed_ticks` ticks after the one before."""
        if self.rate_reference is RateReference.PER_UPDATE:
            return 1.0
        return min(1.0, elapsed_ticks / self.process.ticks_per_sample)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if max(map(abs, (*self.low, *self.high))) > LARGEST:
            raise ValueError(f"a low or high beyond {LARGEST:g}: it does not cross the link, in single precision")
        if any(low >= high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("each low must be below its high")
        if min(self.rate) <= 0:
            raise ValueError("each rate must be positive")
        return self
