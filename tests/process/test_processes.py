"""Other processes through the whole rig: over the link as in one process, adaptive and fixed, under faults."""

import json
import re
from pathlib import Path
from typing import Final

import pytest

from coldloop.process.model_file import read_document, write_document
from coldloop.registers.control_plc import Mode
from coldloop_rig.process_file.making import made_from
from tests.harness.process_files import COLUMN, TANK, made
from tests.harness.processes import Processes
from tests.harness.unstable_plants import pendulum
from tests.process.direct_problem import worst
from tests.process.runs import run, started

ROOT: Final = Path(__file__).parents[2]


@pytest.mark.parametrize("period", ["adaptive", pytest.param("2.5", marks=pytest.mark.night)])
def test_the_quadruple_tank_is_the_same_over_the_link_and_in_one_process(
    period: str, processes: Processes, tmp_path: Path
) -> None:
    options = ("--load", "a", "--duration", "15min", "--updating-period", period)
    here = run(processes, TANK, tmp_path / "here", "--in-process", *options)
    there = run(processes, TANK, tmp_path / "there", *options)
    assert here["trace_sha256"] == there["trace_sha256"]
    assert here["h1_outside_band_pct"] == here["h2_outside_band_pct"] == 0.0
    assert here["updates"] > 100
    assert (tmp_path / "there" / "run.png").is_file()


def test_the_column_has_other_time_and_dead_times_that_its_model_approximates(
    processes: Processes, tmp_path: Path
) -> None:
    options = ("--load", "c", "--duration", "2h")
    here = run(processes, COLUMN, tmp_path / "here", "--in-process", *options)
    there = run(processes, COLUMN, tmp_path / "there", *options)
    assert here["trace_sha256"] == there["trace_sha256"]
    assert here["ticks"] == 2 * 3600 / 3
    assert 6.0 <= here["tau_u_mean"] <= 60.0
    of_12_s = run(processes, COLUMN, tmp_path / "fixed", "--in-process", *options, "--updating-period", "12")
    assert of_12_s["tau_u_mean"] == 12.0


@pytest.mark.parametrize(
    ("inputs", "outputs", "tick_s", "load"),
    [pytest.param(1, 1, 0.01, False, id="small", marks=pytest.mark.night), pytest.param(6, 10, 60.0, True, id="large")],
)
def test_any_number_of_signals_and_any_tick(
    inputs: int, outputs: int, tick_s: float, load: bool, processes: Processes, tmp_path: Path  # noqa: FBT001
) -> None:  # fmt: skip
    file = made(tmp_path, inputs=inputs, outputs=outputs, tick_s=tick_s, load=load)
    options = ("--load", "a", "--duration", f"{1000 * tick_s:g}s")
    here = run(processes, file, tmp_path / "here", "--in-process", *options)
    there = run(processes, file, tmp_path / "there", *options)
    assert here["trace_sha256"] == there["trace_sha256"]
    assert here["ticks"] == 1000
    assert all(here[f"y{i}_outside_band_pct"] <= 5.0 for i in range(0, outputs, 2))


def test_the_condensed_problem_is_the_one_that_is_written_down(tmp_path: Path) -> None:
    """That of the cold box, whose states weigh, too: tests/optimizer_plc/test_problem.py."""
    made_from(COLUMN).model.save(tmp_path / "model.json")
    cost_error, violation = worst(tmp_path / "model.json")
    assert cost_error <= 1e-9
    assert violation <= 1e-6


def test_a_run_is_repeated_with_its_process_as_it_was_then(processes: Processes, tmp_path: Path) -> None:
    """A process file that says something else since, or none, is not taken for it; reading takes the folder's."""
    folder, mark = tmp_path / "run", tmp_path / "executed"
    changed, same, source = (tmp_path / name for name in ("tank.toml", "quadruple_tank.toml", "quadruple_tank.py"))
    for name in (same.name, source.name, "quadruple_tank.svg"):
        (tmp_path / name).write_text((TANK.parent / name).read_text(encoding="utf-8"), encoding="utf-8")
    source.write_text(f"{source.read_text(encoding='utf-8')}\nopen({str(mark)!r}, 'w').close()\n", encoding="utf-8")
    changed.write_text(same.read_text(encoding="utf-8").replace("[12.0, 12.6]", "[11.0, 12.6]"), encoding="utf-8")
    run(processes, same, folder, "--in-process", "--load", "a", "--duration", "60s")
    mark.unlink()
    for words in (("plot", folder), ("compare", folder, folder, "--out", tmp_path / "compare.png"), ("report", folder)):
        assert started(processes, *words)[0] == 0
    for words in (("rerun",), ("--process", changed, "rerun")):
        assert not mark.exists()
        code, _, complaints = started(processes, *words, folder)
        assert code != 0
        assert "a run of quadruple-tank" in complaints
        assert complaints.endswith("rerun --trust executes the plant that the folder holds\n")
    for words in (("--process", same, "rerun", folder), ("rerun", folder / "manifest.json", "--trust")):
        code, told, complaints = started(processes, *words)
        assert code == 0, complaints
        assert "the same trace" in told
    model = folder / "inputs" / "model.json"
    declared = read_document(model, "")
    declared["process"]["has_pond"] = True
    write_document(model, declared)
    for words in (("report", "--force"), ("plot",), ("compare", folder)):
        code, _, complaints = started(processes, *words, folder)
        assert code != 0
        assert complaints.count("\n") == 1
        assert "has_pond is unknown; use the version of Coldloop that made this run" in complaints


@pytest.mark.night
@pytest.mark.parametrize("plan", ["kill", "drop"])
@pytest.mark.parametrize(("file", "duration"), [(TANK, "30min"), (COLUMN, "2h")], ids=["tank", "column"])
def test_a_process_survives_chaos_as_the_cold_box_does(
    file: Path, duration: str, plan: str, processes: Processes, tmp_path: Path
) -> None:
    options = ("chaos", plan, "--duration", duration, "--out", tmp_path / "out")
    code, _, complaints = started(processes, "--process", file, *options)
    assert code == 0, complaints
    judged = json.loads((tmp_path / "out" / "chaos.json").read_text(encoding="utf-8"))
    assert judged["failure"] is None
    assert judged["ladder"]["mode"] == Mode.MPC
    assert all(step <= 1.0 for step in judged["largest_steps"].values())
    assert judged["outside_s"] == judged["undisturbed_outside_s"]
    raised = {alarm["name"] for fault in judged["faults"] for alarm in fault["alarms"]}
    assert {"OPTIMIZER_LOST", "PLANT_LOST"} & raised
    assert "SENSOR_BAD" not in raised


def test_the_list_of_plans_has_those_that_suit_the_process(processes: Processes) -> None:
    code, listed, complaints = started(processes, "--process", TANK, "chaos", "--list")
    assert code == 0, complaints
    names = {line.split()[0] for line in listed.splitlines()}
    assert {"kill", "drop", "lossy"} <= names
    assert not {"sensor", "mixed", "day", "refrigerator"} & names


def test_the_registers_that_are_listed_are_those_of_the_process(processes: Processes) -> None:
    code, listed, complaints = started(processes, "--process", TANK, "registers", "--format", "json")
    assert code == 0, complaints
    names = [f"{one['block']} {one['name']} {one['unit']}" for one in json.loads(listed)]
    assert "measurement y.h1 cm" in names
    assert not [name for name in names if re.search(r"station|surroundings|model range|CV155|NCR22|\bT5\b|\bK\b", name)]


UNITS = {
    "giganewtons": ("low = -10.0\nhigh = 10.0\nrate = 200.0", "low = -1e9\nhigh = 1e9\nrate = 1e9"),
    "nanoradians": ("band = [-0.1, 0.1]", "band = [-1e-9, 1e-9]"),
}


@pytest.mark.parametrize("units", UNITS)
def test_weights_are_as_small_or_large_as_the_units_make_them(units: str, processes: Processes, tmp_path: Path) -> None:
    file = pendulum(tmp_path)
    file.write_text(file.read_text(encoding="utf-8").replace(*UNITS[units]), encoding="utf-8")
    code, told, complaints = started(processes, "--process", file, "config")
    assert code == 0, complaints
    assert "design.violation_weight = " in told
