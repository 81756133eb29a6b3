"""How long the next updating period is: rules for q(t_{k+1}), the number of iterations of the next period.

`Algorithm1` is the paper's rule (section II), literally as printed; `FixedPeriod` is what it is compared with.
"""

import math
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Observation:
    """What is known at t_{k+1} of the period that ends there; costs are positive (Assumption 1 of the paper)."""

    iterations: int
    """q(t_k)."""
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


@dataclass(frozen=True, slots=True)
class Assessment:
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
    """Compute the quantities of Algorithm 1 as printed."""
    o = observation
    q = o.iterations
    E = o.delivered / o.hot_start
    D = (o.effective * o.hot_start) / (o.delivered * o.effective_before)
    K = E * D
    dD = (D - 1.0) / q
    dE = (o.delivered - o.last_but_one) / o.hot_start
    dK = E * dD + D * dE
    log_K = math.log(K)
    dt_r = (-log_K + q / K * dK) / log_K**2 if log_K != 0.0 else math.copysign(math.inf, dK)
    return Assessment(E, D, K, dD, dE, dK, dt_r, gamma=dK if K >= 1.0 else dt_r)


class UpdatingRule(Protocol):
    """Decides q(t_{k+1})."""

    @property
    def first(self) -> int:
        """Iterations of the first period, q(t_0)."""

    def next(self, observation: Observation) -> tuple[int, Assessment]:
        """Return q(t_{k+1}) and the quantities it was, or could have been, decided by."""


@dataclass(frozen=True, slots=True)
class FixedPeriod:
    """Always the same number of iterations."""

    iterations: int

    @property
    def first(self) -> int:
        """The fixed number."""
        return self.iterations

    def next(self, observation: Observation) -> tuple[int, Assessment]:
        """Return the fixed number."""
        return self.iterations, assess(observation)


@dataclass(frozen=True, slots=True)
class Algorithm1:
    """The paper's rule: one step of size `delta` down the gradient Gamma, projected on {q_min, ..., q_max}."""

    q_first: int
    q_min: int
    q_max: int
    delta: int

    @property
    def first(self) -> int:
        """q(t_0)."""
        return self.q_first

    def next(self, observation: Observation) -> tuple[int, Assessment]:
        """Return max(q_min, min(q_max, q - delta sign(Gamma)))."""
        assessment = assess(observation)
        sign = int(assessment.gamma > 0) - int(assessment.gamma < 0)
        q = observation.iterations - self.delta * sign
        return max(self.q_min, min(self.q_max, q)), assessment
