"""The digest of the programs: whatever takes part in a run counts, and nothing of this machine or process does."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any

import pytest

from coldloop.kernels.reach import is_decisive_module, reached
from coldloop_rig.cosim.compiled.plants import advance_box
from coldloop_studies.request import Procedure, RunRequest, perform, programs, programs_digest

ROOT = Path(__file__).parents[2]
DIGEST = "from coldloop_studies.request import programs_digest; print(programs_digest())"
SHORT = RunRequest("", (0, 30), (400.0, 300.0), 60, 0.5)


Place = tuple[str, str, int]
"""File, name and line: numba changes the flags, and so the hash, of the code of kernels that are profiled."""


def place(code: CodeType) -> Place:
    return code.co_filename, code.co_qualname, code.co_firstlineno


def places(code: CodeType) -> Iterator[Place]:
    yield place(code)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from places(constant)


def executed(action: Callable[[], Any]) -> set[Place]:
    """Return the code of ours that is executed, without that of modules being imported."""
    found: dict[int, tuple[CodeType, str]] = {}

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and id(frame.f_code) not in found:
            found[id(frame.f_code)] = frame.f_code, frame.f_globals.get("__name__", "")

    sys.setprofile(note)
    try:
        action()
    finally:
        sys.setprofile(None)
    ours = {
        code for code, module in found.values() if is_decisive_module(module) and module.partition(".")[0] != "tests"
    }
    return {place(code) for code in ours if code.co_name != "<module>"}


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("procedure", Procedure)
def test_all_code_of_ours_that_a_run_executes_counts(procedure: Procedure) -> None:
    request = replace(SHORT, procedure=procedure)
    counted = {
        each for holder in reached(programs()) if isinstance(holder, FunctionType) for each in places(holder.__code__)
    }
    perform(SHORT)  # it imports
    done = executed(partial(perform, request))
    assert len(done) > 50
    assert not done - counted


def test_the_compiled_step_of_a_plant_counts() -> None:
    assert advance_box.py_func in reached(programs())  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sources in another folder."""
    there = tmp_path_factory.mktemp("copy")
    for name in ("shared", "services", "rig", "beside/refrigerator"):
        shutil.copytree(ROOT / name, there / name, ignore=shutil.ignore_patterns("__pycache__"))
    return there


def digest_in(folder: Path, first: str = "", **environment: str) -> str:
    """Return what a process computes with the sources in a folder."""
    path = os.pathsep.join(
        str(folder / name)
        for name in (
            "shared",
            "services/plant",
            "services/control_plc",
            "services/optimizer_plc",
            "services/hmi",
            "rig",
            "beside/refrigerator",
            ".",
        )
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", f"{first}\n{DIGEST}"], env={**os.environ, "PYTHONPATH": path, **environment},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    return done.stdout.split()[-1]


@pytest.mark.usefixtures("compiles")
def test_the_digest_is_the_same_elsewhere_and_whatever_was_imported_or_done_before(copy: Path) -> None:
    before = (
        "import coldloop_rig.cosim.compiled.own_plants, coldloop_rig.cli.commands.runs, coldloop_rig as rig\n"
        "rig.simulate(load='a', duration_s=15)"
    )
    assert digest_in(copy, before, PYTHONHASHSEED="1") == programs_digest()


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("beside/refrigerator/coldloop_refrigerator/compiled.py", "station[SIGNALS + 1]", "station[SIGNALS + 0]"),
        ("shared/coldloop/registers/plant.py", "MAX_STATE: Final = 1e9", "MAX_STATE: Final = 1e8"),
        ("services/plant/coldloop_plant/helium/__init__.py", "COLDEST = 1.0", "COLDEST = 1.5"),
    ],
)
def test_an_edit_of_what_a_run_uses_is_another_digest(copy: Path, file: str, old: str, new: str) -> None:
    text = (copy / file).read_text()
    assert old in text
    (copy / file).write_text(text.replace(old, new))
    try:
        assert digest_in(copy) != programs_digest()
    finally:
        (copy / file).write_text(text)


@pytest.mark.usefixtures("programs")
def test_the_edit_of_a_docstring_a_comment_or_the_page_is_not(copy: Path) -> None:
    for file, old, new in (
        ("services/optimizer_plc/coldloop_optimizer_plc/settings.py", '"""Settings of', '"""The settings of'),
        ("services/plant/coldloop_plant/helium/__init__.py", "# K, below the table", "# K, somewhat below the table"),
        ("services/hmi/coldloop_hmi/process_image.py", "import math\n", "import math\n\nEXTRA = 1\n"),
    ):
        text = (copy / file).read_text()
        assert old in text
        (copy / file).write_text(text.replace(old, new, 1))
    assert digest_in(copy) == programs_digest()
