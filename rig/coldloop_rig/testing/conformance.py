"""Conformance test of a solver, a rule or an estimator that is installed beside this package, and its quality.

`python -m coldloop_rig.testing.conformance NAME` prints it of a solver, with `rule` or `estimator` behind it of such.
"""

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from coldloop.errors import ColdloopError
from coldloop.process.declaration import REFERENCE_TICK_S, Process
from coldloop.process.lti_model import load
from coldloop.process.updating_periods import SHORTEST_TICKS
from coldloop_optimizer_plc.computing_settings import DaqpSettings, OutsideSettings, Part, made
from coldloop_optimizer_plc.estimator import Measured, OutsideCorrection, PlantModel, plant_model
from coldloop_optimizer_plc.qp.costs import augmented_cost
from coldloop_optimizer_plc.qp.prediction import PredictionModel, prediction_of
from coldloop_optimizer_plc.qp.problem import PredictiveProblem, QpParameters, QuadraticProblem
from coldloop_optimizer_plc.rules import Observation, OutsideDecision, assess
from coldloop_optimizer_plc.solvers.interface import OutsideMethod, OutsideSolver
from coldloop_optimizer_plc.solvers.outside_libraries import DaqpSolver
from coldloop_rig.settings import Settings
from coldloop_rig.text_tables import aligned

DECISIONS: Final = 200
"""Decisions in each session."""
LONGEST_TICKS: Final = 20
"""Ticks of the cold box's sampling period; a ladder lists the updating periods to choose from."""
LADDERS: Final = (
    tuple(range(SHORTEST_TICKS, LONGEST_TICKS + 1)), (SHORTEST_TICKS, LONGEST_TICKS), (LONGEST_TICKS,),
)  # fmt: skip
"""Every period, two, and a single one: on a slow PLC there is no other."""
SEEDS: Final = range(5)
PERIODS: Final = 400
"""Updating periods of a session; of half a sampling period each, as far as ticks go."""
AHEAD: Final = 60
"""Periods over which outputs are predicted from an estimate."""
LEFT: Final = 0.1
"""Share of the first error of these predictions that may be left at the end."""
LOST: Final = range(20, 40)
"""Periods in which readings are lost, the first one alone at first and all of them in the middle one."""
PROBLEMS: Final = 20
COUNTS: Final = (0, 1, 2, 5, 20, 100)
LONGEST: Final = COUNTS[-1]
NOISE: Final = 1e-9
"""Rise of a cost, relative, that is rounding."""


class Requirement(NamedTuple):
    """A requirement, and in how many cases it was not kept."""

    text: str
    failures: int
    cases: int


def counted(cases: Iterable[Mapping[str, object]]) -> list[Requirement]:
    """Return the requirements of cases, which have for each whether it was kept."""
    kept = list(cases)
    return [Requirement(text, sum(not case[text] for case in kept), len(kept)) for text in kept[0]]


def rule_requirements(make: Callable[[Sequence[int]], OutsideDecision]) -> list[Requirement]:
    """Return what the rules that are made keep, in a session with each ladder."""

    def case(ladder: Sequence[int]) -> dict[str, object]:
        rule, twin = make(ladder), make(ladder)
        decided = session(rule, ladder)
        after_step = getattr(rule, "after_interruption", rule.first)
        return {
            "begins with the number of a period": is_q(decided[0], ladder),
            "decides numbers of periods, 1 to their count": all(is_q(q, ladder) for q in decided[1:]),
            "has the number of a period after a load step": is_q(after_step(), ladder),
            "decides the same from the same observations": decided == session(twin, ladder),
            "begins a session as if there had been none before": decided == session(make(ladder), ladder),
        }

    return counted(map(case, LADDERS))


def is_q(q: float, ladder: Sequence[int]) -> bool:
    """Return whether this is the number of a period, which is one of whole ticks."""
    return float(q).is_integer() and 1 <= q <= len(ladder)


def session(rule: OutsideDecision, ladder: Sequence[int]) -> list[float]:
    """Return what a rule decides in a session of random costs over twelve decades, the first q first.

    A q that it should not have decided is followed by the nearest.
    """
    random = np.random.default_rng(1)
    decided: list[float] = [rule.first()]
    for _ in range(DECISIONS):
        q = int(np.clip(np.nan_to_num(decided[-1], nan=1.0), 1, len(ladder)))
        before, hot_start, delivered, effective = (10.0 ** random.uniform(0.0, 12.0, 4)).tolist()
        last_but_one = delivered * (1.0 + abs(float(random.normal())))
        ticks = ladder[q - 1]
        o = Observation(q, 4 * ticks, ticks * REFERENCE_TICK_S, before, hot_start, last_but_one, delivered, effective)
        decided.append(rule.decide(o, assess(o)))
    return decided


Array = NDArray[np.float64]
Made = Callable[[PlantModel], OutsideCorrection]
Estimate = tuple[Array, float]


def estimator_requirements(make: Made, settings: Settings) -> list[Requirement]:
    """Return what the estimators that are made keep, in a session each of several plants."""
    program = settings.optimizer_plc.program
    prediction = prediction_of(load(settings.model.file), program.estimator.disturbed, program.design)

    model = partial(plant_model, prediction, program.estimator)

    def case(seed: int) -> dict[str, object]:
        world, lossy = (World(model(), settings.process, seed, loses=loses) for loses in (False, True))
        twin = make(model())
        first, second = world.session(make(model())), lossy.session(make(model()))
        return {
            "returns a finite state of n numbers and a mismatch": all(is_estimate(one, world.n) for one in first),
            "does so where readings are missing": all(is_estimate(one, world.n) for one in second),
            "leaves the prediction and the measurement as they were": not world.touched,
            "converges on a plant that is its model": world.left <= LEFT,
            "gives the same bits for the same measurements": equal(first, world.session(twin)),
            "begins a session as if there had been none before": equal(first, world.session(make(model()))),
        }

    return counted(map(case, SEEDS))


def is_estimate(estimate: Estimate, n: int) -> bool:
    """Return whether this is a finite state (n,) and mismatch."""
    x, mismatch = estimate
    return np.shape(x) == (n,) and bool(np.isfinite(x).all()) and math.isfinite(mismatch)


def equal(some: list[Estimate], others: list[Estimate]) -> bool:
    """Return whether estimates have the same bits."""
    return all(np.array_equal(x, y) and v == w for (x, v), (y, w) in zip(some, others, strict=True))


class World:
    """Plant that equals the model and begins away from the initial estimate, without process noise.

    Its inputs move; its sensor biases are some standard deviations of the noise; a part of its load is unmeasured.
    """

    def __init__(self, model: PlantModel, process: Process, seed: int, *, loses: bool) -> None:
        self._process, self._ticks = process, process.ticks_per_sample // 2
        self._model, self._seed, self._loses = model, seed, loses
        self.n = len(model.A)
        self.touched = False
        """Whether an estimator has changed what it was given."""
        self.left = math.inf
        """Error of the outputs predicted from the last estimate, over that from nothing."""

    def session(self, estimator: OutsideCorrection) -> list[Estimate]:
        """Return the estimates of a session; a missing one is replaced by the prediction, as in the program."""
        m, random = self._model, np.random.default_rng(self._seed)
        A, B, F = over(m, self._ticks)
        scale = math.sqrt(self._process.ticks_per_sample) * m.walks
        x = random.normal(size=self.n) * 10.0 * scale[:-1]
        unseen = float(random.normal()) * 10.0 * scale[-1] * self._process.has_load
        size = np.array([0.02 * (one.high - one.low) for one in self._process.inputs])
        predicted, mismatch, found = np.zeros(self.n), 0.0, []
        before = self._error(x, unseen, predicted, mismatch)
        u = np.zeros(len(size))
        for period in range(PERIODS):
            y = m.C @ x + m.D @ u + m.G[:, 0] * unseen
            if self._loses and period in LOST:
                y[: 1 if period != LOST[len(LOST) // 2] else None] = np.nan
            measured = Measured(self._ticks, u.copy(), 0.0, y.copy())
            given = predicted.copy()
            estimate = estimator.correct(given, mismatch, measured)
            self.touched |= not (
                np.array_equal(given, predicted) and np.array_equal(measured.y, y, equal_nan=True)
                and np.array_equal(measured.u, u)
            )  # fmt: skip
            found.append((np.array(estimate[0], np.float64), float(estimate[1])))
            if is_estimate(found[-1], self.n):
                predicted, mismatch = found[-1]
            self.left = self._error(x, unseen, predicted, mismatch) / before
            u = size * np.sin(0.1 * period + np.arange(len(size)))
            x = A @ x + B @ u + F[:, 0] * unseen
            predicted = A @ predicted + B @ u + F[:, 0] * mismatch
        return found

    def _error(self, x: Array, unseen: float, found: Array, mismatch: float) -> float:
        """Return the error of outputs predicted from an estimate, over the sensors' noise, root mean square."""
        m, (A, _, F) = self._model, over(self._model, self._ticks)
        e, w, errors = x - found, unseen - mismatch, []
        for _ in range(AHEAD):
            e = A @ e + F[:, 0] * w
            errors.append((m.C @ e + m.G[:, 0] * w) / m.noise)
        return float(np.sqrt(np.mean(np.square(errors))))


def over(model: PlantModel, ticks: int) -> tuple[Array, Array, Array]:
    """Return A, B and F over so many ticks."""
    A, B, F = np.eye(len(model.A)), np.zeros_like(model.B), np.zeros_like(model.F)
    for _ in range(ticks):
        A, B, F = model.A @ A, model.A @ B + model.B, model.A @ F + model.F
    return A, B, F


def requirements(method: OutsideMethod, problems: list[QuadraticProblem]) -> list[Requirement]:
    """Return what a method keeps of what the rig relies on."""

    def case(problem: QuadraticProblem) -> dict[str, object]:
        guess, before = np.clip(0.0, problem.low, problem.high), [np.array(part) for part in problem]
        kept = guess.copy()
        first, done = method.solve(problem, guess, LONGEST)
        is_point = np.shape(first) == kept.shape and np.isfinite(first).all()
        again, _ = method.solve(problem, kept.copy(), LONGEST)
        none = method.solve(problem, kept.copy(), 0)[0]
        intact = all(np.array_equal(np.asarray(now), old) for now, old in zip(problem, before, strict=True))
        return {
            "returns a finite point of n numbers and a count": is_point,
            "with 0 iterations returns the guess": np.array_equal(none, kept),
            "gives the same bits for the same problem": np.array_equal(first, again),
            "leaves the problem and the guess as they were": intact and np.array_equal(guess, kept),
            "does no more iterations than asked for": 0 <= done <= LONGEST,
        }

    return counted(map(case, problems))


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


Report = tuple[list[Requirement], str]
"""Result of the conformance test of a part, and further lines."""


def of_solver(name: str) -> Report:
    """Return the conformance report of a solver, with its quality."""
    problems = list(problems_of(Settings()))
    gaps, rises = quality(OutsideSolver(OutsideSettings(solver=name)), problems)
    table = aligned([
        ("iterations", *map(str, COUNTS)), ("above the optimum, of what the guess is", *(f"{gap:.3g}" for gap in gaps)),
    ])  # fmt: skip
    monotone = "never" if not rises else f"in {100 * rises:.0f} % of the steps"
    more = f"{table}\nthe cost rises {monotone} between these counts\n"
    return requirements(made(Part.SOLVER, name), problems), more


REPORTS: Final[Mapping[Part, Callable[[str], Report]]] = {
    Part.SOLVER: of_solver,
    Part.RULE: lambda name: (rule_requirements(partial(made, Part.RULE, name)), ""),
    Part.ESTIMATOR: lambda name: (estimator_requirements(partial(made, Part.ESTIMATOR, name), Settings()), ""),
}


def main() -> int:
    """Print the report of the part that is named; return 0 if it keeps everything."""
    name, part = [*sys.argv[1:], Part.SOLVER][:2] if len(sys.argv) > 1 else ("", "")
    if len(sys.argv) not in (2, 3) or part not in list(Part):
        sys.stderr.write(f"usage: python -m coldloop_rig.testing.conformance NAME [{'|'.join(Part)}]\n")
        return 2
    try:
        kept, more = REPORTS[Part(part)](name)
    except ColdloopError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    rows = [(one.text, f"NO, in {one.failures} of {one.cases}" if one.failures else "yes") for one in kept]
    sys.stdout.write(f"{aligned(rows)}\n{more}")
    return int(any(one.failures for one in kept))


if __name__ == "__main__":
    sys.exit(main())
