"""Programs of the rig that are started in a folder of somebody's own, with files whose names are those of packages."""

from pathlib import Path

import pytest

from rig import cli

PACKAGES = ("plant", "control_plc", "optimizer_plc", "coldloop", "rig", "numpy")


@pytest.mark.usefixtures("realtime")
def test_what_is_in_the_users_folder_is_not_run_in_the_place_of_a_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in PACKAGES:
        (tmp_path / f"{package}.py").write_text("raise SystemExit('the file in the user folder was run')")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "--duration", "10s", "--figures", "png", "--out", "out"]) == 0
    assert (tmp_path / "out" / "run.png").exists()
