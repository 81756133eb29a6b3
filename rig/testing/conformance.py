"""What a solver that is installed beside this package keeps, and how good it is.

`python -m rig.testing.conformance NAME` prints it.
"""

import sys
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from coldloop.errors import ColdloopError
from coldloop.process.lti_model import load
from optimizer_plc.computing_settings import DaqpSettings, OutsideSettings
from optimizer_plc.qp.costs import augmented_cost
from optimizer_plc.qp.prediction import PredictionModel
from optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem
from optimizer_plc.solvers.daqp import DaqpSolver
from optimizer_plc.solvers.outside import OutsideMethod, OutsideSolver, find_method
from rig.settings import Settings
from rig.text_tables import aligned

PROBLEMS: Final = 20
COUNTS: Final = (0, 1, 2, 5, 20, 100)
LONGEST: Final = COUNTS[-1]
NOISE: Final = 1e-9
"""Rise of a cost, relative, that is rounding."""


class Requirement(NamedTuple):
    """Something that a solver has to keep, and in how many problems it did not."""

    text: str
    failures: int


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
    return [Requirement(text, failures) for text, failures in failed.items()]


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
    """Yield problems of the loaded process: states that a tenth of the inputs' ranges makes, loads, inputs."""
    program, random = settings.optimizer_plc.program, np.random.default_rng(1)
    prediction = PredictionModel(load(settings.model.file))
    problem = PredictiveProblem(prediction, program.design, settings.limits)
    spread = 0.1 * (np.array(settings.limits.high) - np.array(settings.limits.low))
    moves = np.abs(prediction.sample.B) @ spread
    for _ in range(count):
        u = np.clip(random.normal(size=len(spread)) * spread, settings.limits.low - prediction.u0,
                    settings.limits.high - prediction.u0)  # fmt: skip
        yield problem.at(QpParameters(random.normal(size=len(moves)) * moves, float(random.normal()), u))


def report(name: str) -> tuple[str, bool]:
    """Return what there is to say of a solver, as text, and whether it keeps what it has to.

    Raises:
        ConfigurationError: There is none of this name, or it raises.
    """
    problems = list(problems_of(Settings()))
    kept = requirements(find_method(name), problems)
    gaps, rises = quality(OutsideSolver(OutsideSettings(solver=name)), problems)
    rows = [(one.text, "yes" if not one.failures else f"NO, in {one.failures} of {len(problems)}") for one in kept]
    text = aligned(rows) + "\n" + aligned([
        ("iterations", *map(str, COUNTS)), ("above the optimum, of what the guess is", *(f"{gap:.3g}" for gap in gaps)),
    ])  # fmt: skip
    monotone = "never" if not rises else f"in {100 * rises:.0f} % of the steps"
    return f"{text}\nthe cost rises {monotone} between these counts\n", not any(one.failures for one in kept)


def main() -> int:
    """Print the report of the solver that is named; return 0 if it keeps everything."""
    if len(sys.argv) != 2:
        sys.stderr.write("usage: python -m rig.testing.conformance NAME\n")
        return 2
    try:
        text, passes = report(sys.argv[1])
    except ColdloopError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(text)
    return 0 if passes else 1


if __name__ == "__main__":
    sys.exit(main())
