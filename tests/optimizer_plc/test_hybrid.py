"""The hybrid solver: who gets a problem, and what its slots hold."""

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from optimizer_plc.computing_settings import HybridSettings
from optimizer_plc.problem import PredictiveProblem, QuadraticProblem
from optimizer_plc.settings import ProgramSettings, SolverName
from optimizer_plc.solution import Solution
from optimizer_plc.solvers import make_solver
from optimizer_plc.solvers.hybrid import HybridSolver, is_far, iterations_in, slots_passed

if TYPE_CHECKING:
    from tests.optimizer_plc.conftest import Jump, Situations

Array = NDArray[np.float64]


class Scripted:
    """A solver whose costs are written down: that of the guess, then one an iteration; it ends with the last one."""

    alpha = 1.0

    def __init__(self, tau_1_s: float, costs: dict[float, tuple[float, ...]]) -> None:
        self.tau_1_s = tau_1_s
        self._costs = costs
        self.done: list[int] = []

    def reset(self) -> None:
        self.done = []

    def start(self, _: QuadraticProblem, guess: Array) -> None:
        self._present = self._costs[float(guess[0])]
        self.solution = guess
        self._at = 0

    def iterate(self, count: int) -> int:
        before = self._at
        self._at = min(self._at + count, len(self._present) - 1)
        self.done.append(self._at - before)
        return self._at - before

    @property
    def cost(self) -> float:
        return self._present[self._at]

    def judged(self) -> Solution:
        raise NotImplementedError


@pytest.fixture
def anything() -> QuadraticProblem:
    one = np.ones(1)
    return QuadraticProblem(np.eye(1), one, np.eye(1), one, -one, one, constant=4.0)


def test_a_load_step_goes_to_the_interior_point_until_it_has_little_to_win(anything: QuadraticProblem) -> None:
    """With constant and floor 5: J+ and Jhat are 10 and 7, 15 and 9, 10 and 9, 10 and 8."""
    far = Scripted(0.2, {1.0: (10.0, 4.0), 2.0: (5.0, 4.0), 3.0: (5.0, 3.0)})
    quiet = Scripted(0.2, {0.0: (5.0, 2.0), 1.0: (10.0, 9.0), 2.0: (5.0, 4.5), 3.0: (5.0, 3.0)})
    solver = HybridSolver(HybridSettings(switch=1.5), far, quiet, floor=1.0)
    taken = []
    for problem in (0.0, 1.0, 2.0, 3.0):
        solver.start(anything, np.array([problem]))
        solver.iterate(1)
        taken.append(solver.is_far)
    # 10 > 1.5 inf: no; 15 > 1.5 * 7: yes; max(10, 15) > 1.5 * 9: yes; max(10, 10) > 1.5 * 9: no
    assert taken == [False, True, True, False]


def test_the_first_problem_is_a_quiet_one_whatever_it_costs() -> None:
    assert not is_far(2.0, 1e9, math.inf, math.inf)
    assert is_far(2.0, 21.0, 5.0, 10.0)
    assert is_far(2.0, 5.0, 21.0, 10.0)
    assert not is_far(2.0, 20.0, 20.0, 10.0)


def test_iterations_never_take_longer_than_their_slots() -> None:
    assert [iterations_in(slots, 0.25, 0.17) for slots in (0, 1, 2, 3, 4, 9, 19)] == [0, 1, 2, 4, 5, 13, 27]
    assert [iterations_in(slots, 0.25, 0.25) for slots in range(25)] == list(range(25))
    assert all(iterations_in(slots, 0.25, 0.17) * 0.17 <= slots * 0.25 + 1e-9 for slots in range(200))


def test_slots_pass_as_long_as_there_is_something_to_do() -> None:
    assert slots_passed(13, 13, 4, 5, 0.25, 0.17) == 5
    assert slots_passed(6, 13, 4, 5, 0.25, 0.17) == 1, "six iterations take 1.02 s: the fifth slot has begun"
    assert slots_passed(2, 13, 4, 5, 0.25, 0.17) == 0


def test_what_is_left_of_a_slot_counts_for_the_next_one(harsh_jumps: "list[Jump]") -> None:
    qp, guess = harsh_jumps[0]
    far = Scripted(0.17, {float(guess[0]): tuple(range(100, 60, -1))})
    solver = HybridSolver(HybridSettings(), far, Scripted(0.25, {float(guess[0]): (1e6,)}), floor=1.0)
    solver.go_on_after(1.0, 1.0)
    solver.start(qp, guess)
    assert solver.is_far
    assert [solver.iterate(1) for _ in range(4)] == [1] * 4
    assert far.done == [1, 1, 2, 1]


def test_on_harsh_problems_it_is_the_interior_point_in_the_time_of_its_slots(
    problem: PredictiveProblem, situations: "Situations", harsh_jumps: "list[Jump]"
) -> None:
    solver, interior = (make_solver(ProgramSettings(solver=name)) for name in (SolverName.HYBRID, "interior-point"))
    solver.start(problem.at(situations(np.random.default_rng(30))), np.zeros(49))
    solver.iterate(19)
    qp, guess = harsh_jumps[0]
    solver.start(qp, guess)
    assert solver.iterate(3) == 3
    interior.start(qp, guess)
    interior.iterate(4)
    assert isinstance(solver, HybridSolver)
    assert solver.is_far
    assert (solver.solution == interior.solution).all()


def test_both_judge_by_one_cost() -> None:
    with pytest.raises((ConfigurationError, ValueError), match="one cost"):
        ProgramSettings.model_validate({"solver": "hybrid", "ode": {"alpha": 10.0}})
