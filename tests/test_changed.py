"""Which tests a change can reach, on a small tree."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.harness.changed import can_reach, changed_files

FILES = {
    "shared/coldloop/units.py": "BAR = 1e5\n",
    "shared/coldloop/__init__.py": "",
    "rig/coldloop_rig/runs.py": "def run():\n    from coldloop import units\n",
    "rig/coldloop_rig/table.csv": "",
    "rig/coldloop_rig/figures.py": "import matplotlib\n",
    "tests/rig/test_runs.py": "from coldloop_rig.runs import run\n",
    "tests/rig/test_figures.py": "import coldloop_rig.figures\n",
    "tests/docs/test_docs.py": "",
}


@pytest.fixture
def reaches(tmp_path: Path) -> Callable[..., bool]:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    return lambda test, *changed, fixtures=(): can_reach(tmp_path / "tests" / test, fixtures, changed, tmp_path)


@pytest.mark.parametrize(
    ("test", "changed", "expected"),
    [
        ("rig/test_runs.py", "rig/coldloop_rig/runs.py", True),
        ("rig/test_runs.py", "shared/coldloop/units.py", True),
        ("rig/test_runs.py", "tests/rig/test_runs.py", True),
        ("rig/test_runs.py", "rig/coldloop_rig/figures.py", False),
        ("rig/test_figures.py", "shared/coldloop/units.py", False),
        ("rig/test_figures.py", "rig/coldloop_rig/table.csv", True),
        ("rig/test_figures.py", "pyproject.toml", True),
        ("rig/test_figures.py", "docs/figures.md", False),
        ("docs/test_docs.py", "docs/figures.md", True),
    ],
)
def test_a_change_reaches_tests_by_imports(
    reaches: Callable[..., bool], test: str, changed: str, *, expected: bool
) -> None:
    assert reaches(test, changed) is expected


def test_the_command_line_and_programs_reach_everything(reaches: Callable[..., bool]) -> None:
    assert reaches("rig/test_figures.py", "shared/coldloop/units.py", fixtures=["coldloop"])
    assert not reaches("rig/test_figures.py", fixtures=["coldloop"])


@pytest.mark.usefixtures("programs")
def test_a_commit_that_there_is_not_is_refused() -> None:
    with pytest.raises(pytest.UsageError, match=r"--changed no-such-commit: .*; name a commit or a branch"):
        changed_files("no-such-commit")
