"""What a run leaves on disk."""

import json
import math
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import pandas as pd
import pyarrow.parquet as pq
import pytest

from coldloop.errors import UsageError
from coldloop.process.cold_box import INPUT_NAMES, INPUT_UNITS, OUTPUT_NAMES, OUTPUT_UNITS, STATE_NAMES, STATE_UNITS
from coldloop.process.lti_model import load
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import PlantSample
from coldloop.text import whole_file
from coldloop_rig import cli
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.columns import FILES, STATION
from coldloop_rig.results.recording import LinkStatistics, Recorder, Recording, evaluate
from coldloop_rig.results.run_folder import claim_folder_of_now, write_json
from coldloop_rig.settings import Settings

if TYPE_CHECKING:
    from coldloop.process.load_profile import LoadProfile
    from tests.conftest import Coldloop
    from tests.rig.conftest import Simulate

TICKS = 240

SUMMARY = {
    "complete", "reason", "ticks", "updates", "trace_sha256", "J_dev", "J_cst", "J_BF", "c1", "c2", "tau_u_mean",
    "tau_u_mean_per_update", "iterations_total", "L1_outside_band_pct", "T5_outside_band_pct", "deadline_misses",
    "wall_seconds", "realtime_factor",
}  # fmt: skip
PREDICTED = ("J_dev", "J_cst", "J_open_mean", "c1", "c2", "tau_u_mean", "tau_u_mean_per_update")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, programs: None) -> Path:  # noqa: ARG001 a mark
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
    names = {"manifest.json", "summary.json", "schema.json", "run.png", "inputs", *FILES} - {STATION}
    assert {path.name for path in folder.iterdir()} == names
    assert [path.name for path in (folder / "inputs").iterdir()] == ["model.json"]
    assert (folder / "run.png").read_bytes().startswith(b"\x89PNG")


def test_the_summary_has_all_indicators_and_null_for_what_does_not_exist(folder: Path, minute: Recording) -> None:
    summary = read(folder / "summary.json")
    assert set(summary) >= SUMMARY
    assert summary.pop("trace_sha256") == minute.trace_sha256
    absent = {"reason", "overruns", "lateness_max_ms", "lateness_p99_ms"}
    assert {name for name, value in summary.items() if value is None} == absent, "in lock-step nothing is late"
    assert all(math.isfinite(value) for value in summary.values() if value is not None)
    assert summary["ticks"] == TICKS
    assert summary["updates"] == len(minute.updates)
    assert summary["iterations_total"] == sum(row.iterations for row in minute.updates)
    wall_s = summary["wall_seconds"]
    as_rounded = pytest.approx(TICKS / 4 / wall_s, abs=0.006, rel=6e-4 / wall_s)
    assert summary["realtime_factor"] == as_rounded


def test_a_streamed_run_and_a_recording_in_memory_have_the_same_indicators(folder: Path, minute: Recording) -> None:
    settings = Settings()
    indicators = evaluate(minute, load(settings.model.file), settings.optimizer_plc.program.design)
    summary = read(folder / "summary.json")
    assert {name: summary[name] for name in indicators.by_name} == indicators.by_name


def test_the_trace_has_a_row_a_tick_and_the_values_of_the_run(folder: Path, minute: Recording) -> None:
    table = pq.read_table(folder / "trace.parquet")
    assert table["tick"].to_pylist() == list(range(TICKS))
    assert table["time_s"].to_pylist() == [tick / 4 for tick in range(TICKS)]
    assert table["load_w"].to_pylist() == minute.load.tolist()
    assert table["CV156"].to_pylist() == minute.u[:, 2].tolist()
    assert table["L1"].to_pylist() == minute.y[:, 0].tolist()
    assert table["x_T_nef34_12"].to_pylist() == minute.x[:, -1].tolist()


@pytest.mark.parametrize("name", FILES[:-1])
def test_each_column_has_its_unit_and_description_in_the_file_and_in_the_schema(name: str, folder: Path) -> None:
    described = {column["name"]: column for column in read(folder / "schema.json")["files"][name]["columns"]}
    schema = pq.read_schema(folder / name)
    assert list(described) == schema.names
    for field in schema:
        assert re.fullmatch(r"[A-Za-z]\w*", field.name), "a name that SQL and MATLAB take as it is"
        assert field.metadata[b"unit"].decode() == described[field.name]["unit"]
        assert field.metadata[b"description"].decode() == described[field.name]["description"] != ""
        assert str(field.type) == described[field.name]["type"]


def test_the_units_of_the_trace_are_those_of_the_process(folder: Path) -> None:
    units = {field.name: field.metadata[b"unit"].decode() for field in pq.read_schema(folder / "trace.parquet")}
    assert units == {
        "tick": "1", "time_s": "s", "load_w": "W", **dict(zip(INPUT_NAMES, INPUT_UNITS, strict=True)),
        **dict(zip(OUTPUT_NAMES, OUTPUT_UNITS, strict=True)),
        **{f"x_{name}": unit for name, unit in zip(STATE_NAMES, STATE_UNITS, strict=True)},
        "L1_measured": "%", "T5_measured": "K", **dict.fromkeys(("mode", "cause", "driver", "bad_sensors"), ""),
        "stage_cost": "1", "update": "1", "tau_u_s": "s", "iterations": "1", "J": "1", "model_range": "1",
    }  # fmt: skip


def test_the_trace_says_at_each_tick_what_the_optimiser_was_doing(folder: Path, minute: Recording) -> None:
    table = pq.read_table(folder / "trace.parquet")
    for row in minute.updates:
        assert set(table["update"].to_pylist()[row.tick : row.tick + row.tau_u]) == {row.update}
        assert set(table["tau_u_s"].to_pylist()[row.tick : row.tick + row.tau_u]) == {row.tau_u / 4}
        assert set(table["iterations"].to_pylist()[row.tick : row.tick + row.tau_u]) == {row.iterations}


def test_the_updates_are_the_history_of_the_optimiser_in_seconds(folder: Path, minute: Recording) -> None:
    rows = pq.read_table(folder / "updates.parquet").to_pylist()
    for row, update in zip(rows, minute.updates, strict=True):
        assert row.pop("time_s") == update.tick / 4
        assert row.pop("tau_u_s") == update.tau_u / 4
        expected = update._asdict()
        del expected["tau_u"]
        assert row == expected


def test_the_events_say_when_mpc_took_over(folder: Path) -> None:
    events = pq.read_table(folder / "events.parquet").to_pylist()
    assert [(event["kind"], event["subject"], event["cause"]) for event in events] == [
        ("mode", "hold", "session started"),
        ("mode", "mpc", "sequence began"),
    ]


def test_duckdb_and_pandas_read_the_trace(folder: Path, minute: Recording) -> None:
    path = folder / "trace.parquet"
    query = f"select max(L1), count(x_P1), avg(tau_u_s) from '{path}' where time_s >= 30"  # noqa: S608 our own file
    ((highest, count, _),) = duckdb.sql(query).fetchall()
    assert (highest, count) == (minute.y[120:, 0].max(), TICKS - 120)
    frame = pd.read_parquet(path)
    assert frame["L1"].tolist() == minute.y[:, 0].tolist()


def test_the_manifest_holds_what_is_needed_to_repeat_the_run(folder: Path, minute: Recording) -> None:
    manifest = read(folder / "manifest.json")
    assert manifest["hashes"]["trace_sha256"] == minute.trace_sha256
    assert {"coldloop", "python", "platform", "dependencies", "command", "arguments", "inputs"} <= set(manifest)
    assert datetime.fromisoformat(manifest["started_utc"]) <= datetime.fromisoformat(manifest["ended_utc"])
    assert datetime.fromisoformat(manifest["started_utc"]).tzinfo is UTC
    assert manifest["configuration"]["plant.load"] == "e"


@pytest.mark.usefixtures("undrawn")
def test_an_existing_run_is_replaced_only_when_forced(coldloop: "Coldloop", results: Path) -> None:
    run = ("run", "--in-process", "--duration", "2s", "--figures", "png", "--out", results)
    assert coldloop(*run).code == 0
    before = {path: path.read_bytes() for path in results.iterdir() if path.is_file()}
    outcome = coldloop(*run, "--load", "b")
    assert outcome.code == 2
    assert len(outcome.complaints) == 1
    assert "--force" in outcome.complaints[0]
    assert {path: path.read_bytes() for path in results.iterdir() if path.is_file()} == before
    assert coldloop(*run, "--load", "b", "--force").code == 0
    assert read(results / "manifest.json")["configuration"]["plant.load"] == "b"


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


def test_threads_may_write_the_same_file_at_once(tmp_path: Path) -> None:
    path, together = tmp_path / "record.json", threading.Barrier(2)

    def write(draft: Path) -> None:
        draft.write_text('{"run": 1}')
        together.wait(10)

    with ThreadPoolExecutor(2) as pool:
        for writer in [pool.submit(whole_file, path, write) for _ in range(2)]:
            writer.result()
    assert [file.name for file in tmp_path.iterdir()] == ["record.json"]
    assert read(path) == {"run": 1}


def test_a_device_is_not_replaced_by_a_file() -> None:
    with pytest.raises(UsageError, match="not a regular file"):
        write_json(Path("/dev/full"), {})
    assert Path("/dev/full").is_char_device()


def test_a_recording_keeps_the_updates_whose_sequence_was_played() -> None:
    recorder = Recorder(ticks=100)
    row = Optimization(*[0] * len(Optimization._fields))
    for number, (tick, tau_u) in enumerate([(0, 40), (40, 20), (50, 49), (99, 10)]):
        recorder.update(row._replace(update=number, tick=tick, tau_u=tau_u))
    for tick in range(100):
        recorder.sample(PlantSample(tick, 0.0, (0.0,) * 3, (0.0,) * 22, (0.0,) * 28))
    assert [kept.update for kept in recorder.recording().updates] == [0, 2], "1 was cut off, 3 reaches beyond the run"
    assert recorder.recording().link == LinkStatistics()
    assert len(recorder.recording().load) == 100


@pytest.mark.usefixtures("programs")
def test_a_run_without_updates_leaves_all_files_too(coldloop: "Coldloop", results: Path) -> None:
    outcome = coldloop(
        "run", "--in-process", "--load", "e", "--duration", "60s", "--set", "control_plc.driver=classical",
        "--set", "control_plc.classical.level.setpoint_offset=0.5", "--out", results,
    )  # fmt: skip
    assert outcome.code == 0, outcome.complaints
    assert "no updates" in outcome.out
    summary = json.loads((results / "summary.json").read_text(encoding="utf-8"))
    assert (summary["updates"], summary["iterations_total"]) == (0, 0)
    assert [summary[name] for name in PREDICTED] == [None] * len(PREDICTED)
    assert summary["J_BF"] > 0.0
    assert pq.read_table(results / "updates.parquet").num_rows == 0
    assert pq.read_table(results / "trace.parquet").num_rows == TICKS
    assert (results / "run.png").read_bytes().startswith(b"\x89PNG")


def test_runs_that_begin_in_one_second_have_a_folder_each(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(lambda _: claim_folder_of_now(tmp_path / "runs", "a"), range(40)))
    assert len(set(folders)) == 40
    assert all(folder.is_dir() and folder.name.startswith("a-20") for folder in folders)
