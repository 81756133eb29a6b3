"""Programs of the rig that are started in a folder of somebody's own, with files whose names are those of packages."""

import sys
from pathlib import Path

import pytest

from coldloop_rig import cli
from tests.harness.processes import Processes

PACKAGES = ("coldloop_plant", "coldloop_control_plc", "coldloop_optimizer_plc", "coldloop", "coldloop_rig", "numpy")


@pytest.mark.usefixtures("realtime")
def test_what_is_in_the_users_folder_is_not_run_in_the_place_of_a_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in PACKAGES:
        (tmp_path / f"{package}.py").write_text("raise SystemExit('the file in the user folder was run')")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "--duration", "10s", "--figures", "png", "--out", "out"]) == 0
    assert (tmp_path / "out" / "run.png").exists()


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&- <&-"])
def test_a_stream_that_the_caller_has_closed_is_not_taken_by_a_file(
    closed: str, tmp_path: Path, processes: Processes
) -> None:
    command = f"exec {sys.executable} -m coldloop_rig run --in-process --duration 10s --figures png --out run {closed}"
    shell = processes.python(
        "-c", f"import os; os.chdir({str(tmp_path)!r}); os.execv('/bin/sh', ['sh', '-c', {command!r}])"
    )
    assert shell.ended(300.0).code == 0
    assert (tmp_path / "run" / "run.png").read_bytes().startswith(b"\x89PNG")
    assert "Traceback" not in shell.said
