"""This project's rule: short periods while the delivered cost contracts, longer ones in quiet.

With g = max(0, ln(J-hat_k / J-hat_{k+1})) / tau_u the rate at which successive profiles improve, and v its decaying
maximum, q goes from `q_quiet` at v = 0 down to `q_busy` at v = `rate`. A profile that turns out worse than `surprise`
times what was predicted, and a load step, are answered by one long solve, with `q_step`
(`docs/updating-period.md`).
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus
from optimizer_plc.rules.assessment import Assessment, Observation
from optimizer_plc.rules.interface import OF_PROBLEM, decides_by

Array = NDArray[np.float64]

RATE: Final = 0
"""Place of v (1/s) in the memory."""
DELIVERED: Final = OF_PROBLEM
"""Place of J-hat of the profile before; 0 where it says nothing."""


class ContractionRule(NamedTuple):
    """Its parameters; the last three in the floating-point type of the costs."""

    q_busy: int
    q_quiet: int
    q_step: int
    rate: float
    """Contraction, 1/s, from which on the period is shortest."""
    memory: float
    """What is left of v after a second."""
    surprise: float

    @property
    def first(self) -> int:
        """Q in quiet."""
        return self.q_quiet

    @property
    def status(self) -> UpdatingRuleStatus:
        """The three numbers that q moves between; the first period has that of quiet."""
        return UpdatingRuleStatus(UpdatingRuleKind.CONTRACTION, self.q_step, self.q_busy, self.q_step)

    def after_interruption(self) -> int:
        """Return the q of one long solve."""
        return self.q_step


@decides_by(ContractionRule)
@kernel
def decide(rule: ContractionRule, memory: Array, o: Observation, a: Assessment) -> int:  # noqa: ARG001
    """Return q(t_{k+1}): about a dozen operations."""
    zero, one, two = memory.dtype.type(0.0), memory.dtype.type(1.0), memory.dtype.type(2.0)
    known = memory[DELIVERED] != zero
    improvement = math.log(memory[DELIVERED] / o.delivered) / o.period_s if known else zero
    remembered = rule.memory**o.period_s * memory[RATE]
    memory[RATE] = max(min(improvement, two * rule.rate), remembered)
    memory[DELIVERED] = o.delivered
    if o.effective > rule.surprise * o.delivered:
        return rule.q_step
    busy = min(one, memory[RATE] / rule.rate)
    quiet, span = memory.dtype.type(rule.q_quiet), memory.dtype.type(rule.q_quiet - rule.q_busy)
    return int(round(quiet - span * busy))  # noqa: RUF046 it is no int to the type checker
