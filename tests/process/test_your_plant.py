"""docs/your-plant.md followed to the letter."""

import json
import subprocess
from pathlib import Path

from coldloop_rig.cli import main
from coldloop_rig.cli.commands.runs import EXAMPLES
from tests.harness.processes import PROGRAM_S, Processes

PAGE = Path(__file__).parents[2] / "docs" / "your-plant.md"


def test_a_newcomer_gets_what_the_page_shows(processes: Processes, tmp_path: Path) -> None:
    def coldloop(*arguments: object) -> str:
        started = processes.coldloop(*arguments, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        code, out, err = started.ended(PROGRAM_S)
        assert code == 0, err
        return out

    page = PAGE.read_text(encoding="utf-8")
    assert "process.toml" in coldloop("new", "heater")
    plant = (tmp_path / "heater" / "my_plant.py").read_text(encoding="utf-8")
    shown = page.split("```python\n")[1].split("```")[0].splitlines()
    assert [line for line in shown if line] == [line for line in plant.splitlines() if line in shown and line]
    found = coldloop("process", "heater/process.toml").splitlines()
    shown = page.split("```text\n")[1].split("```")[0].splitlines()
    assert shown == [line for line in found if not line.startswith(("derivatives", "model"))]
    options = ("--in-process", "--load", "a", "--duration", "10min", "--out", "run")
    assert "temperature 0.00 %" in coldloop("--process", "heater/process.toml", "run", *options)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))
    assert summary["ticks"] == 2400
    assert "budget" in page
    assert "fits" in coldloop("--process", "heater/process.toml", "budget", "--plc", "siemens-s7-1511-1-pn")


def test_each_file_of_the_examples_belongs_to_one_that_can_be_had(tmp_path: Path) -> None:
    for name in EXAMPLES:
        assert main(["new", str(tmp_path), "--example", name]) == 0
    there = {file.name for file in (PAGE.parents[1] / "examples").rglob("*.*") if file.suffix != ".pyc"}
    assert {file.name for file in tmp_path.iterdir()} == there
    assert main(["new", str(tmp_path), "--example", "wood_berry"]) == 2


def test_a_folder_that_is_in_use_is_left_alone(processes: Processes, tmp_path: Path) -> None:
    (tmp_path / "my_plant.py").write_text("mine", encoding="utf-8")
    started = processes.coldloop("new", tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    code, _, err = started.ended(PROGRAM_S)
    assert code != 0
    assert err.splitlines() == [f"coldloop: {tmp_path / 'my_plant.py'}: is there already; name another folder"]
    assert not (tmp_path / "process.toml").exists()
