"""How long the next updating period is: rules for q(t_{k+1}), the number of iterations of the next period.

`Algorithm1` is the paper's rule (section II), literally as printed; `FixedPeriod` is what it is compared with;
`ContractionRule` is this project's own (`docs/updating-period.md`).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus


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
    """Compute the quantities of Algorithm 1 as printed; the rig compiles this function and what the rules decide by."""
    o = observation
    q = o.iterations
    E = o.delivered / o.hot_start
    D = (o.effective * o.hot_start) / (o.delivered * o.effective_before)
    K = E * D
    dD = (D - 1.0) / q
    dE = (o.delivered - o.last_but_one) / o.hot_start
    dK = E * dD + D * dE
    log_K = math.log(K)
    dt_r = (-log_K + q / K * dK) / (log_K * log_K) if log_K != 0.0 else math.copysign(math.inf, dK)
    return Assessment(E, D, K, dD, dE, dK, dt_r, dK if K >= 1.0 else dt_r)


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
        return one_step(self.q_min, self.q_max, self.delta, observation.iterations, assessment.gamma), assessment


def one_step(q_min: int, q_max: int, delta: int, q: int, gamma: float) -> int:
    """Return max(q_min, min(q_max, q - delta sign(Gamma))), the decision of Algorithm 1."""
    sign = int(gamma > 0) - int(gamma < 0)
    return max(q_min, min(q_max, q - delta * sign))


class ContractionParameters(NamedTuple):
    """Parameters of the contraction rule."""

    q_busy: int
    q_quiet: int
    q_step: int
    rate: float
    """Contraction, 1/s, from which on the period is shortest."""
    memory: float
    """What is left of v after a second."""
    surprise: float


def recent_contraction(rule: ContractionParameters, contraction: float, delivered: float, o: Observation) -> float:
    """Return v (1/s) at the end of a period, from v before and the cost delivered then (0 for none)."""
    improvement = math.log(delivered / o.delivered) / o.period_s if delivered else 0.0
    remembered: float = rule.memory**o.period_s * contraction
    return max(min(improvement, 2.0 * rule.rate), remembered)


def by_contraction(rule: ContractionParameters, contraction: float, o: Observation) -> int:
    """Return q(t_{k+1}) for v at the end of the period: about a dozen operations with those of v."""
    if o.effective > rule.surprise * o.delivered:
        return rule.q_step
    busy = min(1.0, contraction / rule.rate)
    return round(rule.q_quiet - (rule.q_quiet - rule.q_busy) * busy)


@dataclass(slots=True)
class ContractionRule:
    """This project's rule: short periods while the delivered cost contracts, longer ones in quiet.

    With g = max(0, ln(J-hat_k / J-hat_{k+1})) / tau_u the rate at which successive profiles improve, and v its decaying
    maximum, q goes from `q_quiet` at v = 0 down to `q_busy` at v = `rate`. A profile that turns out worse than
    `surprise` times what was predicted, and a load step, are answered by one long solve of `q_step` iterations.
    """

    parameters: ContractionParameters
    contraction: float = 0.0
    """v."""
    delivered: float = 0.0
    """J-hat of the profile before; 0 where it says nothing."""

    @property
    def first(self) -> int:
        """Iterations in quiet."""
        return self.parameters.q_quiet

    @property
    def status(self) -> UpdatingRuleStatus:
        """The three numbers that q moves between; the first period has that of quiet."""
        rule = self.parameters
        return UpdatingRuleStatus(UpdatingRuleKind.CONTRACTION, rule.q_step, rule.q_busy, rule.q_step)

    def after_interruption(self) -> int:
        """Return what one long solve takes."""
        self.delivered = 0.0  # another load is another problem: its cost says nothing of contraction
        return self.parameters.q_step

    def next(self, observation: Observation) -> tuple[int, Assessment]:
        """Return q(t_{k+1})."""
        rule = self.parameters
        self.contraction = recent_contraction(rule, self.contraction, self.delivered, observation)
        self.delivered = observation.delivered
        return by_contraction(rule, self.contraction, observation), assess(observation)
