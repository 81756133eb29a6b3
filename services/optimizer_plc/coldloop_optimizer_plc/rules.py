"""Rules of the updating period: what they decide by, the three of ours, and somebody else's.

A rule decides q(t_{k+1}), the number of the next period in the ladder of periods; `PlcBudget` knows the ladder, and how
many iterations of the solver fit into each. A rule is a NamedTuple of its parameters and a kernel that is registered
for it, which takes single and double precision alike.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple, Protocol

from numba.extending import overload

from coldloop.kernels.compiled import kernel
from coldloop.kernels.intrinsics import Implementations
from coldloop.registers.optimizer_plc import UpdatingRuleKind, UpdatingRuleStatus
from coldloop_optimizer_plc.computing_settings import Part, PlcBudget, in_its_name, made
from coldloop_optimizer_plc.qp.linear_algebra import DOUBLE, Array, Real
from coldloop_optimizer_plc.settings import ProgramSettings, RuleName

MEMORY: Final = 1  # numbers that a rule may remember from one period to the next, in an array that begins with zeros


class Observation(NamedTuple):
    """Observation at t_{k+1} of the period that ends there; costs are positive (Assumption 1 of the paper).

    q is q(t_k), the number of the period in the ladder, period_s is t_{k+1} - t_k. effective_before is J_k, p(t_k) at
    the state reached at t_k; effective is J_{k+1}, p(t_{k+1}) at the state reached at t_{k+1}. At the state predicted
    for t_{k+1}, hot_start is J+_k, of the shifted profile, last_but_one that after all iterations but one, and
    delivered Ĵ_{k+1}, after all iterations.
    """

    q: int
    iterations: int
    period_s: float
    effective_before: float
    hot_start: float
    last_but_one: float
    delivered: float
    effective: float


class Assessment(NamedTuple):
    """The quantities of Algorithm 1. `gamma` is the gradient whose sign decides; n are iterations, the paper's q.

    Efficiency is E^r, mismatch D^r, contraction K^r = E^r D^r; the increments are those of D^r, E^r, K^r and t_r over
    Delta n, the last one infinite at K^r = 1, where the response time is.
    """

    efficiency: float
    mismatch: float
    contraction: float
    mismatch_increment: float
    efficiency_increment: float
    contraction_increment: float
    response_increment: float
    gamma: float


def assess(observation: Observation) -> Assessment:
    """Compute the quantities of Algorithm 1 as printed, in the floating-point type of the costs."""
    o = observation
    real = type(o.effective)
    zero, one, n = real(0.0), real(1.0), real(o.iterations)
    E = o.delivered / o.hot_start
    D = (o.effective * o.hot_start) / (o.delivered * o.effective_before)
    K = E * D
    dD = (D - one) / n
    dE = (o.delivered - o.last_but_one) / o.hot_start
    dK = E * dD + D * dE
    log_K = real(math.log(K))
    dt_r = (-log_K + n / K * dK) / (log_K * log_K) if log_K != zero else real(math.copysign(real(math.inf), dK))
    return Assessment(E, D, K, dD, dE, dK, dt_r, dK if one <= K else dt_r)


assessed = kernel(assess)


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
DECISIONS: Final[Implementations[Decision]] = Implementations("decide_by")  # the kernel of each rule
decides_by = DECISIONS.register  # decorator of the kernel that decides by rules of a class


def decide_by(rule: Any, memory: Array, observation: Observation, assessment: Assessment) -> int:  # noqa: ANN401
    """Return q(t_{k+1}) by the kernel that is registered for a rule, which may overwrite its memory (1,)."""
    return DECISIONS[type(rule)](rule, memory, observation, assessment)


@overload(decide_by, jit_options={"error_model": "numpy"}, strict=False)
def _decide_by(rule: Any, memory: Any, observation: Any, assessment: Any) -> Any:  # noqa: ANN401, ARG001 types of numba
    decide = DECISIONS[rule.instance_class]
    return lambda rule, memory, observation, assessment: decide(rule, memory, observation, assessment)  # noqa: PLW0108


FIXED_PERIOD: Final = int(UpdatingRuleKind.FIXED)
ALGORITHM_1: Final = int(UpdatingRuleKind.ALGORITHM_1)
CONTRACTION: Final = int(UpdatingRuleKind.CONTRACTION)


class Rule(NamedTuple):
    """Parameters of any rule of ours: of one type, so that what is compiled for one serves all.

    - Fixed period: always the same q, what adaptive periods are compared with.
    - Algorithm 1: the paper's rule as printed (section II), one step of `delta` down Gamma, projected on
      {low, ..., high}.
    - Contraction: Algorithm 1 with a dead band, that rests at its shortest period; the default of the cold box.

    The cost contracts from J_k to J_{k+1} by K. Where |ln K| is within `band` times its usual size, it says nothing,
    and the contraction rule's q goes down by one to `low`. Beyond that, q goes up by one where the gradient Gamma of
    the response time asks for a longer period, and down by one where it does not. The usual size is the median of
    |ln K|, followed by small steps up and down: in quiet it is the noise of the measured contraction
    (`docs/updating-period.md`). The last three parameters have the floating-point type of the costs.
    """

    kind: int  # an `UpdatingRuleKind`
    first: int  # q(t_0), and that of a period which begins with a load step: what was learnt before says nothing of it
    low: int  # least q
    high: int  # largest q
    delta: int = 0  # step of Algorithm 1
    band: float = 0.0  # usual sizes of |ln K| up to which it says nothing
    least: float = 0.0  # least usual size, where it begins
    change: float = 0.0  # share by which the usual size changes in a period

    @property
    def status(self) -> UpdatingRuleStatus:
        """The rule and its whole numbers, as registers show them."""
        return UpdatingRuleStatus(UpdatingRuleKind(self.kind), *self[1:5])

    def after_interruption(self) -> int:
        """Return the q of the period that begins with a load step."""
        return self.first


@decides_by(Rule)
@kernel
def decide(rule: Rule, memory: Array, o: Observation, a: Assessment) -> int:
    """Return q(t_{k+1}); by contraction it takes about a dozen operations, one of them a logarithm.

    The usual size of |ln K| is in the memory.
    """
    zero, one = memory.dtype.type(0.0), memory.dtype.type(1.0)
    if rule.kind == FIXED_PERIOD:
        return rule.first
    if rule.kind == ALGORITHM_1:
        sign = int(a.gamma > zero) - int(a.gamma < zero)
        return max(rule.low, min(rule.high, o.q - rule.delta * sign))
    usual = max(memory[0], rule.least)
    size = abs(math.log(o.effective / o.effective_before))
    memory[0] = usual * (one + rule.change) if size > usual else usual * (one - rule.change)
    longer = size > rule.band * usual and a.gamma < zero
    return min(o.q + 1, rule.high) if longer else max(min(o.q - 1, rule.high), rule.low)


class OutsideDecision(Protocol):
    """Rule that an entry point of the group `coldloop.rules` makes for each session; it is deterministic.

    It may have `after_interruption()`, too: the q of a period that begins with a load step, which else is the first.
    """

    def __init__(self, periods: Sequence[int]) -> None:
        """Begin with the ladder: updating periods in ticks, rising. Their numbers q count from 1."""

    def first(self) -> int:
        """Return q(t_0)."""

    def decide(self, observation: Observation, assessment: Assessment) -> int:
        """Return q(t_{k+1})."""


class OutsideRule:
    """Rule of an entry point: a result that is no period's number leaves q unchanged, at a beginning at the longest."""

    def __init__(self, name: str, budget: PlcBudget) -> None:
        self.name, self._most = name, len(budget.ladder)
        self._rule: OutsideDecision = made(Part.RULE, name, budget.ladder)
        self.first = self._asked("first", otherwise=self._most)

    @property
    def status(self) -> UpdatingRuleStatus:
        """The ladder that it may use."""
        return UpdatingRuleStatus(UpdatingRuleKind.OUTSIDE, self.first, 1, self._most)

    def after_interruption(self) -> int:
        """Return the q of the period that begins with a load step."""
        return self._asked("after_interruption", "first", otherwise=self._most)

    def decide(self, o: Observation, a: Assessment) -> int:
        """Return q(t_{k+1}); a ConfigurationError is that the rule raises, or returns no number."""
        return self._asked("decide", given=(o, a), otherwise=o.q)

    def _asked(self, *names: str, given: Sequence[object] = (), otherwise: int) -> int:
        """Return what the first method says that there is; to look for it runs code of others, too."""
        with in_its_name(Part.RULE, self.name):
            name = next((each for each in names if hasattr(self._rule, each)), names[-1])
            q = float(getattr(self._rule, name)(*given))
        return int(q) if q.is_integer() and 1 <= q <= self._most else otherwise


@decides_by(OutsideRule)
def decide_outside(rule: OutsideRule, memory: Array, o: Observation, a: Assessment) -> int:  # noqa: ARG001 it has its own
    """Return q(t_{k+1})."""
    return rule.decide(o, a)


def make_rule(settings: ProgramSettings, budget: PlcBudget, fixed_ticks: int, real: Real = DOUBLE) -> UpdatingRule:
    """Return the rule that the settings name, for a fixed updating period (ticks) or, 0, adaptive ones.

    `budget` knows the q of a fixed period; `real` is the floating-point type of the costs.
    Raises ConfigurationError if there is no such rule, or it cannot be made.
    """
    if settings.outside.rule and not fixed_ticks:
        return OutsideRule(settings.outside.rule, budget)
    adaptive, own = settings.adaptive, settings.adaptive.contraction
    parts = 0, real(own.band), real(own.least), real(own.change)
    if fixed_ticks:
        q = budget.q(fixed_ticks)
        return Rule(FIXED_PERIOD, q, q, q, *parts)
    if adaptive.rule is RuleName.CONTRACTION:
        return Rule(CONTRACTION, own.q_max, own.q_rest, own.q_max, *parts)
    return Rule(ALGORITHM_1, adaptive.q_first, adaptive.q_min, adaptive.q_max, adaptive.delta, *parts[1:])
