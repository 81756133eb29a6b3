"""What a run leaves on disk."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from coldloop.process import (
    INPUT_NAMES,
    INPUT_UNITS,
    OUTPUT_NAMES,
    OUTPUT_UNITS,
    STATE_NAMES,
    STATE_UNITS,
)
from coldloop.registers.optimizer_plc import Optimization
from rig import cli
from rig.recording import LinkStatistics, Recorder, Recording
from rig.results import whole_file, write_json, write_trace
from rig.scenario import Scenario

if TYPE_CHECKING:
    from plant.program import LoadProfile
    from tests.conftest import Coldloop
    from tests.rig.conftest import Simulate

TICKS = 240

SUMMARY = {
    "ticks", "updates", "trace_sha256", "J_dev", "J_cst", "J_BF", "c1", "c2", "tau_u_mean", "iterations_total",
    "L1_outside_band_pct", "T5_outside_band_pct", "deadline_misses", "wall_seconds", "realtime_factor",
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a minute of load e."""
    folder = tmp_path_factory.mktemp("run") / "deep" / "results"
    assert cli.main(["run", "--in-process", "--load", "e", "--duration", "60s", "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def minute(simulate: "Simulate", load_e: "LoadProfile") -> Recording:
    return simulate(Scenario(TICKS, load_e, 0.0, seed=1))


def read(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return document


def test_a_run_leaves_these_files_and_no_others(folder: Path) -> None:
    names = {"manifest.json", "summary.json", "trace.parquet", "updates.parquet", "run.png"}
    assert {path.name for path in folder.iterdir()} == names
    assert (folder / "run.png").read_bytes().startswith(b"\x89PNG")


def test_the_summary_has_all_indicators_as_finite_numbers(folder: Path, minute: Recording) -> None:
    summary = read(folder / "summary.json")
    assert set(summary) >= SUMMARY
    assert summary.pop("trace_sha256") == minute.trace_sha256
    assert all(isinstance(value, int | float) and math.isfinite(value) for value in summary.values())
    assert summary["ticks"] == TICKS
    assert summary["updates"] == len(minute.updates)
    assert summary["iterations_total"] == sum(row.iterations for row in minute.updates)
    assert summary["realtime_factor"] == pytest.approx(TICKS / 4 / summary["wall_seconds"], rel=0.05)


def test_the_trace_has_a_row_a_tick_and_a_unit_for_each_column(folder: Path, minute: Recording) -> None:
    table = pq.read_table(folder / "trace.parquet")
    units = {field.name: field.metadata[b"unit"].decode() for field in table.schema}
    assert units == {
        "time": "s", "load": "W", **dict(zip(INPUT_NAMES, INPUT_UNITS, strict=True)),
        **dict(zip(OUTPUT_NAMES, OUTPUT_UNITS, strict=True)),
        **{f"x.{name}": unit for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True)},
        "update": "1", "tau_u": "s", "iterations": "1", "J": "1",
    }  # fmt: skip
    assert table["time"].to_pylist() == [tick / 4 for tick in range(TICKS)]
    assert table["load"].to_pylist() == minute.load.tolist()
    assert table["CV156"].to_pylist() == minute.u[:, 2].tolist()
    assert table["L1"].to_pylist() == minute.y[:, 0].tolist()
    assert table["x.T_nef34_12"].to_pylist() == minute.x[:, -1].tolist()


def test_the_trace_says_at_each_tick_what_the_optimiser_was_doing(folder: Path, minute: Recording) -> None:
    table = pq.read_table(folder / "trace.parquet")
    for row in minute.updates:
        assert set(table["update"].to_pylist()[row.tick : row.tick + row.tau_u]) == {row.update}
        assert set(table["tau_u"].to_pylist()[row.tick : row.tick + row.tau_u]) == {row.tau_u / 4}
        assert set(table["iterations"].to_pylist()[row.tick : row.tick + row.tau_u]) == {row.iterations}


def test_the_updates_are_the_history_of_the_optimiser(folder: Path, minute: Recording) -> None:
    table = pq.read_table(folder / "updates.parquet")
    assert tuple(table.column_names) == Optimization._fields
    assert table.to_pylist() == [row._asdict() for row in minute.updates]


def test_the_manifest_holds_what_is_needed_to_repeat_the_run(
    folder: Path, minute: Recording, coldloop: "Coldloop", tmp_path: Path
) -> None:
    manifest = read(folder / "manifest.json")
    assert manifest["hashes"]["trace_sha256"] == minute.trace_sha256
    assert {"coldloop", "python", "platform", "dependencies", "command", "arguments"} <= set(manifest)
    assert manifest["configuration"]["plant.load"] == "e"
    settings = [f"--set={key}={json.dumps(value)}" for key, value in manifest["configuration"].items()]
    again = coldloop("run", "--in-process", "--duration", "60s", *settings, "--out", tmp_path / "again")
    assert again.code == 0
    assert read(tmp_path / "again" / "summary.json")["trace_sha256"] == minute.trace_sha256


def test_a_run_shorter_than_its_first_update_has_results_too(coldloop: "Coldloop", results: Path) -> None:
    assert coldloop("run", "--in-process", "--duration", "0.25s", "--out", results).code == 0
    assert read(results / "summary.json")["updates"] == 0
    assert pq.read_table(results / "trace.parquet").num_rows == 1
    assert pq.read_table(results / "updates.parquet").num_rows == 0


class DiskFullError(OSError):
    """What a full disk would raise."""


def test_a_file_that_cannot_be_written_whole_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    write_json(path, {"run": 1})

    def fail_halfway(draft: Path) -> None:
        draft.write_text('{"run": ')
        raise DiskFullError

    with pytest.raises(DiskFullError):
        whole_file(path, fail_halfway)
    assert [file.name for file in tmp_path.iterdir()] == ["summary.json"]
    assert read(path) == {"run": 1}


def test_a_trace_that_cannot_be_written_whole_leaves_no_file(
    tmp_path: Path, minute: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail_halfway(_table: pa.Table, path: Path, **_: object) -> None:
        path.write_bytes(b"PAR1")
        raise DiskFullError

    monkeypatch.setattr(pq, "write_table", fail_halfway)
    with pytest.raises(DiskFullError):
        write_trace(tmp_path / "trace.parquet", minute)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_told_in_one_line(coldloop: "Coldloop", results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise DiskFullError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", fail)
    outcome = coldloop("run", "--in-process", "--duration", "2s", "--out", results)
    assert outcome.code == 1
    assert "No space left" in outcome.complaints[-1]


def test_a_recording_keeps_the_updates_whose_sequence_was_played() -> None:
    recorder = Recorder(ticks=100)
    row = Optimization(*[0] * len(Optimization._fields))
    for number, (tick, tau_u) in enumerate([(0, 40), (40, 59), (99, 10)]):
        recorder.update(row._replace(update=number, tick=tick, tau_u=tau_u))
    assert [kept.update for kept in recorder.recording().updates] == [0, 1]
    assert recorder.recording().link == LinkStatistics()


def test_a_run_without_updates_leaves_all_files_too(coldloop: "Coldloop", results: Path) -> None:
    outcome = coldloop(
        "run", "--in-process", "--load", "e", "--duration", "60s", "--set", "control_plc.driver=classical",
        "--set", "control_plc.classical.level.setpoint_offset=0.5", "--out", results,
    )  # fmt: skip
    assert outcome.code == 0, outcome.complaints
    assert "no updates" in outcome.out
    summary = json.loads((results / "summary.json").read_text(encoding="utf-8"))
    assert (summary["updates"], summary["iterations_total"], summary["tau_u_mean"]) == (0, 0, 0.0)
    assert summary["J_BF"] > 0.0
    assert pq.read_table(results / "updates.parquet").num_rows == 0
    assert pq.read_table(results / "trace.parquet").num_rows == TICKS
    assert (results / "run.png").read_bytes().startswith(b"\x89PNG")
