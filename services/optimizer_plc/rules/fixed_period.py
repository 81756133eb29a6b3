"""Always the same number of iterations: what adaptive periods are compared with."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus
from optimizer_plc.rules.assessment import Assessment, Observation
from optimizer_plc.rules.interface import decides_by

Array = NDArray[np.float64]


class FixedPeriod(NamedTuple):
    """Always the same number of iterations."""

    iterations: int

    @property
    def first(self) -> int:
        """The fixed number."""
        return self.iterations

    @property
    def status(self) -> UpdatingRuleStatus:
        """The fixed number."""
        return UpdatingRuleStatus(UpdatingRuleKind.FIXED, self.iterations, self.iterations, self.iterations)

    def after_interruption(self, memory: Array) -> int:  # noqa: ARG002 it remembers nothing
        """Return the fixed number."""
        return self.iterations


@decides_by(FixedPeriod)
@kernel
def decide(rule: FixedPeriod, memory: Array, o: Observation, a: Assessment) -> int:  # noqa: ARG001
    """Return the fixed number."""
    return rule.iterations
