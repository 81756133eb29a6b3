"""Explains an updating period: from the record of an update to the branch that decided it.

A pure function of registers: it works on a running rig and on a recorded run alike. Symbols are those of Algorithm 1
(`coldloop_optimizer_plc/rules/`): the quantities of update i were found at t_i, of the period that ended there.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from coldloop.process.declaration import Process
from coldloop.process.updating_periods import ComputingTimes
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import Optimization, UpdatingRuleKind, UpdatingRuleStatus

RESOLUTION: Final = 2.0**-22
"""A change of E that is smaller is lost in the single precision of the registers."""
STEEPEST: Final = 0.1
"""Slope of K, 1/iteration, that is not reached where K is 1."""


class Branch(StrEnum):
    """Branch that decided q."""

    FIXED = "fixed"
    """The period is fixed."""
    FIRST = "first"
    """There is no period before this one."""
    BEGUN_AGAIN = "begun again"
    """The optimiser was restarted, had no answer before, or another client has moved the inputs."""
    INTERRUPTED = "interrupted"
    """A load step ended the period before."""
    LATE = "late"
    """The sequence before never took effect: q is kept."""
    UNKNOWN = "unknown"
    """The update before is not recorded."""
    DOWN = "down"
    """Gamma > 0: a shorter period."""
    UP = "up"
    """Gamma < 0: a longer period."""
    LEVEL = "level"
    """Gamma = 0: as before."""
    CONTRACTION = "contraction"
    """The contraction rule."""
    OUTSIDE = "outside"
    """Somebody else's rule."""


DECIDED: Final = frozenset({Branch.DOWN, Branch.UP, Branch.LEVEL})
"""Branches of Algorithm 1."""


class Increments(NamedTuple):
    """The quantities per iteration that Gamma is made of."""

    mismatch: float
    """Delta D / Delta n."""
    efficiency: float
    """Delta E / Delta n."""
    contraction: float
    """Delta K / Delta n."""


@dataclass(frozen=True)
class Alternative:
    """What another q would have meant, to first order."""

    q: int
    iterations: int
    """That fit into its period."""
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
    q_before: int | None
    q: int
    spare_s: float
    """How much longer the period is than that of q: answers have been late."""
    period_before_s: float | None
    elapsed_s: float | None
    """Of the period before, until this one began."""
    period_s: float
    increments: Increments | None
    alternatives: tuple[Alternative, ...]
    budget: Budget
    predicted: float
    """Cost predicted for the end of this period."""
    came: float | None
    """Cost that was reached there; None while it is not known."""


def explain(
    update: Optimization, before: Optimization | None, after: Optimization | None, rule: UpdatingRuleStatus,
    process: Process,
) -> Explanation:  # fmt: skip
    """Explain the updating period that begins with `update`.

    Args:
        update: The update.
        before: The one recorded before it.
        after: The one recorded after it.
        rule: What decides the updating period.
        process: Whose ticks they are.
    """
    tick_s = process.tick_s
    if before is not None and before.update + 1 != update.update:
        before = None
    branch = _branch(update, before, rule)
    times = ComputingTimes(rule.slots, rule.preparation, rule.iteration, tick_s, process.ticks_per_sample)
    n_before = times.iterations(times.period(before.q)) if before is not None else 0
    increments = increments_of(update, n_before) if branch in DECIDED and before is not None else None
    needed = update.tau_u if branch is Branch.FIXED else times.period(update.q)
    return Explanation(
        update=update,
        before=before,
        branch=branch,
        q_before=before.q if before is not None else None,
        q=update.q,
        spare_s=(update.tau_u - needed) * tick_s,
        period_before_s=before.tau_u * tick_s if before is not None else None,
        elapsed_s=(update.tick - before.tick) * tick_s if before is not None else None,
        period_s=update.tau_u * tick_s,
        increments=increments,
        alternatives=_alternatives(update, before.q, increments, rule.delta, times) if increments and before else (),
        budget=budget_of(update, rule, tick_s),
        predicted=update.j_delivered,
        came=after.j_effective if after is not None and after.update == update.update + 1 else None,
    )


def is_rounded_to_one(update: Optimization) -> bool:
    """Return whether K was below 1, and is 1 in the single precision of the registers: Gamma is no slope of K then."""
    return update.contraction == 1.0 and abs(update.gamma) >= STEEPEST


def increments_of(update: Optimization, iterations_before: int) -> Increments | None:
    """Return what Gamma was made of: it follows from E, D, K, Gamma and the iterations; None where it does not."""
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


def budget_of(update: Optimization, rule: UpdatingRuleStatus, tick_s: float) -> Budget:
    """Return how the PLC spends the period."""
    answer = rule.preparation + update.iterations * rule.iteration
    return Budget(rule.preparation, answer, update.tau_u * tick_s, update.iterations, rule.iteration)


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
    if rule.rule == UpdatingRuleKind.OUTSIDE:
        return Branch.OUTSIDE
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
    if before.verdict == Verdict.NO_ANSWER:
        return Branch.BEGUN_AGAIN
    if elapsed < before.tau_u and before.verdict in {Verdict.NONE, Verdict.WRONG_UPDATE}:
        return Branch.INTERRUPTED
    if elapsed != before.tau_u and update.q == rule.q_first != before.q:
        return Branch.BEGUN_AGAIN
    return Branch.LATE


def _alternatives(
    update: Optimization, q_before: int, increments: Increments, delta: int, times: ComputingTimes
) -> tuple[Alternative, ...]:
    found = []
    n_before = times.iterations(times.period(q_before))
    for q in (q_before - delta, q_before, q_before + delta):
        if q < 1:
            continue
        period = times.period(q)
        n = times.iterations(period)
        K = update.contraction + (n - n_before) * increments.contraction
        response = -n * times.iteration / math.log(K) if 0.0 < K < 1.0 else None
        found.append(Alternative(q, n, period * times.tick_s, K, response))
    return tuple(found)
