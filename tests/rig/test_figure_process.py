"""The figure of a run is drawn by a process of its own: what it draws, and what becomes of what goes wrong in it."""

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop.errors import ResultsError, UsageError
from coldloop_rig.figures import worker as figure_process
from coldloop_rig.figures.worker import FigureProcess
from tests.conftest import draw_nothing

if TYPE_CHECKING:
    from tests.conftest import Coldloop


pytestmark = pytest.mark.usefixtures("processes")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two seconds without a figure."""
    from coldloop_rig import cli  # noqa: PLC0415

    folder = tmp_path_factory.mktemp("recorded") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        draw_nothing(monkeypatch)
        assert cli.main(["run", "--in-process", "--duration", "2s", "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def run(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "run"))


@pytest.mark.parametrize("early", [True, pytest.param(False, marks=pytest.mark.night)])
def test_it_draws_in_the_formats_asked_for_whether_it_was_started_early_or_not(run: Path, *, early: bool) -> None:
    with FigureProcess(["png", "pdf"]) as figure:
        if early:
            figure.start()
        figure.draw(run)
    assert (run / "run.png").read_bytes().startswith(b"\x89PNG")
    assert (run / "run.pdf").read_bytes().startswith(b"%PDF")


def test_what_goes_wrong_there_is_raised_here(run: Path) -> None:
    (run / "run.png").mkdir()
    with (
        FigureProcess(["png"]) as figure,
        pytest.raises(UsageError, match=r"run\.png: exists and is not a regular file"),
    ):
        figure.draw(run)
    with FigureProcess(["png"]) as figure, pytest.raises(UsageError, match="name the folder of a run"):
        figure.draw(run / "absent")


def test_a_process_that_fails_is_one_line_with_what_to_do(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dies = "import sys; sys.exit('MemoryError: no room for a figure')"
    monkeypatch.setattr(figure_process, "COMMAND", (sys.executable, "-c", dies))
    with FigureProcess(["png"]) as figure, pytest.raises(ResultsError) as told:
        figure.draw(run)
    assert "no room for a figure; try `coldloop plot" in str(told.value)
    assert "\n" not in str(told.value)


def test_a_command_that_is_refused_leaves_no_process_behind(
    coldloop: "Coldloop", monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[FigureProcess] = []
    start = FigureProcess.start

    def noted(process: FigureProcess) -> None:
        start(process)
        started.append(process)

    monkeypatch.setattr(FigureProcess, "start", noted)
    outcome = coldloop("run", "--in-process", "--duration", "2s", "--set", "plant.seed=none")
    assert outcome.code == 2
    (process,) = started
    assert process._process is not None  # noqa: SLF001
    assert process._process.returncode is not None, "it has ended"  # noqa: SLF001
