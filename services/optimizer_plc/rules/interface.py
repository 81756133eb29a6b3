"""Inputs of a rule of the updating period, the quantities of Algorithm 1, and the call of the right rule's kernel.

A rule decides q(t_{k+1}), the number of iterations of the next period. Its file has a NamedTuple of its parameters and
a kernel `decide` that is registered for it. It takes single and double precision alike.
"""

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple, Protocol, TypeVar

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from coldloop.kernels.compiled import kernel
from coldloop.registers.optimizer_plc import UpdatingRuleStatus

Array = NDArray[np.float64]

MEMORY = 2
"""Numbers that a rule may remember from one period to the next, in an array that begins with zeros."""


class Observation(NamedTuple):
    """What is known at t_{k+1} of the period that ends there; costs are positive (Assumption 1 of the paper)."""

    iterations: int
    """q(t_k)."""
    period_s: float
    """t_{k+1} - t_k."""
    effective_before: float
    """J_k: p(t_k) at the state reached at t_k."""
    hot_start: float
    """J+_k: the shifted profile at the state predicted for t_{k+1}."""
    last_but_one: float
    """J after q - 1 iterations, at the predicted state."""
    delivered: float
    """Ĵ_{k+1}: after q iterations, at the predicted state."""
    effective: float
    """J_{k+1}: p(t_{k+1}) at the state reached at t_{k+1}."""


class Assessment(NamedTuple):
    """The quantities of Algorithm 1. `gamma` is the gradient whose sign decides; increments are per iteration."""

    efficiency: float
    """E^r."""
    mismatch: float
    """D^r."""
    contraction: float
    """K^r = E^r D^r."""
    mismatch_increment: float
    """Delta D^r / Delta q."""
    efficiency_increment: float
    """Delta E^r / Delta q."""
    contraction_increment: float
    """Delta K^r / Delta q."""
    response_increment: float
    """Delta t_r / Delta q; infinite at K^r = 1, where the response time is."""
    gamma: float


def assess(observation: Observation) -> Assessment:
    """Compute the quantities of Algorithm 1 as printed, in the floating-point type of the costs."""
    o = observation
    real = type(o.effective)
    zero, one, q = real(0.0), real(1.0), real(o.iterations)
    E = o.delivered / o.hot_start
    D = (o.effective * o.hot_start) / (o.delivered * o.effective_before)
    K = E * D
    dD = (D - one) / q
    dE = (o.delivered - o.last_but_one) / o.hot_start
    dK = E * dD + D * dE
    log_K = real(math.log(K))
    dt_r = (-log_K + q / K * dK) / (log_K * log_K) if log_K != zero else real(math.copysign(real(math.inf), dK))
    return Assessment(E, D, K, dD, dE, dK, dt_r, dK if one <= K else dt_r)


assessed = kernel(assess)


class UpdatingRule(Protocol):
    """Parameters of a rule; a kernel is registered for their type."""

    @property
    def first(self) -> int:
        """Iterations of the first period, q(t_0)."""

    @property
    def status(self) -> UpdatingRuleStatus:
        """The rule and its parameters, as registers show them."""

    def after_interruption(self, memory: Array) -> int:
        """Return the iterations of the period that begins with a load step."""


Decision = Callable[[Any, Array, Observation, Assessment], int]
D = TypeVar("D", bound=Decision)

DECISIONS: Final[dict[type, Decision]] = {}
"""The kernel of each rule."""


def decides_by(rule: type) -> Callable[[D], D]:
    """Register a kernel as what decides by rules of this type."""

    def register(decision: D) -> D:
        DECISIONS[rule] = decision
        return decision

    return register


def decide_by(rule: Any, memory: Array, observation: Observation, assessment: Assessment) -> int:  # noqa: ANN401
    """Return q(t_{k+1}) by the kernel that is registered for a rule, which may overwrite its memory (2,)."""
    return DECISIONS[type(rule)](rule, memory, observation, assessment)


@overload(decide_by, jit_options={"error_model": "numpy"}, strict=False)
def _decide_by(rule: Any, memory: Any, observation: Any, assessment: Any) -> Any:  # noqa: ANN401, ARG001 types of numba
    decide = DECISIONS[rule.instance_class]
    return lambda rule, memory, observation, assessment: decide(rule, memory, observation, assessment)  # noqa: PLW0108
