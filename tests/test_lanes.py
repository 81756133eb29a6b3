"""The lanes and the budget of the tests: what judges the others, on cases by hand."""

import asyncio
import os
import subprocess
import sys
import time
from pathlib import Path

import numba
import pytest

from tests.conftest import WATCH
from tests.harness import lanes
from tests.harness.budget import Account, Use, read_budget
from tests.harness.lanes import Lane, judge, lane_of, table


@pytest.mark.parametrize(
    ("marks", "lane"),
    [
        ((), Lane.FAST),
        (("process",), Lane.SYSTEM),
        (("realtime", "browser"), Lane.SYSTEM),
        (("process", "night"), Lane.NIGHT),
        (("container",), Lane.NIGHT),
    ],
)
def test_the_marks_of_a_test_decide_its_lane(marks: tuple[str, ...], lane: Lane) -> None:
    assert lane_of(marks) is lane


def noted() -> list[str]:
    """Return what was noted of this test, which may do it: it is then forgotten."""
    found = WATCH.notes
    WATCH.begin(WATCH.lane)
    return found


def test_programs_that_a_test_starts_are_noted() -> None:
    subprocess.run([sys.executable, "-c", ""], check=True)
    assert noted() == [f"it starts {sys.executable!r}"]


def test_a_fork_is_noted() -> None:
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    assert noted() == ["it calls os.fork"]


def test_a_kernel_that_a_test_is_to_compile_is_noted_and_not_compiled() -> None:
    def successor(x: int) -> int:
        return x + 1

    with pytest.raises(pytest.fail.Exception, match=r"it compiles .*successor"):
        numba.njit(successor)(1)
    assert len(found := noted()) == 1
    assert "it compiles" in found[0]
    WATCH.begin(Lane.SYSTEM)
    assert numba.njit(successor)(1) == 2
    WATCH.begin(Lane.FAST)


def test_waiting_for_the_clock_is_noted_when_it_is_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lanes, "WAITED_S", 0.05)
    time.sleep(0.02)
    assert noted() == []
    time.sleep(0.03)
    asyncio.run(asyncio.sleep(0.03))
    assert noted() == ["it waits 0.1 s for the clock"]


def test_a_time_limit_that_is_not_reached_is_no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lanes, "WAITED_S", 0.05)

    async def story() -> None:
        async with asyncio.timeout(60):
            await asyncio.to_thread(lambda: None)

    asyncio.run(story())
    assert noted() == []


def test_what_is_noted_fails_tests_of_the_fast_lane_alone() -> None:
    judge(Lane.SYSTEM, ["it starts 'sleep'"])
    judge(Lane.FAST, [])
    with pytest.raises(pytest.fail.Exception, match=r"it starts 'sleep'; it calls os\.fork"):
        judge(Lane.FAST, ["it starts 'sleep'", "it calls os.fork"])


def test_the_table_counts_tests_by_file_and_lane_and_says_why() -> None:
    tests = [
        ("tests/a/test_x.py::test_1", Lane.FAST, set[str]()),
        ("tests/a/test_x.py::test_2[1]", Lane.SYSTEM, {"process", "parametrize"}),
        ("tests/a/test_x.py::test_2[2]", Lane.NIGHT, {"process", "night"}),
        ("tests/test_y.py::test_3", Lane.FAST, set[str]()),
    ]
    assert table(tests)[2:] == [
        "| tests/a/test_x.py | 1 | 1 | 1 | night, process |", "| tests/test_y.py | 1 | 0 | 0 |  |",
        "| all | 2 | 1 | 1 | |",
    ]  # fmt: skip


def test_a_folder_is_over_its_budget_when_it_uses_more_than_half_as_much_again() -> None:
    account = Account()
    account.uses += [
        Use("tests/modbus/test_x.py::test_1", "fast", 900.0),
        Use("tests/modbus/test_x.py::test_2", "fast", 601.0),
        Use("tests/modbus/test_x.py::test_3", "system", 2000.0),
        Use("tests/link/test_x.py::test_1", "fast", 1500.0),
        Use("tests/test_x.py::test_1", "fast", 149.0),
        Use("tests/hmi/test_x.py::test_1", "fast", 151.0),
        Use("tests/rig/test_x.py::test_1", "night", 99999.0),
    ]
    budget = {"fast": {"modbus": 1000.0, "link": 1000.0}, "system": {"modbus": 1400.0}}
    assert account.over(budget) == ["fast hmi", "fast modbus"]
    lines = account.lines(budget)
    assert "fast   modbus              1501     1000" in lines
    assert [line.split()[-1].rpartition("::")[2] for line in lines[lines.index("dearest tests:") + 1 :]][:2] == [
        "test_1", "test_3",
    ]  # fmt: skip


def test_the_budget_names_folders_that_exist() -> None:
    folders = {path.name for path in Path(__file__).parent.iterdir() if path.is_dir()} | {"."}
    budget = read_budget()
    assert budget.keys() == {"fast", "system"}
    assert all(budget[lane].keys() <= folders for lane in budget)
