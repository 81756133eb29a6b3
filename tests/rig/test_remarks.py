"""What the head of a run says of its configuration, and that what it does not mention holds."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coldloop_rig import simulate

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


# -- a PLC that is too slow for what is simulated ----------------------------------------------------------------------

POWER, PERIOD = "optimizer_plc.program.budget.power=", "optimizer_plc.program.updating_period_s"
SLOW = {"program": {"budget": {"power": 0.5}}}


def test_a_plc_that_cannot_do_what_is_simulated_is_named_and_refused_by_enforce(
    coldloop: "Coldloop", tmp_path: Path
) -> None:
    slow = (*RUN, "--duration", "5s", "--set", f"{POWER}0.05", "--out", tmp_path / "run")
    (told, *_) = coldloop(*slow).out.splitlines()
    why = "the slot of the preparation and an iteration take 10 s, and the longest updating period is 5 s"
    assert told.startswith("this PLC (P = 0.05) cannot do what is simulated")
    assert why in told
    refused = coldloop(*slow, "--force", "--enforce")
    assert (refused.code, len(refused.complaints)) == (2, 1)
    assert why in refused.complaints[0]
    assert why in coldloop("up", "--enforce", "--set", f"{POWER}0.05").complaints[0]


def test_in_real_time_a_period_in_which_no_answer_comes_is_refused_before_anything_starts(
    coldloop: "Coldloop", tmp_path: Path
) -> None:
    """The optimiser PLC would refuse the session; with --enforce the period is long enough."""
    short = ("--load", "a", "--set", f"{POWER}0.3", "--updating-period", "0.5")
    why = "this PLC (P = 0.3) needs 1.4 s for an answer with ode"
    run = ("run", "--mode", "realtime", "--duration", "1s", "--out", tmp_path / "run")
    for command in (run, ("up", "--detach"), ("up",)):
        refused = coldloop(*command, *short)
        assert (refused.code, len(refused.complaints)) == (2, 1), refused.complaints
        assert why in refused.complaints[0]
    assert not (tmp_path / "run").exists()


def test_a_fixed_period_is_lengthened_to_what_the_plc_takes(coldloop: "Coldloop", tmp_path: Path) -> None:
    settings = ("--set", f"{POWER}0.5", "--updating-period", "0.5")
    outcome = coldloop(*RUN, "--duration", "10s", *settings, "--enforce", "--out", tmp_path / "run")
    assert "cannot do" not in outcome.out
    assert "tau_u 1.00 s" in outcome.out
    assert f'"{PERIOD}"' in (tmp_path / "run" / "manifest.json").read_text(encoding="utf-8")


def test_a_simulation_warns_of_it_and_can_be_enforced_too() -> None:
    with pytest.warns(UserWarning, match="cannot do what is simulated"):
        simulate("a", updating_period=0.5, duration_s=5, optimizer_plc=SLOW)
    assert simulate("a", updating_period=0.5, duration_s=10, optimizer_plc=SLOW, enforce=True).summary["updates"] == 9
