"""What holds for each of the solvers, and what the borrowed ones need to be told."""

import importlib
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.lti_model import LtiModel
from coldloop.registers.control_plc import Verdict
from coldloop_optimizer_plc.computing_settings import FastGradientSettings, InteriorPointSettings, QpoasesSettings
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QuadraticProblem
from coldloop_optimizer_plc.settings import OptimizerSection, Preset, ProgramSettings, SolverName
from coldloop_optimizer_plc.solvers import Solver, judged, make_solver, outside_libraries
from coldloop_optimizer_plc.solvers.fast_gradient import fast_gradient_solver, step_sizes, stiffest_hessian
from coldloop_optimizer_plc.solvers.interior_point import interior_point_solver
from coldloop_optimizer_plc.solvers.outside_libraries import QpoasesSolver
from coldloop_plant.load import find_load
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

if TYPE_CHECKING:
    from tests.harness.processes import Processes
    from tests.optimizer_plc.conftest import Jump, Optimum, PenalisedOptimum, Situations

Array = NDArray[np.float64]

seeds = st.integers(0, 2**32 - 1)
repeatable = settings(max_examples=15, derandomize=True)

EVERY = [name.value for name in SolverName]
EXACT = ["qpoases", "osqp", "daqp"]
CONVERGED = {
    "qpoases": 500,
    "osqp": 20_000,
    "daqp": 1,
    "ode": 400,
    "fast-gradient": 15_000,
    "interior-point": 40,
    "hybrid": 400,
}
"""Iterations after which nothing is truncated any more."""


def solver_named(name: str) -> Solver:
    return make_solver(ProgramSettings(preset=Preset.PAPER, solver=SolverName(name)))


def convex_problem(rng: np.random.Generator, n: int, m: int) -> QuadraticProblem:
    """Return a strictly convex problem with a point inside all of its rows and its box."""
    factor = rng.normal(size=(n, n))
    inside = rng.normal(size=n)
    Gamma = rng.normal(size=(m, n))
    return QuadraticProblem(
        np.ascontiguousarray(factor @ factor.T + np.eye(n)), 20.0 * rng.normal(size=n), Gamma,
        Gamma @ inside + rng.exponential(size=m), inside - rng.exponential(size=n), inside + rng.exponential(size=n),
        constant=0.0,
    )  # fmt: skip


def answer(solver: Solver, qp: QuadraticProblem, guess: Array, count: int) -> Array:
    return solver.solve(qp, guess, (count,)).z


@pytest.mark.parametrize("name", EXACT)
@repeatable
@given(seed=seeds)
def test_the_exact_ones_end_at_the_optimum(name: str, optimum: "Optimum", seed: int) -> None:
    rng = np.random.default_rng(seed)
    qp = convex_problem(rng, n=int(rng.integers(1, 9)), m=int(rng.integers(1, 12)))
    z = answer(solver_named(name), qp, rng.normal(size=len(qp.phi)), CONVERGED[name])
    assert z == pytest.approx(optimum(qp), abs=1e-12)


@pytest.mark.parametrize(
    ("name", "accuracy"), [("ode", 2e-2), ("fast-gradient", 1e-10), ("interior-point", 1e-11), ("hybrid", 2e-2)]
)
@pytest.mark.parametrize("seed", range(20, 25))
def test_the_penalised_ones_end_at_the_penalised_optimum(
    name: str,
    accuracy: float,
    problem: PredictiveProblem,
    situations: "Situations",
    penalised_optimum: "PenalisedOptimum",
    seed: int,
) -> None:
    """Of a hundred draws the ODE-based solver ends in three above its accuracy here: these are none of them."""
    qp = problem.at(situations(np.random.default_rng(seed)))
    solver = solver_named(name)
    reached = solver.solve(qp, np.zeros(49), (CONVERGED[name],)).cost
    lowest = solver_named(name).solve(qp, penalised_optimum(qp, solver.alpha), (0,)).guessed
    assert reached + qp.constant == pytest.approx(lowest + qp.constant, rel=accuracy, abs=1e-8)


@pytest.mark.parametrize("name", ["qpoases", "daqp"])
@repeatable
@given(seed=seeds)
def test_on_the_controllers_problem_residuals_and_gap_vanish_at_the_optimum(
    name: str, problem: PredictiveProblem, situations: "Situations", optimum: "Optimum", seed: int
) -> None:
    rng = np.random.default_rng(seed)
    qp = problem.at(situations(rng))
    solver = solver_named(name)
    found = solver.solve(qp, np.zeros(49), (CONVERGED[name],))
    assert found.z == pytest.approx(optimum(qp), abs=1e-11)
    solution = judged(qp, found, solver.alpha)
    assert solution.primal_residual <= 1e-11
    assert solution.dual_residual <= 1e-13 * max(1.0, float(np.abs(qp.phi).max()))
    assert solution.gap <= 1e-10 * max(1.0, abs(solution.cost))


@pytest.mark.parametrize("name", EVERY)
def test_an_answer_is_judged_by_its_residuals(name: str, problem: PredictiveProblem, situations: "Situations") -> None:
    rng = np.random.default_rng(21)
    solver = solver_named(name)
    for count in (0, 1, 3):
        qp = problem.at(situations(rng))
        found = solver.solve(qp, np.concatenate([rng.normal(size=21), np.zeros(28)]), (count,))
        z, solution = found.z, judged(qp, found, solver.alpha)
        excess = np.maximum(qp.Gamma @ z - qp.gamma, 0.0)
        assert (solution.z == z).all()
        assert solution.base_cost == pytest.approx(z @ qp.Phi @ z + qp.phi @ z)
        assert solution.cost == pytest.approx(solution.base_cost + solver.alpha * excess @ excess)
        assert solution.cost == pytest.approx(found.cost)
        assert solution.violation == solution.primal_residual == pytest.approx(excess.max())
        assert solution.multipliers.shape == qp.gamma.shape
        assert (solution.multipliers >= 0).all()


@pytest.mark.parametrize("name", EVERY)
def test_before_the_first_iteration_the_answer_is_the_guess_inside_the_box(
    name: str, problem: PredictiveProblem, situations: "Situations"
) -> None:
    qp = problem.at(situations(np.random.default_rng(22)))
    guess = np.full(49, -1e3)
    solver = solver_named(name)
    assert (answer(solver, qp, guess, 0) == qp.low).all()
    assert (guess == -1e3).all(), "the caller's guess is not touched"


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("name", EVERY)
def test_truncated_answers_stay_inside_the_box(name: str, harsh_jumps: "list[Jump]") -> None:
    solver = solver_named(name)
    for qp, guess in harsh_jumps:
        for count in (1, 2):
            z = answer(solver, qp, guess, count)
            assert ((qp.low <= z) & (z <= qp.high)).all()


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("name", EVERY)
def test_iterations_add_up(name: str, harsh_jumps: "list[Jump]") -> None:
    at_once, in_parts = solver_named(name), solver_named(name)
    for qp, guess in harsh_jumps[:15]:
        parts = in_parts.solve(qp, guess, (3, 3, 7, 8))
        assert (parts.points[0] == parts.points[1]).all()
        assert parts.z == pytest.approx(answer(at_once, qp, guess, 8), rel=1e-9, abs=1e-9)


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("name", EVERY)
def test_reset_forgets(name: str, harsh_jumps: "list[Jump]") -> None:
    def sequence(solver: Solver) -> list[bytes]:
        return [answer(solver, qp, guess, 4).tobytes() for qp, guess in harsh_jumps[:8]]

    fresh, used = solver_named(name), solver_named(name)
    sequence(used)
    used.reset()
    assert sequence(fresh) == sequence(used)


@pytest.mark.parametrize("name", EVERY)
def test_data_that_are_no_numbers_do_no_lasting_harm(
    name: str, problem: PredictiveProblem, situations: "Situations"
) -> None:
    rng = np.random.default_rng(23)
    first, second = problem.at(situations(rng)), problem.at(situations(rng))
    spared, struck = solver_named(name), solver_named(name)
    for solver in (spared, struck):
        answer(solver, first, np.zeros(49), 5)
    for spoilt in (first._replace(phi=first.phi * np.nan), first._replace(gamma=first.gamma * np.nan)):
        answer(struck, spoilt, np.zeros(49), 5)
    z = answer(struck, second, np.zeros(49), 5)
    assert np.isfinite(z).all()
    assert z.tobytes() == answer(spared, second, np.zeros(49), 5).tobytes()


@pytest.mark.parametrize("name", EVERY)
def test_rounding_in_the_data_hardly_changes_the_cost_of_answers(
    name: str, problem: PredictiveProblem, situations: "Situations"
) -> None:
    rng = np.random.default_rng(24)
    qp = problem.at(situations(rng))
    count = CONVERGED[name] if name in EXACT else 200
    rounded = qp._replace(phi=qp.phi * (1 + 1e-12 * rng.normal(size=49)), gamma=qp.gamma + 1e-12 * rng.normal(size=94))
    costs = [solver_named(name).solve(each, np.zeros(49), (count,)).cost + qp.constant for each in (qp, rounded)]
    assert costs[0] == pytest.approx(costs[1], rel=2e-4 if name in {"ode", "hybrid"} else 1e-10)


# -- qpOASES ----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("compiles")
def test_an_iteration_of_qpoases_changes_the_working_set_at_most_once(
    harsh_jumps: "list[Jump]", monkeypatch: pytest.MonkeyPatch
) -> None:
    solver = QpoasesSolver(QpoasesSettings())
    solver.solve(*harsh_jumps[0], (0,))
    changes = []
    step = outside_libraries._Chain.step  # noqa: SLF001

    def counted(chain: outside_libraries._Chain) -> str:
        status = step(chain)
        changes.append(chain._buffer.stats()["iter_count"])  # noqa: SLF001 only CasADi knows
        return status

    monkeypatch.setattr(outside_libraries._Chain, "step", counted)  # noqa: SLF001
    solver.solve(*harsh_jumps[1], (200,))
    assert set(changes) == {0, 1}
    assert changes == sorted(changes, reverse=True), "once it has arrived it stays"


@pytest.mark.usefixtures("compiles")
def test_ten_recalculations_at_once_come_to_the_same_point(harsh_jumps: "list[Jump]") -> None:
    casadi = outside_libraries.load_casadi()
    ours = QpoasesSolver(QpoasesSettings())
    (first, guess), (second, _) = harsh_jumps[0], harsh_jumps[1]
    answer(ours, first, guess, 1)
    z = answer(ours, second, guess, 10)

    def throttled(count: int) -> object:
        shapes = {"h": casadi.Sparsity.dense(49, 49), "a": casadi.Sparsity.dense(94, 49)}
        options = {"nWSR": count, "printLevel": "none", "error_on_fail": False}
        return casadi.conic("qp", "qpoases", shapes, options)

    def solved(conic: object, qp: QuadraticProblem) -> Array:
        data = {"h": 2 * qp.Phi, "g": qp.phi, "a": qp.Gamma, "lba": -np.inf, "uba": qp.gamma}
        found = conic(**data, lbx=qp.low, ubx=qp.high)  # type: ignore[operator]
        return np.array(found["x"]).ravel()

    theirs = throttled(10)
    for _ in range(40):
        solved(theirs, first)
    expected = solved(theirs, second)
    assert z == pytest.approx(np.clip(expected, second.low, second.high), abs=1e-9)


@pytest.mark.usefixtures("compiles")
def test_qpoases_goes_on_from_where_it_stopped(harsh_jumps: "list[Jump]", optimum: "Optimum") -> None:
    solver = QpoasesSolver(QpoasesSettings())
    solver.solve(*harsh_jumps[0], (0,))
    qp, guess = harsh_jumps[1]
    distances = [float(np.abs(answer(solver, qp, guess, 5) - optimum(qp)).max()) for _ in range(20)]
    assert distances[0] > 1e-3
    assert distances[-1] < 1e-13


def test_a_problem_without_solution_leaves_the_guess_and_the_next_one_is_solved(
    problem: PredictiveProblem, situations: "Situations", optimum: "Optimum", capfd: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(25)
    qp = problem.at(situations(rng))
    impossible = qp._replace(gamma=np.where(np.arange(94) >= 60, -1e6, qp.gamma))
    solver = QpoasesSolver(QpoasesSettings())
    answer(solver, qp, np.zeros(49), 1)
    answer(solver, impossible, np.zeros(49), 500)
    assert answer(solver, qp, np.zeros(49), 500) == pytest.approx(optimum(qp), abs=1e-11)
    assert capfd.readouterr() == ("", "")


def test_no_solver_prints(processes: "Processes") -> None:
    program = (
        "import numpy as np\n"
        "from coldloop_optimizer_plc.qp.problem import QuadraticProblem\n"
        "from coldloop_optimizer_plc.settings import ProgramSettings, SolverName\n"
        "from coldloop_optimizer_plc.solvers import make_solver\n"
        "one = np.ones(1)\n"
        "for name in SolverName:\n"
        "    solver = make_solver(ProgramSettings(solver=name))\n"
        "    for phi in (1.0, -3.0):\n"
        "        problem = QuadraticProblem(np.eye(1), phi * one, np.eye(1), one, -one, one, 0.0)\n"
        "        solver.solve(problem, 0 * one, (5,))\n"
    )
    assert processes.run_python(program) == ("", "")


def test_without_casadi_qpoases_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> object:
        raise ModuleNotFoundError(name)

    outside_libraries.load_casadi.cache_clear()
    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(ConfigurationError) as caught:
        solver_named("qpoases")
    message = str(caught.value)
    assert "\n" not in message
    assert all(part in message for part in ("optimizer_plc.program.solver", "CasADi", "coldloop[qpoases]"))


def test_casadi_is_not_imported_unless_it_is_needed(processes: "Processes") -> None:
    program = (
        "import sys\n"
        "from coldloop_optimizer_plc.settings import ProgramSettings\n"
        "from coldloop_optimizer_plc.solvers import make_solver\n"
        "make_solver(ProgramSettings())\n"
        "print('casadi' in sys.modules)"
    )
    assert processes.run_python(program)[0].strip() == "False"


# -- the fast gradient method -----------------------------------------------------------------------------------------


def test_the_step_is_bounded_by_the_largest_curvature(problem: PredictiveProblem) -> None:
    H = stiffest_hessian(problem.Phi, problem.Gamma, 3000.0)
    assert pytest.approx(2 * problem.Phi + 6000 * problem.Gamma.T @ problem.Gamma) == H
    steps = step_sizes(problem.Phi, problem.Gamma, 3000.0)
    largest = np.linalg.eigvalsh(np.sqrt(np.outer(steps, steps)) * H)[-1]
    assert 0.9 < largest <= 1.0


@pytest.mark.usefixtures("compiles")
def test_without_momentum_a_step_never_raises_the_cost(harsh_jumps: "list[Jump]") -> None:
    solver = fast_gradient_solver(FastGradientSettings())
    for qp, guess in harsh_jumps:
        first = solver.solve(qp, guess, (1,))
        assert first.cost <= first.guessed


# -- the interior-point method ----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("compiles")
def test_the_answer_of_the_interior_point_method_never_gets_worse(harsh_jumps: "list[Jump]") -> None:
    solver = interior_point_solver(InteriorPointSettings())
    for qp, guess in harsh_jumps:
        path = solver.solve(qp, guess, range(60))
        assert path.iterations[-1] < 59, "it ends by itself"
        assert path.costs.tolist() == sorted(path.costs, reverse=True)


@pytest.mark.usefixtures("compiles")
def test_after_eight_iterations_it_is_at_the_optimum_of_most_harsh_problems(
    harsh_jumps: "list[Jump]", penalised_optimum: "PenalisedOptimum"
) -> None:
    ratios = []
    for qp, guess in harsh_jumps:
        solver = interior_point_solver(InteriorPointSettings())
        reached = solver.solve(qp, guess, (8,)).cost
        lowest = solver.solve(qp, penalised_optimum(qp, solver.alpha), (0,)).guessed
        ratios.append((reached + qp.constant + 1.0) / (lowest + qp.constant + 1.0))
    assert min(ratios) > 1.0 - 1e-6, "nothing is below the optimum"
    assert np.median(ratios) < 1.01


def test_its_structure_changes_nothing_but_the_work(problem: PredictiveProblem, situations: "Situations") -> None:
    """With upper bounds on the slacks, far away, other variables are eliminated first."""
    qp = problem.at(situations(np.random.default_rng(27)))
    far = qp._replace(high=np.minimum(qp.high, 1e4))
    first, second = (
        answer(interior_point_solver(InteriorPointSettings()), each, np.zeros(49), 40) for each in (qp, far)
    )
    assert first == pytest.approx(second, abs=1e-7)


# -- the loop ---------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("updating_period_s", [0.0, pytest.param(5.0, marks=pytest.mark.night)])
def test_every_solver_closes_the_loop(name: str, updating_period_s: float, model: LtiModel) -> None:
    section = OptimizerSection(program=ProgramSettings(solver=SolverName(name)))
    rig = OneProcessRig(Settings(optimizer_plc=section))
    recorder = Recorder(480)
    rig.run(Scenario(480, find_load("e", model.w0, COLD_BOX), updating_period_s, seed=1), recorder)
    recording = recorder.recording()
    assert len(recording.updates) >= 20
    assert {row.verdict for row in recording.updates} == {Verdict.ACCEPTED}
