"""Somebody else's solver: a package with an entry point, installed and run as its author would."""

import json
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.errors import ConfigurationError
from optimizer_plc.computing_settings import OutsideSettings
from optimizer_plc.qp.problem import QuadraticProblem
from optimizer_plc.solvers import outside
from optimizer_plc.solvers.outside import OutsideSolver
from rig.settings import Settings
from rig.testing.conformance import problems_of, requirements
from tests.harness.processes import PROGRAM_S, Processes

EXAMPLE = Path(__file__).parents[2] / "examples" / "outside_solver"
Array = NDArray[np.float64]


class Halving:
    """Halves the guess at each iteration."""

    def solve(self, problem: QuadraticProblem, guess: Array, iterations: int) -> tuple[Array, int]:  # noqa: ARG002
        return guess / 2.0**iterations, iterations


class Broken(Halving):
    """Changes what it is given, forgets a number, does too much, and draws lots."""

    def solve(self, problem: QuadraticProblem, guess: Array, iterations: int) -> tuple[Array, int]:  # noqa: ARG002
        guess += np.random.default_rng().normal(size=guess.size)
        return guess[:-1], iterations + 1


class Raising(Halving):
    def solve(self, problem: QuadraticProblem, guess: Array, iterations: int) -> tuple[Array, int]:  # noqa: ARG002
        raise ZeroDivisionError("no pivot")


@pytest.fixture
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The three classes as entry points of an installed package."""
    points = EntryPoints(
        EntryPoint(name, f"{__name__}:{name}", outside.GROUP) for name in ("Halving", "Broken", "Raising", "Missing")
    )
    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])
    monkeypatch.setattr(outside, "entry_points", lambda **_: points)


def problem() -> QuadraticProblem:
    return next(problems_of(Settings()))


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
    with pytest.raises(ConfigurationError, match="solver Raising: ZeroDivisionError: no pivot"):
        OutsideSolver(OutsideSettings(solver="Raising")).solve(qp, guess, (3,))
    with pytest.raises(ConfigurationError, match="solver Missing: cannot be made"):
        OutsideSolver(OutsideSettings(solver="Missing"))
    with pytest.raises(ConfigurationError, match="no solver 'Quick' among the entry points"):
        OutsideSolver(OutsideSettings(solver="Quick"))


def test_the_conformance_suite_finds_what_a_solver_does_not_keep() -> None:
    problems = list(problems_of(Settings(), 3))
    assert not any(one.failures for one in requirements(Halving(), problems))
    assert all(one.failures == 3 for one in requirements(Broken(), problems))


def test_the_example_is_installed_and_runs_with_no_edit_here(processes: Processes, tmp_path: Path) -> None:
    site = tmp_path / "site"
    install = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--target", site, EXAMPLE)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    installed = processes.python(*map(str, install), **pipes).ended(PROGRAM_S)
    assert installed.code == 0, installed.err
    beside = {"PYTHONPATH": str(site)}
    traces = []
    for way in (("--in-process",), ()):
        out = tmp_path / f"run{len(traces)}"
        run = ("run", *way, "--load", "a", "--duration", "3min", "--outside-solver", "scaled-gradient", "--out", out)
        ended = processes.coldloop(*run, more=beside, **pipes).ended(PROGRAM_S)
        assert ended.code == 0, ended.err
        traces.append(json.loads((out / "summary.json").read_text(encoding="utf-8"))["trace_sha256"])
    assert traces[0] == traces[1]
    report = processes.python("-m", "rig.testing.conformance", "scaled-gradient", more=beside, **pipes).ended(PROGRAM_S)
    assert report.code == 0, report.out + report.err
