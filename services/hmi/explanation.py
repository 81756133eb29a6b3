"""Why an updating period is as long as it is: from what was recorded of an update to the branch that decided, in words.

A pure function of registers: it works on a running rig and on a recorded run alike. Symbols are those of Algorithm 1
(`optimizer_plc/updating_period.py`): the quantities of update i were found at t_i, of the period that ended there.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from coldloop.event_text import word
from coldloop.process import TICK_S, TICKS_PER_SAMPLE
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import Optimization, UpdatingRuleKind, UpdatingRuleStatus

EPSILON: Final = 1e-6
LONGEST_TICKS: Final = TICKS_PER_SAMPLE


class Branch(StrEnum):
    """What decided the number of iterations."""

    FIXED = "fixed"
    """The period is fixed."""
    FIRST = "first"
    """There is no period before this one."""
    BEGUN_AGAIN = "begun again"
    """The optimiser had lost the thread: others have moved the inputs, or it was restarted."""
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
    """Why an updating period is as long as it is."""

    update: Optimization
    branch: Branch
    iterations_before: int | None
    iterations: int
    period_before_s: float | None
    period_s: float
    increments: Increments | None
    alternatives: tuple[Alternative, ...]
    budget: Budget
    predicted: float
    """Cost predicted for the end of this period."""
    came: float | None
    """Cost that was reached there; None while it is not known."""
    sentence: str


def planned_iterations(update: Optimization, rule: UpdatingRuleStatus) -> int:
    """Return q(t_i): what was done, or more when more would have changed nothing."""
    q = update.iterations
    while q < rule.q_max and period_ticks(q, rule) < update.tau_u:
        q += 1
    return q if period_ticks(q, rule) == update.tau_u else update.iterations


def period_ticks(iterations: int, rule: UpdatingRuleStatus) -> int:
    """Return the updating period that holds so many iterations, in ticks."""
    needed = (rule.slots + iterations * rule.iteration) / TICK_S
    return min(LONGEST_TICKS, math.ceil(needed - EPSILON))


def increments_of(update: Optimization, iterations_before: int) -> Increments:
    """Return the increments that Gamma was made of: they follow from E, D, K, Gamma and q."""
    E, D, K = update.efficiency, update.mismatch, update.contraction
    dD = (D - 1.0) / iterations_before
    if K >= 1.0:
        dK = update.gamma
    else:
        log_K = math.log(K)
        dK = (update.gamma * log_K**2 + log_K) * K / iterations_before
    return Increments(dD, (dK - E * dD) / D, dK)


def explain(
    update: Optimization,
    before: Optimization | None,
    after: Optimization | None,
    rule: UpdatingRuleStatus,
) -> Explanation:
    """Explain the updating period that begins with `update`.

    Args:
        update: The update.
        before: The update before it, as far as it is recorded.
        after: The update after it, as far as there is one.
        rule: What decides the updating period.
    """
    if before is not None and before.update >= update.update:
        before = None
    branch = _branch(update, before, rule)
    follows = before is not None and before.update + 1 == update.update
    q_before = planned_iterations(before, rule) if before is not None and follows else None
    q = planned_iterations(update, rule)
    decided = branch in (Branch.DOWN, Branch.UP, Branch.LEVEL)
    increments = increments_of(update, q_before) if decided and q_before else None
    came = after.j_effective if after is not None and after.update == update.update + 1 else None
    return Explanation(
        update=update,
        branch=branch,
        iterations_before=q_before,
        iterations=q,
        period_before_s=before.tau_u * TICK_S if before is not None and follows else None,
        period_s=update.tau_u * TICK_S,
        increments=increments,
        alternatives=_alternatives(update, q_before, increments, rule) if increments and q_before else (),
        budget=budget_of(update, rule),
        predicted=update.j_delivered,
        came=came,
        sentence=_sentence(update, before if follows else None, branch, q_before, q, rule),
    )


def _branch(update: Optimization, before: Optimization | None, rule: UpdatingRuleStatus) -> Branch:
    if rule.rule == UpdatingRuleKind.FIXED:
        return Branch.FIXED
    if update.update == 0:
        return Branch.FIRST
    undecided = update.efficiency == update.mismatch == update.contraction == 1.0 and update.gamma == 0.0
    if before is None or before.update + 1 != update.update:
        if undecided or rule.rule == UpdatingRuleKind.CONTRACTION:
            return Branch.UNKNOWN
    elif undecided:
        played = before.verdict == Verdict.ACCEPTED and update.tick - before.tick == before.tau_u
        if not played:
            return _why_not_played(update, before, rule)
    if rule.rule == UpdatingRuleKind.CONTRACTION:
        return Branch.CONTRACTION
    if update.gamma > 0:
        return Branch.DOWN
    return Branch.UP if update.gamma < 0 else Branch.LEVEL


def _why_not_played(update: Optimization, before: Optimization, rule: UpdatingRuleStatus) -> Branch:
    elapsed = update.tick - before.tick
    if elapsed < before.tau_u and before.verdict in {Verdict.NONE, Verdict.WRONG_UPDATE}:
        return Branch.INTERRUPTED
    if update.tau_u == before.tau_u and before.verdict != Verdict.ACCEPTED:
        return Branch.LATE
    if elapsed != before.tau_u and update.tau_u == period_ticks(rule.q_first, rule):
        return Branch.BEGUN_AGAIN
    return Branch.LATE


def _alternatives(
    update: Optimization, q_before: int, increments: Increments, rule: UpdatingRuleStatus
) -> tuple[Alternative, ...]:
    steps = (-rule.delta, 0, rule.delta)
    found = []
    for step in steps:
        q = q_before + step
        if q < 1:
            continue
        K = update.contraction + step * increments.contraction
        falls = 0.0 < K < 1.0
        found.append(
            Alternative(
                iterations=q,
                period_s=period_ticks(q, rule) * TICK_S,
                contraction=K,
                response_s=-q * rule.iteration / math.log(K) if falls else None,
            )
        )
    return tuple(found)


def budget_of(update: Optimization, rule: UpdatingRuleStatus) -> Budget:
    """Return how the PLC spends the period."""
    q = planned_iterations(update, rule)
    answer = rule.preparation + q * rule.iteration
    return Budget(rule.preparation, answer, update.tau_u * TICK_S, q, rule.iteration)


def _sentence(
    update: Optimization,
    before: Optimization | None,
    branch: Branch,
    q_before: int | None,
    q: int,
    rule: UpdatingRuleStatus,
) -> str:
    period = f"{update.tau_u * TICK_S:g} s"
    change = _change(update, before)
    if branch is Branch.FIXED:
        return f"tau_u is {period} because the session has a fixed updating period; q = {q} iterations fit into it."
    if branch is Branch.FIRST:
        return f"tau_u is {period} because this is the first update: q starts at q_first = {rule.q_first}."
    if branch is Branch.BEGUN_AGAIN:
        return (
            f"{change} because the optimiser had to begin again (a restart, or somebody else moved the inputs): "
            f"q starts at q_first = {rule.q_first}."
        )
    if branch is Branch.UNKNOWN:
        return f"tau_u is {period}; the update before is not recorded, so what decided cannot be told."
    if branch is Branch.INTERRUPTED and before is not None:
        return (
            f"{change} because a load step ended the period before after {(update.tick - before.tick) * TICK_S:g} s of "
            f"{before.tau_u * TICK_S:g} s: what was learnt is void and q starts at {rule.q_first}."
        )
    if branch is Branch.LATE and before is not None:
        verdict = word(Verdict(before.verdict)) if before.verdict in Verdict.__members__.values() else "unknown"
        return (
            f"{change}: the sequence before never took effect (verdict: {verdict}), so there was nothing to learn from "
            f"and q stays at {q}."
        )
    if branch is Branch.CONTRACTION:
        return _contraction(update, before, change, q, rule)
    return _algorithm_1(update, change, branch, q_before, q, rule)


def _change(update: Optimization, before: Optimization | None) -> str:
    now = update.tau_u * TICK_S
    if before is None:
        return f"tau_u is {now:g} s"
    then = before.tau_u * TICK_S
    if now == then:
        return f"tau_u stays at {now:g} s"
    return f"tau_u {'rises' if now > then else 'falls'} from {then:g} s to {now:g} s"


def _algorithm_1(
    update: Optimization, change: str, branch: Branch, q_before: int | None, q: int, rule: UpdatingRuleStatus
) -> str:
    K, gamma = update.contraction, update.gamma
    if K >= 1.0:
        looks = f"K = {K:.4g} is not below 1 (the cost does not fall), so K itself is to fall"
        slope = f"dK/dq = {gamma:.3g}"
    else:
        looks = f"K = {K:.4g} is below 1 (the cost falls), so the response time is to fall"
        slope = f"dt_r/dq = {gamma:.3g}"
    if branch is Branch.LEVEL:
        return f"{change} because {looks}; {slope} says that q makes no difference."
    way = "fewer" if branch is Branch.DOWN else "more"
    steps = f"q goes from {q_before} to {q}" if q_before is not None and q != q_before else f"q stays at {q}"
    limit = ""
    if q_before is not None and q == q_before:
        limit = f", as q_{'min' if branch is Branch.DOWN else 'max'} allows no {way}"
    return f"{change} because {looks}; {slope} {'>' if gamma > 0 else '<'} 0 asks for {way} iterations: {steps}{limit}."


def _contraction(
    update: Optimization, before: Optimization | None, change: str, q: int, rule: UpdatingRuleStatus
) -> str:
    if q == rule.q_max and before is not None and update.j_effective > before.j_delivered:
        ratio = update.j_effective / before.j_delivered
        return (
            f"{change} because the cost that was reached is {ratio:.3g} times the one predicted: a surprise is answered "
            f"by one long solve of q = {q}."
        )
    return (
        f"{change} because of how much successive profiles have improved lately: the contraction rule goes from "
        f"q = {rule.q_min} while they do to more in quiet; here q = {q}."
    )
