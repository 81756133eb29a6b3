"""The hybrid solver: who gets a problem, and what its slots hold."""

import math
import types
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop_optimizer_plc.qp.problem import PredictiveProblem
from coldloop_optimizer_plc.settings import Preset, ProgramSettings, SolverName
from coldloop_optimizer_plc.solvers import (
    Answer,
    HybridMethod,
    Solver,
    in_slots,
    is_far,
    iterations_in,
    make_solver,
    picoseconds,
    slots_begun,
    solve_hybrid,
)
from coldloop_optimizer_plc.solvers.interface import KERNELS, Costs

if TYPE_CHECKING:
    from tests.optimizer_plc.conftest import Jump, Situations

Array = NDArray[np.float64]


@pytest.fixture
def choices(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, Costs]]:
    """What the choice of each problem was made by; the kernel itself is run as plain Python."""
    made: list[tuple[float, Costs]] = []

    def noted(switch: float, guessed: float, before: Costs) -> bool:
        made.append((float(guessed), Costs(*map(float, before))))
        return bool(is_far(switch, guessed, before))

    plain = types.FunctionType(
        solve_hybrid.py_func.__code__,  # type: ignore[attr-defined] # of a kernel
        solve_hybrid.py_func.__globals__ | {"is_far": noted},  # type: ignore[attr-defined]
    )
    monkeypatch.setitem(KERNELS, HybridMethod, plain)
    return made


def made(name: SolverName) -> Solver:
    """With the penalties of the fixtures' problems."""
    return make_solver(ProgramSettings(preset=Preset.PAPER, solver=name))


@pytest.mark.usefixtures("compiles")
def test_a_problem_is_chosen_for_by_the_costs_of_the_one_before(
    choices: list[tuple[float, Costs]], harsh_jumps: "list[Jump]"
) -> None:
    """J+ and Jhat, both with constant and floor, are those of the problem before, whoever solved it."""
    solver = made(SolverName.HYBRID)
    answers = [solver.solve(qp, guess, (4, 5)) for qp, guess in harsh_jumps[:6]]
    rest = [qp.constant + 1.0 for qp, _ in harsh_jumps[:6]]
    whole = [Costs(a.guessed + more, a.cost + more) for a, more in zip(answers, rest, strict=True)]
    assert choices[0][1] == (math.inf, math.inf)
    for (guessed, before), own, last in zip(choices[1:], whole[1:], whole, strict=False):
        assert guessed == pytest.approx(own.guessed)
        assert before == pytest.approx(last)
    solver.reset()
    solver.solve(*harsh_jumps[0], (1,))
    assert choices[-1][1] == (math.inf, math.inf)


def test_a_load_step_goes_to_the_interior_point_until_it_has_little_to_win() -> None:
    """With constant and floor: J+ and Jhat are 10 and 7, 15 and 9, 10 and 9, 10 and 8."""
    costs = [Costs(10.0, 7.0), Costs(15.0, 9.0), Costs(10.0, 9.0), Costs(10.0, 8.0)]
    before = [Costs(math.inf, math.inf), *costs]
    # 10 > 1.5 inf: no; 15 > 1.5 * 7: yes; max(10, 15) > 1.5 * 9: yes; max(10, 10) > 1.5 * 9: no
    taken = [is_far(1.5, own.guessed, last) for own, last in zip(costs, before, strict=False)]
    assert taken == [False, True, True, False]


def test_the_first_problem_is_a_quiet_one_whatever_it_costs() -> None:
    assert not is_far(2.0, 1e9, Costs(math.inf, math.inf))
    assert is_far(2.0, 21.0, Costs(5.0, 10.0))
    assert is_far(2.0, 5.0, Costs(21.0, 10.0))
    assert not is_far(2.0, 20.0, Costs(20.0, 10.0))


SLOT, INTERIOR = picoseconds(0.25), picoseconds(0.17)


def test_iterations_never_take_longer_than_their_slots() -> None:
    assert iterations_in(np.array([0, 1, 2, 3, 4, 9, 19]), SLOT, INTERIOR).tolist() == [0, 1, 2, 4, 5, 13, 27]
    assert iterations_in(np.arange(25), SLOT, SLOT).tolist() == list(range(25))
    assert (iterations_in(np.arange(200), SLOT, INTERIOR) * 0.17 <= np.arange(200) * 0.25 + 1e-9).all()


def test_a_time_that_is_no_decimal_fits_as_often_as_it_should() -> None:
    assert iterations_in(np.array([1]), picoseconds(1 / 3), picoseconds(1 / 6)) == 2
    assert iterations_in(np.array([3]), picoseconds(0.7), picoseconds(2.1)) == 1
    assert slots_begun(3, picoseconds(2.1), picoseconds(0.7)) == 1


def passed(iterations: list[int], slots: list[int], tau_1_ps: int = INTERIOR) -> list[int]:
    """Return how many of the slots pass when a solver does so many iterations in them."""
    allowed = iterations_in(np.array(slots), SLOT, tau_1_ps)
    nothing = np.empty(0)
    answer = Answer(0.0, nothing, nothing, np.minimum(iterations, allowed), nothing)
    return in_slots(answer, np.array(slots), allowed, SLOT, tau_1_ps).iterations.tolist()


@pytest.mark.usefixtures("compiles")
def test_slots_pass_as_long_as_there_is_something_to_do() -> None:
    assert passed([5, 13], [4, 9]) == [4, 9], "all that fit were done"
    assert passed([5, 6], [4, 9]) == [4, 5], "six iterations take 1.02 s: the fifth slot has begun"
    assert passed([2, 2], [4, 9]) == [2, 2], "it has ended within the second slot"
    assert passed([0, 0], [4, 9]) == [0, 0]


@pytest.mark.usefixtures("compiles")
def test_what_is_left_of_a_slot_counts_for_the_next_one() -> None:
    allowed = iterations_in(np.arange(5), SLOT, INTERIOR)
    assert np.diff(allowed).tolist() == [1, 1, 2, 1]
    assert passed([99] * 5, [0, 1, 2, 3, 4]) == [0, 1, 2, 3, 4]


@pytest.mark.usefixtures("compiles")
def test_on_harsh_problems_it_is_the_interior_point_in_the_time_of_its_slots(
    problem: PredictiveProblem, situations: "Situations", harsh_jumps: "list[Jump]"
) -> None:
    solver, interior = (
        make_solver(ProgramSettings(preset=Preset.PAPER, solver=name)) for name in (SolverName.HYBRID, "interior-point")
    )
    solver.solve(problem.at(situations(np.random.default_rng(30))), np.zeros(49), (19,))
    qp, guess = harsh_jumps[0]
    slots = solver.solve(qp, guess, (3,))
    assert slots.iterations[-1] == 3
    assert (slots.z == interior.solve(qp, guess, (4,)).z).all()


def test_in_quiet_it_is_the_ode_based_solver(problem: PredictiveProblem, situations: "Situations") -> None:
    solver, ode = (
        make_solver(ProgramSettings(preset=Preset.PAPER, solver=name)) for name in (SolverName.HYBRID, SolverName.ODE)
    )
    qp = problem.at(situations(np.random.default_rng(31)))
    first = solver.solve(qp, np.zeros(49), (5, 400))
    solver.solve(qp, first.z, (40,))  # the guess before was bad: the interior point has it
    again = solver.solve(qp, first.z, (1, 2))
    assert (first.points == ode.solve(qp, np.zeros(49), (5, 400)).points).all(), "the first problem is a quiet one"
    assert (again.points == ode.solve(qp, first.z, (1, 2)).points).all(), "there is little to win"


def test_both_judge_by_one_cost() -> None:
    with pytest.raises((ConfigurationError, ValueError), match="one cost"):
        ProgramSettings.model_validate({"solver": "hybrid", "ode": {"alpha": 10.0}})
