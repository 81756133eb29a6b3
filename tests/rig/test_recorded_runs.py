"""What is done with a recorded run: exported, compared, drawn, reported, repeated."""

import csv
import fcntl
import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import loadmat

from coldloop.errors import UsageError
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.load_profile import read_load_file
from coldloop.process.model_file import digest_of
from coldloop.text import file_digest
from coldloop_rig import cli
from coldloop_rig.results.run_folder import RunFolder, claim_folder
from coldloop_rig.runs.running import json_digest
from tests.conftest import draw_nothing
from tests.harness.processes import Processes

if TYPE_CHECKING:
    from tests.conftest import Coldloop

LOAD = "time_s,load_w\n0,385\n10,445\n40,330\n"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two runs of 90 s under a load of one's own: mpc and classical."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "my_load.csv").write_text(LOAD)
    common = ["run", "--in-process", "--load", str(folder / "my_load.csv"), "--duration", "90s", "--figures", "png"]
    with pytest.MonkeyPatch.context() as monkeypatch:
        draw_nothing(monkeypatch)
        assert cli.main([*common, "--out", str(folder / "mpc")]) == 0
        assert cli.main([*common, "--set", "control_plc.driver=classical", "--out", str(folder / "classical")]) == 0
    return folder


@pytest.fixture
def mpc(runs: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may change."""
    return Path(shutil.copytree(runs / "mpc", tmp_path / "mpc"))


def trace(run: Path) -> dict[str, list[Any]]:
    columns: dict[str, list[Any]] = pq.read_table(run / "trace.parquet").to_pydict()
    return columns


# -- export ------------------------------------------------------------------------------------------------------------


def test_csv_has_the_columns_and_values_of_the_trace(coldloop: "Coldloop", mpc: Path) -> None:
    assert coldloop("export", mpc, "--csv").code == 0
    rows = list(csv.DictReader((mpc / "trace.csv").read_text().splitlines()))
    expected = trace(mpc)
    assert list(rows[0]) == list(expected)
    assert [np.float32(row["L1"]) for row in rows] == expected["L1"]
    assert {path.name for path in mpc.glob("*.csv")} == {"trace.csv", "updates.csv", "events.csv"}


def test_a_matlab_file_has_structures_with_units(coldloop: "Coldloop", mpc: Path, tmp_path: Path) -> None:
    outcome = coldloop("export", mpc, "--mat", "--out", tmp_path / "exported")
    assert outcome.out.splitlines() == [str(tmp_path / "exported" / "run.mat")]
    content = loadmat(tmp_path / "exported" / "run.mat", simplify_cells=True)
    expected = trace(mpc)
    assert content["trace"]["L1"].tolist() == expected["L1"]
    assert content["trace"]["x_T_nef34_12"].tolist() == expected["x_T_nef34_12"]
    assert content["units"]["trace"]["T5"] == "K"
    assert content["updates"]["tau_u_s"].tolist() == pq.read_table(mpc / "updates.parquet")["tau_u_s"].to_pylist()
    assert content["run"]["complete"]


def test_an_hdf5_file_has_groups_whose_datasets_know_their_units(coldloop: "Coldloop", runs: Path, mpc: Path) -> None:
    for run in (mpc, Path(shutil.copytree(runs / "classical", mpc.parent / "classical"))):
        assert coldloop("export", run, "--hdf5").code == 0
        with h5py.File(run / "run.h5") as file:
            assert file["trace/L1"][:].tolist() == trace(run)["L1"]
            assert file["trace/L1"].attrs["unit"] == "%"
    with h5py.File(mpc / "run.h5") as file:
        assert file["events/subject"].asstr()[0] == "hold"
    with h5py.File(mpc.parent / "classical" / "run.h5") as file:
        assert np.isnan(file["trace/tau_u_s"][:]).all(), "the classical loops have no updating period"


def test_an_export_does_not_replace_a_file_unless_forced(coldloop: "Coldloop", mpc: Path) -> None:
    (mpc / "updates.csv").write_text("precious")
    outcome = coldloop("export", mpc, "--csv")
    assert outcome.code == 2
    assert "updates.csv: exists" in outcome.complaints[0]
    assert (mpc / "updates.csv").read_text() == "precious"
    assert not (mpc / "trace.csv").exists()
    assert coldloop("export", mpc, "--csv", "--force").code == 0


@pytest.mark.parametrize("command", ["export --csv", "report", "plot", "rerun"])
def test_a_folder_without_a_run_is_refused_in_one_line(command: str, coldloop: "Coldloop", tmp_path: Path) -> None:
    outcome = coldloop(*command.split(), tmp_path)
    assert outcome.code == 2
    (complaint,) = outcome.complaints
    assert "manifest.json" in complaint
    assert not list(tmp_path.iterdir())


# -- compare -----------------------------------------------------------------------------------------------------------


def test_runs_are_compared_by_indicators_and_by_what_differs_in_their_configuration(
    coldloop: "Coldloop", runs: Path, tmp_path: Path
) -> None:
    figure = tmp_path / "both.png"
    outcome = coldloop("compare", runs / "mpc", runs / "classical", "--out", figure)
    assert outcome.code == 0
    rows = {line.split()[0]: line.split()[1:] for line in outcome.out.splitlines()[1:]}
    assert rows["control_plc.driver"] == ["mpc", "classical"]
    assert rows["J_dev"][1] == "-", "the classical loops predict nothing"
    assert "plant.seed" not in rows
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert coldloop("compare", runs / "mpc", runs / "classical", "--out", figure).code == 2, "it exists"


@pytest.mark.parametrize("arguments", [["{}/mpc"], ["{}/mpc", "{}/mpc", "--out", "both.txt"]])
def test_one_run_or_an_unknown_format_is_refused(arguments: list[str], coldloop: "Coldloop", runs: Path) -> None:
    assert coldloop("compare", *[argument.format(runs) for argument in arguments]).code == 2


# -- plot and report ---------------------------------------------------------------------------------------------------


def test_a_run_is_drawn_again_in_all_formats(coldloop: "Coldloop", mpc: Path) -> None:
    assert coldloop("plot", mpc).code == 0
    assert (mpc / "run.pdf").read_bytes().startswith(b"%PDF")
    svg = (mpc / "run.svg").read_text()
    assert "<svg" in svg


def test_the_page_of_a_run_needs_no_other_host_and_shows_alarms_and_settings(coldloop: "Coldloop", mpc: Path) -> None:
    assert coldloop("report", mpc).code == 0
    page = (mpc / "report.html").read_text(encoding="utf-8")
    own = page[: page.index("<script>")] + page[page.index("</script>") :]
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=", page[: page.index("<script>")])
    assert "http" not in re.sub(r"<script.*?</script>", "", own, flags=re.DOTALL)
    for part in ("sequence began", "plant.sensors.level", RunFolder(mpc).summary["trace_sha256"], "my_load.csv"):
        assert part in page
    assert "Plotly.newPlot" in page
    assert coldloop("report", mpc).code == 2, "it exists"


def test_a_page_says_that_a_run_is_not_complete(coldloop: "Coldloop", mpc: Path) -> None:
    manifest = json.loads((mpc / "manifest.json").read_text())
    (mpc / "manifest.json").write_text(json.dumps(manifest | {"complete": False, "reason": "interrupted by <SIGINT>"}))
    assert coldloop("report", mpc).code == 0
    assert "interrupted by &lt;SIGINT&gt;" in (mpc / "report.html").read_text(encoding="utf-8")


# -- rerun -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mpc", "classical"])
def test_a_run_is_repeated_from_its_folder_alone(
    name: str, coldloop: "Coldloop", runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = Path(shutil.copytree(runs / name, tmp_path / "moved"))
    monkeypatch.setenv("COLDLOOP__PLANT__SEED", "7")
    outcome = coldloop("rerun", moved / "manifest.json")
    assert (outcome.code, outcome.out.split(",")[0]) == (0, "360 ticks")
    assert "the same trace" in outcome.out
    assert outcome.out.split()[-1] == RunFolder(moved).summary["trace_sha256"]


@pytest.mark.usefixtures("undrawn")
def test_a_repetition_does_not_replace_what_it_repeats(coldloop: "Coldloop", mpc: Path) -> None:
    before = {file: file.read_bytes() for file in mpc.rglob("*") if file.is_file()}
    for words in (
        ("rerun", mpc, "--out", mpc, "--force"),
        ("run", "--in-process", "--load", mpc / "inputs" / "load.csv", "--duration", "10s", "--out", mpc, "--force"),
    ):
        outcome = coldloop(*words)
        assert (outcome.code, len(outcome.complaints)) == (2, 1)
        assert "the run replaces what is in" in outcome.complaints[0]
    assert {file: file.read_bytes() for file in mpc.rglob("*") if file.is_file()} == before


def test_a_folder_that_another_process_has_claimed_is_not_taken(tmp_path: Path) -> None:
    other = os.open(tmp_path, os.O_RDONLY)  # locks are of open files: as good as another process
    fcntl.flock(other, fcntl.LOCK_EX)
    with pytest.raises(UsageError, match="another run is being written there"):
        claim_folder(tmp_path, force=True)
    os.close(other)
    claim_folder(tmp_path, force=True)


@pytest.mark.night
def test_two_runs_at_once_do_not_share_a_folder(processes: Processes, tmp_path: Path) -> None:
    words = ("run", "--load", "a", "--duration", "100h", "--out", tmp_path / "run")
    first = processes.coldloop(*words)
    deadline = time.monotonic() + 300.0
    while not (tmp_path / "run" / "manifest.json").exists():
        assert time.monotonic() < deadline, first.said
        assert first.alive, first.said
    second = processes.coldloop(*words, "--force", stderr=subprocess.PIPE).ended()
    assert (second.code, len(second.err.splitlines())) == (2, 1)
    assert "another run is being written there" in second.err
    assert first.interrupt() == 130


DAMAGED: dict[str, Callable[[dict[str, Any]], object]] = {
    "no way": lambda manifest: manifest.pop("way"),
    "no configuration": lambda manifest: manifest.pop("configuration"),
    "a configuration of another kind": lambda manifest: manifest.update(configuration=[1]),
    "no hashes": lambda manifest: manifest["hashes"].clear(),
    "inputs of another kind": lambda manifest: manifest.update(inputs={"load": 3}),
}


@pytest.mark.parametrize(
    ("command", "damage"),
    [
        *(("plot", damage) for damage in DAMAGED),
        *((one, "no way") for one in ("page", "report", "rerun", "export --csv")),
    ],
)
def test_a_manifest_that_was_changed_is_one_line(command: str, damage: str, coldloop: "Coldloop", mpc: Path) -> None:
    manifest = json.loads((mpc / "manifest.json").read_text())
    DAMAGED[damage](manifest)
    (mpc / "manifest.json").write_text(json.dumps(manifest))
    outcome = coldloop(*command.split(), mpc)
    assert (outcome.code, len(outcome.complaints)) == (2, 1)
    assert "manifest.json" in outcome.complaints[0]


@pytest.mark.parametrize("command", ["page", "plot", "report", "export --csv"])
@pytest.mark.parametrize("damage", ["bytes", "columns"])
def test_a_trace_that_is_damaged_is_one_line(command: str, damage: str, coldloop: "Coldloop", mpc: Path) -> None:
    trace = mpc / "trace.parquet"
    if damage == "bytes":
        content = bytearray(trace.read_bytes())
        content[200:-2000] = bytes(len(content) - 2200)
        trace.write_bytes(content)
    else:
        shutil.copy(mpc / "updates.parquet", trace)
    outcome = coldloop(*command.split(), mpc)
    if (command, damage) == ("export --csv", "columns"):  # it has its own columns
        return
    assert (outcome.code, len(outcome.complaints)) == (2, 1), outcome
    assert "damaged" in outcome.complaints[0]


def table_with(column: str, values: pa.Array) -> Callable[[Path], None]:
    """Return what replaces a column of a Parquet file."""

    def change(file: Path) -> None:
        table = pq.read_table(file)
        pq.write_table(table.slice(0, 1).append_column("x", values[:1]).drop_columns([column]).rename_columns(
            [*(name for name in table.column_names if name != column), column]), file)  # fmt: skip

    return change


def fifo(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def device(file: Path) -> None:
    file.unlink()
    file.symlink_to("/dev/zero")


def many_rows(file: Path) -> None:
    schema = pq.read_schema(file)
    pq.write_table(pa.table([pa.nulls(600_000, one.type) for one in schema], schema=schema), file)


def long_text(file: Path) -> None:
    table_with("cause", pa.array(["x" * 500_000]))(file)


FOREIGN: Final = {
    "FIFO for a manifest": ("rerun", "manifest.json", fifo, "not a regular file"),
    "FIFO for a table": ("plot", "trace.parquet", fifo, "not a regular file"),
    "FIFO for a model": ("identify", "inputs/model.json", fifo, "not a regular file"),
    "link to a device": ("report", "summary.json", device, "outside the folder"),
    "type": ("plot", "trace.parquet", table_with("time_s", pa.array(["x"])), "time_s is string"),
    "missing time": ("report", "events.parquet", table_with("time_s", pa.array([None], pa.float64())), "is missing"),
    "rows of ticks": ("plot", "updates.parquet", many_rows, "600000 rows, and manifest.json says 360 ticks"),
    "rows of events": ("report", "events.parquet", many_rows, "600000 rows; 500000 at most"),
    "text": ("plot", "trace.parquet", long_text, "a text of more than 4096 bytes"),
}


@pytest.mark.parametrize("what", FOREIGN)
def test_a_folder_of_somebody_else_is_data_within_bounds(what: str, coldloop: "Coldloop", mpc: Path) -> None:
    command, name, damage, why = FOREIGN[what]
    damage(mpc / name)
    outcome = coldloop("page" if name == "updates.parquet" else command, mpc)
    assert (outcome.code, len(outcome.complaints)) == (2, 1), outcome
    assert name in outcome.complaints[0]
    assert why in outcome.complaints[0]


@pytest.mark.parametrize("place", ["/dev/zero", "../mpc/inputs/model.json"])
def test_a_manifest_names_files_of_its_folder_alone(place: str, coldloop: "Coldloop", mpc: Path) -> None:
    manifest = json.loads((mpc / "manifest.json").read_text())
    manifest["inputs"]["model"]["file"] = place
    (mpc / "manifest.json").write_text(json.dumps(manifest))
    outcome = coldloop("rerun", mpc)
    assert outcome.code == 2
    assert "outside the folder that names it" in outcome.complaints[-1]


def test_no_file_that_a_configuration_names_is_opened_outside_the_folder(coldloop: "Coldloop", mpc: Path) -> None:
    manifest = json.loads((mpc / "manifest.json").read_text())
    manifest["configuration"] |= {"plant.kind": "refrigerator", "plant.refrigerator.file": "/dev/zero"}
    manifest["hashes"]["configuration_sha256"] = json_digest(manifest["configuration"])
    (mpc / "manifest.json").write_text(json.dumps(manifest))
    complaint = f"coldloop: {mpc / 'manifest.json'}: plant.refrigerator.file: the folder has no copy of it"
    assert coldloop("rerun", mpc).complaints == [complaint]


ENTRIES: Final[dict[str, Any]] = {
    "a list": [], "no name": {"source": "x"}, "a number": {"source": "x", "file": 3}, "outside": "/dev/zero",
    "above": "../mpc/inputs/model.json", "a folder": "inputs", "another one": "inputs/model.json",
}  # fmt: skip


@pytest.mark.parametrize("what", ENTRIES)
def test_a_file_of_the_refrigerator_is_one_of_the_folder(what: str, coldloop: "Coldloop", mpc: Path) -> None:
    entry = ENTRIES[what]
    manifest = json.loads((mpc / "manifest.json").read_text())
    manifest["inputs"]["refrigerator"] = {"source": "x", "file": entry} if isinstance(entry, str) else entry
    (mpc / "manifest.json").write_text(json.dumps(manifest))
    outcome = coldloop("rerun", mpc)
    assert (outcome.code, len(outcome.complaints)) == (2, 1), outcome


WRITTEN: Final = {
    "semicolons, commas in numbers": "time_s;load_w\n0;385,5\n10;445,25\n",
    "UTF-16": LOAD,
    "a byte order mark": "\ufeff" + LOAD,
    "a unit below, empty rows": "time_s,load_w\ns,W\n\n0,385\n\n10,445\n",
    "many digits": "time_s,load_w\n0,385.123456789012345\n1e1,4.45e2\n",
}


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("what", WRITTEN)
def test_the_copy_of_a_load_is_what_was_read(what: str, coldloop: "Coldloop", tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text(WRITTEN[what], encoding="utf-16" if what == "UTF-16" else "utf-8")
    words = ("run", "--in-process", "--load", tmp_path / "load.csv", "--duration", "15s", "--out", tmp_path / "run")
    assert coldloop(*words).code == 0
    assert read_load_file(tmp_path / "run" / "inputs" / "load.csv", COLD_BOX) == read_load_file(
        tmp_path / "load.csv", COLD_BOX
    )
    (tmp_path / "load.csv").unlink()
    assert coldloop("rerun", tmp_path / "run").code == 0


def test_what_a_manifest_says_is_printed_as_printable(coldloop: "Coldloop", runs: Path, mpc: Path) -> None:
    manifest = json.loads((mpc / "manifest.json").read_text())
    manifest["configuration"]["plant.\x1b[31m"] = "\x1b[2J"
    (mpc / "manifest.json").write_text(json.dumps(manifest))
    outcome = coldloop("compare", mpc, runs / "classical", "--out", mpc / "figure.png")
    assert outcome.code == 0
    assert "\x1b" not in outcome.out
    assert "\\x1b[2J" in outcome.out


@pytest.mark.usefixtures("programs")
def test_a_repetition_can_be_kept(coldloop: "Coldloop", mpc: Path, results: Path) -> None:
    assert coldloop("rerun", mpc, "--out", results).code == 0
    assert RunFolder(results).summary["trace_sha256"] == RunFolder(mpc).summary["trace_sha256"]


@pytest.mark.parametrize("name", ["load.csv", "model.json"])
def test_an_input_that_was_changed_is_named(name: str, coldloop: "Coldloop", mpc: Path) -> None:
    file = mpc / "inputs" / name
    file.write_text(file.read_text().replace("385", "386"))
    outcome = coldloop("rerun", mpc)
    assert outcome.code == 2
    (complaint,) = outcome.complaints
    assert str(file) in complaint


def test_a_configuration_that_was_changed_is_named(coldloop: "Coldloop", mpc: Path) -> None:
    manifest = json.loads((mpc / "manifest.json").read_text())
    manifest["configuration"]["plant.seed"] = 3
    (mpc / "manifest.json").write_text(json.dumps(manifest))
    (complaint,) = coldloop("rerun", mpc).complaints
    assert "configuration" in complaint


def test_another_trace_is_told_with_the_versions_that_differ(coldloop: "Coldloop", mpc: Path) -> None:
    manifest = json.loads((mpc / "manifest.json").read_text())
    manifest["hashes"]["trace_sha256"] = "0" * 64
    manifest["dependencies"]["numba"] = "0.1"
    (mpc / "manifest.json").write_text(json.dumps(manifest))
    outcome = coldloop("rerun", mpc)
    assert outcome.code == 1
    assert "another trace" in outcome.out
    assert "instead of 0.1" in outcome.out


@pytest.mark.parametrize("is_copied", [True, False], ids=["a model in the folder", "a model elsewhere"])
def test_a_folder_that_calls_a_plant_of_its_own_a_cold_box_executes_nothing(
    is_copied: bool, mpc: Path, coldloop: "Coldloop", tmp_path: Path  # noqa: FBT001
) -> None:  # fmt: skip
    executed, model = tmp_path / "executed", mpc / "inputs" / "model.json"
    document = json.loads(model.read_text(encoding="utf-8"))
    document |= {"process": COLD_BOX.model_dump(mode="json"), "plant": "python"}
    source = f"open({str(executed)!r}, 'w')\nclass P: ..."
    document["plant_parameters"] = {"source": source, "class": "P", "file": "p.py"}
    document["digest"] = digest_of(document)
    model.write_text(json.dumps(document), encoding="utf-8")
    manifest = json.loads((mpc / "manifest.json").read_text(encoding="utf-8"))
    manifest["configuration"] |= {"plant.kind": "of-process", "model.file": str(model)}
    copy = {"file": "inputs/model.json", "sha256": file_digest(model)} if is_copied else {"file": None, "sha256": None}
    manifest["inputs"]["model"] |= copy
    manifest["hashes"]["configuration_sha256"] = json_digest(manifest["configuration"])
    (mpc / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    outcome = coldloop("rerun", mpc)
    assert (outcome.code, len(outcome.complaints)) != (0, 0)
    assert not executed.exists(), outcome.complaints
