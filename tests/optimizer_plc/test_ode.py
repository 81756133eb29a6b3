from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from coldloop_optimizer_plc.computing_settings import OdeSettings
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QuadraticProblem
from coldloop_optimizer_plc.solvers import KernelSolver
from coldloop_optimizer_plc.solvers.ode import ode_solver

if TYPE_CHECKING:
    from tests.optimizer_plc.conftest import Jump, PenalisedOptimum, Situations

Array = NDArray[np.float64]

seeds = st.integers(0, 2**32 - 1)


def spread(rng: np.random.Generator, low: float, high: float) -> float:
    return float(10.0 ** rng.uniform(low, high))


def random_problem(rng: np.random.Generator, n: int, m: int) -> QuadraticProblem:
    """Return a problem of any scale: Phi of any rank, rows of any direction, a box that may be a point somewhere."""
    rank = rng.integers(0, n + 1)
    factor = rng.normal(size=(n, rank)) * spread(rng, -2, 2)
    Phi = np.ascontiguousarray(factor @ factor.T)
    middle, width = rng.normal(size=n), rng.exponential(size=n) * spread(rng, -2, 1) * rng.choice([0.0, 1.0, 1.0], n)
    low, high = middle - width, middle + width
    if rank == n:
        high[rng.random(n) < 0.3] = np.inf
        low[rng.random(n) < 0.3] = -np.inf
    phi = rng.normal(size=n) * spread(rng, -2, 4)
    Gamma = rng.normal(size=(m, n)) * spread(rng, -1, 1)
    return QuadraticProblem(Phi, phi, Gamma, rng.normal(size=m) * spread(rng, -1, 1), low, high, 0.0)


def augmented(qp: QuadraticProblem, z: Array, alpha: float) -> float:
    excess = np.maximum(qp.Gamma @ z - qp.gamma, 0.0)
    return float(z @ qp.Phi @ z + qp.phi @ z + alpha * excess @ excess)


def settings_for(rng: np.random.Generator) -> OdeSettings:
    if rng.random() < 0.5:
        return OdeSettings()
    return OdeSettings(
        alpha=spread(rng, 0, 5),
        cost_scale=spread(rng, -8, 0),
        tolerance=spread(rng, -3, 2),
        growth=rng.uniform(1.5, 10),
        rejection=rng.uniform(0.1, 0.9),
    )


def descend(qp: QuadraticProblem, guess: Array, chosen: OdeSettings, iterations: int) -> None:
    """Iterate; fail if J rises once, if the box is left once, or if the cost told is not that of the solution told."""
    answer = ode_solver(chosen).solve(qp, guess, range(1, iterations + 1))
    costs = np.array([answer.guessed, *answer.costs])
    assert (np.diff(costs) <= 0.0).all()
    assert ((qp.low <= answer.points) & (answer.points <= qp.high)).all()
    size = np.abs(costs).max() + 1.0
    assert answer.cost == pytest.approx(augmented(qp, answer.z, chosen.alpha), rel=1e-8, abs=1e-8 * size)


@pytest.mark.parametrize("block", range(10))
def test_the_cost_never_rises_and_the_box_is_never_left_on_random_problems(block: int) -> None:
    rng = np.random.default_rng([block, 7])
    for _ in range(300):
        qp = random_problem(rng, n=int(rng.integers(1, 9)), m=int(rng.integers(1, 12)))
        descend(qp, rng.normal(size=len(qp.phi)) * spread(rng, -1, 2), settings_for(rng), iterations=20)


@given(seed=seeds)
def test_the_cost_never_rises_on_random_problems_of_the_real_size(seed: int) -> None:
    rng = np.random.default_rng(seed)
    descend(random_problem(rng, 49, 94), rng.normal(size=49) * spread(rng, -1, 1), settings_for(rng), iterations=20)


@given(seed=seeds)
def test_the_cost_never_rises_on_the_controllers_own_problem(
    problem: PredictiveProblem, situations: "Situations", seed: int
) -> None:
    rng = np.random.default_rng(seed)
    guess = np.concatenate([rng.normal(size=21), rng.exponential(size=28)]) * spread(rng, -1, 1)
    descend(problem.at(situations(rng)), guess, settings_for(rng), iterations=40)


def test_an_iteration_is_a_step_of_tr_bdf2_with_the_papers_first_step_size() -> None:
    rng = np.random.default_rng(11)
    chosen = OdeSettings(cost_scale=0.1)
    for n in (1, 3, 8):
        factor = rng.normal(size=(n, n))
        free = np.full(n, np.inf)
        qp = QuadraticProblem(
            factor @ factor.T, rng.normal(size=n), np.zeros((1, n)), np.ones(1), -free, free, constant=0.0
        )
        z = rng.normal(size=n)
        solution = ode_solver(chosen).solve(qp, z, (1,)).z
        A, b = -0.1 * 2 * qp.Phi, -0.1 * qp.phi
        h = 1 / np.sqrt(np.linalg.norm(A @ z + b))
        g = 2 - np.sqrt(2)
        one = np.eye(n)
        half_way = np.linalg.solve(one - g / 2 * h * A, z + g / 2 * h * (A @ z + 2 * b))
        share = (1 - g) / (2 - g)
        backward = half_way / (g * (2 - g)) - (1 - g) ** 2 / (g * (2 - g)) * z + share * h * b
        assert solution == pytest.approx(np.linalg.solve(one - share * h * A, backward), rel=1e-10, abs=1e-12)


def test_it_stays_put_at_an_optimum(
    problem: PredictiveProblem, situations: "Situations", penalised_optimum: "PenalisedOptimum"
) -> None:
    rng = np.random.default_rng(12)
    solver = ode_solver(OdeSettings())
    for _ in range(20):
        qp = problem.at(situations(rng))
        best = penalised_optimum(qp, solver.alpha)
        answer = solver.solve(qp, best, (30,))
        assert answer.z == pytest.approx(best, abs=1e-5)
        assert answer.cost == pytest.approx(answer.guessed, rel=1e-9, abs=1e-6)


def test_the_same_start_gives_the_same_bits_whatever_was_solved_before(
    problem: PredictiveProblem, situations: "Situations"
) -> None:
    rng = np.random.default_rng(14)
    qp, other = problem.at(situations(rng)), problem.at(situations(rng))
    guess = np.concatenate([rng.normal(size=21), np.zeros(28)])

    def path(solver: KernelSolver) -> bytes:
        answer = solver.solve(qp, guess, range(1, 31))
        return answer.points.tobytes() + answer.costs.tobytes()

    fresh, used = ode_solver(OdeSettings()), ode_solver(OdeSettings())
    used.solve(other, np.zeros(49), (7,))
    assert path(fresh) == path(used) == path(fresh)


def test_a_solution_that_was_handed_out_does_not_change_any_more(
    problem: PredictiveProblem, situations: "Situations"
) -> None:
    solver, qp = ode_solver(OdeSettings()), problem.at(situations(np.random.default_rng(15)))
    answer = solver.solve(qp, np.zeros(49), (0, 5))
    copied = answer.points.copy()
    solver.solve(qp, answer.z, (5,))
    assert (answer.points == copied).all()
    assert (answer.points[0] != answer.points[1]).any()


@pytest.mark.usefixtures("compiles")
def test_after_harsh_load_jumps_few_iterations_come_near_the_optimum(
    harsh_jumps: "list[Jump]", penalised_optimum: "PenalisedOptimum"
) -> None:
    assert len(harsh_jumps) >= 50
    solver = ode_solver(OdeSettings())
    ratios = []
    for qp, guess in harsh_jumps:
        best = augmented(qp, penalised_optimum(qp, solver.alpha), solver.alpha) + qp.constant
        assert best > 0
        ratios.append((solver.solve(qp, guess, range(41)).costs + qp.constant) / best)
    median = np.median(ratios, axis=0)
    assert np.min(ratios) > 1 - 1e-9, "nothing is below the optimum"
    assert median[0] > 100, "the jumps are harsh"
    assert median[4] <= 3.3
    assert median[8] <= 1.65
    assert median[20] <= 1.18
    assert median[40] <= 1.06
