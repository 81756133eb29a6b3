"""What the optimiser PLC can compute in an updating period, and when its answer is there.

The reference PLC (P = 1) is the Schneider TSX P574634M of the paper: one ODE iteration in a slot of 0.25 s, and one
slot for the preparation of the problem, hence 4 tau_u - 1 iterations (section VI; `report/slips.md`, 7).
"""

from bisect import bisect_right
from functools import cached_property
from typing import Annotated

from pydantic import Field, PositiveFloat

from coldloop.process.settings import ProcessSettings, declared
from coldloop.process.updating_periods import ComputingTimes

SLOT_S = 0.25
"""Of the reference PLC, with the problem of the cold box."""


class BudgetSettings(ProcessSettings):
    """Computing power of the optimiser PLC."""

    power: PositiveFloat = 1.0
    """P, relative to the reference PLC."""
    preparation_slots: Annotated[int, Field(ge=0, le=20)] = 1
    """Slots of 0.25 s / P that the preparation is given in an updating period."""
    preparation_s: Annotated[float, Field(ge=0)] = declared(lambda process: 0.17 * process.share("preparation"))
    """Time that it takes at P = 1: 89,000 operations at 0.53 Mflop/s (`docs/budget.md`)."""


class PlcBudget:
    """Converts between iterations and updating periods for one solver."""

    def __init__(self, settings: BudgetSettings, tau_1_s: float) -> None:
        process = settings.process
        slots_s = settings.preparation_slots * (SLOT_S * process.share("preparation"))
        self.times = ComputingTimes(
            slots_s / settings.power, settings.preparation_s / settings.power, tau_1_s / settings.power,
            process.tick_s, process.ticks_per_sample,
        )  # fmt: skip

    @cached_property
    def ladder(self) -> tuple[int, ...]:
        """Updating periods that a rule chooses from, in ticks; q is the number of one, from 1."""
        return self.times.ladder()

    @property
    def longest_ticks(self) -> int:
        """Longest updating period, a sampling period."""
        return self.times.longest_ticks

    def q(self, ticks: int) -> int:
        """Return the number of the longest period of the ladder that is no longer than so many ticks; at least 1."""
        return max(1, bisect_right(self.ladder, ticks))

    def iterations(self, ticks: int) -> int:
        """Return the iterations that fit into an updating period of `ticks` ticks; at least one is always done."""
        return self.times.iterations(ticks)

    def answer_after_s(self, iterations: int) -> float:
        """Return the plant time from an updating instant to the end of its computation, in seconds."""
        return self.times.preparation + iterations * self.times.iteration

    def too_slow(self, ticks: int = 0) -> str:
        """Return that an iteration does not fit into a fixed period, or into the longest (0); empty where it does."""
        period = ticks or self.longest_ticks
        if self.times.holds(period):
            return ""
        needed_s, which = self.times.slots + self.times.iteration, "" if ticks else "longest "
        return (
            f"the slot of the preparation and an iteration take {needed_s:.3g} s, and the {which}updating period is "
            f"{period * self.times.tick_s:g} s"
        )

    def is_enough(self, ticks: int) -> bool:
        """Return whether an answer of one iteration is there within an updating period of `ticks` ticks."""
        return self.answer_after_s(1) <= ticks * self.times.tick_s
