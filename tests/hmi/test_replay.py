"""A recorded run on the page, without servers; two side by side; and the page of `coldloop up`."""

import json
import re
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from coldloop.process.cold_box import COLD_BOX, OUTPUT_NAMES
from coldloop.registers.common import Event, EventKind
from coldloop_hmi.explanation import Branch
from coldloop_hmi.process_image import SOUND, JournalEntry, Model, doubted
from coldloop_hmi.runtime import Replay
from coldloop_rig.live.recorded_page import RecordedPage
from coldloop_rig.results.run_folder import RunFolder
from tests.conftest import Coldloop
from tests.harness.processes import END_S, Processes
from tests.harness.waiting import eventually
from tests.hmi.conftest import RECORDED_S, Served


def test_the_page_shows_what_the_files_of_the_run_have(served: Served, recorded_run: Path) -> None:
    table = pq.read_table(recorded_run / "trace.parquet", columns=["L1", "T5", "CV155", "load_w"]).to_pylist()
    for tick in (0, 100, 4 * RECORDED_S - 1):
        served.ask("/api/replay", {"tick": tick})
        values = served.ask("/api/state")["values"]
        shown = [values[f"control_plc.process.{name}"] for name in ("y.L1", "y.T5", "u.CV155", "load")]
        assert shown == pytest.approx(list(table[tick].values()), rel=1e-6)


def test_a_trend_of_a_replay_has_every_tick(served: Served) -> None:
    served.ask("/api/replay", {"tick": 4 * RECORDED_S - 1})
    trend = served.ask(f"/api/trend?names=L1&seconds={RECORDED_S}&points=4000")
    assert [round(time * 4) for time in trend["time"]] == list(range(4 * RECORDED_S))


def test_the_replay_goes_on_at_its_speed_and_ends_at_the_end(served: Served) -> None:
    served.ask("/api/replay", {"tick": 0, "speed": 200.0, "playing": True})
    eventually(lambda: not served.ask("/api/replay")["playing"], "it ends")
    assert served.ask("/api/replay")["tick"] == 4 * RECORDED_S - 1


def test_ticks_that_are_missing_in_a_recording_are_a_gap_and_end_nothing(recorded_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(recorded_run, folder)
    table = pq.read_table(folder / "trace.parquet")
    rows = table.to_pandas()
    rows.loc[100:160, [name for name in rows.select_dtypes("float") if name != "time_s"]] = float("nan")
    pq.write_table(pa.Table.from_pandas(rows, preserve_index=False).cast(table.schema), folder / "trace.parquet")
    model, run = Model(COLD_BOX, time.monotonic, 3600.0), RecordedPage(RunFolder(folder))
    assert run.frame(120) is None
    replay = Replay(run, model, 3600.0)
    for tick, gaps in ((120, []), (161, [(99, 161)]), (239, [(99, 161)])):
        replay.go_to(tick)
        assert model.trends.gaps(0, 1000) == gaps


def test_updates_of_a_run_are_explained(served: Served, recorded_run: Path) -> None:
    served.ask("/api/replay", {"tick": 4 * RECORDED_S - 1})
    rows = pq.read_table(recorded_run / "updates.parquet").to_pylist()
    first, second = (served.ask(f"/api/explanation?update={row['update']}") for row in rows[:2])
    assert first["branch"] == Branch.FIRST
    assert second["branch"] in {Branch.UP, Branch.DOWN, Branch.CONTRACTION}
    assert second["predicted"] == pytest.approx(rows[1]["j_delivered"])
    assert second["period_s"] == rows[1]["tau_u_s"]


def test_a_replay_takes_no_commands(served: Served) -> None:
    assert not served.ask("/api/me")["operates"]


def test_recorded_settings_give_rule_and_limits(recorded_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "of another machine"
    shutil.copytree(recorded_run, folder)
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    manifest["configuration"]["model.file"] = "/absent/model.json"
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    recorded = RecordedPage(RunFolder(folder))
    assert (recorded.rule.q_first, recorded.rule.delta, recorded.rule.iteration) == (5, 0, 0.25)
    assert recorded.limits.output_high == (61.0, 16.0)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("absent",), "name the folder of a run"),
        (("a", "b", "c"), "two side by side"),
        (("--page-port", "70000"), "--page-port"),
    ],
)
def test_what_cannot_be_shown_is_one_line(coldloop: Coldloop, arguments: tuple[str, ...], part: str) -> None:
    outcome = coldloop("page", *arguments)
    assert outcome.code == 2
    assert len(outcome.complaints) == 1
    assert part in outcome.complaints[0]


def test_up_with_its_page_prints_where_it_is_and_a_password_that_operates(processes: Processes, tmp_path: Path) -> None:
    port = processes.free_port()
    words, more = ("--port-base", processes.three_ports()), {"XDG_RUNTIME_DIR": str(tmp_path)}
    up = processes.coldloop("up", *words, "--page-port", port, "--detach", stdout=subprocess.PIPE, more=more)
    try:
        said, _ = up.popen.communicate(timeout=2 * END_S)
        assert up.popen.returncode == 0, up.said
        address = f"http://127.0.0.1:{port}"
        assert address in said
        found = re.search(r"user (\S+), password (\S+)", said)
        assert found is not None
        body = json.dumps({"user": found[1], "password": found[2]}).encode()
        request = urllib.request.Request(f"{address}/api/login", body, {"Origin": address})  # noqa: S310 our own page
        with urllib.request.urlopen(request, timeout=END_S) as answer:  # noqa: S310
            assert json.loads(answer.read())["role"] == "operate"
    finally:
        assert processes.coldloop("down", *words, more=more).popen.wait(END_S) == 0


def test_a_recorded_run_has_the_quality_of_its_sensors(recorded_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = RecordedPage(RunFolder(recorded_run))
    t5, kinds = OUTPUT_NAMES.index("T5"), EventKind
    noted = ((5, kinds.SENSOR, 2), (9, kinds.SENSOR_FAULT, 3), (12, kinds.SENSOR, 0), (15, kinds.SENSOR_FAULT, 0))
    events = [
        JournalEntry.of("plant", Event(tick=at, kind=kind, subject=t5, cause=cause), COLD_BOX)
        for at, kind, cause in noted
    ]
    monkeypatch.setattr(recorded, "events", events)
    told = [doubted(recorded.frame(tick).doubts, COLD_BOX).get("T5") for tick in (4, 5, 8, 9, 13, 15)]
    assert told == [None, "suspect", "suspect", "simulated", "simulated", None]
    assert recorded.frame(recorded.ticks - 1).doubts == SOUND
    assert recorded._bits("L1 T5") == 1 << OUTPUT_NAMES.index("L1") | 1 << t5  # noqa: SLF001
