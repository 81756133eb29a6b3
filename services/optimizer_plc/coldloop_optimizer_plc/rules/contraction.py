"""This project's rule, the default of the cold box: Algorithm 1 with a dead band, that rests at its shortest period.

The cost contracts from J_k to J_{k+1} by K. Where |ln K| is within `band` times its usual size, it says nothing, and q
goes down by one to `q_rest`. Beyond that, q goes up by one where the gradient Gamma of the response time asks for a
longer period, and down by one where it does not. The usual size is the median of |ln K|, followed by small steps up
and down: in quiet it is the noise of the measured contraction (`docs/updating-period.md`).
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus
from coldloop_optimizer_plc.rules.assessment import Assessment, Observation
from coldloop_optimizer_plc.rules.interface import decides_by

Array = NDArray[np.float64]

USUAL: Final = 0
"""Place of the usual size of |ln K| in the memory."""


class ContractionRule(NamedTuple):
    """Its parameters; the last three in the floating-point type of the costs."""

    q_rest: int
    q_max: int
    band: float
    """Usual sizes of |ln K| up to which it says nothing."""
    least: float
    """Least usual size, where it begins."""
    change: float
    """Share by which the usual size changes in a period."""

    @property
    def first(self) -> int:
        """The largest q."""
        return self.q_max

    @property
    def status(self) -> UpdatingRuleStatus:
        """The two numbers that q moves between."""
        return UpdatingRuleStatus(UpdatingRuleKind.CONTRACTION, self.q_max, self.q_rest, self.q_max)

    def after_interruption(self) -> int:
        """Return the largest q: a new load is answered by one longer solve."""
        return self.q_max


@decides_by(ContractionRule)
@kernel
def decide(rule: ContractionRule, memory: Array, o: Observation, a: Assessment) -> int:
    """Return q(t_{k+1}): about a dozen operations, one of them a logarithm."""
    zero, one = memory.dtype.type(0.0), memory.dtype.type(1.0)
    usual = max(memory[USUAL], rule.least)
    size = abs(math.log(o.effective / o.effective_before))
    memory[USUAL] = usual * (one + rule.change) if size > usual else usual * (one - rule.change)
    longer = size > rule.band * usual and a.gamma < zero
    return min(o.q + 1, rule.q_max) if longer else max(min(o.q - 1, rule.q_max), rule.q_rest)
