"""The paper's rule (section II), literally as printed: one step down the gradient Gamma of the response time.

Gamma, and what it is made of, is in `assessment.py`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus
from coldloop_optimizer_plc.rules.assessment import Assessment, Observation
from coldloop_optimizer_plc.rules.interface import decides_by

Array = NDArray[np.float64]


class Algorithm1(NamedTuple):
    """One step of size `delta` down the gradient Gamma, projected on {q_min, ..., q_max}."""

    q_first: int
    q_min: int
    q_max: int
    delta: int

    @property
    def first(self) -> int:
        """q(t_0)."""
        return self.q_first

    @property
    def status(self) -> UpdatingRuleStatus:
        """Its four parameters."""
        return UpdatingRuleStatus(UpdatingRuleKind.ALGORITHM_1, self.q_first, self.q_min, self.q_max, self.delta)

    def after_interruption(self) -> int:
        """Return q(t_0): what was learnt of the problem before the step says nothing of the one after."""
        return self.q_first


@decides_by(Algorithm1)
@kernel
def decide(rule: Algorithm1, memory: Array, o: Observation, a: Assessment) -> int:  # noqa: ARG001
    """Return max(q_min, min(q_max, q - delta sign(Gamma)))."""
    zero = type(a.gamma)(0.0)
    sign = int(a.gamma > zero) - int(a.gamma < zero)
    return max(rule.q_min, min(rule.q_max, o.q - rule.delta * sign))
