import math

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop.registers.optimizer_plc import UpdatingRuleKind
from coldloop_optimizer_plc.computing_settings import BudgetSettings, PlcBudget
from coldloop_optimizer_plc.rules import (
    ALGORITHM_1,
    CONTRACTION,
    FIXED_PERIOD,
    MEMORY,
    Assessment,
    Observation,
    Rule,
    UpdatingRule,
    assess,
    assessed,
    decide,
    decide_by,
    make_rule,
)
from coldloop_optimizer_plc.settings import AdaptiveSettings, ProgramSettings, RuleName

RULE = Rule(ALGORITHM_1, first=9, low=2, high=19, delta=2)


class Deciding:
    """A rule with its memory."""

    def __init__(self, rule: UpdatingRule) -> None:
        self.rule, self.memory = rule, np.zeros(MEMORY)

    def next(self, observation: Observation) -> tuple[int, Assessment]:
        a = assess(observation)
        return decide_by(self.rule, self.memory, observation, a), a


costs = st.floats(1.0, 1e8)
rules = st.builds(
    lambda bounds, delta: Rule(ALGORITHM_1, first=bounds[0], low=bounds[0], high=bounds[1], delta=delta),
    st.tuples(st.integers(1, 20), st.integers(1, 20)).map(lambda pair: (min(pair), max(pair))),
    st.integers(1, 20),
)
observations = st.builds(
    Observation,
    q=st.integers(1, 20),
    iterations=st.integers(1, 200),
    period_s=st.floats(0.5, 5.0),
    effective_before=costs,
    hot_start=costs,
    last_but_one=costs,
    delivered=costs,
    effective=costs,
)


def contracting(**changed: float) -> Observation:
    """K = 0.45: from J+ = 200 over 104 to 100 in 4 iterations at the predicted state; 90 where the plant really is."""
    base = Observation(
        q=4,
        iterations=4,
        period_s=1.25,
        effective_before=200.0,
        hot_start=200.0,
        last_but_one=104.0,
        delivered=100.0,
        effective=90.0,
    )
    return base._replace(**changed)  # type: ignore[arg-type]


def test_the_quantities_are_those_that_the_paper_defines() -> None:
    a = assess(contracting(effective_before=160.0))
    assert a.efficiency == 0.5  # 100 / 200
    assert a.mismatch == 1.125  # 90 * 200 / (100 * 160)
    assert a.contraction == 0.5625  # 90 / 160
    assert a.mismatch_increment == pytest.approx(0.03125)  # (1.125 - 1) / 4
    assert a.efficiency_increment == pytest.approx(-0.02)  # (100 - 104) / 200
    assert a.contraction_increment == pytest.approx(-0.006875)  # 0.5 * 0.03125 - 1.125 * 0.02
    # (-ln 0.5625 + 4 / 0.5625 * -0.006875) / ln(0.5625)^2 = (0.575364 - 0.048889) / 0.331044
    assert a.response_increment == pytest.approx(1.590349, rel=1e-5)
    assert a.gamma == a.response_increment


def test_a_contraction_that_the_last_iteration_hardly_helped_makes_the_period_shorter() -> None:
    q, a = Deciding(RULE).next(contracting(effective_before=160.0))
    assert a.gamma > 0
    assert q == 2


def test_a_contraction_that_still_gains_with_the_last_iteration_makes_the_period_longer() -> None:
    q, a = Deciding(RULE).next(contracting(last_but_one=180.0))
    assert a.contraction < 1
    assert a.gamma < 0
    assert q == 6


def test_without_contraction_the_sign_of_the_contractions_increment_decides() -> None:
    # K = 260 / 200; D = 2.6: dK = 0.5 * 1.6 / 4 + 2.6 * dE is 0.2 - 0.052 with 104 before, 0.2 - 1.04 with 180
    observed = contracting(effective=260.0)
    shorter, better = (Deciding(RULE).next(one) for one in (observed, observed._replace(last_but_one=180.0)))
    assert (shorter[1].gamma, better[1].gamma) == pytest.approx((0.148, -0.84))
    assert (shorter[0], better[0]) == (2, 6)


def test_a_contraction_of_exactly_1_counts_as_none() -> None:
    at_one = contracting(effective=200.0)
    q, a = Deciding(RULE).next(at_one)
    assert a.contraction == 1.0
    assert math.isinf(a.response_increment)
    assert a.gamma == a.contraction_increment == pytest.approx(0.5 * 1.0 / 4 - 2.0 * 0.02)
    assert q == 2
    assert Deciding(RULE).next(at_one._replace(last_but_one=180.0))[0] == 6


def test_increments_are_per_iteration_and_the_step_is_in_periods() -> None:
    """The same costs after 32 iterations in the period of q = 4: D changes by an eighth as much for each."""
    q, a = Deciding(RULE).next(contracting(effective_before=160.0, iterations=32))
    assert a.mismatch_increment == pytest.approx(0.03125 / 8)
    assert a.efficiency_increment == pytest.approx(-0.02)
    assert q == 6
    assert a.gamma < 0, "32 iterations at -0.02 each outweigh the mismatch"


def test_a_zero_gradient_changes_nothing() -> None:
    still = Observation(
        q=7,
        iterations=7,
        period_s=2.0,
        effective_before=5.0,
        hot_start=5.0,
        last_but_one=5.0,
        delivered=5.0,
        effective=5.0,
    )
    q, a = Deciding(RULE).next(still)
    assert (q, a.gamma) == (7, 0.0)


@given(rule=rules, observation=observations)
def test_q_moves_by_delta_against_the_gradient_or_is_clipped(rule: Rule, observation: Observation) -> None:
    q, a = Deciding(rule).next(observation)
    assert rule.low <= q <= rule.high
    sign = (a.gamma > 0) - (a.gamma < 0)
    wanted = observation.q - rule.delta * sign
    assert q == min(rule.high, max(rule.low, wanted))
    assert not math.isnan(a.gamma)


@given(observation=observations)
def test_the_branch_depends_on_whether_the_cost_contracts(observation: Observation) -> None:
    a = assess(observation)
    assert a.contraction == pytest.approx(observation.effective / observation.effective_before, rel=1e-9)
    assert a.gamma == (a.contraction_increment if a.contraction >= 1 else a.response_increment)


@given(observation=observations, exponent=st.integers(-20, 20))
def test_multiplying_all_costs_by_a_constant_changes_nothing(observation: Observation, exponent: int) -> None:
    factor = 2.0**exponent  # exact in binary, so that rounding cannot change the decision
    scaled = Observation(
        q=observation.q,
        iterations=observation.iterations,
        period_s=observation.period_s,
        effective_before=observation.effective_before * factor,
        hot_start=observation.hot_start * factor,
        last_but_one=observation.last_but_one * factor,
        delivered=observation.delivered * factor,
        effective=observation.effective * factor,
    )
    assert Deciding(RULE).next(scaled) == Deciding(RULE).next(observation)


@given(observation=observations)
def test_the_response_increment_is_the_derivative_of_the_response_time(observation: Observation) -> None:
    """t_r(q) = -q / log K(q), with K moving at its increment (`studies/slips.md`, ruling 10)."""
    a, q = assess(observation), observation.iterations
    if not 1e-6 < a.contraction < 0.99:
        return
    h = 1e-6 * a.contraction / max(abs(a.contraction_increment), a.contraction)

    def response(step: float) -> float:
        return -(q + step) / math.log(a.contraction + step * a.contraction_increment)

    numerical = (response(h) - response(-h)) / (2 * h)
    scale = abs(a.contraction_increment / a.contraction) * q / math.log(a.contraction) ** 2
    assert a.response_increment == pytest.approx(numerical, rel=1e-3, abs=1e-3 * scale + 1e-6)


@pytest.mark.usefixtures("compiles")
@given(observation=observations, q=st.integers(1, 19))
def test_a_fixed_period_is_fixed_but_tells_the_quantities_all_the_same(observation: Observation, q: int) -> None:
    rule = Rule(FIXED_PERIOD, q, q, q)
    assert rule.first == q
    assert Deciding(rule).next(observation) == (q, assess(observation))


def test_the_first_period_is_the_one_configured() -> None:
    assert RULE.first == 9


OWN = Rule(CONTRACTION, first=5, low=2, high=5, band=10.0, least=5e-4, change=0.02)


def following(cost: float, q: int, before: float = 100.0) -> Observation:
    """From `before` to `cost`, with a last iteration that still gains: Gamma asks for a longer period where K < 1."""
    return contracting(q=q, effective_before=before, hot_start=before, last_but_one=2.0 * cost, delivered=cost,
                       effective=cost)  # fmt: skip


def test_own_rule_goes_up_by_one_where_the_cost_contracts_beyond_its_noise() -> None:
    """The dead band is 10 times 5e-4, the first usual size; -ln 0.99 is 0.01005 and -ln 0.996 is 0.00401."""
    for cost, q, chosen in ((99.0, 2, 3), (99.0, 5, 5), (99.6, 2, 2), (99.6, 4, 3), (99.0, 9, 5)):
        rule = Deciding(OWN)
        assert rule.next(following(cost, q))[0] == chosen, (cost, q)
    assert Deciding(OWN).next(contracting())[0] == 3, "Gamma asks for a shorter period"


def test_own_rule_follows_the_usual_size_by_steps() -> None:
    rule = Deciding(OWN)
    sizes = [rule.memory[0] for cost in (99.0, 99.0, 100.0) if rule.next(following(cost, 2))]
    assert sizes == pytest.approx([5e-4 * share for share in (1.02, 1.02**2, 1.02**2 * 0.98)])
    for _ in range(10):
        rule.next(following(100.0, 2))
    assert rule.memory[0] == pytest.approx(4.9e-4), "it does not fall below the least"


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2, 0.1])
def test_own_rule_rests_while_the_cost_is_noise(noise: float) -> None:
    """Whatever Gamma says; once the usual size, which begins at 5e-4, has been learnt."""
    rule, random, q, before, chosen = Deciding(OWN), np.random.default_rng(3), 5, 100.0, []
    for _ in range(1200):
        cost = 100.0 * math.exp(noise * random.uniform(-1.0, 1.0))
        q, _ = rule.next(following(cost, q, before))
        chosen.append(q)
        before = cost
    assert set(chosen[400:]) == {2}


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_own_rule_leaves_its_rest_after_a_load_step(noise: float) -> None:
    rule, random, q, before = Deciding(OWN), np.random.default_rng(4), 5, 100.0
    for _ in range(400):
        cost = 100.0 * math.exp(noise * random.uniform(-1.0, 1.0))
        q, _ = rule.next(following(cost, q, before))
        before = cost
    chosen = []
    for cost in (1000.0, 500.0, 250.0, 125.0, 100.0, 100.0, 100.0, 100.0):
        q, _ = rule.next(following(cost, q, before))
        chosen.append(q)
        before = cost
    assert chosen == [3, 4, 5, 5, 5, 4, 3, 2]


@given(observed=st.lists(observations, max_size=20))
def test_own_rule_stays_between_its_numbers(observed: list[Observation]) -> None:
    rule = Deciding(OWN)
    assert all(2 <= rule.next(one)[0] <= 5 for one in observed)
    assert OWN.first == OWN.after_interruption() == OWN.status.q_first == 5


@pytest.mark.usefixtures("compiles")
@given(rule=rules, observation=observations)
def test_compiled_and_plain_a_rule_is_assessed_the_same(rule: Rule, observation: Observation) -> None:
    """To the bit, and in single precision to its rounding."""
    assert assessed(observation) == assess(observation)
    single = Observation(*observation[:2], *map(np.float32, observation[2:]))
    rough, exact = assessed(single), assess(Observation(*single[:2], *map(float, single[2:])))
    assert rough.contraction == pytest.approx(exact.contraction, rel=1e-6)
    assert rule.low <= decide_by(rule, np.zeros(MEMORY, np.float32), single, rough) <= rule.high


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("kind", [kind for kind in UpdatingRuleKind if kind != UpdatingRuleKind.OUTSIDE])
@given(observation=observations)
def test_each_kind_is_decided_by_its_rule(kind: UpdatingRuleKind, observation: Observation) -> None:
    settings = ProgramSettings(adaptive=AdaptiveSettings(rule=RuleName[kind.name])) if kind else ProgramSettings()
    rule = make_rule(settings, PlcBudget(BudgetSettings(), 0.25), 0 if kind else 7)
    assert rule.status.rule == kind
    decided, a = Deciding(rule).next(observation)
    assert decided == decide.py_func(rule, np.zeros(MEMORY), observation, a)  # type: ignore[attr-defined]
    assert a == assess(observation)


def test_one_compilation_serves_fixed_and_adaptive_periods() -> None:
    """Else the first update of a session with the other one would wait for the compiler."""
    budget = PlcBudget(BudgetSettings(), 0.25)
    adaptive, fixed = (make_rule(ProgramSettings(), budget, ticks) for ticks in (0, 8))
    assert numba.typeof(adaptive) == numba.typeof(fixed)
