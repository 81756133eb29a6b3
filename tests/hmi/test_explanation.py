"""Why an updating period changed: the sentence and its figures against a computation by hand.

The reference is the paper's Algorithm 1 with fractions and logarithms of many digits, written here a second time and
tried on a case that was computed on paper.
"""

import math
import random
from collections.abc import Sequence
from decimal import Decimal, getcontext
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from coldloop.process.cold_box import COLD_BOX, OUTPUT_NAMES, T5
from coldloop.registers.codec import blank
from coldloop.registers.control_plc import Verdict
from coldloop.registers.optimizer_plc import ModelDeviation, Optimization, UpdatingRuleKind, UpdatingRuleStatus
from coldloop_hmi import explanation
from coldloop_hmi.explanation import Branch, Explanation, increments_of, sentence
from coldloop_optimizer_plc.rules import ALGORITHM_1, Observation, Rule, assess, decide
from tests.harness.records import MAPS, as_transmitted

getcontext().prec = 40
explain = partial(explanation.explain, process=COLD_BOX)
deviation = partial(explanation.deviation, process=COLD_BOX)

RULE = UpdatingRuleStatus(UpdatingRuleKind.ALGORITHM_1, 9, 2, 19, 2, slots=0.25, preparation=0.13, iteration=0.25)
FIXED = UpdatingRuleStatus(UpdatingRuleKind.FIXED, 9, 9, 9, 0, slots=0.25, preparation=0.13, iteration=0.25)
UNDECIDED = {"efficiency": 1.0, "mismatch": 1.0, "contraction": 1.0, "gamma": 0.0}
OF_EACH_KIND = 10


class ByHand(NamedTuple):
    """What Algorithm 1 says, in many digits."""

    contraction: Decimal
    slope: Decimal
    """dK/dq."""
    gamma: Decimal
    q: int


P1 = OUTPUT_NAMES.index("P1")


def by_hand(q: int, before: float, hot_start: float, last_but_one: float, delivered: float, effective: float) -> ByHand:
    """Algorithm 1 of the paper, line by line."""
    J_k, J_hot, J_last, J_hat, J_next = (
        Decimal(value) for value in (before, hot_start, last_but_one, delivered, effective)
    )
    E, D = J_hat / J_hot, J_next / J_hat * J_hot / J_k
    K = E * D
    dK = E * (D - 1) / q + D * (J_hat - J_last) / J_hot
    gamma = dK if K >= 1 else (-K.ln() + q / K * dK) / K.ln() ** 2
    step = -2 if gamma > 0 else 2 if gamma < 0 else 0
    return ByHand(K, dK, gamma, max(2, min(19, q + step)))


def test_the_reference_is_right_on_a_case_computed_on_paper() -> None:
    """E = 100 / 200, D = 90 * 200 / (100 * 160); (0.575364 - 0.048889) / 0.331044 = 1.590349."""
    found = by_hand(4, 160.0, 200.0, 104.0, 100.0, 90.0)
    assert found.contraction == Decimal("0.5625")
    assert found.slope == Decimal("-0.006875")
    assert float(found.gamma) == pytest.approx(1.590349, rel=1e-6)
    assert found.q == 2


class Case(NamedTuple):
    """Two updates in a row, and what is known of them by hand."""

    before: Optimization
    update: Optimization
    q_before: int
    reference: ByHand


def optimization(number: int, tick: int, q: int, **values: float) -> Optimization:
    numbers = {
        "j_effective": 10.0, "j_hot_start": 10.0, "j_delivered": 9.0, "j_dev": 1.0, "j_cst": 0.0, "violation": 0.0,
        "load_mismatch": 0.0, **UNDECIDED, **values,
    }  # fmt: skip
    verdict = int(numbers.pop("verdict", Verdict.ACCEPTED))
    return as_transmitted(Optimization(number, tick, tau_u=1 + q, q=q, iterations=q, verdict=verdict, **numbers))


def decided_cases(wanted: int) -> list[Case]:
    """Updates of chance that Algorithm 1 decided, of which the sign of Gamma is `wanted`."""
    chance = random.Random(wanted)  # noqa: S311 not a secret
    found: list[Case] = []
    while len(found) < OF_EACH_KIND:
        q = chance.randint(3, 18)
        J_k, J_hot = chance.uniform(5, 50), chance.uniform(5, 50)
        J_last = J_hot * chance.uniform(0.3, 1.0)
        J_hat, J_next = J_last * chance.uniform(0.7, 1.0), J_k * chance.uniform(0.3, 1.4)
        reference = by_hand(q, J_k, J_hot, J_last, J_hat, J_next)
        if (reference.gamma > 0) - (reference.gamma < 0) != wanted or abs(reference.contraction - 1) < Decimal("0.01"):
            continue
        observed = Observation(q, q, 0.25 * (1 + q), J_k, J_hot, J_last, J_hat, J_next)
        a = assess(observed)
        decided = decide(Rule(ALGORITHM_1, 9, 2, 19, 2), np.zeros(2), observed, a)
        assert decided == reference.q, "the program agrees with the reference"
        before = optimization(7, 100, q, j_effective=J_k, j_hot_start=J_hot, j_delivered=J_hat)
        update = optimization(
            8, 101 + q, reference.q, j_effective=J_next, efficiency=a.efficiency, mismatch=a.mismatch,
            contraction=a.contraction, gamma=a.gamma,
        )  # fmt: skip
        found.append(Case(before, update, q, reference))
    return found


@pytest.mark.parametrize(("wanted", "branch"), [(1, Branch.DOWN), (-1, Branch.UP)])
def test_periods_that_algorithm_1_made_shorter_or_longer(wanted: int, branch: Branch) -> None:
    for before, update, q, reference in decided_cases(wanted):
        found = explain(update, before, None, RULE)
        assert found.branch is branch
        assert (found.q_before, found.q) == (q, reference.q)
        assert found.increments is not None
        assert found.increments.contraction == pytest.approx(float(reference.slope), rel=2e-3, abs=1e-6)
        text = sentence(found, RULE)
        assert ("asks for a shorter period" in text) is (wanted > 0)
        assert ("is not below 1" in text) is (reference.contraction >= 1)
        assert f"{float(reference.contraction):.4g}"[:4] in text
        says = f"q goes from {q} to {reference.q}" if q != reference.q else f"q stays at {q}"
        assert says in text
        assert (
            f"{'falls' if wanted > 0 else 'rises'} from {0.25 * (1 + q):g} s to {0.25 * (1 + reference.q):g} s" in text
        )


def test_what_other_numbers_of_iterations_would_have_meant() -> None:
    """K +- 2 dK; the response time is q tau_1 / -ln K, and there is none where K is not below 1."""
    for before, update, q, reference in decided_cases(1) + decided_cases(-1):
        found = explain(update, before, None, RULE)
        steps = [one.q - q for one in found.alternatives]
        assert steps == [step for step in (-2, 0, 2) if q + step >= 1]
        for one in found.alternatives:
            K = reference.contraction + (one.iterations - q) * reference.slope
            assert one.contraction == pytest.approx(float(K), rel=2e-3, abs=1e-5)
            assert one.period_s == min(5.0, 0.25 + 0.25 * one.iterations)
            if one.response_s is not None and 0.05 < K < Decimal("0.95"):
                assert one.response_s == pytest.approx(-one.iterations * 0.25 / math.log(K), rel=2e-2)
            assert (one.response_s is None) is not (0 < one.contraction < 1)


def test_a_faster_solver_takes_the_same_steps_and_does_more_in_each() -> None:
    """0.03 s an iteration: q = 4 is 1.25 s with 33 iterations, q = 6 is 1.75 s with 50, and K moves by 17 of them."""
    fast = RULE._replace(iteration=0.03)
    a = assess(Observation(4, 33, 1.25, 160.0, 200.0, 104.0, 100.0, 90.0))
    values = {"efficiency": a.efficiency, "mismatch": a.mismatch, "contraction": a.contraction, "gamma": a.gamma}
    before = optimization(7, 100, 4)._replace(iterations=33)
    found = explain(optimization(8, 105, 2, **values), before, None, fast)
    assert [(one.q, one.period_s, one.iterations) for one in found.alternatives] == [
        (2, 0.75, 16), (4, 1.25, 33), (6, 1.75, 50)
    ]  # fmt: skip
    slope = (found.alternatives[2].contraction - found.alternatives[1].contraction) / 17
    assert slope == pytest.approx(a.contraction_increment, rel=1e-3)


def assert_all(cases: Sequence[Explanation], branch: Branch, rule: UpdatingRuleStatus, *parts: str) -> None:
    assert len(cases) == OF_EACH_KIND
    for found in cases:
        assert found.branch is branch
        assert found.increments is None
        text = sentence(found, rule)
        for part in parts:
            assert part in text, text


def test_periods_that_a_load_step_interrupted() -> None:
    cases = []
    for number in range(OF_EACH_KIND):
        q = 10 + number % 5
        before = optimization(number, 100, q, verdict=Verdict.WRONG_UPDATE if number % 2 else Verdict.NONE)
        update = optimization(number + 1, 101 + number % 4, 9)
        cases.append(explain(update, before, None, RULE))
        elapsed, period = (1 + number % 4) * 0.25, (1 + q) * 0.25
        assert f"after {elapsed:g} s of {period:g} s" in sentence(cases[-1], RULE)
    assert_all(cases, Branch.INTERRUPTED, RULE, "a load step ended the period before", "q starts at 9")


def test_periods_after_a_sequence_that_came_too_late() -> None:
    cases = []
    for number in range(OF_EACH_KIND):
        q = 2 + number
        before = optimization(number, 50, q, verdict=Verdict.LATE)
        cases.append(explain(optimization(number + 1, 51 + q, q), before, None, RULE))
        assert f"q stays at {q}" in sentence(cases[-1], RULE)
    assert_all(cases, Branch.LATE, RULE, "verdict: late", "tau_u stays at")


def test_periods_that_are_fixed() -> None:
    cases = [
        explain(optimization(number + 1, 10 * number + 10, 9), optimization(number, 10 * number, 9), None, FIXED)
        for number in range(OF_EACH_KIND)
    ]
    assert_all(
        cases, Branch.FIXED, FIXED, "tau_u is 2.5 s because the session has a fixed updating period", "9 iterations"
    )


def test_periods_of_the_contraction_rule() -> None:
    own = RULE._replace(rule=UpdatingRuleKind.CONTRACTION, q_first=5, q_max=5, delta=0)
    beyond, within = "K = 0.5 is beyond its noise and Gamma = -0.1 < 0", "K = 0.5 is within its noise, or Gamma = -0.1"
    for before, q, says in ((2, 3, beyond), (5, 5, beyond), (3, 2, within), (2, 2, within)):
        update = optimization(2, 101 + before, q, contraction=0.5, gamma=-0.1)
        found = explain(update, optimization(1, 100, before), None, own)
        assert found.branch is Branch.CONTRACTION
        assert says in sentence(found, own)
        assert f"has q = {q}, at rest 2" in sentence(found, own)


def test_the_first_update_one_after_a_restart_and_one_whose_predecessor_is_unknown() -> None:
    assert explain(optimization(0, 0, 9), None, None, RULE).branch is Branch.FIRST
    again = explain(optimization(5, 300, 9), optimization(4, 100, 3), None, RULE)
    assert again.branch is Branch.BEGUN_AGAIN
    assert "had to start over" in sentence(again, RULE)
    unknown = explain(optimization(5, 300, 9), optimization(3, 100, 3), None, RULE)
    assert unknown.branch is Branch.UNKNOWN
    assert unknown.q_before is None


def test_a_period_after_an_update_without_an_answer() -> None:
    """Its q is that of a first one; here the session's last one happens to be the same."""
    before = optimization(4, 100, 9, verdict=Verdict.NO_ANSWER, j_effective=math.nan)
    found = explain(optimization(5, 110, 9), before, None, RULE)
    assert found.branch is Branch.BEGUN_AGAIN
    assert "the update before has no answer" in sentence(found, RULE)
    assert "q starts at 9" in sentence(found, RULE)


def test_the_time_line_of_the_plc_and_what_was_predicted_and_came() -> None:
    """0.13 s of preparation and 9 iterations of 0.25 s: an answer after 2.38 s of 2.5 s."""
    update, after = optimization(3, 30, 9, j_delivered=8.0), optimization(4, 40, 9, j_effective=8.25)
    found = explain(update, None, after, RULE)
    assert found.budget.answer == pytest.approx(2.38)
    assert found.budget.slack == pytest.approx(0.12)
    assert (found.predicted, found.came) == (8.0, 8.25)
    assert explain(update, None, optimization(5, 50, 9), RULE).came is None


def test_a_period_that_is_longer_than_that_of_its_q_says_so() -> None:
    case = decided_cases(1)[0]
    late = case.update._replace(tau_u=case.update.tau_u + 3)
    found = explain(late, case.before, None, RULE)
    assert found.spare_s == 0.75
    assert "0.75 s longer" in sentence(found, RULE)
    assert found.budget.slack == pytest.approx(0.12 + 0.75)
    assert "longer than" not in sentence(explain(case.update, case.before, None, RULE), RULE)


def test_increments_are_found_again_on_both_sides_of_one() -> None:
    for effective in (80.0, 300.0):
        a = assess(Observation(4, 4, 1.25, 160.0, 200.0, 104.0, 100.0, effective))
        values = {"efficiency": a.efficiency, "mismatch": a.mismatch, "contraction": a.contraction, "gamma": a.gamma}
        found = increments_of(optimization(1, 5, 4, **values), 4)
        assert found is not None
        assert found.efficiency == pytest.approx(a.efficiency_increment, rel=1e-4)
        assert found.mismatch == pytest.approx(a.mismatch_increment, rel=1e-4)
        assert found.contraction == pytest.approx(a.contraction_increment, rel=1e-4)


def test_a_slope_where_k_rounds_to_one_is_not_told_as_the_slope_of_k() -> None:
    """K = 1 - 1e-9 in the program, 1 in the registers: Gamma is dt_r/dn, of the size of 1 / ln(K)^2."""
    observed = Observation(4, 4, 1.25, 1.0, 1.0, 1.0, 1.0 - 2e-10, 1.0 - 1e-9)
    a = assess(observed)
    assert a.contraction < 1.0
    assert abs(a.gamma) > 1e6
    before = optimization(7, 100, 4)
    update = optimization(8, 105, 2, contraction=a.contraction, gamma=a.gamma)
    assert update.contraction == 1.0
    found = explain(update, before, None, RULE)
    assert (found.increments, found.alternatives) == (None, ())
    text = sentence(found, RULE)
    assert "K is 1 to the precision of the registers" in text
    assert "dK/dn" not in text


NO_DEVIATION = blank(ModelDeviation, MAPS["optimizer_plc"])


def test_a_plant_that_differs_from_its_model_is_described_the_most_notable_first() -> None:
    y = [0.0] * 22
    y[T5], y[1], y[P1] = 0.31, -4.9, -0.0151
    found = NO_DEVIATION._replace(load=31.0, u=(-4.1, 0.0, 0.2), y=tuple(y))
    assert deviation(found) == "needs 4.1 % more of CV155, T5 +0.31 K, P1 -0.0151 bar, needs 0.2 % less of CV156"
    assert deviation(NO_DEVIATION._replace(load=31.0)) == ""
    everything = NO_DEVIATION._replace(u=(1.0, 1.0, 1.0), y=(1.0,) * 22)
    assert deviation(everything).count(",") == 3
    surprise = [1.0] * 22
    surprise[T5] = 4.23
    further = "T5 4.2 times further from its prediction than expected"
    assert deviation(NO_DEVIATION._replace(surprise=tuple(surprise))) == further
    assert deviation(found._replace(surprise=tuple(surprise))).endswith(f"less of CV156, {further}")
