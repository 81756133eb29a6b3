"""What the head of a run says of its configuration, and that what it does not mention holds."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rig import simulate

if TYPE_CHECKING:
    from tests.conftest import Coldloop

pytestmark = pytest.mark.usefixtures("compiles", "undrawn")

RUN = ("run", "--in-process", "--load", "a")
ESTIMATOR = "optimizer_plc.program.estimator."


def test_an_unmeasured_load_leaves_no_offset_with_valves_that_are_off() -> None:
    valves = {"jt_valve": 0.9, "turbine_valve": 0.9}
    unknown = {"program": {"estimator": {"load_known": False}}}
    summary = simulate("a", plant={"mismatch": valves}, optimizer_plc=unknown, duration_s=1800).summary
    assert summary["L1_outside_band_pct"] < 1.0


def test_what_a_preset_cannot_have_is_named_before_a_run_and_by_config(coldloop: "Coldloop", tmp_path: Path) -> None:
    feedback = ("--set", f"{ESTIMATOR}kind=state-feedback")
    told = coldloop(*RUN, "--duration", "5s", *feedback, "--out", tmp_path / "a").out.splitlines()
    assert told[0].startswith("not applied of the preset: ")
    assert f"{ESTIMATOR}disturbances" in told[0]
    assert 'preset tuned has ["outputs"], not applied: state-feedback' in coldloop("config", *feedback).out
    usual = coldloop(*RUN, "--duration", "5s", "--out", tmp_path / "b").out.splitlines()
    assert usual[0].startswith("20 ticks")
