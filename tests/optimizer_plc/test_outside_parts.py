"""Somebody else's solver, rule and estimator: a package with entry points, installed and run as its author would."""

import json
import math
import subprocess
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from coldloop.process.lti_model import LtiModel
from coldloop.process.settings import InputLimits
from coldloop.registers.control_plc import Plan, Update
from coldloop.registers.optimizer_plc import UpdatingRuleKind
from coldloop_optimizer_plc import computing_settings
from coldloop_optimizer_plc.computing_settings import BudgetSettings, OutsideSettings, PlcBudget
from coldloop_optimizer_plc.estimator import Measured, OutsideEstimator, PlantModel, no_belief
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.prediction import PredictionModel
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.rules import Assessment, Observation, OutsideRule, assess
from coldloop_optimizer_plc.settings import ProgramSettings
from coldloop_optimizer_plc.solvers.interface import OutsideSolver
from coldloop_rig.settings import Settings
from coldloop_rig.testing.conformance import estimator_requirements, problems_of, requirements, rule_requirements
from tests.harness.processes import PROGRAM_S, Processes

if TYPE_CHECKING:
    from coldloop_optimizer_plc.estimator import Estimator

EXAMPLE = Path(__file__).parents[2] / "examples" / "outside_package"
Array = NDArray[np.float64]
BUDGET = PlcBudget(BudgetSettings(), 0.25)
SURPRISED = Observation(5, 12, 1.5, 2.0, 1.9, 1.6, 1.5, 9.0)


class Halving:
    """A solver: halves the guess at each iteration."""

    def solve(self, problem: QuadraticProblem, guess: Array, iterations: int) -> tuple[Array, int]:  # noqa: ARG002
        return guess / 2.0**iterations, iterations


class Broken(Halving):
    """Changes what it is given, forgets a number, does too much, and draws lots."""

    def solve(self, problem: QuadraticProblem, guess: Array, iterations: int) -> tuple[Array, int]:  # noqa: ARG002
        guess += np.random.default_rng().normal(size=guess.size)
        return guess[:-1], iterations + 1


class Raising(Halving):
    def solve(self, problem: QuadraticProblem, guess: Array, iterations: int) -> tuple[Array, int]:  # noqa: ARG002
        raise ZeroDivisionError("no\npivot")


class Shorter:
    """A rule: one period shorter each time."""

    def __init__(self, periods: Sequence[int]) -> None:
        self.most = len(periods)

    def first(self) -> int:
        return self.most

    def decide(self, observation: Observation, assessment: Assessment) -> int:  # noqa: ARG002
        return max(1, observation.q - 1)


class Wild(Shorter):
    """Decides what is no number of a period; has a memory that outlives its session."""

    decided = 0

    def first(self) -> float:  # type: ignore[override]
        return float("nan")

    def decide(self, observation: Observation, assessment: Assessment) -> float:  # type: ignore[override]  # noqa: ARG002
        Wild.decided += 1
        return (0, 1e300, 2.5, -1)[Wild.decided % 4] + Wild.decided

    def after_interruption(self) -> int:
        return 0


class Silent(Shorter):
    def decide(self, observation: Observation, assessment: Assessment) -> int:  # noqa: ARG002
        return None  # type: ignore[return-value]


class Believing:
    """An estimator: believes the prediction, and half of the first reading."""

    def __init__(self, model: PlantModel) -> None:
        self.model = model

    def correct(self, predicted: Array, mismatch: float, measured: Measured) -> tuple[Array, float]:  # noqa: ARG002
        return predicted + 1.0, 25.0


class Lost(Believing):
    """Changes what it is given, and returns what is no state or not finite, if a reading is missing."""

    def correct(self, predicted: Array, mismatch: float, measured: Measured) -> tuple[Array, float]:
        predicted += 1.0
        return predicted[:-1] * measured.y[0], mismatch + float(measured.y[0]) + np.random.default_rng().normal()


class Failing(Believing):
    def correct(self, predicted: Array, mismatch: float, measured: Measured) -> tuple[Array, float]:  # noqa: ARG002
        raise np.linalg.LinAlgError("Singular matrix")


@pytest.fixture
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The classes as entry points of an installed package, and one that is missing in it."""
    classes = (Halving, Broken, Raising, Shorter, Wild, Silent, Believing, Lost, Failing)
    names = [one.__name__ for one in classes] + ["Missing"]
    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])
    monkeypatch.setattr(
        computing_settings, "entry_points",
        lambda group: EntryPoints(EntryPoint(name, f"{__name__}:{name}", group) for name in names),
    )  # fmt: skip


def problem() -> QuadraticProblem:
    return next(problems_of(Settings()))


# -- a solver ----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("named")
@pytest.mark.parametrize("counts", [(0, 1), (2, 3)])
def test_points_are_judged_after_each_count(counts: Sequence[int]) -> None:
    qp = problem()
    guess = np.clip(np.ones(len(qp.phi)), qp.low, qp.high)
    answer = OutsideSolver(OutsideSettings(solver="Halving")).solve(qp, guess, counts)
    expected = [np.clip(guess / 2.0**count, qp.low, qp.high) for count in counts]
    assert np.array_equal(answer.points, expected)
    assert answer.iterations.tolist() == list(counts)


@pytest.mark.usefixtures("named")
def test_what_is_no_profile_is_as_good_as_the_guess_and_what_raises_is_said_in_one_line() -> None:
    qp = problem()
    guess = np.clip(np.ones(len(qp.phi)), qp.low, qp.high)
    assert np.array_equal(OutsideSolver(OutsideSettings(solver="Broken")).solve(qp, guess, (3,)).z, guess)
    with pytest.raises(ConfigurationError, match=r"^solver Raising: ZeroDivisionError: no pivot; the optimiser ends"):
        OutsideSolver(OutsideSettings(solver="Raising")).solve(qp, guess, (3,))
    with pytest.raises(ConfigurationError, match="solver Missing: cannot be made"):
        OutsideSolver(OutsideSettings(solver="Missing"))
    with pytest.raises(ConfigurationError, match=r"no solver 'Quick' among the entry points coldloop.solvers"):
        OutsideSolver(OutsideSettings(solver="Quick"))


@pytest.mark.usefixtures("named")
@pytest.mark.parametrize(("count", "done"), [(-5, 0), (-(10**30), 0), (10**30, 3)])
def test_a_solver_neither_writes_into_its_problem_nor_counts_outside_its_limit(
    count: int, done: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def solve(_: Halving, given: QuadraticProblem, guess: np.ndarray, __: int) -> tuple[np.ndarray, int]:
        for part in given[:-1]:
            part[...] = np.nan
        return guess, count

    monkeypatch.setattr(Halving, "solve", solve)
    qp = problem()
    answer = OutsideSolver(OutsideSettings(solver="Halving")).solve(qp, np.zeros(len(qp.phi)), (3,))
    assert np.isfinite(qp.Phi).all()
    assert answer.iterations.tolist() == [done]


def test_the_conformance_suite_finds_what_a_solver_does_not_keep() -> None:
    problems = list(problems_of(Settings(), 3))
    assert not any(one.failures for one in requirements(Halving(), problems))
    assert all(one.failures == 3 for one in requirements(Broken(), problems))


# -- a rule ------------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("named")
def test_a_rule_that_is_not_ours_decides_q() -> None:
    rule = OutsideRule("Shorter", BUDGET)
    most = len(BUDGET.ladder)
    assert (rule.first, rule.decide(SURPRISED, assess(SURPRISED)), rule.after_interruption()) == (most, 4, most)
    assert rule.status[:4] == (UpdatingRuleKind.OUTSIDE, most, 1, most)


@pytest.mark.usefixtures("named")
def test_what_is_no_number_of_a_period_leaves_q_as_it_is_and_is_the_longest_at_a_beginning() -> None:
    rule, most = OutsideRule("Wild", BUDGET), len(BUDGET.ladder)
    assert (rule.first, rule.after_interruption()) == (most, most)
    decided = {rule.decide(SURPRISED, assess(SURPRISED)) for _ in range(100)}
    assert decided <= {SURPRISED.q, *range(1, most + 1)}
    with pytest.raises(ConfigurationError, match=r"^rule Silent: TypeError: "):
        OutsideRule("Silent", BUDGET).decide(SURPRISED, assess(SURPRISED))
    with pytest.raises(ConfigurationError, match=r"outside.rule: no rule .Quick. among the entry points coldloop"):
        OutsideRule("Quick", BUDGET)


NUMBERS: Final = {
    "nan": math.nan, "infinite": math.inf, "none": 0, "negative": -(10**30), "large": 10**30, "part": 2.5,
    "beyond a float": 10**400, "text": "five", "several": [3, 4], "complex": 3j, "nothing": None,
}  # fmt: skip
KEPT: Final = ("nan", "infinite", "none", "negative", "large", "part")


@pytest.mark.usefixtures("named")
@pytest.mark.parametrize("what", NUMBERS)
@pytest.mark.parametrize("asked", ["first", "decide", "after_interruption"])
def test_a_rule_that_answers_anything_leaves_q_or_is_refused(
    asked: str, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Shorter, asked, lambda *_: NUMBERS[what], raising=False)

    def q() -> int:
        rule = OutsideRule("Shorter", BUDGET)
        if asked == "first":
            return rule.first
        return rule.after_interruption() if asked == "after_interruption" else rule.decide(SURPRISED, assess(SURPRISED))

    if what in KEPT:
        assert q() == (SURPRISED.q if asked == "decide" else len(BUDGET.ladder))
    else:
        with pytest.raises(ConfigurationError, match=r"^rule Shorter: \w+Error: [^\n]*; the optimiser ends here"):
            q()


@pytest.mark.usefixtures("named")
@pytest.mark.parametrize(("name", "method"), [
    ("Shorter", "first"), ("Shorter", "decide"), ("Shorter", "after_interruption"),
    ("Halving", "alpha"), ("Halving", "reset"), ("Halving", "solve"),
])  # fmt: skip
def test_what_raises_where_it_is_looked_up_is_refused_too(
    name: str, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(_: object) -> None:
        raise RuntimeError("not today")

    def use() -> None:
        if name == "Shorter":
            rule = OutsideRule(name, BUDGET)
            rule.after_interruption()
            rule.decide(SURPRISED, assess(SURPRISED))
        else:
            solver, qp = OutsideSolver(OutsideSettings(solver=name)), problem()
            solver.reset()
            solver.solve(qp, qp.low, (1,))

    monkeypatch.setattr(globals()[name], method, property(missing), raising=False)
    with pytest.raises(ConfigurationError, match=rf"{name}: RuntimeError: not today; the optimiser ends here"):
        use()


def test_the_conformance_suite_finds_what_a_rule_does_not_keep() -> None:
    assert not any(one.failures for one in rule_requirements(Shorter))
    assert all(one.failures == 3 for one in rule_requirements(Wild))


# -- an estimator ------------------------------------------------------------------------------------------------------


def at_rest(model: LtiModel, tick: int = 0, update: int = 0, playing: int = 0) -> Update:
    u, y, x = (tuple(values.tolist()) for values in (model.u0, model.y0, model.x0))
    return Update(1, update, tick, playing, load=model.w0, u_before=u, u=u, y=y, x=x)


@pytest.mark.usefixtures("named")
def test_an_estimate_that_is_none_leaves_the_prediction_and_what_raises_is_said_in_one_line(model: LtiModel) -> None:
    prediction, settings = PredictionModel(model), ProgramSettings()
    constants: Estimator = OptimizerProgram(model, settings, InputLimits()).constants.estimator

    def corrected(name: str, first: float) -> tuple[Array, float, float]:
        belief = no_belief(prediction.n_states, 22)
        belief.predicted[:] = 3.0
        estimator = OutsideEstimator(name, prediction, settings.estimator)
        y = model.y0.copy()
        y[0] = first
        estimator.correct(constants, belief, model.u0, model.w0 + 4.0, y)
        return belief.x, float(belief.numbers[0]["mismatch"]), float(belief.numbers[0]["w"])

    x, mismatch, w = corrected("Believing", 60.0)
    assert (set(x), mismatch, w) == ({4.0}, 25.0, 29.0)
    for reading in (60.0, np.nan):
        x, mismatch, w = corrected("Lost", reading)
        assert (set(x), mismatch, w) == ({3.0}, 0.0, 4.0)
    with pytest.raises(ConfigurationError, match=r"^estimator Failing: LinAlgError: Singular matrix; "):
        corrected("Failing", 60.0)


ESTIMATES: Final = {
    "one number": 3.0, "nothing": None, "three": (1.0, 2.0, 3.0), "text": ("x", 0.0), "short": ([1.0], 0.0),
    "no number": ([math.nan] * 28, 0.0), "infinite": ([1.0] * 28, math.inf), "complex": ([1j] * 28, 0.0),
    "table": (np.ones((28, 28)), 0.0),
    "objects": ([object()] * 28, 0.0), "beyond a float": ([10**400] * 28, 0.0), "no mismatch": ([1.0] * 28, None),
}  # fmt: skip


@pytest.mark.usefixtures("named")
@pytest.mark.parametrize("what", ESTIMATES)
def test_an_estimator_that_answers_anything_leaves_the_prediction_or_is_refused(
    what: str, model: LtiModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    prediction, settings = PredictionModel(model), ProgramSettings()
    constants: Estimator = OptimizerProgram(model, settings, InputLimits()).constants.estimator
    inputs, outputs, belief = model.u0.copy(), model.y0.copy(), no_belief(prediction.n_states, 22)
    belief.predicted[:] = 3.0

    def correct(_: object, predicted: Array, __: float, measured: Measured) -> object:
        for given in (predicted, measured.u, measured.y):
            given[:] = math.nan
        return ESTIMATES[what]

    monkeypatch.setattr(Believing, "correct", correct)
    estimator = OutsideEstimator("Believing", prediction, settings.estimator)
    refused = what not in ("no number", "infinite", "short", "table")
    with pytest.raises(ConfigurationError, match=r"^estimator Believing: ") if refused else nullcontext():
        estimator.correct(constants, belief, inputs, model.w0, outputs)
    assert set(belief.predicted) == {3.0}
    assert float(belief.numbers[0]["mismatch"]) == 0.0
    assert np.array_equal(inputs, model.u0)
    assert np.array_equal(outputs, model.y0)


@pytest.mark.usefixtures("compiles")
@pytest.mark.usefixtures("named")
def test_a_program_with_both_restarts_as_if_it_were_new(model: LtiModel) -> None:
    settings = ProgramSettings(outside=OutsideSettings(rule="Shorter", estimator="Believing"))
    program = OptimizerProgram(model, settings, InputLimits())

    def session() -> tuple[Plan, bytes, Plan]:
        first = program.plan(at_rest(model))
        sequence = program.solve()
        tick, number = first.next_update_tick, sequence.header.number
        return first, repr(sequence).encode(), program.plan(at_rest(model, tick, 1, number))

    one = session()
    assert one[2].next_update_tick - one[0].next_update_tick < one[0].next_update_tick, "the second is shorter"
    program.restart(0.0)
    assert session() == one
    program.restart(1.0)
    assert program.plan(at_rest(model)).next_update_tick == 4, "a fixed period is fixed"


@pytest.mark.usefixtures("compiles")
def test_the_conformance_suite_finds_what_an_estimator_does_not_keep() -> None:
    failures = {one.text: one.failures for one in estimator_requirements(Believing, Settings())}
    assert [text for text, count in failures.items() if count] == ["converges on a plant that is its model"]
    assert all(one.failures == one.cases for one in estimator_requirements(Lost, Settings()))


@pytest.mark.parametrize("part", ["solver", "estimator"])
def test_what_is_not_ours_is_refused_in_single_precision(part: str) -> None:
    with pytest.raises(ValueError, match="what is not ours computes in double precision"):
        ProgramSettings(arithmetic="float32", outside=OutsideSettings(**{part: "some"}))


# -- the example -------------------------------------------------------------------------------------------------------


def test_the_example_is_installed_and_runs_with_no_edit_here(processes: Processes, tmp_path: Path) -> None:
    site = tmp_path / "site"
    install = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--target", site, EXAMPLE)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    installed = processes.python(*map(str, install), **pipes).ended(PROGRAM_S)
    assert installed.code == 0, installed.err
    beside = {"PYTHONPATH": str(site)}
    outside = "optimizer_plc.program.outside"
    solver = ("--outside-solver", "scaled-gradient")
    both = ("--set", f"{outside}.rule=trust", "--set", f"{outside}.estimator=running-covariance")
    hashes = []
    for chosen in (solver, both, (*solver, *both)):
        for way in (("--in-process",), ()):
            out = tmp_path / f"run{len(hashes)}"
            run = ("run", *way, "--load", "a", "--duration", "10min", *chosen, "--out", out)
            ended = processes.coldloop(*run, more=beside, **pipes).ended(PROGRAM_S)
            assert ended.code == 0, ended.err
            hashes.append(json.loads((out / "summary.json").read_text(encoding="utf-8"))["trace_sha256"])
    assert hashes[::2] == hashes[1::2]
    assert len(set(hashes)) == 3
    for words in (("scaled-gradient",), ("trust", "rule"), ("running-covariance", "estimator")):
        conformance = ("-m", "coldloop_rig.testing.conformance", *words)
        report = processes.python(*conformance, more=beside, **pipes).ended(PROGRAM_S)
        assert report.code == 0, report.out + report.err


RAISING = """
class Raising:
    solved = 0

    def solve(self, problem, guess, iterations):
        Raising.solved += 1
        if Raising.solved > 5:
            raise ZeroDivisionError("no\\npivot")
        return guess, iterations
"""


@pytest.fixture
def raising(tmp_path: Path) -> dict[str, str]:
    """The environment with a package installed whose solver `raising` raises at its sixth problem."""
    site = tmp_path / "site"
    metadata = site / "raising-1.dist-info"
    metadata.mkdir(parents=True)
    (site / "raising.py").write_text(RAISING, encoding="utf-8")
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: raising\nVersion: 1\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text("[coldloop.solvers]\nraising = raising:Raising\n", encoding="utf-8")
    return {"PYTHONPATH": str(site)}


REMEDY = "mend it, or choose another"


def test_a_solver_that_raises_on_the_bus_ends_the_run_with_one_line(
    raising: dict[str, str], processes: Processes, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    run = ("run", "--load", "a", "--duration", "2min", "--outside-solver", "raising", "--out", out)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    code, _, complaints = processes.coldloop(*run, more=raising, **pipes).ended(PROGRAM_S)
    words = "optimizer_plc: solver raising: ZeroDivisionError: no pivot; the optimiser ends here: " + REMEDY
    assert code != 0
    said = f"coldloop: the optimizer_plc service has ended with exit code 2: {words} (log: "
    assert complaints.splitlines()[-1].startswith(said), complaints
    assert "Traceback" not in complaints
    log = (out / "logs" / "optimizer_plc.log").read_text(encoding="utf-8")
    assert log.splitlines()[-1] == words
    assert "Traceback" not in log
