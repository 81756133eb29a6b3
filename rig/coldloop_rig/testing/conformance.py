"""What a solver, a rule or an estimator that is installed beside this package keeps, and how good it is.

`python -m coldloop_rig.testing.conformance NAME` prints it of a solver, with `rule` or `estimator` behind it of such.
"""

import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np

from coldloop.errors import ColdloopError
from coldloop.process.lti_model import load
from coldloop_optimizer_plc.computing_settings import DaqpSettings, OutsideSettings
from coldloop_optimizer_plc.entry_points import Part, made
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem
from coldloop_optimizer_plc.solvers.daqp import DaqpSolver
from coldloop_optimizer_plc.solvers.outside import OutsideMethod, OutsideSolver
from coldloop_rig.settings import Settings
from coldloop_rig.testing.estimator_conformance import estimator_requirements
from coldloop_rig.testing.requirement import Requirement
from coldloop_rig.testing.rule_conformance import rule_requirements
from coldloop_rig.text_tables import aligned

PROBLEMS: Final = 20
COUNTS: Final = (0, 1, 2, 5, 20, 100)
LONGEST: Final = COUNTS[-1]
NOISE: Final = 1e-9
"""Rise of a cost, relative, that is rounding."""


def requirements(method: OutsideMethod, problems: list[QuadraticProblem]) -> list[Requirement]:
    """Return what a method keeps of what the rig relies on."""
    failed = dict.fromkeys(
        ("returns a finite point of n numbers and a count", "with 0 iterations returns the guess",
         "gives the same bits for the same problem", "leaves the problem and the guess as they were",
         "does no more iterations than asked for"), 0,
    )  # fmt: skip
    shape, zero, same, left, count = failed
    for problem in problems:
        guess, before = np.clip(0.0, problem.low, problem.high), [np.array(part) for part in problem]
        kept = guess.copy()
        first, done = method.solve(problem, guess, LONGEST)
        again, _ = method.solve(problem, kept.copy(), LONGEST)
        failed[shape] += not (np.shape(first) == kept.shape and np.isfinite(first).all())
        failed[zero] += not np.array_equal(method.solve(problem, kept.copy(), 0)[0], kept)
        failed[same] += not np.array_equal(first, again)
        intact = all(np.array_equal(np.asarray(now), old) for now, old in zip(problem, before, strict=True))
        failed[left] += not (intact and np.array_equal(guess, kept))
        failed[count] += not 0 <= done <= LONGEST
    return [Requirement(text, failures, len(problems)) for text, failures in failed.items()]


def quality(solver: OutsideSolver, problems: list[QuadraticProblem]) -> tuple[list[float], float]:
    """Return how far costs are above the optimum after each count, and in which share of steps they rise.

    The first are medians over the problems, over what the guess is above the optimum.
    """
    oracle, gaps, rises = DaqpSolver(DaqpSettings()), [], []
    for problem in problems:
        guess = np.clip(0.0, problem.low, problem.high)
        costs = np.append(solver.solve(problem, guess, COUNTS[1:]).costs, 0.0)[:-1]
        costs = np.insert(costs, 0, augmented_cost(problem, guess, solver.alpha))
        optimum = augmented_cost(problem, oracle.solve(problem, guess, (1,)).z, solver.alpha)
        best = min(float(optimum), float(costs.min()))
        gaps.append((costs - best) / max(costs[0] - best, 1e-12))
        rises.append(np.mean(np.diff(costs) > NOISE * np.abs(costs[:-1])))
    return np.median(gaps, axis=0).tolist(), float(np.mean(rises))


def problems_of(settings: Settings, count: int = PROBLEMS) -> Iterator[QuadraticProblem]:
    """Yield problems of the process: states that a tenth of the inputs' ranges makes, loads, inputs."""
    program, random = settings.optimizer_plc.program, np.random.default_rng(1)
    prediction = PredictionModel(load(settings.model.file))
    problem = PredictiveProblem(prediction, program.design, settings.limits)
    spread = 0.1 * (np.array(settings.limits.high) - np.array(settings.limits.low))
    moves = np.abs(prediction.sample.B) @ spread
    for _ in range(count):
        u = np.clip(random.normal(size=len(spread)) * spread, settings.limits.low - prediction.u0,
                    settings.limits.high - prediction.u0)  # fmt: skip
        yield problem.at(QpParameters(random.normal(size=len(moves)) * moves, float(random.normal()), u))


class Report(NamedTuple):
    """What there is to say of a part."""

    kept: list[Requirement]
    more: str = ""

    @property
    def passes(self) -> bool:
        """Whether it keeps what it has to."""
        return not any(one.failures for one in self.kept)

    @property
    def text(self) -> str:
        """All of it, in lines."""
        return f"{aligned([(one.text, one.outcome) for one in self.kept])}\n{self.more}"


def of_solver(name: str) -> Report:
    """Return what there is to say of a solver."""
    problems = list(problems_of(Settings()))
    gaps, rises = quality(OutsideSolver(OutsideSettings(solver=name)), problems)
    table = aligned([
        ("iterations", *map(str, COUNTS)), ("above the optimum, of what the guess is", *(f"{gap:.3g}" for gap in gaps)),
    ])  # fmt: skip
    monotone = "never" if not rises else f"in {100 * rises:.0f} % of the steps"
    more = f"{table}\nthe cost rises {monotone} between these counts\n"
    return Report(requirements(made(Part.SOLVER, name), problems), more)


def of_rule(name: str) -> Report:
    """Return what there is to say of a rule of the updating period."""
    return Report(rule_requirements(lambda periods: made(Part.RULE, name, periods)))


def of_estimator(name: str) -> Report:
    """Return what there is to say of a state estimator."""
    return Report(estimator_requirements(lambda model: made(Part.ESTIMATOR, name, model), Settings()))


REPORTS: Final[Mapping[Part, Callable[[str], Report]]] = {
    Part.SOLVER: of_solver, Part.RULE: of_rule, Part.ESTIMATOR: of_estimator,
}  # fmt: skip


def main() -> int:
    """Print the report of the part that is named; return 0 if it keeps everything."""
    name, part = [*sys.argv[1:], Part.SOLVER][:2] if len(sys.argv) > 1 else ("", "")
    if len(sys.argv) not in (2, 3) or part not in list(Part):
        sys.stderr.write(f"usage: python -m coldloop_rig.testing.conformance NAME [{'|'.join(Part)}]\n")
        return 2
    try:
        report = REPORTS[Part(part)](name)
    except ColdloopError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(report.text)
    return 0 if report.passes else 1


if __name__ == "__main__":
    sys.exit(main())
