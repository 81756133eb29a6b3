import pytest
from hypothesis import given
from hypothesis import strategies as st

from coldloop_optimizer_plc.computing_settings import BudgetSettings, OdeSettings, PlcBudget

TAU_1_S = OdeSettings().tau_1_s
powers = st.floats(0.05, 20.0)
sizes = st.sampled_from([0.25, 0.5])


def budget(power: float = 1.0, tau_1_s: float = TAU_1_S) -> PlcBudget:
    return PlcBudget(BudgetSettings(power=power), tau_1_s)


def test_the_reference_plc_does_9_iterations_of_a_solver_twice_as_slow_in_5_s() -> None:
    assert budget(tau_1_s=0.5).iterations(20) == 9
    assert PlcBudget(BudgetSettings(preparation_slots=0), 0.5).iterations(20) == 10


@pytest.mark.parametrize(
    ("tau_1_s", "power", "ladder"),
    [
        (0.25, 1.0, [(ticks, ticks - 1) for ticks in range(2, 21)]),
        (0.25, 0.5, [(2 * n + 2, n) for n in range(1, 10)]),
        (0.475, 1.0, [(3, 1), (5, 2), (7, 3), (9, 4), (11, 5), (13, 6), (15, 7), (17, 8), (19, 9), (20, 10)]),
        (0.03, 1.0, [(ticks, 25 * (ticks - 1) // 3) for ticks in range(2, 21)]),
        (0.25, 4.0, [(ticks, 4 * ticks - 1) for ticks in range(2, 21)]),
        (4.75, 1.0, [(20, 1)]),
    ],
)
def test_the_ladder_has_each_period_that_holds_more(
    tau_1_s: float, power: float, ladder: list[tuple[int, int]]
) -> None:
    """With the paper's solver and PLC, and with slower ones, q is the number of iterations; faster ones do more."""
    plc = budget(power, tau_1_s)
    assert [(ticks, plc.iterations(ticks)) for ticks in plc.ladder] == ladder


@given(power=powers, tau_1_s=st.floats(0.01, 5.0), ticks=st.integers(1, 20))
def test_periods_of_the_ladder_hold_more_and_more_and_answers_are_in_time(
    power: float, tau_1_s: float, ticks: int
) -> None:
    plc = budget(power, tau_1_s)
    counts = [plc.iterations(one) for one in plc.ladder]
    assert list(plc.ladder) == sorted(set(plc.ladder))
    assert counts == sorted(set(counts))
    assert len(counts) == 1 or plc.answer_after_s(counts[-1]) <= plc.ladder[-1] * 0.25
    nearest = plc.ladder[plc.q(ticks) - 1]
    assert plc.iterations(ticks) == plc.iterations(nearest) or nearest > ticks


@given(power=powers, more=st.floats(1.0, 5.0), tau_1_s=sizes, ticks=st.integers(1, 20), iterations=st.integers(1, 100))
def test_a_faster_plc_does_no_less_and_needs_no_longer(
    power: float, more: float, tau_1_s: float, ticks: int, iterations: int
) -> None:
    slow, fast = budget(power, tau_1_s), budget(power * more, tau_1_s)
    assert fast.iterations(ticks) >= slow.iterations(ticks)
    assert fast.ladder[0] <= slow.ladder[0]
    assert fast.answer_after_s(iterations) <= slow.answer_after_s(iterations)


@pytest.mark.parametrize(("power", "iterations"), [(0.2, 3), (0.4, 7), (0.6, 11), (1.0, 19), (2.0, 39), (10.0, 199)])
def test_iterations_in_5_s_grow_with_the_power(power: float, iterations: int) -> None:
    assert budget(power).iterations(20) == iterations


def test_one_iteration_is_done_however_slow_the_plc_is() -> None:
    assert budget(power=0.01).iterations(2) == 1
    assert budget(power=0.01).ladder == (20,)
