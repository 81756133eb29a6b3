"""Compiled loops of other processes leave what the programs leave; kernels that processes share suit all of them."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pytest

from tests.harness.processes import Processes
from tests.process.runs import started
from tests.process.test_processes import COLUMN, ROOT, TANK, made

NOISE: Final = "plant.sensors.declared=1"
PROGRAM: Final = "optimizer_plc.program."
OUTSIDE: Final = """
[load]
name = "feed"
at = 0.5
span = [-1.0, 2.0]
[[disturbances]]
name = "rain"
at = 0.0
span = [-1.0, 1.0]
noise = 0.01
course = "course.csv"
[[disturbances]]
name = "draw"
at = 0.2
span = [-1.0, 1.0]
[[disturbances]]
name = "wind"
at = 0.0
span = [-1.0, 1.0]
noise = 0.01
course = "course.csv"
"""
SIGNALS: Final = """
[[inputs]]
name = "u0"
at = 1.0
low = 0.0
high = 2.0
rate = 0.1
[[inputs]]
name = "u1"
at = 1.0
low = 0.0
high = 2.0
rate = 0.1
[[outputs]]
name = "y0"
at = 5.0
range = [-50.0, 50.0]
noise = 0.01
setpoint = 5.1
tolerance = 0.05
[[outputs]]
name = "y1"
at = 3.0
range = [-50.0, 50.0]
noise = 0.01
"""


def small(folder: Path) -> Path:
    return made(folder, inputs=1, outputs=1, tick_s=0.01, load=False)


def large(folder: Path) -> Path:
    """Return one with bands that several outputs leave at times."""
    file = made(folder, inputs=6, outputs=10, tick_s=60.0, load=True)
    text = file.read_text(encoding="utf-8").replace("[4.5, 5.5]", "[4.98, 5.02]")
    file.write_text(text, encoding="utf-8")
    return file


def short_samples(folder: Path) -> Path:
    file = made(folder, inputs=3, outputs=5, tick_s=1.0, load=True)
    file.write_text("ticks_per_sample = 7\n" + file.read_text(encoding="utf-8"), encoding="utf-8")
    return file


def disturbed(folder: Path, plant: str) -> Path:
    """Return one of two inputs and outputs, a load, three disturbances of which two are measured, and a setpoint."""
    lines = ["time_s,rain,wind", "0,0,0", "60,0.5,0", "75.5,0.4,-0.5", "200,0,-0.5"]
    (folder / "course.csv").write_text("\n".join(lines), encoding="utf-8")
    file = folder / "process.toml"
    file.write_text(f'name = "disturbed"\n{plant}{SIGNALS}{OUTSIDE}', encoding="utf-8")
    return file


def matrices(folder: Path) -> Path:
    np.savez(
        folder / "matrices.npz", A=[[-0.05, 0.01], [0.0, -0.02]], B=[[0.05, 0.01], [0.0, 0.03]],
        C=[[1.0, 0.2], [0.0, 1.0]], F=[[0.02, 0.01, 0.01, 0.0], [0.0, 0.01, 0.0, 0.02]],
    )  # fmt: skip
    return disturbed(folder, '[plant]\nmatrices = "matrices.npz"\n')


def foreseen(folder: Path) -> Path:
    file = matrices(folder)
    (folder / "forecast.csv").write_text("time_s,feed\n0,0.5\n120,1.4\n", encoding="utf-8")
    text = file.read_text(encoding="utf-8").replace("[load]", '[load]\nforecast = "forecast.csv"')
    file.write_text(text, encoding="utf-8")
    return file


def lags(folder: Path) -> Path:
    delays = {"y0 u0": 3, "y0 feed": 0, "y1 u1": 0, "y1 rain": 7.5, "y0 draw": 1, "y0 wind": 2}
    lag = "[[plant.transfer_functions]]\noutput = {!r}\nsource = {!r}\ngain = 0.7\ntime_constant_s = 15\ndelay_s = {}\n"
    return disturbed(folder, "".join(lag.format(*pair.split(), delay) for pair, delay in delays.items()))


PROCESSES: Final = {
    "tank": lambda _: TANK, "column": lambda _: COLUMN, "small": small, "large": large, "matrices": matrices,
    "foreseen": foreseen, "lags": lags, "short samples": short_samples,
}  # fmt: skip


class Case(NamedTuple):
    """A run."""

    process: str
    assignments: tuple[str, ...] = ()
    load: str = "0:0.1,400:0.8,900:-0.9"
    events: frozenset[str] = frozenset()
    """That happen in it."""
    ticks: int = 1200
    """Of 1500 that are compiled at least."""
    updates: float = 0.8
    """Share of those that are compiled at least."""


ALARMS: Final = frozenset({"ALARM_RAISED", "ALARM_RETURNED"})
STEPS: Final = f"{PROGRAM}interrupting_load_step_w=0.01"
LONG: Final = f"{PROGRAM}updating_period_s=60"
CASES: Final = {
    "column": Case("column"),
    "column, noise, alarms": Case("column", (NOISE, "control_plc.alarms.level_band=[96.24,96.26]"), events=ALARMS),
    "column, load steps that interrupt": Case("column", (STEPS, LONG)),
    "column, single precision": Case("column", (f'{PROGRAM}arithmetic="float32"',)),
    "column, a borrowed solver": Case("column", (f'{PROGRAM}solver="osqp"', LONG), updates=0),
    "column, frozen sensors": Case("column", ("control_plc.sensors.frozen_s=24",), events=ALARMS | {"SENSOR"}),
    "small, noise": Case("small", (NOISE,), "0:0"),
    "small, at rest": Case("small", (), "0:0"),
    "large, alarms of several outputs": Case("large", events=ALARMS),
    "matrices": Case("matrices"),
    "matrices, noise, load steps that interrupt": Case("matrices", (NOISE, STEPS)),
    "matrices, state feedback": Case("matrices", (f'{PROGRAM}estimator.kind="state-feedback"',)),
    "foreseen": Case("foreseen", (f"{PROGRAM}updating_period_s=5",), updates=0),
    "lags": Case("lags"),
    "lags, noise": Case("lags", (NOISE,)),
    "short samples": Case("short samples", ticks=1000),
    "a class": Case("tank", ticks=0, updates=0),
}
USUALLY: Final = {"column, noise, alarms", "small, noise", "matrices", "foreseen"}


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
