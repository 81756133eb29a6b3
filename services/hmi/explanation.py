"""Explains an updating period: from the record of an update to the branch that decided it.

A pure function of registers: it works on a running rig and on a recorded run alike. Symbols are those of Algorithm 1
(`optimizer_plc/rules/`): the quantities of update i were found at t_i, of the period that ended there.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from coldloop.process.signals import TICK_S, TICKS_PER_SAMPLE
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import Optimization, UpdatingRuleKind, UpdatingRuleStatus

ROUNDING: Final = 1e-6
RESOLUTION: Final = 2.0**-22
"""A change of E that is smaller is lost in the single precision of the registers."""
STEEPEST: Final = 0.1
"""Slope of K, 1/iteration, that is not reached where K is 1."""
LONGEST_TICKS: Final = TICKS_PER_SAMPLE


class Branch(StrEnum):
    """Branch that decided the number of iterations."""

    FIXED = "fixed"
    """The period is fixed."""
    FIRST = "first"
    """There is no period before this one."""
    BEGUN_AGAIN = "begun again"
    """The optimiser was restarted, or another client has moved the inputs."""
    INTERRUPTED = "interrupted"
    """A load step ended the period before."""
    LATE = "late"
    """The sequence before never took effect: q is kept."""
    UNKNOWN = "unknown"
    """The update before is not recorded."""
    DOWN = "down"
    """Gamma > 0: fewer iterations."""
    UP = "up"
    """Gamma < 0: more iterations."""
    LEVEL = "level"
    """Gamma = 0: as before."""
    CONTRACTION = "contraction"
    """The contraction rule."""


DECIDED: Final = frozenset({Branch.DOWN, Branch.UP, Branch.LEVEL})
"""Branches of Algorithm 1."""


class Increments(NamedTuple):
    """The quantities per iteration that Gamma is made of."""

    mismatch: float
    """Delta D / Delta q."""
    efficiency: float
    """Delta E / Delta q."""
    contraction: float
    """Delta K / Delta q."""


@dataclass(frozen=True)
class Alternative:
    """What another number of iterations would have meant, to first order."""

    iterations: int
    period_s: float
    contraction: float
    response_s: float | None
    """Time in which the cost falls by a factor e; None when it does not fall."""


@dataclass(frozen=True)
class Budget:
    """How the PLC spends the period, s from its beginning."""

    preparation: float
    """End of the preparation."""
    answer: float
    """End of the last iteration: the answer."""
    period: float
    iterations: int
    iteration: float
    """Time of one iteration."""

    @property
    def slack(self) -> float:
        """What is left; negative when the answer is late."""
        return self.period - self.answer


@dataclass(frozen=True)
class Explanation:
    """Explanation of an updating period."""

    update: Optimization
    before: Optimization | None
    """The update right before it; None when it is not recorded."""
    branch: Branch
    iterations_before: int | None
    iterations: int
    spare_s: float
    """How much longer the period is than its iterations need: answers have been late, or more would change nothing."""
    period_before_s: float | None
    period_s: float
    increments: Increments | None
    alternatives: tuple[Alternative, ...]
    budget: Budget
    predicted: float
    """Cost predicted for the end of this period."""
    came: float | None
    """Cost that was reached there; None while it is not known."""


def explain(
    update: Optimization, before: Optimization | None, after: Optimization | None, rule: UpdatingRuleStatus
) -> Explanation:
    """Explain the updating period that begins with `update`.

    Args:
        update: The update.
        before: The one recorded before it.
        after: The one recorded after it.
        rule: What decides the updating period.
    """
    if before is not None and before.update + 1 != update.update:
        before = None
    branch = _branch(update, before, rule)
    q_before = before.iterations if before is not None else None
    increments = increments_of(update, q_before) if branch in DECIDED and q_before else None
    return Explanation(
        update=update,
        before=before,
        branch=branch,
        iterations_before=q_before,
        iterations=update.iterations,
        spare_s=max(0, update.tau_u - period_ticks(update.iterations, rule)) * TICK_S,
        period_before_s=before.tau_u * TICK_S if before is not None else None,
        period_s=update.tau_u * TICK_S,
        increments=increments,
        alternatives=_alternatives(update, q_before, increments, rule) if increments and q_before else (),
        budget=budget_of(update, rule),
        predicted=update.j_delivered,
        came=after.j_effective if after is not None and after.update == update.update + 1 else None,
    )


def period_ticks(iterations: int, rule: UpdatingRuleStatus) -> int:
    """Return the updating period that holds so many iterations, in ticks."""
    needed = (rule.slots + iterations * rule.iteration) / TICK_S
    return min(LONGEST_TICKS, math.ceil(needed - ROUNDING))


def is_rounded_to_one(update: Optimization) -> bool:
    """Return whether K was below 1, and is 1 in the single precision of the registers: Gamma is no slope of K then."""
    return update.contraction == 1.0 and abs(update.gamma) >= STEEPEST


def increments_of(update: Optimization, iterations_before: int) -> Increments | None:
    """Return the increments that Gamma was made of: they follow from E, D, K, Gamma and q; None where they do not."""
    if is_rounded_to_one(update):
        return None
    E, D, K = update.efficiency, update.mismatch, update.contraction
    dD = (D - 1.0) / iterations_before
    if K >= 1.0:
        dK = update.gamma
    else:
        log_K = math.log(K)
        dK = (update.gamma * log_K**2 + log_K) * K / iterations_before
    dE = (dK - E * dD) / D
    return Increments(dD, dE if abs(dE) * iterations_before > RESOLUTION else 0.0, dK)


def budget_of(update: Optimization, rule: UpdatingRuleStatus) -> Budget:
    """Return how the PLC spends the period."""
    answer = rule.preparation + update.iterations * rule.iteration
    return Budget(rule.preparation, answer, update.tau_u * TICK_S, update.iterations, rule.iteration)


def _branch(update: Optimization, before: Optimization | None, rule: UpdatingRuleStatus) -> Branch:
    if rule.rule == UpdatingRuleKind.FIXED:
        return Branch.FIXED
    if update.update == 0:
        return Branch.FIRST
    undecided = update.efficiency == update.mismatch == update.contraction == 1.0 and update.gamma == 0.0
    if undecided and (before is None or not _was_played(update, before)):
        return _why_not_played(update, before, rule)
    if rule.rule == UpdatingRuleKind.ALGORITHM_1:
        return _by_sign(update.gamma)
    if rule.rule == UpdatingRuleKind.CONTRACTION:
        return Branch.CONTRACTION
    raise NotImplementedError(f"no words for the rule {rule.rule} of the updating period: add a branch")


def _by_sign(gamma: float) -> Branch:
    if gamma > 0:
        return Branch.DOWN
    return Branch.UP if gamma < 0 else Branch.LEVEL


def _was_played(update: Optimization, before: Optimization) -> bool:
    return before.verdict == Verdict.ACCEPTED and update.tick - before.tick == before.tau_u


def _why_not_played(update: Optimization, before: Optimization | None, rule: UpdatingRuleStatus) -> Branch:
    if before is None:
        return Branch.UNKNOWN
    elapsed = update.tick - before.tick
    if elapsed < before.tau_u and before.verdict in {Verdict.NONE, Verdict.WRONG_UPDATE}:
        return Branch.INTERRUPTED
    if elapsed != before.tau_u and update.iterations == rule.q_first != before.iterations:
        return Branch.BEGUN_AGAIN
    return Branch.LATE


def _alternatives(
    update: Optimization, q_before: int, increments: Increments, rule: UpdatingRuleStatus
) -> tuple[Alternative, ...]:
    found = []
    for step in (-rule.delta, 0, rule.delta):
        q = q_before + step
        if q < 1:
            continue
        K = update.contraction + step * increments.contraction
        response = -q * rule.iteration / math.log(K) if 0.0 < K < 1.0 else None
        found.append(Alternative(q, period_ticks(q, rule) * TICK_S, K, response))
    return tuple(found)
