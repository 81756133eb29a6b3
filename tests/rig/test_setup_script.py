"""Which Python scripts/setup makes its environment with."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("programs")

ROOT = Path(__file__).parents[2]
GOOD, UNUSABLE, SLOW, ABSENT = 0, 1, 3, 127
"""What the question of the script to an interpreter ends with; the last one is a shim's with nothing behind it."""
FAKE = """#!/bin/bash
case "$*" in
    *ensurepip*) exit {code} ;;
    *platform*) echo Python 3.11.99 ;;
    *"-m venv"*) exit 1 ;;
esac
"""
"""It can make no environment, with which the script ends, and names it."""


def chosen(folder: Path, **more: str) -> str:
    """Return the last line of the script where PATH has the folders `one` and `two`."""
    copy = folder / "project"
    (copy / "scripts").mkdir(parents=True)
    shutil.copy(ROOT / "scripts" / "setup", copy / "scripts")
    (copy / "pyproject.toml").touch()
    tools = folder / "tools"
    tools.mkdir()
    for name in ("bash", "dirname", "grep", "cat", "cmp", "sed"):
        (tools / name).symlink_to(str(shutil.which(name)))
    path = os.pathsep.join(map(str, (folder / "one", folder / "two", tools)))
    environment = {"PATH": path, "HOME": str(folder), **more}
    done = subprocess.run(
        [tools / "bash", copy / "scripts" / "setup", "run"],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.returncode == 1, done.stderr
    return done.stderr.splitlines()[-1].removeprefix("coldloop: ").replace(f"{folder}/", "")


def put(folder: Path, pythons: dict[str, int]) -> None:
    for name, code in pythons.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(FAKE.format(code=code))
        file.chmod(0o755)


@pytest.mark.parametrize(
    ("pythons", "taken"),
    [
        ({"one/python3.13": GOOD, "two/python3.14": GOOD}, "two/python3.14"),
        ({"one/python3.11": SLOW, "two/python3.11": GOOD}, "two/python3.11"),
        ({"one/python3.13": SLOW, "two/python3.12": GOOD}, "two/python3.12"),
        ({"one/python3.14": ABSENT, "one/python3.11": SLOW, "two/python3.11": UNUSABLE}, "one/python3.11"),
        ({"one/python3": SLOW, ".pyenv/versions/3.14.2/bin/python": GOOD}, ".pyenv/versions/3.14.2/bin/python"),
        ({"one/python3.13": SLOW, "two/python3.12": SLOW}, "one/python3.13"),
    ],
)
def test_the_newest_python_that_is_not_slow_is_taken(pythons: dict[str, int], taken: str, tmp_path: Path) -> None:
    put(tmp_path, pythons)
    assert chosen(tmp_path).startswith(f"{taken} could not make a virtual environment")


@pytest.mark.parametrize("code", [GOOD, SLOW])
def test_the_python_of_the_environment_is_taken_whatever_its_build(code: int, tmp_path: Path) -> None:
    put(tmp_path, {"one/python3.14": GOOD, "mine": code})
    said = chosen(tmp_path, PYTHON=str(tmp_path / "mine"))
    assert said.startswith("mine could not make a virtual environment")


def test_a_python_of_the_environment_that_will_not_do_is_named(tmp_path: Path) -> None:
    put(tmp_path, {"one/python3.14": GOOD, "mine": UNUSABLE})
    said = chosen(tmp_path, PYTHON=str(tmp_path / "mine"))
    assert said.startswith("PYTHON=mine is not a Python 3.11 or later")


def test_without_a_python_the_script_says_what_to_install(tmp_path: Path) -> None:
    put(tmp_path, {"one/python3": UNUSABLE, "one/python": ABSENT})
    assert "python3-venv" in chosen(tmp_path)


def test_the_question_to_an_interpreter_is_understood(tmp_path: Path) -> None:
    real = tmp_path / "one" / "python3.11"
    put(tmp_path, {"one/python3.11": GOOD})
    real.write_text(f'#!/bin/bash\n[[ "$*" != *"-m venv"* ]] && exec {sys.executable} "$@"\n')
    assert chosen(tmp_path).startswith("one/python3.11 could not make a virtual environment")
