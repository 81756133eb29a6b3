"""Somebody else's solver, rule and estimator with another process; a solver that raises while the rig is up."""

import tomllib
from pathlib import Path
from typing import Final

import pytest

from coldloop.registers.control_plc import Mode
from tests.harness.installed import installed
from tests.harness.processes import Processes
from tests.harness.waiting import eventually
from tests.process.runs import run, started
from tests.process.site import TANK, up

PACKAGE: Final = Path(__file__).parents[2] / "examples" / "outside_package"
RAISING: Final = """
class Raising:
    left = 30

    def solve(self, problem, guess, iterations):
        self.left -= 1
        if self.left < 0:
            raise ZeroDivisionError("no\\npivot")
        return guess, iterations
"""
REASON: Final = (
    "optimizer_plc: solver raising: ZeroDivisionError: no pivot; the optimiser ends here: mend it, or choose another"
)


@pytest.fixture
def raising(tmp_path: Path) -> dict[str, str]:
    """A solver that raises after some problems."""
    return installed(tmp_path / "site", {"raising.py": RAISING}, {"coldloop.solvers": {"raising": "raising:Raising"}})


def test_the_example_is_the_same_over_the_link_and_in_one_process(processes: Processes, tmp_path: Path) -> None:
    points = tomllib.loads((PACKAGE / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    sources = {file.name: file.read_text(encoding="utf-8") for file in PACKAGE.glob("*.py")}
    more = installed(tmp_path / "site", sources, points)
    outside = "optimizer_plc.program.outside"
    parts = ("--set", f"{outside}.rule=trust", "--set", f"{outside}.estimator=running-covariance")
    options = ("--load", "a", "--duration", "10min", "--outside-solver", "scaled-gradient", *parts)
    here = run(processes, TANK.file, tmp_path / "here", "--in-process", *options, more=more)
    there = run(processes, TANK.file, tmp_path / "there", *options, more=more)
    assert here["trace_sha256"] == there["trace_sha256"]
    assert here["updates"] > 100


def test_a_run_whose_solver_raises_says_so_in_one_line(
    raising: dict[str, str], processes: Processes, tmp_path: Path
) -> None:
    words = ("run", "--load", "a", "--duration", "10min", "--outside-solver", "raising", "--out", tmp_path / "run")
    code, _, complaints = started(processes, "--process", TANK.file, *words, more=raising)
    assert code != 0
    assert REASON in complaints.splitlines()[-1]
    assert "Traceback" not in complaints
    log = (tmp_path / "run" / "logs" / "optimizer_plc.log").read_text(encoding="utf-8")
    assert log.splitlines()[-1] == REASON
    assert "Traceback" not in log


@pytest.mark.usefixtures("realtime")
def test_when_a_solver_raises_the_ladder_acts_without_a_step_and_the_service_is_started_again(
    raising: dict[str, str], processes: Processes, tmp_path: Path
) -> None:
    options = ("--outside-solver", "raising", "--updating-period", "5")
    with up(TANK, processes, tmp_path, *options, more=raising) as site:
        eventually(lambda: site.looked() and REASON in site.rig.said, "the service says why it ends")
        eventually(lambda: site.looked() and site.mode() != Mode.MPC, "the ladder acts")
        site.modes_until(Mode.MPC)
        said = site.rig.said
        site.assert_no_step()
    assert f"the optimizer_plc service has ended with exit code 2: {REASON} (log: " in said
    assert said.splitlines()[-1].endswith("started again in 1 s (1 of 5)")
    assert "Traceback" not in said
