"""`coldloop export plc`: a folder that is whole, with a README; a refusal in one line and nothing written."""

import io
import re
import shutil
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop_export import folder as plc_folder
from coldloop_rig import cli
from tests.harness.processes import Processes
from tests.plc_export.c_programs import COMPILERS, NO_COMPILER, compiled, output
from tests.plc_export.st_interpreter import Machine
from tests.process.runs import started

if TYPE_CHECKING:
    from tests.conftest import Coldloop

TANK = Path(__file__).parents[2] / "examples" / "processes" / "quadruple_tank.toml"
SOLVER_TEXTS = ["types.st", "functions.st", "kernels.st", "golden.st", "self_test.st", "configuration.st"]
GUARD_TEXTS = ["types.st", "functions.st", "kernels.st", "output_guard.st", "self_test.st", "configuration.st"]
DESCRIBED = ["README.md", "manifest.json"]
OF_SOLVER = "kernels.h kernels.c problem.h problem.c tables.h tables.c golden.h golden.c self_test.c"
OF_OPTIMIZER = "kernels.h kernels.c constants.h constants.c golden.h golden.c optimizer.h optimizer.c self_test.c"
OF_GUARD = "kernels.h kernels.c limits.h limits.c golden.h golden.c output_guard.h output_guard.c self_test.c README.md"
FILES = {
    "c": [
        *OF_SOLVER.split(), *DESCRIBED,
        *(f"optimizer/{name}" for name in (*OF_OPTIMIZER.split(), *DESCRIBED)),
        *(f"output_guard/{name}" for name in OF_GUARD.split()),
    ],
    "st": [
        *SOLVER_TEXTS, *DESCRIBED,
        *(f"optimizer/{name}" for name in
          (*SOLVER_TEXTS[:3], "optimizer.st", *SOLVER_TEXTS[3:], "registers.md", *DESCRIBED)),
        *(f"output_guard/{name}" for name in (*GUARD_TEXTS, "README.md")),
    ],
    "plcopen": [
        "solver.xml", *DESCRIBED, "optimizer/optimizer.xml", "optimizer/registers.md",
        *(f"optimizer/{name}" for name in DESCRIBED), "output_guard/output_guard.xml", "output_guard/README.md",
    ],
}  # fmt: skip
Exported = Callable[[str], tuple[Path, str]]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """Return the folder of an export for a target, made once, and what the command has printed."""

    @cache
    def made(target: str) -> tuple[Path, str]:
        out = tmp_path_factory.mktemp("new") / target
        with redirect_stdout(io.StringIO()) as printed:
            assert cli.main(["export", "plc", "--target", target, "--out", str(out), "--ticks", "800"]) == 0
        return out, printed.getvalue()

    return made


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize("target", ["c", "st", pytest.param("plcopen", marks=pytest.mark.night)])
def test_the_sources_and_a_readme_are_written(exported: Exported, target: str) -> None:
    out, printed = exported(target)
    assert printed.splitlines() == [str(out / name) for name in FILES[target]]
    written = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    assert written == sorted(FILES[target])
    readme = (out / "README.md").read_text()
    assert "@" not in readme
    assert all(name in readme for name in FILES[target] if name not in DESCRIBED and "/" not in name)
    assert all("@" not in file.read_text() for file in out.rglob("*/*") if file.is_file())
    assert [path.name for path in out.parent.iterdir()] == [target]


@pytest.mark.usefixtures("compiles")
def test_the_written_structured_text_passes_its_self_test_and_no_call_does_more_than_the_readme_says(
    exported: Exported,
) -> None:
    out, _ = exported("st")
    machine = Machine(*((out / name).read_text() for name in SOLVER_TEXTS))
    test, most = machine.instance("cl_self_test"), 0
    test.run = True
    while not test.done:
        machine.operations[0] = 0
        test.run_()
        most = max(most, machine.operations[0])
    assert test.passed
    readme = (out / "README.md").read_text()
    found = re.search(r"in calls that do ([\d,]+) and at most (\d+) more", readme)
    assert found
    work, piece = (int(each.replace(",", "")) for each in found.groups())
    assert work < most <= work + piece


@pytest.mark.usefixtures("compiles")
@pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)
def test_the_written_c_passes_its_self_tests(exported: Exported, tmp_path: Path) -> None:
    shutil.copytree(exported("c")[0], tmp_path, dirs_exist_ok=True)
    for folder in (tmp_path, tmp_path / "optimizer", tmp_path / "output_guard"):
        code, said = output(compiled(folder, COMPILERS[0], "-O1"))
        assert (code, said[-13:]) == (0, ", 0 failures\n")


def test_it_is_the_solver_of_the_process_that_is_named(processes: Processes, tmp_path: Path) -> None:
    out = tmp_path / "tank"
    outcome = started(processes, "--process", TANK, "export", "plc", "--target", "st", "--out", out)
    assert outcome.code == 0
    assert "for 42 variables and 72 rows" in (out / "README.md").read_text()
    program = Machine(*((out / name).read_text() for name in SOLVER_TEXTS)).instance("cl_main")
    while not program.test.done:
        program.run_()
    assert program.test.passed


@pytest.mark.usefixtures("compiles")
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("plc", "--target", "st"), "name a new folder with --out"),
        (("plc", "--target", "st", "--out", "taken"), "taken: is not an empty folder"),
        (("plc", "--target", "st", "--out", "taken/file"), "taken/file: is not an empty folder"),
        (("plc", "--target", "st", "--out", "taken/file/new"), "taken/file/new: "),
        (("plc", "--target", "st", "--out", "new", "--force"), "--force does not replace one"),
        (("plc", "--target", "ladder", "--out", "new"), "invalid choice: 'ladder'"),
        (("plc", "--target", "c", "--out", "new", "--ticks", "0"), "is not a whole number of at least 1"),
        (("plc", "--target", "c", "--out", "new", "--ticks", "40"), "no input moves within 40 ticks"),
        (("runs", "--target", "c", "--out", "new"), "runs: has no target"),
        (("runs", "--csv", "--ticks", "40"), "--ticks: is for coldloop export plc"),
        (("plc", "--target", "st", "--out", "new", "--plc", "none"), "--plc none: neither a file nor one of"),
        (("runs", "--csv", "--set", "plant.seed=2"), "--config, --set, --plc and --score: are for coldloop export plc"),
        (
            ("plc", "--target", "c", "--out", "new", "--set", "optimizer_plc.program.arithmetic=float64"),
            "in single precision alone",
        ),
        *(
            (
                ("plc", "--target", target, "--out", "new", "--set", f"optimizer_plc.program.solver={solver}"),
                "with the ODE-based solver alone",
            )
            for target, solver in (("c", "interior-point"), ("c", "hybrid"), ("c", "fast-gradient"), ("st", "hybrid"))
        ),
        (("plc", "--out", "new"), "--target is required"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line_and_nothing_is_written(
    coldloop: "Coldloop",
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: tuple[str, ...],
    complaint: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").write_text("precious")
    outcome = coldloop("export", *arguments)
    assert outcome.code == 2
    assert len(outcome.complaints) == 1
    assert complaint in outcome.complaints[0]
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["taken", "taken/file"]


def test_a_folder_that_cannot_be_finished_is_not_begun(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(plc_folder.UsageError, match="No space left"):
        plc_folder.write_whole(tmp_path / "new", {"a.st": ""})
    assert list(tmp_path.iterdir()) == []


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    plc_folder.refuse_taken(tmp_path)
    plc_folder.write_whole(tmp_path, {"a.st": "one"})
    assert [path.name for path in tmp_path.iterdir()] == ["a.st"]
