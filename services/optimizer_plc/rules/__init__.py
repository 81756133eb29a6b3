"""Rules of the updating period: one file each, one interface, joined here by name."""

from optimizer_plc.arithmetic import DOUBLE, Real
from optimizer_plc.budget import PlcBudget
from optimizer_plc.rules.algorithm_1 import Algorithm1
from optimizer_plc.rules.contraction import ContractionRule
from optimizer_plc.rules.fixed_period import FixedPeriod
from optimizer_plc.rules.interface import Assessment, Observation, UpdatingRule, assess
from optimizer_plc.settings import ProgramSettings, RuleName

__all__ = [
    "Algorithm1", "Assessment", "ContractionRule", "FixedPeriod", "Observation", "UpdatingRule", "assess", "make_rule"
]  # fmt: skip


def make_rule(settings: ProgramSettings, budget: PlcBudget, fixed_ticks: int, real: Real = DOUBLE) -> UpdatingRule:
    """Return the rule that the settings name.

    Args:
        settings: Of the program.
        budget: Says how many iterations fit into a fixed period.
        fixed_ticks: Fixed updating period; 0 is adaptive.
        real: Floating-point type of the costs.
    """
    if fixed_ticks:
        return FixedPeriod(budget.iterations(fixed_ticks))
    adaptive = settings.adaptive
    if adaptive.rule is RuleName.CONTRACTION:
        own = adaptive.contraction
        return ContractionRule(
            own.q_busy, own.q_quiet, own.q_step, real(own.rate), real(own.memory), real(own.surprise)
        )
    return Algorithm1(adaptive.q_first, adaptive.q_min, adaptive.q_max, adaptive.delta)
