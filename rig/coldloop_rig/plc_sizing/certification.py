"""Certified number of iterations, with its confidence: sampled scenarios and the binomial bound.

A scenario is fifteen minutes under a random telegraph: a family of hour drawn from a to f, and a draw of it that no
study uses. Scenarios are independent of each other. Each gives, for each solver, two figures: the iterations that its
worst problem needs, and those that the problem at a random instant needs. A problem needs q iterations when from q on,
up to `LONGEST`, J stays within a tolerance of its optimum.

If k of N independent scenarios violate something, then with confidence 1 - beta the probability that a new one does is
at most the epsilon at which the chance of k or fewer violations is beta (Clopper and Pearson, Biometrika 26, 1934; for
k = 0 it is 1 - beta^(1/N), as in Tempo, Bai and Dabbene, Systems & Control Letters 30, 1997). For the number of
iterations itself, the largest of N is one decision made by scenarios, and the same bound holds for it: Campi and
Garatti, SIAM Journal on Optimization 19 (3), 2008, with one variable. The claim is about the distribution that the
scenarios are drawn from, and about problems that a converged loop meets, hot-started from the optimum before.
"""

import random
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from coldloop.errors import ConfigurationError
from coldloop.process.lti_model import load
from coldloop_optimizer_plc.computing_settings import PlcBudget
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.settings import ProgramSettings, SolverName
from coldloop_optimizer_plc.solvers import Solver, make_solver
from coldloop_plant.load import HOURS, drawn
from coldloop_rig.cosim.ideal_loop import run_ideal_loop
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.progress import make_console
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import aligned

Array = NDArray[np.float64]

FAMILIES: Final = "abcdef"
SCENARIO_TICKS: Final = 3600
LONGEST: Final = 200
"""Iterations after which a problem counts as not solved: those of 5 s at ten times the power of the PLC."""
OWN_SEEDS: Final = 10**9
"""First seed of the scenarios: no named load has one so large."""


class Problem(NamedTuple):
    """A problem that the loop met."""

    qp: QuadraticProblem
    guess: Array
    """The shifted optimum of the problem before."""
    optimum: Array


class Needs(NamedTuple):
    """Iterations that the problems of one scenario need; `LONGEST` + 1 means more."""

    worst: int
    at_random: int


class Certificate(NamedTuple):
    """Result of N scenarios for one solver."""

    solver: SolverName
    fitting: int
    """Iterations in the longest updating period."""
    failures: int
    """Scenarios whose problem at a random instant needs more than that."""
    failure_bound: float
    worst: int
    """Largest need of all problems of all scenarios."""
    run_failures: int
    """Scenarios that have a problem which needs more than fits."""
    run_bound: float


def failure_bound(failures: int, scenarios: int, beta: float) -> float:
    """Return the probability that is not exceeded with confidence 1 - beta, given failures among scenarios.

    It is the upper end of the one-sided Clopper-Pearson interval: the epsilon with sum_{i <= k} C(N, i) epsilon^i
    (1 - epsilon)^(N - i) = beta.
    """
    if failures >= scenarios:
        return 1.0
    return float(betaincinv(failures + 1, scenarios - failures, 1.0 - beta))


def iterations_needed(solver: Solver, problem: Problem, tolerance: float, floor: float) -> int:
    """Return from which iteration on J stays within a tolerance of its optimum; `LONGEST` + 1 if from none.

    Args:
        solver: Begins from the problem's guess.
        problem: With its optimum.
        tolerance: Share of the optimal J.
        floor: Constant that J has besides that of the problem, as in Algorithm 1.
    """
    qp = problem.qp
    rest = qp.constant + floor
    enough = (1.0 + tolerance) * (float(augmented_cost(qp, problem.optimum, solver.alpha)) + rest)
    answer = solver.solve(qp, problem.guess, range(1, LONGEST + 1))
    above = np.flatnonzero(np.array([answer.guessed, *answer.costs]) + rest > enough)
    return int(above[-1]) + 1 if len(above) else 0


def scenario_problems(settings: Settings, number: int) -> list[Problem]:
    """Return the problems of a scenario, at instants of 5 s of the converged loop."""
    draw = random.Random(OWN_SEEDS + number)  # noqa: S311 not for secrets; the one generator stable over versions
    hour = draw.choice(FAMILIES)
    family = HOURS[hour]._replace(seed=OWN_SEEDS + number)
    profile = drawn(family, hour, load(settings.model.file).w0, settings.process)
    problems: list[Problem] = []
    scenario = Scenario(SCENARIO_TICKS, profile, 0.0, number)
    run_ideal_loop(
        settings, scenario, Recorder(SCENARIO_TICKS, []), settings.process.ticks_per_sample,
        lambda qp, guess, optimum: problems.append(Problem(qp, guess, optimum)),
    )  # fmt: skip
    return problems[1:]  # the first is at rest, and a chain of qpOASES begins with it


def scenario_needs(solver: Solver, problems: list[Problem], number: int, tolerance: float, floor: float) -> Needs:
    """Return what a scenario needs of a solver, beginning without a hot start."""
    solver.reset()
    needs = [iterations_needed(solver, problem, tolerance, floor) for problem in problems]
    return Needs(max(needs), needs[random.Random(number).randrange(len(needs))])  # noqa: S311


def certify(
    settings: Settings, scenarios: int, tolerance: float, beta: float, progress: Callable[[int], None]
) -> list[Certificate]:
    """Return a certificate for each solver that is installed.

    Args:
        settings: Of plant, problem and solvers.
        scenarios: N.
        tolerance: Share of the optimal J that an answer may cost more.
        beta: One minus the confidence.
        progress: Called with the number of scenarios done.
    """
    program = settings.optimizer_plc.program
    solvers = {name: solver for name in SolverName if (solver := _solver(program, name)) is not None}
    floor = program.adaptive.cost_floor
    needs: dict[SolverName, list[Needs]] = {name: [] for name in solvers}
    for number in range(scenarios):
        problems = scenario_problems(settings, number)
        for name, solver in solvers.items():
            needs[name].append(scenario_needs(solver, problems, number, tolerance, floor))
        progress(number + 1)
    longest = program.process.ticks_per_sample
    fitting = {name: PlcBudget(program.budget, one.tau_1_s).iterations(longest) for name, one in solvers.items()}
    return [_certificate(name, fitting[name], needs[name], beta) for name in solvers]


def _certificate(name: SolverName, fitting: int, needs: list[Needs], beta: float) -> Certificate:
    failures = sum(one.at_random > fitting for one in needs)
    run_failures = sum(one.worst > fitting for one in needs)
    return Certificate(
        name, fitting, failures, failure_bound(failures, len(needs), beta), max(one.worst for one in needs),
        run_failures, failure_bound(run_failures, len(needs), beta),
    )  # fmt: skip


def _solver(program: ProgramSettings, name: SolverName) -> Solver | None:
    """Return a solver; None if it is not installed."""
    try:
        return make_solver(program.model_copy(update={"solver": name}))
    except ConfigurationError:
        return None


def certification_table(settings: Settings, scenarios: int, tolerance_pct: float, confidence_pct: float) -> str:
    """Sample scenarios and return what they certify, as text.

    Args:
        settings: Of plant, problem, solvers and budget.
        scenarios: N, 1 or more.
        tolerance_pct: An answer is good when its J is within this of the optimum.
        confidence_pct: Of the bounds.
    """
    beta = 1.0 - confidence_pct / 100.0
    with make_console().status("") as status:
        found = certify(
            settings, scenarios, tolerance_pct / 100.0, beta,
            lambda done: status.update(f"{done} of {scenarios} scenarios"),
        )  # fmt: skip
    none_failed = 100.0 * failure_bound(0, scenarios, beta)
    power, period_s = settings.optimizer_plc.program.budget.power, settings.process.sampling_period_s
    heading = (
        f"{scenarios} independent scenarios of {SCENARIO_TICKS // 240} min under random telegraphs, problems "
        f"every {period_s:g} s; good is an answer within {tolerance_pct:g} % of the optimal J\n"
        f"with confidence {confidence_pct:g} %: at most so many problems at a random instant are not good after "
        f"the iterations that fit into {period_s:g} s at P = {power:g};\n"
        "at most so many scenarios have one that is not; and at most "
        f"{none_failed:.2f} % have one that needs more iterations than the most needed\n\n"
    )
    fit = f"fit into {period_s:g} s"
    header = ("solver", fit, "problems failed", "at most", "scenarios failed", "at most", "most needed")
    rows = [
        (one.solver, f"{one.fitting}", f"{one.failures} of {scenarios}", f"{100 * one.failure_bound:.1f} %",
         f"{one.run_failures} of {scenarios}", f"{100 * one.run_bound:.1f} %",
         f"{one.worst}" if one.worst <= LONGEST else f"over {LONGEST}")
        for one in found
    ]  # fmt: skip
    return heading + aligned([header, *rows], numbers=True)
