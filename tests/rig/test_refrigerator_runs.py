"""Runs of the whole refrigerator: one hash however it is connected, and what its folder holds."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow.parquet as pq
import pytest

from coldloop.process.cold_box import INPUT_NAMES, L1, STATION_SIGNAL_NAMES
from coldloop_rig import simulate

if TYPE_CHECKING:
    from tests.conftest import Coldloop

pytestmark = pytest.mark.usefixtures("compiles")

TRIP = """
[plant]
kind = "refrigerator"
load = "e"

[plant.refrigerator]
events = [{ at_s = 10, target = "nc1", value = 0 }, { at_s = 40, target = "nc1", value = 1 }]
"""


@pytest.fixture(scope="module")
def configured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("trip") / "trip.toml"
    file.write_text(TRIP, encoding="utf-8")
    return file


@pytest.mark.usefixtures("undrawn", "processes")
def test_a_trip_leaves_one_trace_in_one_process_and_over_the_link(
    configured: Path, tmp_path: Path, coldloop: "Coldloop"
) -> None:
    common = ("--config", str(configured), "--duration", "60s", "--figures", "png")
    for way, name in ((("--in-process",), "alone"), ((), "networked")):
        assert coldloop("run", *common, *way, "--out", tmp_path / name).code == 0
    alone, networked = (tmp_path / name for name in ("alone", "networked"))
    assert trace_of(alone) == trace_of(networked)
    table = pq.read_table(networked / "station.parquet").to_pydict()
    assert table["tick"] == list(range(240))
    assert min(table["P12"]) < 14.5
    assert table == pq.read_table(alone / "station.parquet").to_pydict()
    files = json.loads((networked / "schema.json").read_text(encoding="utf-8"))["files"]
    columns = [column["name"] for column in files["station.parquet"]["columns"]]
    assert columns == ["tick", "time_s", *STATION_SIGNAL_NAMES, "mode", "alarms"]


def trace_of(folder: Path) -> str:
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return str(summary["trace_sha256"])


@pytest.mark.usefixtures("undrawn")
def test_a_cold_box_leaves_no_station(tmp_path: Path, coldloop: "Coldloop") -> None:
    assert coldloop("run", "--in-process", "--load", "a", "--duration", "15s", "--out", tmp_path / "run").code == 0
    assert not (tmp_path / "run" / "station.parquet").exists()


def test_the_optimiser_runs_with_a_model_that_knows_the_pressures() -> None:
    plant = {"kind": "refrigerator"}
    known = simulate("e", duration_s=300, plant=plant, model={"file": "refrigerator"})
    unknown = simulate("e", duration_s=300, plant=plant)
    labels = [axes.get_ylabel() for axes in known.plot().axes]
    assert sum("bar" in label for label in labels) == 2, "high and low pressure are drawn as those of a run's folder"
    assert known.summary["trace_sha256"] != unknown.summary["trace_sha256"]
    assert known.summary["L1_outside_band_pct"] == known.summary["T5_outside_band_pct"] == 0.0


def test_a_compressor_trip_makes_no_good_sensor_suspect_and_the_level_comes_back() -> None:
    events = [{"at_s": 600, "target": "nc1", "value": 0}, {"at_s": 720, "target": "nc1", "value": 1}]
    run = simulate("a", duration_s=1800, plant={"kind": "refrigerator", "refrigerator": {"events": events}})
    alarms = {event["subject"] for event in run.events.arrow.to_pylist()}
    assert "level band" in alarms, "the trip moves the plant"
    assert "sensor suspect" not in alarms
    level = run.recording.y[:, L1]
    assert 55.0 < level.min() < 59.0
    assert level[-400:].min() > 59.0


def test_a_turbine_trip_costs_no_helium_and_its_valve_is_left_until_it_turns() -> None:
    """LQ blew 1.7 kg off in two minutes, and MPC opened CV156 to 54 %."""
    events = [{"at_s": 300, "target": "turbine", "value": 0}, {"at_s": 420, "target": "turbine", "value": 1}]
    run = simulate("a", duration_s=600, plant={"kind": "refrigerator", "refrigerator": {"events": events}})
    station = run.recording.station
    assert station[-1, STATION_SIGNAL_NAMES.index("lost")] < 0.01
    assert station[:, STATION_SIGNAL_NAMES.index("P12")].max() < 17.6
    valve = run.recording.u[:, INPUT_NAMES.index("CV156")]
    assert np.ptp(valve[1220:1680]) < 1e-3
    assert valve[-400:].max() > valve[1680] + 0.5, "it moves again"
    heard = [(row["kind"], row["subject"]) for row in run.events.arrow.to_pylist()]
    assert ("alarm raised", "input without effect") in heard
    assert ("alarm returned", "input without effect") in heard


def test_a_stuck_valve_that_nobody_sees_does_not_take_the_level_sensor_with_it() -> None:
    """CV155 for 20 min in hour c; L1 was suspected for half an hour, and rose to 72 %."""
    events = [{"at_s": 600, "target": "cv155", "value": 0}, {"at_s": 1800, "target": "cv155", "value": 1}]
    run = simulate("c", duration_s=2700, plant={"kind": "refrigerator", "refrigerator": {"events": events}})
    level = run.recording.y[:, L1]
    assert level.max() < 64.0
    assert level[-1] < 61.5
