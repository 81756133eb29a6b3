"""What the optimiser PLC can compute in an updating period, and when its answer is there.

The reference PLC (P = 1) is the Schneider TSX P574634M of the paper: one ODE iteration in a slot of 0.25 s, and one
slot for the preparation of the problem, hence 4 tau_u - 1 iterations (section VI; `docs/science.md`, ruling 7).
"""

import math
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat

from coldloop.process.signals import TICK_S, TICKS_PER_SAMPLE

MAX_PERIOD_TICKS = TICKS_PER_SAMPLE


class BudgetSettings(BaseModel):
    """Computing power of the optimiser PLC."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    power: PositiveFloat = 1.0
    """P, relative to the reference PLC."""
    preparation_slots: Annotated[int, Field(ge=0, le=20)] = 1
    """Slots of 0.25 s / P that the preparation is given in an updating period."""
    preparation_s: Annotated[float, Field(ge=0)] = 0.17
    """Time that it takes at P = 1: 89,000 operations at 0.53 Mflop/s (`docs/budget.md`)."""


class ComputingTimes(NamedTuple):
    """Times of one solver on this PLC, s."""

    slots: float
    """Kept free in an updating period for the preparation."""
    preparation: float
    iteration: float


class PlcBudget:
    """Converts between iterations and updating periods for one solver."""

    def __init__(self, settings: BudgetSettings, tau_1_s: float) -> None:
        self._settings = settings
        self._iteration_s = tau_1_s / settings.power
        self._slots_s = settings.preparation_slots * TICK_S / settings.power

    @property
    def times(self) -> ComputingTimes:
        """What a period is made of."""
        return ComputingTimes(self._slots_s, self._settings.preparation_s / self._settings.power, self._iteration_s)

    def iterations(self, ticks: int) -> int:
        """Return the iterations that fit into an updating period of `ticks` ticks; at least one is always done."""
        return max(1, math.floor((ticks * TICK_S - self._slots_s) / self._iteration_s + 1e-9))

    def period(self, iterations: int) -> int:
        """Return the updating period, in ticks, that holds this many iterations; at most 5 s."""
        return min(MAX_PERIOD_TICKS, math.ceil((self._slots_s + iterations * self._iteration_s) / TICK_S - 1e-9))

    def answer_after_s(self, iterations: int) -> float:
        """Return the plant time from an updating instant to the end of its computation, in seconds."""
        return self._settings.preparation_s / self._settings.power + iterations * self._iteration_s

    def is_enough(self, ticks: int) -> bool:
        """Return whether an answer of one iteration is there within an updating period of `ticks` ticks."""
        return self.answer_after_s(1) <= ticks * TICK_S
