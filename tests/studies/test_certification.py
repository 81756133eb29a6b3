"""Certified iterations: the bound, what a problem needs, and the command."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.settings import SolverName
from coldloop_optimizer_plc.solvers import Answer, make_solver
from coldloop_rig.plc_sizing.intervals import (
    LONGEST,
    Problem,
    failed,
    failure_bound,
    iterations_needed,
    scenario_needs,
    scenario_problems,
)
from coldloop_studies.settings import settings_of

if TYPE_CHECKING:
    from tests.conftest import Coldloop

Array = NDArray[np.float64]


@pytest.mark.parametrize(
    ("failures", "scenarios", "beta", "bound"),
    [
        (0, 1, 0.05, 0.95),  # one good one says little
        (0, 59, 0.05, 1 - 0.05 ** (1 / 59)),  # Wilks: 59 good ones bound 5 % with 95 %
        (0, 300, 1e-3, 1 - 1e-3 ** (1 / 300)),
        (1, 10, 0.05, 0.3942),  # tables of Clopper and Pearson
        (5, 5, 0.05, 1.0),
    ],
)
def test_the_bound_of_the_failure_probability(failures: int, scenarios: int, beta: float, bound: float) -> None:
    assert failure_bound(failures, scenarios, beta) == pytest.approx(bound, abs=5e-5)


@pytest.mark.parametrize(("failures", "scenarios"), [(0, 20), (3, 20), (19, 20), (7, 300)])
def test_at_the_bound_so_few_failures_are_as_likely_as_one_minus_the_confidence(failures: int, scenarios: int) -> None:
    epsilon = failure_bound(failures, scenarios, 0.01)
    chance = sum(math.comb(scenarios, i) * epsilon**i * (1 - epsilon) ** (scenarios - i) for i in range(failures + 1))
    assert chance == pytest.approx(0.01, rel=1e-6)


class Written:
    """A solver whose costs are written down."""

    tau_1_s = 0.25
    alpha = 1.0

    def __init__(self, *costs: float) -> None:
        self._costs = costs

    def reset(self) -> None:
        """Nothing is kept."""

    def solve(self, problem: QuadraticProblem, guess: Array, counts: Sequence[int]) -> Answer:
        """Go along the costs up to the last one."""
        del problem
        places = np.minimum(counts, len(self._costs) - 1)
        points = np.tile(guess, (len(places), 1))
        return Answer(self._costs[0], points, np.array(self._costs)[places], places, np.zeros(1))


ONE = np.ones(1)
PROBLEM = Problem(
    QuadraticProblem(np.eye(1), np.zeros(1), np.zeros((1, 1)), ONE, -ONE, ONE, 8.0), np.zeros(1), np.array([1.0])
)
"""min z^2 with constant 8: at the optimum, said to be z = 1, J is 1 + 8, and with a floor of 1 it is 10."""


@pytest.mark.parametrize(
    ("costs", "needed"),
    [
        ((1.0,), 0),  # the guess is the optimum
        ((2.0, 1.6, 1.5, 1.2), 2),  # 5 % of 10 are 0.5: 1.5 is enough
        ((2.0, 1.2, 1.9, 1.1), 3),  # it gets worse again: only from the third on it stays
        ((2.0, 1.2, 1.9), LONGEST + 1),  # it ends by itself where it is not enough
        ((9.0,) * (LONGEST + 5), LONGEST + 1),
        ((9.0,) * LONGEST + (1.0,) * 5, LONGEST),
    ],
)
def test_what_a_problem_needs(costs: tuple[float, ...], needed: int) -> None:
    assert iterations_needed(Written(*costs), PROBLEM, 0.05, 1.0) == needed


def test_a_certificate_counts_scenarios() -> None:
    """19 fit: of four problems at random one fails, of four worst ones two."""
    at_random, worst = (2, 19, 3, 25), (5, 19, 20, 40)
    assert failed(at_random, 19, 0.05) == ("1 of 4", f"{100 * failure_bound(1, 4, 0.05):.1f} %")
    assert failed(worst, 19, 0.05) == ("2 of 4", f"{100 * failure_bound(2, 4, 0.05):.1f} %")


def test_scenarios_repeat_and_differ() -> None:
    settings = settings_of(())
    one, again, other = (scenario_problems(settings, number) for number in (3, 3, 4))
    assert len(one) == 179
    assert all((a.qp.phi == b.qp.phi).all() for a, b in zip(one, again, strict=True))
    assert any((a.qp.phi != b.qp.phi).any() for a, b in zip(one, other, strict=True))


def test_an_exact_solver_needs_one_iteration_and_a_truncated_one_more() -> None:
    settings = settings_of(())
    problems = scenario_problems(settings, 1)[:60]
    program = settings.optimizer_plc.program
    needs = {
        name: scenario_needs(make_solver(program.model_copy(update={"solver": name})), problems, 1, 0.05, 1.0)
        for name in (SolverName.DAQP, SolverName.ODE, SolverName.QPOASES)
    }
    assert needs[SolverName.DAQP].worst == 1
    assert needs[SolverName.QPOASES].worst <= LONGEST
    assert needs[SolverName.ODE].worst > 1


def test_the_command_prints_a_row_for_each_solver(coldloop: "Coldloop", monkeypatch: pytest.MonkeyPatch) -> None:
    """Of scenarios of three minutes."""
    monkeypatch.setattr("coldloop_rig.plc_sizing.intervals.SCENARIO_TICKS", 720)
    outcome = coldloop("budget", "--certify", "2", "--confidence", "90")
    assert outcome.code == 0, outcome.complaints
    rows = {line.split()[0]: line for line in outcome.out.splitlines() if line and line.split()[0] in set(SolverName)}
    assert set(rows) == set(SolverName)
    assert "68.38 % have one that needs more" in outcome.out, "1 - 0.1^(1/2)"
    assert rows["daqp"].split()[1:5] == ["1", "0", "of", "2"]
    assert coldloop("budget", "--certify", "2", "--confidence", "90").out == outcome.out


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("--certify", "0"), "'0' is not a whole number of at least 1"),
        (("--certify", "2", "--confidence", "100"), "'100' is not a percentage"),
        (("--certify", "2", "--tolerance", "much"), "'much' is not a percentage"),
        (("--certify", "2", "--power", "2"), "leave out --power, --plc and --updating-period"),
    ],
)
def test_certificates_asked_for_wrongly_are_one_line(
    arguments: tuple[str, ...], part: str, coldloop: "Coldloop"
) -> None:
    outcome = coldloop("budget", *arguments)
    assert outcome.code == 2
    assert part in outcome.complaints[-1]
