"""Which rule of the updating period a session has."""

from optimizer_plc.budget import PlcBudget
from optimizer_plc.settings import ProgramSettings, RuleName
from optimizer_plc.updating_period import Algorithm1, ContractionParameters, ContractionRule, FixedPeriod, UpdatingRule


def make_rule(settings: ProgramSettings, budget: PlcBudget, fixed_ticks: int) -> UpdatingRule:
    """Return the rule that the settings name.

    Args:
        settings: Of the program.
        budget: Says how many iterations fit into a fixed period.
        fixed_ticks: Fixed updating period; 0 is adaptive.
    """
    if fixed_ticks:
        return FixedPeriod(budget.iterations(fixed_ticks))
    adaptive = settings.adaptive
    if adaptive.rule is RuleName.CONTRACTION:
        return ContractionRule(ContractionParameters(**adaptive.contraction.model_dump()))
    return Algorithm1(adaptive.q_first, adaptive.q_min, adaptive.q_max, adaptive.delta)
