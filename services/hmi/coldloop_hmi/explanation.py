"""Explains an updating period: from the record of an update to the branch that decided it, and to a sentence.

A pure function of registers: it works on a running rig and on a recorded run alike. Symbols are those of Algorithm 1
(`coldloop_optimizer_plc/rules.py`): the quantities of update i were found at t_i, of the period that ended there.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from coldloop.process import declaration, updating_periods
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import ModelDeviation, Optimization, UpdatingRuleKind, UpdatingRuleStatus
from coldloop.text import number_text

RESOLUTION: Final = 2.0**-22
"""A change of E that is smaller is lost in the single precision of the registers."""
STEEPEST: Final = 0.1
"""Slope of K, 1/iteration, that is not reached where K is 1."""
AT_REST: Final = 1e-9
"""A Gamma that is smaller is rounding: the cost is at its floor."""
NOTABLE_SHARE: Final = 0.01
"""A plant that differs from its model by less than this share of the range of an input is not worth a word, ..."""
NOTABLE_NOISE: Final = 5.0
"""... nor by less than so many times the noise of an output, where the process does not declare what is notable."""
MOST_DEVIATIONS: Final = 4
SURPRISING: Final = 3.0
"""A reading that is so many times further from its prediction than the filter expects is worth a word."""


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


@dataclass(frozen=True)
class Increments:
    """The quantities per iteration that Gamma is made of."""

    mismatch: float
    """Delta D / Delta n."""
    efficiency: float
    """Delta E / Delta n."""
    contraction: float
    """Delta K / Delta n."""


@dataclass(frozen=True)
class Alternative:
    """Expected effect of another q, to first order."""

    q: int
    iterations: int
    """Number of iterations that fit into its period."""
    period_s: float
    contraction: float
    response_s: float | None
    """Time in which the cost falls by a factor e; None when it does not fall."""


@dataclass(frozen=True)
class Budget:
    """Use of the period by the PLC, s from its beginning."""

    preparation: float
    """End of the preparation."""
    answer: float
    """End of the last iteration: the answer."""
    period: float
    iterations: int
    iteration: float
    """Time of one iteration."""
    slack: float
    """Time that is left; negative when the answer is late."""


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
    """Elapsed time of the period before, until this one began."""
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
    process: declaration.Process,
) -> Explanation:  # fmt: skip
    """Explain the updating period that begins with `update`, recorded between two others."""
    tick_s = process.tick_s
    if before is not None and before.update + 1 != update.update:
        before = None
    branch = _branch(update, before, rule)
    times = updating_periods.ComputingTimes(
        rule.slots, rule.preparation, rule.iteration, tick_s, process.ticks_per_sample
    )
    n_before = times.iterations(times.period(before.q)) if before is not None else 0
    increments = increments_of(update, n_before) if branch in DECIDED and before is not None else None
    alternatives = []
    if increments is not None and before is not None:
        for q in (before.q - rule.delta, before.q, before.q + rule.delta):
            if q >= 1:
                period = times.period(q)
                n = times.iterations(period)
                K = update.contraction + (n - n_before) * increments.contraction
                response = -n * times.iteration / math.log(K) if 0.0 < K < 1.0 else None
                alternatives.append(Alternative(q, n, period * tick_s, K, response))
    needed = update.tau_u if branch is Branch.FIXED else times.period(update.q)
    answer, period_s = rule.preparation + update.iterations * rule.iteration, update.tau_u * tick_s
    return Explanation(
        update=update,
        before=before,
        branch=branch,
        q_before=before.q if before is not None else None,
        q=update.q,
        spare_s=(update.tau_u - needed) * tick_s,
        period_before_s=before.tau_u * tick_s if before is not None else None,
        elapsed_s=(update.tick - before.tick) * tick_s if before is not None else None,
        period_s=period_s,
        increments=increments,
        alternatives=tuple(alternatives),
        budget=Budget(rule.preparation, answer, period_s, update.iterations, rule.iteration, period_s - answer),
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


def _branch(update: Optimization, before: Optimization | None, rule: UpdatingRuleStatus) -> Branch:
    if rule.rule == UpdatingRuleKind.FIXED:
        return Branch.FIXED
    if update.update == 0:
        return Branch.FIRST
    undecided = update.efficiency == update.mismatch == update.contraction == 1.0 and update.gamma == 0.0
    was_played = before and before.verdict == Verdict.ACCEPTED and update.tick - before.tick == before.tau_u
    if undecided and not was_played:
        return _why_not_played(update, before, rule)
    if rule.rule == UpdatingRuleKind.ALGORITHM_1:
        return Branch.DOWN if update.gamma > 0 else Branch.UP if update.gamma < 0 else Branch.LEVEL
    if rule.rule == UpdatingRuleKind.CONTRACTION:
        return Branch.CONTRACTION
    if rule.rule == UpdatingRuleKind.OUTSIDE:
        return Branch.OUTSIDE
    raise NotImplementedError(f"no words for the rule {rule.rule} of the updating period: add a branch")


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


def deviation(found: ModelDeviation, process: declaration.Process, suspects: int = 0) -> str:
    """Return how the plant differs from its model, without the load, the most notable first; empty where it agrees.

    Last come the reading that is furthest from what is predicted, if it is surprising: the model, or its sensor, is
    not what the filter takes it for; and those that are not used for that reason (bit i is output i); and inputs
    that have no effect (the bits after those).
    """
    names, notable = process.output_names, list[tuple[float, str]]()
    for moved, value in zip(process.inputs, found.u, strict=True):
        least = process.notable.get(moved.unit, NOTABLE_SHARE * (moved.high - moved.low))
        more = f"{number_text(abs(value), 3)} {moved.unit} {'less' if value > 0 else 'more'}"
        notable.append((abs(value) / least, f"needs {more} of {moved.name}"))
    for output, value in zip(process.outputs, found.y, strict=True):
        least = process.notable.get(output.unit, NOTABLE_NOISE * output.noise)
        more = f"{'+' if value > 0 else ''}{number_text(value, 3)} {output.unit}"
        notable.append((abs(value) / least, f"{output.name} {more}"))
    texts = [text for _, text in sorted((one for one in notable if one[0] >= 1.0), reverse=True)[:MOST_DEVIATIONS]]
    surprise, name = max(zip(found.surprise, names, strict=True))
    if surprise >= SURPRISING:
        texts.append(f"{name} {number_text(surprise, 2)} times further from its prediction than expected")
    texts += [f"{name} is not used: it contradicts the others" for i, name in enumerate(names) if suspects >> i & 1]
    inputs = enumerate(process.input_names, len(names))
    texts += [f"{name} is left where it is: it has no effect" for i, name in inputs if suspects >> i & 1]
    return ", ".join(texts)


def sentence(found: Explanation, rule: UpdatingRuleStatus) -> str:
    """Return the explanation of the period in one or two sentences."""
    text = f"{_because(found, rule)}."
    if found.spare_s:
        text += f" The period is {found.spare_s:g} s longer than that of q = {found.q}, as answers have been late."
    return text


def _because(found: Explanation, rule: UpdatingRuleStatus) -> str:
    period = f"tau_u is {found.period_s:g} s"
    match found.branch:
        case Branch.FIXED:
            done = f"{found.update.iterations} iterations were done in it"
            return f"{period} because the session has a fixed updating period; {done}"
        case Branch.FIRST:
            return f"{period} because this is the first update: q starts at {rule.q_first}"
        case Branch.UNKNOWN:
            return (
                f"{period}; the update before was not played or is not recorded, so there was nothing to learn from "
                "(a load step that interrupts, a late sequence, or a restart)"
            )
    then = found.period_before_s
    if then is not None and then == found.period_s:
        period = f"tau_u stays at {then:g} s"
    elif then is not None:
        period = f"tau_u {'rises' if found.period_s > then else 'falls'} from {then:g} s to {found.period_s:g} s"
    return f"{period} because {_cause(found, rule)}"


def _cause(found: Explanation, rule: UpdatingRuleStatus) -> str:
    q, verdict = found.q, found.before.verdict if found.before else Verdict.NONE
    match found.branch:
        case Branch.BEGUN_AGAIN:
            why = "a restart, or another client moved the inputs"
            if verdict == Verdict.NO_ANSWER:
                why = "the update before has no answer: what was computed is not finite"
            return f"the optimiser had to start over ({why}): q starts at {rule.q_first}"
        case Branch.INTERRUPTED:
            ended = f"a load step ended the period before after {found.elapsed_s:g} s of {found.period_before_s:g} s"
            return f"{ended}: what was learned is discarded and q starts at {rule.q_first}"
        case Branch.LATE:
            said = f"the sequence before did not take effect at its instant (verdict: {Verdict.word_of(verdict)})"
            return f"{said}: there was nothing to learn from, and q stays at {q}"
        case Branch.CONTRACTION:
            K, gamma = number_text(found.update.contraction, 4), number_text(found.update.gamma, 3)
            why = f"K = {K} is within its noise, or Gamma = {gamma} asks for no longer period"
            if found.q_before is not None and (q > found.q_before or q == found.q_before == rule.q_max > rule.q_min):
                why = f"K = {K} is beyond its noise and Gamma = {gamma} < 0 asks for a longer period"
            return f"{why}: the contraction rule has q = {q}, at rest {rule.q_min}"
        case Branch.OUTSIDE:
            return f"the rule that is installed beside Coldloop decided so: q = {q}"
    return _by_algorithm_1(found)


def _by_algorithm_1(found: Explanation) -> str:
    K, gamma, q = found.update.contraction, found.update.gamma, found.q
    if is_rounded_to_one(found.update):
        looks = "K is 1 to the precision of the registers (the cost does not change), and Gamma"
    elif K >= 1.0:
        looks = f"K = {number_text(K, 6)} is not below 1 (the cost does not fall), so K itself is to fall: dK/dn"
    else:
        looks = f"K = {number_text(K, 6)} is below 1 (the cost falls), so the response time is to fall: dt_r/dn"
    if found.branch is Branch.LEVEL:
        return f"{looks} = 0 says that the number of iterations makes no difference"
    sign, wanted, end, further = (">", "shorter", "min", "less") if gamma > 0 else ("<", "longer", "max", "more")
    rest = " (at rest: the cost is at its floor, and rounding decides)" if abs(gamma) < AT_REST else ""
    step = f"q becomes {q}" if found.q_before is None else f"q goes from {found.q_before} to {q}"
    if q == found.q_before:
        step = f"q stays at {q}, as q_{end} allows no {further}"
    return f"{looks} = {number_text(gamma)} {sign} 0 asks for a {wanted} period{rest}; {step}"
