"""How long the next updating period is: rules for q(t_{k+1}), the number of iterations of the next period.

`Algorithm1` is the paper's rule (section II), literally as printed; `FixedPeriod` is what it is compared with;
`ContractionRule` is this project's own (`docs/updating-period.md`).
"""

import math
from dataclasses import dataclass
from typing import Protocol

from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus


@dataclass(frozen=True, slots=True)
class Observation:
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

    @property
    def status(self) -> UpdatingRuleStatus:
        """The rule and its parameters, as registers show them."""

    def after_interruption(self) -> int:
        """Return the iterations of the period that begins with a load step."""

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

    @property
    def status(self) -> UpdatingRuleStatus:
        """The fixed number."""
        return UpdatingRuleStatus(UpdatingRuleKind.FIXED, self.iterations, self.iterations, self.iterations)

    def after_interruption(self) -> int:
        """Return the fixed number."""
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

    @property
    def status(self) -> UpdatingRuleStatus:
        """Its four parameters."""
        return UpdatingRuleStatus(UpdatingRuleKind.ALGORITHM_1, self.q_first, self.q_min, self.q_max, self.delta)

    def after_interruption(self) -> int:
        """Return q(t_0): what was learnt of the problem before the step says nothing of the one after."""
        return self.q_first

    def next(self, observation: Observation) -> tuple[int, Assessment]:
        """Return max(q_min, min(q_max, q - delta sign(Gamma)))."""
        assessment = assess(observation)
        sign = int(assessment.gamma > 0) - int(assessment.gamma < 0)
        q = observation.iterations - self.delta * sign
        return max(self.q_min, min(self.q_max, q)), assessment


@dataclass(slots=True)
class ContractionRule:
    """This project's rule: short periods while the delivered cost contracts, longer ones in quiet.

    With g = max(0, ln(J-hat_k / J-hat_{k+1})) / tau_u the rate at which successive profiles improve, and v its decaying
    maximum, q goes from `q_quiet` at v = 0 down to `q_busy` at v = `rate`. A profile that turns out worse than
    `surprise` times what was predicted, and a load step, are answered by one long solve of `q_step` iterations.
    """

    q_busy: int
    q_quiet: int
    q_step: int
    rate: float
    """Contraction, 1/s, from which on the period is shortest."""
    memory: float
    """What is left of v after a second."""
    surprise: float
    _contraction: float = 0.0
    _delivered: float = 0.0

    @property
    def first(self) -> int:
        """Iterations in quiet."""
        return self.q_quiet

    @property
    def status(self) -> UpdatingRuleStatus:
        """The three numbers that q moves between; the first period has that of quiet."""
        return UpdatingRuleStatus(UpdatingRuleKind.CONTRACTION, self.q_step, self.q_busy, self.q_step)

    def after_interruption(self) -> int:
        """Return what one long solve takes."""
        self._delivered = 0.0  # another load is another problem: its cost says nothing of contraction
        return self.q_step

    def next(self, observation: Observation) -> tuple[int, Assessment]:
        """Return q(t_{k+1}): about a dozen operations."""
        o = observation
        improvement = math.log(self._delivered / o.delivered) / o.period_s if self._delivered else 0.0
        recent = self.memory**o.period_s * self._contraction
        self._contraction = max(min(improvement, 2.0 * self.rate), recent)
        self._delivered = o.delivered
        assessment = assess(o)
        if o.effective > self.surprise * o.delivered:
            return self.q_step, assessment
        busy = min(1.0, self._contraction / self.rate)
        return round(self.q_quiet - (self.q_quiet - self.q_busy) * busy), assessment
