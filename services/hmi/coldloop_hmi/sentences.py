"""One sentence that explains the length of an updating period."""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Final

from coldloop.number_text import number_text
from coldloop.process.declaration import Process
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import ModelDeviation, UpdatingRuleStatus
from coldloop.service.event_text import word_of
from coldloop_hmi.explanation import Branch, Explanation, is_rounded_to_one

AT_REST: Final = 1e-9
"""A Gamma that is smaller is rounding: the cost is at its floor."""

NOTABLE_SHARE: Final = 0.01
"""A plant that differs from its model by less than this share of the range of an input is not worth a word, ..."""
NOTABLE_NOISE: Final = 5.0
"""... nor by less than so many times the noise of an output, where the process does not declare what is notable."""
MOST_DEVIATIONS: Final = 4
SURPRISING: Final = 3.0
"""A reading that is so many times further from its prediction than the filter expects is worth a word."""


@cache
def _notable(process: Process) -> tuple[float, ...]:
    """Return what is worth a word, by input and output."""
    usual = [(one.unit, NOTABLE_SHARE * (one.high - one.low)) for one in process.inputs]
    usual += [(one.unit, NOTABLE_NOISE * one.noise) for one in process.outputs]
    return tuple(process.notable.get(unit, value) for unit, value in usual)


def deviation(found: ModelDeviation, process: Process, suspects: int = 0) -> str:
    """Return how the plant differs from its model, without the load, the most notable first; empty where it agrees.

    Last come the reading that is furthest from what is predicted, if it is surprising: the model, or its sensor, is
    not what the filter takes it for; and those that are not used for that reason (bit i is output i); and inputs
    that have no effect (the bits after those).
    """
    names = process.output_names
    parts = [
        (value, f"needs {number_text(abs(value), 3)} {unit} {'less' if value > 0 else 'more'} of {name}")
        for name, unit, value in zip(process.input_names, process.input_units, found.u, strict=True)
    ]
    parts += [
        (value, f"{name} {'+' if value > 0 else ''}{number_text(value, 3)} {unit}")
        for name, unit, value in zip(names, process.output_units, found.y, strict=True)
    ]
    notable = [
        (abs(value) / least, text)
        for (value, text), least in zip(parts, _notable(process), strict=True)
        if abs(value) >= least
    ]
    texts = [text for _, text in sorted(notable, reverse=True)[:MOST_DEVIATIONS]]
    surprise, name = max(zip(found.surprise, names, strict=True))
    if surprise >= SURPRISING:
        texts.append(f"{name} {number_text(surprise, 2)} times further from its prediction than expected")
    texts += [f"{name} is not used: it contradicts the others" for i, name in enumerate(names) if suspects >> i & 1]
    inputs = enumerate(process.input_names, len(names))
    texts += [f"{name} is left where it is: it has no effect" for i, name in inputs if suspects >> i & 1]
    return ", ".join(texts)


def sentence(found: Explanation, rule: UpdatingRuleStatus) -> str:
    """Return the explanation of the period in one or two sentences."""
    text = _WORDS[found.branch](found, rule)
    if found.spare_s:
        text += f" The period is {found.spare_s:g} s longer than that of q = {found.q}, as answers have been late."
    return text


def _change(found: Explanation) -> str:
    now, then = found.period_s, found.period_before_s
    if then is None:
        return f"tau_u is {now:g} s"
    if now == then:
        return f"tau_u stays at {now:g} s"
    return f"tau_u {'rises' if now > then else 'falls'} from {then:g} s to {now:g} s"


def _fixed(found: Explanation, _rule: UpdatingRuleStatus) -> str:
    return (
        f"tau_u is {found.period_s:g} s because the session has a fixed updating period; "
        f"{found.update.iterations} iterations were done in it."
    )


def _first(found: Explanation, rule: UpdatingRuleStatus) -> str:
    return f"tau_u is {found.period_s:g} s because this is the first update: q starts at {rule.q_first}."


def _begun_again(found: Explanation, rule: UpdatingRuleStatus) -> str:
    return (
        f"{_change(found)} because the optimiser had to start over ({_why_again(found)}): q starts at {rule.q_first}."
    )


def _why_again(found: Explanation) -> str:
    if found.before is not None and found.before.verdict == Verdict.NO_ANSWER:
        return "the update before has no answer: what was computed is not finite"
    return "a restart, or another client moved the inputs"


def _unknown(found: Explanation, _rule: UpdatingRuleStatus) -> str:
    return (
        f"tau_u is {found.period_s:g} s; the update before was not played or is not recorded, so there was nothing to "
        "learn from (a load step that interrupts, a late sequence, or a restart)."
    )


def _interrupted(found: Explanation, rule: UpdatingRuleStatus) -> str:
    return (
        f"{_change(found)} because a load step ended the period before after {found.elapsed_s:g} s of "
        f"{found.period_before_s:g} s: what was learned is discarded and q starts at {rule.q_first}."
    )


def _late(found: Explanation, _rule: UpdatingRuleStatus) -> str:
    text = word_of(Verdict, found.before.verdict if found.before else Verdict.NONE)
    return (
        f"{_change(found)} because the sequence before did not take effect at its instant (verdict: {text}): there was "
        f"nothing to learn from, and q stays at {found.q}."
    )


def _algorithm_1(found: Explanation, _rule: UpdatingRuleStatus) -> str:
    K, gamma = found.update.contraction, found.update.gamma
    if is_rounded_to_one(found.update):
        looks = "K is 1 to the precision of the registers (the cost does not change), and Gamma"
    elif K >= 1.0:
        looks = f"K = {number_text(K, 6)} is not below 1 (the cost does not fall), so K itself is to fall: dK/dn"
    else:
        looks = f"K = {number_text(K, 6)} is below 1 (the cost falls), so the response time is to fall: dt_r/dn"
    if found.branch is Branch.LEVEL:
        return f"{_change(found)} because {looks} = 0 says that the number of iterations makes no difference."
    shorter = found.branch is Branch.DOWN
    sign, wanted = (">", "shorter") if shorter else ("<", "longer")
    asks = f"{looks} = {number_text(gamma)} {sign} 0 asks for a {wanted} period"
    rest = " (at rest: the cost is at its floor, and rounding decides)" if abs(gamma) < AT_REST else ""
    return f"{_change(found)} because {asks}{rest}; {_step(found, shorter=shorter)}."


def _step(found: Explanation, *, shorter: bool) -> str:
    q = found.q
    if found.q_before is None:
        return f"q becomes {q}"
    if q != found.q_before:
        return f"q goes from {found.q_before} to {q}"
    return f"q stays at {q}, as q_{'min' if shorter else 'max'} allows no {'less' if shorter else 'more'}"


def _contraction(found: Explanation, rule: UpdatingRuleStatus) -> str:
    q, K, gamma = found.q, number_text(found.update.contraction, 4), number_text(found.update.gamma, 3)
    if found.q_before is not None and (q > found.q_before or q == found.q_before == rule.q_max > rule.q_min):
        why = f"K = {K} is beyond its noise and Gamma = {gamma} < 0 asks for a longer period"
    else:
        why = f"K = {K} is within its noise, or Gamma = {gamma} asks for no longer period"
    return f"{_change(found)} because {why}: the contraction rule has q = {q}, at rest {rule.q_min}."


def _outside(found: Explanation, rule: UpdatingRuleStatus) -> str:  # noqa: ARG001 it says nothing of itself
    return f"{_change(found)} because the rule that is installed beside Coldloop decided so: q = {found.q}."


_WORDS: Final[Mapping[Branch, Callable[[Explanation, UpdatingRuleStatus], str]]] = {
    Branch.FIXED: _fixed,
    Branch.FIRST: _first,
    Branch.BEGUN_AGAIN: _begun_again,
    Branch.UNKNOWN: _unknown,
    Branch.INTERRUPTED: _interrupted,
    Branch.LATE: _late,
    Branch.CONTRACTION: _contraction,
    Branch.OUTSIDE: _outside,
    **dict.fromkeys((Branch.DOWN, Branch.UP, Branch.LEVEL), _algorithm_1),
}
