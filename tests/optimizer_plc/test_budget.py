import pytest
from hypothesis import given
from hypothesis import strategies as st

from optimizer_plc.budget import MAX_PERIOD_TICKS, BudgetSettings, PlcBudget
from optimizer_plc.computing_settings import OdeSettings

TAU_1_S = OdeSettings().tau_1_s
powers = st.floats(0.05, 20.0)
sizes = st.sampled_from([0.25, 0.5])


def budget(power: float = 1.0, tau_1_s: float = TAU_1_S) -> PlcBudget:
    return PlcBudget(BudgetSettings(power=power), tau_1_s)


@pytest.mark.parametrize("ticks", range(2, 21))
def test_the_reference_plc_does_4_tau_u_minus_1_iterations_of_the_ode_solver(ticks: int) -> None:
    tau_u = ticks * 0.25
    assert budget().iterations(ticks) == round(4 * tau_u - 1)
    assert budget().period(round(4 * tau_u - 1)) == ticks


def test_the_reference_plc_does_9_iterations_of_a_solver_twice_as_slow_in_5_s() -> None:
    assert budget(tau_1_s=0.5).iterations(20) == 9
    assert PlcBudget(BudgetSettings(preparation_slots=0), 0.5).iterations(20) == 10


@given(power=powers, tau_1_s=sizes, ticks=st.integers(1, MAX_PERIOD_TICKS))
def test_the_iterations_of_a_period_need_no_longer_period(power: float, tau_1_s: float, ticks: int) -> None:
    plc = budget(power, tau_1_s)
    iterations = plc.iterations(ticks)
    if iterations > 1:
        assert plc.period(iterations) <= ticks
        assert plc.iterations(plc.period(iterations)) >= iterations
    assert plc.period(iterations + 1) > ticks or ticks == MAX_PERIOD_TICKS


@given(power=powers, tau_1_s=sizes, iterations=st.integers(1, 400))
def test_a_period_holds_its_iterations_unless_5_s_are_too_short(power: float, tau_1_s: float, iterations: int) -> None:
    plc = budget(power, tau_1_s)
    ticks = plc.period(iterations)
    assert 1 <= ticks <= MAX_PERIOD_TICKS
    assert ticks == MAX_PERIOD_TICKS or plc.iterations(ticks) >= iterations


@given(power=powers, more=st.floats(1.0, 5.0), tau_1_s=sizes, ticks=st.integers(1, 20), iterations=st.integers(1, 100))
def test_a_faster_plc_does_no_less_and_needs_no_longer(
    power: float, more: float, tau_1_s: float, ticks: int, iterations: int
) -> None:
    slow, fast = budget(power, tau_1_s), budget(power * more, tau_1_s)
    assert fast.iterations(ticks) >= slow.iterations(ticks)
    assert fast.period(iterations) <= slow.period(iterations)
    assert fast.answer_after_s(iterations) <= slow.answer_after_s(iterations)


@given(iterations=st.integers(1, 19))
def test_the_answer_is_there_before_the_period_ends(iterations: int) -> None:
    assert budget().answer_after_s(iterations) < budget().period(iterations) * 0.25


@pytest.mark.parametrize(("power", "iterations"), [(0.2, 3), (0.4, 7), (0.6, 11), (1.0, 19), (2.0, 39), (10.0, 199)])
def test_iterations_in_5_s_grow_with_the_power(power: float, iterations: int) -> None:
    assert budget(power).iterations(20) == iterations


def test_one_iteration_is_done_however_slow_the_plc_is() -> None:
    assert budget(power=0.01).iterations(2) == 1
