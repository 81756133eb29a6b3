"""Plants with a mode that grows are held by MPC."""

from pathlib import Path
from typing import Any

import pyarrow.parquet

from coldloop.registers.control_plc import Verdict
from tests.harness.processes import Processes
from tests.harness.unstable_plants import pendulum, stirred_tank
from tests.process.runs import run

POWER = "optimizer_plc.program.budget.power=50"


def columns(out: Path, name: str) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = pyarrow.parquet.read_table(out / f"{name}.parquet").to_pydict()
    return found


def test_a_stirred_tank_is_held_at_its_unstable_state(processes: Processes, tmp_path: Path) -> None:
    file = stirred_tank(tmp_path)
    left = run(processes, file, tmp_path / "out", "--in-process", "--load", "a", "--duration", "1h")
    assert left["T_outside_band_pct"] < 8.0
    assert left["J_BF"] is not None
    assert set(columns(tmp_path / "out", "trace")["mode"]) == {"hold", "mpc"}
    assert set(columns(tmp_path / "out", "updates")["verdict"]) == {Verdict.ACCEPTED}


def test_a_pendulum_stays_upright(processes: Processes, tmp_path: Path) -> None:
    """Its rate limit is never active, so that the problem has no rows of rates."""
    file, options = pendulum(tmp_path), ("--in-process", "--load", "a", "--duration", "30s", "--set", POWER)
    left = run(processes, file, tmp_path / "out", *options)
    assert left["angle_outside_band_pct"] == 0.0
    assert left["p_outside_band_pct"] < 30.0
