"""`coldloop chaos`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from rig.chaos.plan import shipped_plans

if TYPE_CHECKING:
    from tests.conftest import Coldloop

PLAN = """
name = "short"
description = "An optimiser that stands still is waited for, a late frame too"
load = "a"
duration_s = 420
standstill_s = 0.5

[[faults]]
kind = "pause"
process = "optimizer"
at_s = 5
duration_s = 60

[[faults]]
kind = "delay"
link = "plant"
at_s = 70
duration_s = 5
delay_ms = 1
"""


def test_list_names_the_shipped_plans(coldloop: "Coldloop") -> None:
    outcome = coldloop("chaos", "--list")
    assert outcome.code == 0
    assert [line.split()[0] for line in outcome.out.splitlines()] == [plan.name for plan in shipped_plans()]


def test_a_plan_that_cannot_be_used_is_one_line(coldloop: "Coldloop", tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text(PLAN.replace("duration_s = 60", "duration = 60"))
    for arguments in ((), ("no-such-plan",), (bad,), ("kill", "--seed", "x"), ("kill", "--load", "no-load")):
        outcome = coldloop("chaos", *arguments, *(["--out", tmp_path / "out"] if arguments else []))
        assert (outcome.code, outcome.out, len(outcome.complaints)) == (2, "", 1), arguments


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
