"""Compiled loops of other processes leave what the programs leave; kernels that processes share suit all of them."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import pytest

from tests.harness.process_configurations import CASES
from tests.harness.process_files import PROCESSES
from tests.harness.processes import Processes
from tests.process.runs import started

ROOT: Final = Path(__file__).parents[2]
USUALLY: Final = {"matrices", "foreseen"}


def model_of(process: str, folder: Path, processes: Processes) -> Path:
    """Make the model file of a process."""
    model = folder / "model.json"
    code, _, complaints = started(processes, "process", PROCESSES[process](folder), "--out", model)
    assert code == 0, complaints
    return model


def printed(module: str, model: Path | None, *words: str) -> Any:  # noqa: ANN401 of JSON
    """Return what a module of these tests prints, loaded with a process, or with the cold box."""
    environment = {**os.environ, **({"COLDLOOP_PROCESS": str(model)} if model else {})}
    command = [sys.executable, "-m", f"tests.process.{module}", *words]
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in USUALLY else pytest.mark.night) for name in CASES]
)
def test_compiled_loops_leave_what_the_programs_leave(name: str, processes: Processes, tmp_path: Path) -> None:
    case = CASES[name]
    left = printed("both_ways", model_of(case.process, tmp_path, processes), "1500", case.load, *case.assignments)
    assert left["same"] == [True] * 4, "trace, updates, events, sensors"
    assert left["late"] == 0, "kernels that were compiled in the session of the programs"
    assert left["ticks"] >= case.ticks
    assert left["updates"] >= case.updates * left["all_updates"]
    assert case.events <= {kind for kind, *_ in left["events"]}


def test_kernels_that_processes_share_have_nothing_of_one_of_them_in_them(processes: Processes, tmp_path: Path) -> None:
    """What differs is of the cold box alone, of a bath, or of kernels whose records have the sizes of a process."""
    models = (None, model_of("short samples", tmp_path, processes))
    cold_box, other = (printed("shared_kernels", model) for model in models)
    alone = ("plant.cold_box", "plant.refrigerator", "rig.cosim.compiled.cold_box_plants")
    shared = {each for each in cold_box.keys() & other.keys() if not each.startswith(alone)}
    differing = {(each, name) for each in shared for name in other[each] if cold_box[each][name] != other[each][name]}
    assert len(shared) > 100
    assert not {each for each, _ in differing if each.startswith("optimizer_plc")}
    assert {name for each, name in differing if each.startswith("control_plc")} <= {
        "N_INPUTS", "TICKS_PER_SAMPLE", "FEW", "FIRST_OF_KIND", "P1",
    }  # fmt: skip
    assert {each.rpartition(".")[0] for each, _ in differing} == {
        "control_plc.output_limits", "control_plc.sensors",
    }  # fmt: skip
