"""The budget of the tests: processor time by folder and lane, in multiples of a calibration loop timed in the same run.

The loop takes 13 ms of the machine that the budget was written on: 75 multiples are a second there. A slow or busy
machine slows the loop and the tests alike. What a test's own process, and the programs that it has waited for, have
used counts for its folder.
"""

import resource
import statistics
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest

from tests.harness.lanes import Lane

FILE: Final = Path(__file__).parents[1] / "budget.toml"
PROPERTY: Final = "processor time"
TOLERANCE: Final = 1.5
"""A folder is over its budget when it uses more than this times what it is allowed."""
SMALL: Final = 150.0
"""Multiples that a folder may use whatever the file says: a short test's time is mostly chance."""
DEAREST: Final = 10
EVERY: Final = 40
"""Tests after which a worker times the loop again."""

Budget = Mapping[str, Mapping[str, float]]
"""Multiples by lane and folder."""


def calibration_s() -> float:
    """Return the processor seconds of the calibration loop at present."""
    began = time.process_time()
    total, numbers = 0.0, [float(each) for each in range(1000)]
    table: dict[int, float] = {}
    for turn in range(600):
        for each in numbers:
            total += each * 0.5
        table[turn] = total
    return time.process_time() - began


def processor_s() -> float:
    """Return what this process and the programs that it has waited for have used so far."""
    uses = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(use.ru_utime + use.ru_stime for use in uses)


def read_budget(file: Path = FILE) -> Budget:
    """Return the budget by lane and folder."""
    budget: dict[str, dict[str, float]] = tomllib.loads(file.read_text(encoding="utf-8"))
    return budget


def folder_of(nodeid: str) -> str:
    """Return the folder of a test, below `tests`."""
    parts = nodeid.partition("::")[0].split("/")
    return parts[1] if len(parts) > 2 else "."


class Use(NamedTuple):
    """Resources that one test has used."""

    test: str
    lane: str
    multiples: float


class Account:
    """Adds up what tests use."""

    def __init__(self) -> None:
        self.uses: list[Use] = []

    def of_folders(self) -> dict[tuple[str, str], float]:
        """Return multiples by lane and folder."""
        found: dict[tuple[str, str], float] = defaultdict(float)
        for use in self.uses:
            found[use.lane, folder_of(use.test)] += use.multiples
        return dict(found)

    def over(self, budget: Budget) -> list[str]:
        """Return the folders, as `lane folder`, that have used more than `TOLERANCE` times their budget."""
        return sorted(
            f"{lane} {folder}"
            for (lane, folder), used in self.of_folders().items()
            if lane != Lane.NIGHT and used > max(SMALL, TOLERANCE * budget.get(lane, {}).get(folder, 0.0))
        )

    def lines(self, budget: Budget) -> list[str]:
        """Return the summary: used and allowed by folder, and the dearest tests."""
        head = f"{'lane':7}{'folder':16}{'used':>8}{'allowed':>9}"
        found = sorted(self.of_folders().items(), key=lambda one: (one[0][0], -one[1]))
        rows = [
            f"{lane:7}{folder:16}{used:8.0f}{budget.get(lane, {}).get(folder, 0.0):9.0f}"
            for (lane, folder), used in found
            if lane != Lane.NIGHT
        ]
        dearest = sorted(self.uses, key=lambda use: -use.multiples)[:DEAREST]
        return [head, *rows, "dearest tests:", *(f"{use.multiples:8.1f}  {use.test}" for use in dearest)]


class BudgetPlugin:
    """Measures each test where it runs, and adds up and judges where the summary is printed.

    Args:
        lane_of: Returns the lane of a test.
    """

    def __init__(self, lane_of: Callable[[pytest.Item], Lane]) -> None:
        self._lane_of = lane_of
        self._account = Account()
        self._loops: list[float] = []
        self._tests = 0
        self._began = 0.0

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self) -> Generator[None, Any, Any]:
        """Begin to measure a test."""
        if self._tests % EVERY == 0:
            self._loops.append(calibration_s())
        self._tests += 1
        self._began = processor_s()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Have the report of a test's end say what it has used, which workers send to where it is added up."""
        report = yield
        if call.when == "teardown":
            multiples = (processor_s() - self._began) / statistics.median(self._loops)
            report.user_properties.append((PROPERTY, (self._lane_of(item).value, multiples)))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add up what a test has used."""
        for name, value in report.user_properties:
            if name == PROPERTY and report.when == "teardown":
                lane, multiples = value
                self._account.uses.append(Use(report.nodeid, lane, multiples))

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
        """Print it; write the folders that are over their budget to the file that `--over-budget` names."""
        if not self._account.uses:
            return
        budget = read_budget()
        terminalreporter.section("processor time in multiples of the calibration loop (tests/budget.toml)")
        for line in self._account.lines(budget):
            terminalreporter.write_line(line)
        over = self._account.over(budget)
        for each in over:
            terminalreporter.write_line(f"over its budget by more than half: {each}", yellow=True)
        file = config.getoption("--over-budget")
        if file:
            Path(file).write_text("".join(f"{each}\n" for each in over), encoding="utf-8")
