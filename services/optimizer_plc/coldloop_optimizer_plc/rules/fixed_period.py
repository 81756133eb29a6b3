"""Always the same period: what adaptive periods are compared with."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus
from coldloop_optimizer_plc.rules.assessment import Assessment, Observation
from coldloop_optimizer_plc.rules.interface import decides_by

Array = NDArray[np.float64]


class FixedPeriod(NamedTuple):
    """Always the same q."""

    q: int

    @property
    def first(self) -> int:
        """The fixed one."""
        return self.q

    @property
    def status(self) -> UpdatingRuleStatus:
        """The fixed one."""
        return UpdatingRuleStatus(UpdatingRuleKind.FIXED, self.q, self.q, self.q)

    def after_interruption(self) -> int:
        """Return the fixed one."""
        return self.q


@decides_by(FixedPeriod)
@kernel
def decide(rule: FixedPeriod, memory: Array, o: Observation, a: Assessment) -> int:  # noqa: ARG001
    """Return the fixed one."""
    return rule.q
