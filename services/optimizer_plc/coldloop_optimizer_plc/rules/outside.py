"""Somebody else's rule of the updating period, by an entry point of the group `coldloop.rules`."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus
from coldloop_optimizer_plc.budget import PlcBudget
from coldloop_optimizer_plc.entry_points import Part, in_its_name, made
from coldloop_optimizer_plc.rules.assessment import Assessment, Observation
from coldloop_optimizer_plc.rules.interface import decides_by

Array = NDArray[np.float64]


class OutsideDecision(Protocol):
    """What an entry point makes for each session; the same observations give the same numbers.

    It may have `after_interruption()`, too: the q of a period that begins with a load step, which else is the first.
    """

    def __init__(self, periods: Sequence[int]) -> None:
        """Begin with the ladder: updating periods in ticks, rising. Their numbers q count from 1."""

    def first(self) -> int:
        """Return q(t_0)."""

    def decide(self, observation: Observation, assessment: Assessment) -> int:
        """Return q(t_{k+1})."""


class OutsideRule:
    """One of these as a rule: what is no number of a period leaves q as it is, at a beginning at the longest."""

    def __init__(self, name: str, budget: PlcBudget) -> None:
        self.name, self._most = name, len(budget.ladder)
        self._rule: OutsideDecision = made(Part.RULE, name, budget.ladder)
        self.first = self._asked("first", otherwise=self._most)

    @property
    def status(self) -> UpdatingRuleStatus:
        """The ladder that it may use."""
        return UpdatingRuleStatus(UpdatingRuleKind.OUTSIDE, self.first, 1, self._most)

    def after_interruption(self) -> int:
        """Return the q of the period that begins with a load step."""
        return self._asked("after_interruption", "first", otherwise=self._most)

    def decide(self, o: Observation, a: Assessment) -> int:
        """Return q(t_{k+1}).

        Raises:
            ConfigurationError: The rule raises, or returns no number.
        """
        return self._asked("decide", given=(o, a), otherwise=o.q)

    def _asked(self, *names: str, given: Sequence[object] = (), otherwise: int) -> int:
        """Return what the first method says that there is; to look for it runs code of others, too."""
        with in_its_name(Part.RULE, self.name):
            name = next((each for each in names if hasattr(self._rule, each)), names[-1])
            q = float(getattr(self._rule, name)(*given))
        return int(q) if q.is_integer() and 1 <= q <= self._most else otherwise


@decides_by(OutsideRule)
def decide(rule: OutsideRule, memory: Array, o: Observation, a: Assessment) -> int:  # noqa: ARG001 it has its own
    """Return q(t_{k+1})."""
    return rule.decide(o, a)
