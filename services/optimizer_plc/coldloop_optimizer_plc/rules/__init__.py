"""Rules of the updating period: one file each, one interface, joined here by name."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus
from coldloop_optimizer_plc.budget import PlcBudget
from coldloop_optimizer_plc.qp.arithmetic import DOUBLE, Real
from coldloop_optimizer_plc.rules import algorithm_1, contraction
from coldloop_optimizer_plc.rules.algorithm_1 import Algorithm1
from coldloop_optimizer_plc.rules.assessment import Assessment, Observation, assess
from coldloop_optimizer_plc.rules.contraction import ContractionRule
from coldloop_optimizer_plc.rules.fixed_period import FixedPeriod
from coldloop_optimizer_plc.rules.interface import UpdatingRule, decides_by
from coldloop_optimizer_plc.rules.outside import OutsideRule
from coldloop_optimizer_plc.settings import ProgramSettings

__all__ = [
    "Algorithm1", "Assessment", "ContractionRule", "FixedPeriod", "Observation", "OutsideRule", "Rule", "UpdatingRule",
    "assess", "make_rule",
]  # fmt: skip

Array = NDArray[np.float64]

FIXED_PERIOD: Final = int(UpdatingRuleKind.FIXED)
ALGORITHM_1: Final = int(UpdatingRuleKind.ALGORITHM_1)


class Rule(NamedTuple):
    """The rules in the order of `UpdatingRuleKind`, of which one decides: what is compiled for one serves all."""

    kind: int
    """An `UpdatingRuleKind`."""
    fixed_period: FixedPeriod
    algorithm_1: Algorithm1
    contraction: ContractionRule

    @property
    def chosen(self) -> UpdatingRule:
        """The rule that decides."""
        rules: tuple[UpdatingRule, ...] = self[1:]
        return rules[self.kind]

    @property
    def first(self) -> int:
        """q(t_0)."""
        return self.chosen.first

    @property
    def status(self) -> UpdatingRuleStatus:
        """The rule and its parameters, as registers show them."""
        return self.chosen.status

    def after_interruption(self) -> int:
        """Return the q of the period that begins with a load step."""
        return self.chosen.after_interruption()


@decides_by(Rule)
@kernel
def decide(rule: Rule, memory: Array, o: Observation, a: Assessment) -> int:
    """Return q(t_{k+1})."""
    if rule.kind == FIXED_PERIOD:
        return rule.fixed_period.q
    if rule.kind == ALGORITHM_1:
        return algorithm_1.decide(rule.algorithm_1, memory, o, a)
    return contraction.decide(rule.contraction, memory, o, a)


def make_rule(settings: ProgramSettings, budget: PlcBudget, fixed_ticks: int, real: Real = DOUBLE) -> UpdatingRule:
    """Return the rule that the settings name.

    Args:
        settings: Of the program.
        budget: Knows the q of a fixed period.
        fixed_ticks: Fixed updating period; 0 is adaptive.
        real: Floating-point type of the costs.

    Raises:
        ConfigurationError: There is no such rule, or it cannot be made.
    """
    if settings.outside.rule and not fixed_ticks:
        return OutsideRule(settings.outside.rule, budget)
    adaptive, own = settings.adaptive, settings.adaptive.contraction
    return Rule(
        FIXED_PERIOD if fixed_ticks else int(UpdatingRuleKind[adaptive.rule.name]),  # one type, compiled once
        FixedPeriod(budget.q(fixed_ticks)),
        Algorithm1(adaptive.q_first, adaptive.q_min, adaptive.q_max, adaptive.delta),
        ContractionRule(own.q_rest, own.q_max, real(own.band), real(own.least), real(own.change)),
    )
