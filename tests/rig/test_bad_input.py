"""Whatever is asked for wrongly: one line on standard error, the right exit code, no results half written."""

import asyncio
import io
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import coldloop_rig.cosim.networked_run
from coldloop.process.model_file import read_document, write_document
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_rig.__main__ import _open_closed_streams
from tests.harness.processes import Processes

if TYPE_CHECKING:
    from tests.conftest import Coldloop, Outcome
    from tests.rig.conftest import Bus

pytestmark = pytest.mark.usefixtures("programs")

USAGE, FAILURE = 2, 1

RUN = ("run", "--in-process", "--duration", "2s")
DESIGN = "optimizer_plc.program.design."


def assert_refused(outcome: "Outcome", code: int, *parts: str) -> None:
    assert outcome.code == code
    assert len(outcome.complaints) == 1, outcome.complaints
    for part in parts:
        assert part in outcome.complaints[0]


def assert_no_results(folder: Path) -> None:
    assert not folder.exists() or not [path for path in folder.rglob("*") if path.is_file()]


# -- configuration -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("assignment", "parts"),
    [
        ("plant.sead=1", ["plant.sead", "no such key", "coldloop config"]),
        ("plant.seed=-1", ["plant.seed", "greater than or equal to 0", "-1"]),
        ("limits.low=[70,0,20]", ["limits", "below its high"]),
        ("optimizer_plc.program.updating_period_s=0.6", ["updating_period_s", "multiple of 0.25"]),
        ("control_plc.server.port=99999", ["control_plc.server.port", "65535"]),
        ("telemetry.prefix=a/#", ["telemetry.prefix"]),
        (f"{DESIGN}violation_weight=[1e12,1e12]", ["violation_weight", "from 0.001 to 1e+07", "single precision"]),
        (f"{DESIGN}input_scale=[1e-6,50,10]", ["input_scale", "from 0.1 to 1000"]),
        (f"{DESIGN}pressure_scale=1e-6", ["pressure_scale", "from 20 to 200000"]),
        ("optimizer_plc.program.penalties.output_rows=1e12", ["output_rows", "1000000"]),
        ("optimizer_plc.program.ode.alpha=1e12", ["ode.alpha", "at most 3e+08"]),
        ("optimizer_plc.program.adaptive.cost_floor=1e200", ["cost_floor", "1e+18"]),
        ("plant.sensors.level=1e200", ["plant.sensors.level", "3.4e+38"]),
    ],
)
def test_a_wrong_key_or_value_on_the_command_line_is_named(
    assignment: str, parts: list[str], coldloop: "Coldloop", results: Path
) -> None:
    assert_refused(coldloop(*RUN, "--set", assignment, "--out", results), USAGE, "--set", *parts)
    assert not results.exists()


@pytest.mark.parametrize("assignment", ["limits.rate=[100,1000,100]", "optimizer_plc.program.budget.power=1e12"])
def test_a_value_that_is_only_large_runs(assignment: str, coldloop: "Coldloop", results: Path) -> None:
    assert coldloop(*RUN, "--set", assignment, "--out", results).code == 0


def test_a_wrong_configuration_file_is_named(coldloop: "Coldloop", tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_bytes(b"[plant]\nsead = 1\n")
    assert_refused(coldloop(*RUN, "--config", file), USAGE, str(file), "plant.sead", "no such key")


def test_a_configuration_file_that_is_not_there_is_named(coldloop: "Coldloop", tmp_path: Path) -> None:
    for file in (tmp_path, tmp_path / "absent.toml"):
        assert_refused(coldloop(*RUN, "--config", file), USAGE, str(file), "--config")


def test_a_wrong_key_in_the_environment_is_named(coldloop: "Coldloop") -> None:
    outcome = coldloop(*RUN, environment={"COLDLOOP__PLANT__SEAD": "1"})
    assert_refused(outcome, USAGE, "COLDLOOP__PLANT__SEAD", "no such key")


# -- options -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["run", "--duration=-5s"], ["--duration", "-5s", "not positive"]),
        (["run", "--duration", "0"], ["--duration", "not positive"]),
        (["run", "--duration", "0.1s"], ["--duration", "multiple of 0.25 s"]),
        (["run", "--duration", "nan"], ["--duration", "2h"]),
        (["run", "--updating-period", "9"], ["--updating-period", "0.5 to 5"]),
        (["run", "--factor", "nan"], ["--factor", "nan"]),
        (["run", "--attach", "a:1", "b:2", "c:70000"], ["--attach", "HOST:PORT"]),
        (["run", "--in-process", "--mode", "realtime"], ["--in-process", "--mode realtime"]),
        (["run", "--nonsense"], ["--nonsense", "coldloop run --help"]),
        (["config", "--set", "telemetry.broker=broker:1884"], ["telemetry.broker", "telemetry.port"]),
        (["fly"], ["fly", "run"]),
        (["registers", "--format", "xml"], ["--format", "xml", "markdown"]),
    ],
)
def test_a_wrong_option_is_told_with_what_would_be_right(
    arguments: list[str], parts: list[str], coldloop: "Coldloop"
) -> None:
    assert_refused(coldloop(*arguments), USAGE, *parts)


def test_output_that_cannot_show_a_character_shows_another(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    _open_closed_streams()
    stream.write("°C")
    stream.flush()
    assert stream.buffer.getvalue() == b"?C"


def test_a_bad_load_is_told_before_anything_is_made(coldloop: "Coldloop", results: Path, tmp_path: Path) -> None:
    load = tmp_path / "load.csv"
    load.write_text("time_s,load_w\n0,385\n5,nan\n")
    assert_refused(coldloop(*RUN, "--load", load, "--out", results), USAGE, str(load), "line 3", "finite")
    assert not results.exists()


@pytest.mark.parametrize(
    ("command", "part"),
    [
        ("fault melt plant", "melt"), ("fault kill boiler", "optimizer_plc"), ("fault pause plant nan", "nan"),
        ("fault cut broker 1", "broker"), ("fault cut plant 1e9", "3600"), ("fault sensor T99 stuck", "T10"),
        ("fault kill plant --rig far:1 far:2 far:3", "their own machine"), ("record --duration 0", "not positive"),
        ("record --figures bmp", "png"), ("set load nan", "finite"), ("set load 1e9", "10000"),
        ("set load absent.csv", "neither watts nor a file"), ("set load 400 --at -5", "0.25"),
        ("set setpoint cv999 4", "cv155"), ("set volume 11", "acknowledge"), ("set factor 0", "0.01"),
        ("proxy absent.toml --listen 1502 --to a:1", "absent.toml"), ("proxy f.toml --listen 99999 --to a:1", "99999"),
        ("chaos absent", "--list"), ("study nothing", "--list"), ("compare absent absent2", "manifest.json"),
        ("rerun absent.json", "absent.json"), ("page absent", "manifest.json"), ("up --port-base 65535", "65533"),
        ("up --tls absent", "certificates"), ("events --kind party", "alarm-raised"),
        ("budget --power nan", "positive"),
        ("model --set model.file=absent.json", "absent.json"), ("completion cmd", "zsh"),
        ("run --seed 4294967296", "4294967296"), ("run --duration 1e99h", "2h"), ("run --load zz", "2h"),
        ("run --set =1", "no such key"), ("run --set plant.seed=1e400", "finite"),
    ],
)  # fmt: skip
def test_what_each_command_cannot_do_is_one_line(
    command: str, part: str, coldloop: "Coldloop", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = coldloop(*command.split())
    assert_refused(outcome, FAILURE if command.startswith("model") else USAGE, part)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["file", "file/results"])
def test_a_place_where_no_results_can_be_written_is_told(name: str, coldloop: "Coldloop", tmp_path: Path) -> None:
    (tmp_path / "file").write_text("precious")
    assert_refused(coldloop(*RUN, "--out", tmp_path / name), USAGE, str(tmp_path / name), "--out")
    assert (tmp_path / "file").read_text() == "precious"


# -- model files -------------------------------------------------------------------------------------------------------


def other_names(document: dict[str, Any]) -> None:
    document["state_names"][0] = "P_of_another_plant"


def fewer_states(document: dict[str, Any]) -> None:
    n = len(document["x0"]) - 1
    for name in ("A", "A_tick"):
        document[name] = [row[:n] for row in document[name][:n]]
    for name in ("B", "F", "B_tick", "F_tick", "state_names", "state_units", "x0"):
        document[name] = document[name][:n]
    document["C"] = [row[:n] for row in document["C"]]


def fewer_outputs(document: dict[str, Any]) -> None:
    for name in ("output_names", "output_units", "y0", "C", "D", "G"):
        document[name] = document[name][:-1]


def other_parameters(document: dict[str, Any]) -> None:
    document["parameters_digest"] = "0" * 64


Change = Callable[[dict[str, Any]], None]


@pytest.mark.parametrize(
    "change",
    [
        other_names, fewer_states, fewer_outputs, other_parameters,
    ],
)  # fmt: skip
def test_a_model_that_is_not_of_this_plant_is_refused(
    change: Change, coldloop: "Coldloop", results: Path, tmp_path: Path
) -> None:
    document = read_document(DEFAULT_MODEL_FILE)
    change(document)
    file = tmp_path / "model.json"
    write_document(file, document)
    assert_refused(coldloop(*RUN, "--set", f"model.file={file}", "--out", results), FAILURE, str(file))
    assert_no_results(results)


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (b"[" * 100_000, "not a readable model file"),
        (b'{"format":' * 5000 + b"1" + b"}" * 5000, "nested too deeply"),
        (DEFAULT_MODEL_FILE.read_bytes().replace(b'"w0": ', b'"w0": 1'), "digest mismatch"),
    ],
    ids=["deep", "deep and whole", "changed"],
)
def test_a_damaged_model_file_is_refused(
    content: bytes, part: str, coldloop: "Coldloop", results: Path, tmp_path: Path
) -> None:
    file = tmp_path / "model.json"
    file.write_bytes(content)
    outcome = coldloop(*RUN, "--set", f"model.file={file}", "--out", results)
    assert_refused(outcome, FAILURE, str(file), part, "python -m coldloop_plant.cold_box.model")
    assert not results.exists()


def test_a_model_file_that_is_not_there_is_named(coldloop: "Coldloop", tmp_path: Path) -> None:
    for file in (tmp_path, tmp_path / "absent.json"):
        assert_refused(coldloop(*RUN, "--set", f"model.file={file}"), FAILURE, str(file))


# -- the link ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coldloop_rig.cosim.networked_run, "ATTACH_PATIENCE_S", 0.1)


@pytest.fixture
def web_server() -> Iterator[int]:
    """The port of something that answers, but not in Modbus."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                with connection:
                    connection.recv(1000)
                    connection.sendall(b"HTTP/1.0 400 Bad Request\r\n\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


@pytest.mark.usefixtures("impatient")
def test_a_rig_that_is_not_there_is_told(coldloop: "Coldloop", results: Path, free_port: int) -> None:
    nobody = f"127.0.0.1:{free_port}"
    outcome = coldloop("run", "--duration", "2s", "--attach", nobody, nobody, nobody, "--out", results)
    assert outcome.code == FAILURE
    assert outcome.complaints[-1] == f"coldloop: nothing listens as plant at {nobody}: start it, or check host and port"
    assert_no_results(results)


@pytest.mark.usefixtures("impatient")
def test_a_rig_that_is_something_else_is_told(coldloop: "Coldloop", results: Path, web_server: int) -> None:
    other = f"127.0.0.1:{web_server}"
    outcome = coldloop("run", "--duration", "2s", "--attach", other, other, other, "--out", results)
    assert_refused(outcome, FAILURE, f"plant at {other}", "check")
    assert_no_results(results)


def test_a_rig_that_runs_another_model_is_told(
    coldloop: "Coldloop", results: Path, tmp_path: Path, three_processes: "Bus"
) -> None:
    document = read_document(DEFAULT_MODEL_FILE)
    document["B"][0][0] *= 1.001
    file = tmp_path / "model.json"
    write_document(file, document)
    ends = [f"{end.host}:{end.port}" for end in three_processes.endpoints]
    asyncio.run(three_processes.ready())
    outcome = coldloop("run", "--attach", *ends, "--set", f"model.file={file}", "--out", results)
    assert outcome.code == FAILURE
    assert f"plant at {ends[0]} runs model" in outcome.complaints[-1]
    assert "the same model" in outcome.complaints[-1]
    assert_no_results(results)


# -- as a program of its own -------------------------------------------------------------------------------------------


def test_the_program_ends_with_the_code_and_one_line(tmp_path: Path, processes: Processes) -> None:
    words, pipe = ("run", "--set", "model.file=absent.json"), subprocess.PIPE
    ended = processes.coldloop(*words, cwd=tmp_path, stdout=pipe, stderr=pipe).ended()
    assert ended.code == FAILURE
    assert len(ended.err.splitlines()) == 1
    assert "Traceback" not in ended.err
    assert not list(tmp_path.iterdir())
