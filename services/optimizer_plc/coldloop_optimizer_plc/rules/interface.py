"""What a rule of the updating period is, and the call of the right rule's kernel.

A rule decides q(t_{k+1}), the number of the next period in the ladder of periods; `PlcBudget` knows the ladder, and how
many iterations of the solver fit into each. Its file has a NamedTuple of its parameters and a kernel `decide` that is
registered for it. It takes single and double precision alike.
"""

from collections.abc import Callable
from typing import Any, Final, Protocol, TypeVar

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from coldloop.kernels.implementations import Implementations
from coldloop.registers.optimizer_plc import UpdatingRuleStatus
from coldloop_optimizer_plc.rules.assessment import Assessment, Observation

Array = NDArray[np.float64]

MEMORY: Final = 1
"""Numbers that a rule may remember from one period to the next, in an array that begins with zeros."""


class UpdatingRule(Protocol):
    """Parameters of a rule; a kernel is registered for their type."""

    @property
    def first(self) -> int:
        """q(t_0)."""

    @property
    def status(self) -> UpdatingRuleStatus:
        """The rule and its parameters, as registers show them."""

    def after_interruption(self) -> int:
        """Return the q of the period that begins with a load step."""


Decision = Callable[[Any, Array, Observation, Assessment], int]
D = TypeVar("D", bound=Decision)

DECISIONS: Final[Implementations[Decision]] = Implementations("decide_by")
"""The kernel of each rule."""


def decides_by(rule: type) -> Callable[[D], D]:
    """Register a kernel as what decides by rules of this type."""

    def register(decision: D) -> D:
        DECISIONS[rule] = decision
        return decision

    return register


def decide_by(rule: Any, memory: Array, observation: Observation, assessment: Assessment) -> int:  # noqa: ANN401
    """Return q(t_{k+1}) by the kernel that is registered for a rule, which may overwrite its memory (1,)."""
    return DECISIONS[type(rule)](rule, memory, observation, assessment)


@overload(decide_by, jit_options={"error_model": "numpy"}, strict=False)
def _decide_by(rule: Any, memory: Any, observation: Any, assessment: Any) -> Any:  # noqa: ANN401, ARG001 types of numba
    decide = DECISIONS[rule.instance_class]
    return lambda rule, memory, observation, assessment: decide(rule, memory, observation, assessment)  # noqa: PLW0108
