"""`coldloop chaos`."""

import json
import signal
import subprocess
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import pyarrow.parquet as pq
import pytest

from coldloop_chaos.faults import shipped_plans
from tests.harness.processes import Processes

if TYPE_CHECKING:
    from tests.conftest import Coldloop

PATIENCE_S = 300.0
"""The first run on a machine compiles the kernels."""

PLAN = """
name = "short"
description = "An optimiser that stands still is waited for, a late frame too"
load = "a"
duration_s = 90
standstill_s = 0.5

[[faults]]
kind = "pause"
process = "optimizer"
at_s = 5
duration_s = 30

[[faults]]
kind = "delay"
link = "plant"
at_s = 40
duration_s = 5
delay_ms = 1
"""


def test_list_names_the_shipped_plans(coldloop: "Coldloop") -> None:
    outcome = coldloop("chaos", "--list")
    assert outcome.code == 0
    assert [line.split()[0] for line in outcome.out.splitlines()] == [plan.name for plan in shipped_plans()]


def test_a_plan_that_cannot_be_used_is_one_line(coldloop: "Coldloop", tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text(PLAN.replace("duration_s = 30", "duration = 30"))
    for arguments in ((), ("no-such-plan",), (bad,), ("kill", "--seed", "x"), ("kill", "--load", "no-load")):
        outcome = coldloop("chaos", *arguments, *(["--out", tmp_path / "out"] if arguments else []))
        assert (outcome.code, outcome.out, len(outcome.complaints)) == (2, "", 1), arguments


@pytest.mark.usefixtures("processes", "undrawn")
def test_faults_that_only_cost_time_leave_the_trace_as_it_is(coldloop: "Coldloop", tmp_path: Path) -> None:
    plan, out = tmp_path / "short.toml", tmp_path / "out"
    plan.write_text(PLAN)
    outcome = coldloop("chaos", plan, "--out", out)
    assert outcome.code == 0
    result = json.loads((out / "chaos.json").read_text())
    assert result["trace_sha256"] == result["undisturbed_trace_sha256"]
    assert [fault["fault"] for fault in result["faults"]] == ["pause optimizer", "delay link plant"]
    assert result["missing_ticks"] == 0
    assert {"chaos.md", "chaos.png", "logs"} <= {path.name for path in out.iterdir()}
    assert_recorded_as_an_ordinary_run(coldloop, out, tmp_path / "ordinary", result["trace_sha256"])


def assert_recorded_as_an_ordinary_run(coldloop: "Coldloop", out: Path, ordinary: Path, trace: str) -> None:
    """Compare the files of a run whose trace is undisturbed with those of the same run without faults."""
    run = ("run", "--in-process", "--load", "a", "--duration", "90s", "--figures", "png", "--out", ordinary)
    assert coldloop(*run).code == 0
    summary, manifest = (json.loads((out / name).read_text()) for name in ("summary.json", "manifest.json"))
    assert (summary["trace_sha256"], manifest["hashes"]["trace_sha256"]) == (trace, trace)
    assert (summary["complete"], summary["missing_ticks"], manifest["way"]) == (True, 0, "chaos")
    assert manifest["configuration"]["plant.load"] == "a"
    columns = pq.read_schema(ordinary / "trace.parquet").names
    ours, theirs = (pd.read_parquet(folder / "trace.parquet") for folder in (out, ordinary))
    assert list(ours.columns) == columns
    pd.testing.assert_frame_equal(ours[["L1", "T5", "CV155", "x_P1"]], theirs[["L1", "T5", "CV155", "x_P1"]])
    updates = [pd.read_parquet(folder / "updates.parquet")["tick"].tolist() for folder in (out, ordinary)]
    assert updates[0] == updates[1]
    assert "mode" in set(pd.read_parquet(out / "events.parquet")["kind"])
    for command in (
        ("plot", out),
        ("report", out),
        ("export", out, "--csv"),
        ("compare", out, ordinary, "--out", out / "c.png"),
    ):
        assert coldloop(*command).code == 0, command
    again = coldloop("rerun", out / "manifest.json")
    assert (again.code, len(again.complaints)) == (2, 1)
    assert "coldloop chaos" in again.complaints[0]


SOON_ON_DISK = """
import sys, coldloop_rig.results.file_sinks
coldloop_rig.results.file_sinks.GROUP_TICKS = coldloop_rig.results.file_sinks.HELD_BACK_TICKS = 256
from coldloop_rig.__main__ import main
sys.exit(main())
"""
"""The program `coldloop`, which writes ticks in small groups: the first ones are in the file after a minute."""


@pytest.mark.night  # test_interruption.py has the same of a run
def test_ctrl_c_in_the_middle_of_a_plan_leaves_what_was_recorded(tmp_path: Path, processes: Processes) -> None:
    out = tmp_path / "out"
    words = ("chaos", "undisturbed", "--duration", "10h", "--out", str(out))
    run = processes.python("-c", SOON_ON_DISK, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + PATIENCE_S
    while not (out / "trace.parquet").exists() or (out / "trace.parquet").stat().st_size < 10_000:
        assert run.alive, run.ended()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    run.popen.send_signal(signal.SIGINT)
    ended = run.ended(PATIENCE_S)
    assert ended.code == 130
    assert "Traceback" not in ended.err
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["complete"], summary["reason"]) == (False, "interrupted by SIGINT")
    assert len(pd.read_parquet(out / "trace.parquet")) == summary["ticks"] > 0


KILLS = """
name = "kills"
description = "Each process is killed in turn"
load = "a"
duration_s = 500
faults = [
    {kind = "kill", process = "optimizer", at_s = 60, duration_s = 60},
    {kind = "kill", process = "control", at_s = 200, duration_s = 1},
    {kind = "kill", process = "plant", at_s = 300, duration_s = 1},
    {kind = "reset", link = "plant", at_s = 400, duration_s = 1},
]
"""


@pytest.mark.night  # test_rig_that_stays_up.py kills each service of a rig that is up
@pytest.mark.usefixtures("processes", "undrawn")
def test_whatever_is_killed_the_plant_is_not_hurt_and_mpc_comes_back(coldloop: "Coldloop", tmp_path: Path) -> None:
    plan, out = tmp_path / "kills.toml", tmp_path / "out"
    plan.write_text(KILLS)
    outcome = coldloop("chaos", plan, "--out", out)
    assert (outcome.code, outcome.complaints[1:]) == (0, [])
    faults = json.loads((out / "chaos.json").read_text())["faults"]
    assert [fault["fault"] for fault in faults] == [
        "kill optimizer", "kill control", "kill plant", "reset link plant",
    ]  # fmt: skip
    for fault in faults:
        assert max(fault["largest_steps"]) <= 1.0, fault
        assert fault["back_s"] <= 30.0, fault
        assert fault["outside_s"] == fault["undisturbed_s"], fault
    optimizer = faults[0]
    assert optimizer["modes"] == ["MPC", "REST", "HOLD", "CLASSICAL", "MPC"]
    assert next(a["after_done_s"] for a in optimizer["alarms"] if a["name"] == "OPTIMIZER_LOST") <= 0.25
