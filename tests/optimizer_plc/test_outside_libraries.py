"""Clarabel, PIQP and QPALM by the entry points of this package; skipped where the library is not installed."""

import sys
import tomllib
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from coldloop.errors import ConfigurationError
from coldloop_optimizer_plc import computing_settings
from coldloop_optimizer_plc.computing_settings import DaqpSettings, OutsideSettings, Part, made
from coldloop_optimizer_plc.qp.problem import QuadraticProblem
from coldloop_optimizer_plc.solvers.interface import OutsideSolver
from coldloop_optimizer_plc.solvers.outside_libraries import DaqpSolver, softened
from coldloop_rig.settings import Settings
from coldloop_rig.testing.conformance import problems_of, requirements

PROJECT: Final = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
POINTS: Final[dict[str, str]] = PROJECT["entry-points"]["coldloop.solvers"]
TO_THE_END: Final = 1000
SAME_COST: Final = 1e-6

pytestmark = pytest.mark.parametrize("name", POINTS)


@pytest.fixture(autouse=True)
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The entry points of this tree, whatever is installed."""
    monkeypatch.setattr(
        computing_settings, "entry_points",
        lambda group: EntryPoints(EntryPoint(name, value, group) for name, value in POINTS.items()),
    )  # fmt: skip


def test_a_missing_library_is_one_line_with_its_extra(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    remedy = rf"^optimizer_plc\.program\.outside\.solver: [^\n]*pip install 'coldloop\[{name}\]'[^\n]*$"
    with pytest.raises(ConfigurationError, match=remedy):
        OutsideSolver(OutsideSettings(solver=name))
    assert PROJECT["optional-dependencies"][name][0].startswith(f"{name}>=")


def test_a_library_keeps_what_the_rig_relies_on(name: str) -> None:
    pytest.importorskip(name)
    kept = requirements(made(Part.SOLVER, name), list(problems_of(Settings(), 5)))
    assert not [one.text for one in kept if one.failures]


def test_a_library_counts_iterations_and_ends_at_the_lowest_cost(name: str) -> None:
    pytest.importorskip(name)
    exact, solver = DaqpSolver(DaqpSettings()), OutsideSolver(OutsideSettings(solver=name, alpha=30_000.0))
    for qp in problems_of(Settings(), 5):
        guess = np.clip(0.0, qp.low, qp.high)
        answer = solver.solve(qp, guess, (0, 1, 3, TO_THE_END))
        assert answer.iterations[:3].tolist() == [0, 1, 3]
        assert answer.iterations[3] < TO_THE_END
        p = softened(qp, solver.alpha)
        soft = QuadraticProblem(p.H / 2.0, p.g, p.C, p.u, p.low, p.high, 0.0)
        assert answer.cost == pytest.approx(exact.solve(soft, p.low, (1,)).cost, rel=SAME_COST, abs=SAME_COST)
        assert answer.cost <= exact.solve(qp, guess, (1,)).cost + SAME_COST, "a softer problem"


def test_a_problem_that_is_none_leaves_the_guess(name: str) -> None:
    pytest.importorskip(name)
    solver, qp = OutsideSolver(OutsideSettings(solver=name)), next(problems_of(Settings()))
    guess = np.clip(0.0, qp.low, qp.high)
    for wrong in (qp._replace(phi=qp.phi * np.nan), qp._replace(low=qp.low + 1e6)):
        assert np.array_equal(solver.solve(wrong, guess, (20,)).points[0], np.clip(guess, wrong.low, wrong.high))
