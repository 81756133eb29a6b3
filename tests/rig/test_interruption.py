"""What is left of a run that a signal, a failure or a full disk ended: records that can be read and say so."""

import json
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import pyarrow.parquet as pq
import pytest

import coldloop_rig.results.file_sinks
from coldloop.errors import LinkError
from coldloop.registers.optimizer_plc import Optimization
from coldloop.registers.plant import PlantSample
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.results.recording import BLOCK_TICKS, KEPT_TICKS, Recorder, SampleBlock, Sink
from tests.harness.processes import Process, Processes

if TYPE_CHECKING:
    from tests.conftest import Coldloop

PATIENCE_S = 300.0
"""The first run on a machine compiles the kernels."""


def read(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return document


def assert_incomplete_but_readable(folder: Path, reason: str) -> int:
    """Check all files of a run; return its number of ticks."""
    summary, manifest = read(folder / "summary.json"), read(folder / "manifest.json")
    for document in (summary, manifest):
        assert document["complete"] is False
        assert reason in document["reason"]
    frame = pd.read_parquet(folder / "trace.parquet")
    assert len(frame) == summary["ticks"] == manifest["recorded_ticks"] < manifest["ticks"]
    assert frame["tick"].tolist() == list(range(len(frame)))
    updates = pq.read_table(folder / "updates.parquet").to_pylist()
    assert len(updates) == summary["updates"]
    assert all(row["time_s"] + row["tau_u_s"] < len(frame) / 4 for row in updates)
    assert (folder / "run.png").read_bytes().startswith(b"\x89PNG")
    return len(frame)


SOON_ON_DISK = """
import sys, coldloop_rig.results.file_sinks
coldloop_rig.results.file_sinks.GROUP_TICKS = coldloop_rig.results.file_sinks.HELD_BACK_TICKS = 512
from coldloop_rig.__main__ import main
sys.exit(main())
"""
"""The program `coldloop`, which writes ticks in small groups: the first ones are in the file after two minutes."""


INTERRUPTED = [
    pytest.param(("--in-process",), signal.SIGTERM, id="in process, SIGTERM"),
    pytest.param((), signal.SIGINT, id="networked, SIGINT", marks=pytest.mark.night),
    pytest.param((), signal.SIGTERM, id="networked, SIGTERM", marks=pytest.mark.night),
    pytest.param(("--in-process",), signal.SIGINT, id="in process, SIGINT", marks=pytest.mark.night),
    pytest.param(("--in-process",), signal.SIGHUP, id="in process, terminal closed", marks=pytest.mark.night),
]


@pytest.mark.parametrize(("way", "number"), INTERRUPTED)
def test_a_signal_in_the_middle_leaves_what_was_recorded(
    way: tuple[str, ...], number: signal.Signals, tmp_path: Path, processes: Processes
) -> None:
    out = tmp_path / "run"
    words = ("run", *way, "--load", "6h", "--duration", "1000h", "--figures", "png", "--out", str(out))
    run = processes.python("-c", SOON_ON_DISK, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + PATIENCE_S
    while not (out / "trace.parquet").exists() or (out / "trace.parquet").stat().st_size < 20_000:
        assert run.alive, run.ended()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    run.popen.send_signal(number)
    ended = run.ended(PATIENCE_S)
    assert ended.code == 128 + number
    assert "Traceback" not in ended.err
    assert f"interrupted by {number.name}" in ended.err.splitlines()[-1]
    assert assert_incomplete_but_readable(out, f"interrupted by {number.name}") >= 512


@pytest.mark.parametrize("delay_s", [0.05, 0.3, 0.8])
def test_ctrl_c_before_there_is_anything_to_record_leaves_nothing(
    delay_s: float, tmp_path: Path, processes: Processes
) -> None:
    words = ("run", "--in-process", "--load", "6h", "--out", tmp_path / "run")
    run = processes.coldloop(*words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    time.sleep(delay_s)
    run.popen.send_signal(signal.SIGINT)
    ended = run.ended(PATIENCE_S)
    if ended.code == 130:
        assert "Traceback" not in ended.err
    else:  # the interpreter itself was not up yet: what it says then is its own
        assert ended.code == -signal.SIGINT or "KeyboardInterrupt" in ended.err, ended


def in_one_process(done: str, out: Path, processes: Processes) -> Process:
    """Start a run whose rig does something else that never returns, and says so in a line before."""
    program = f"""
import sys
from coldloop.errors import foreign
from coldloop.registers.plant import PlantSample
from coldloop_rig.cosim.one_process import OneProcessRig

def stuck(self, scenario, recorder):
    {done}

OneProcessRig.run = stuck
from coldloop_rig.__main__ import main
sys.exit(main())
"""
    words = ("run", "--in-process", "--load", "6h", "--out", str(out))
    run = processes.python("-c", program, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert run.popen.stdout is not None
    assert run.popen.stdout.readline() == "stuck\n"
    return run


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_run_that_compiles(number: signal.Signals, tmp_path: Path, processes: Processes) -> None:
    """As a compiler does, a sum of the interpreter calls no handler until it is done."""
    run = in_one_process("print('stuck', flush=True); sum(range(10**15))", tmp_path / "run", processes)
    run.popen.send_signal(number)
    assert run.ended().code == -number


def test_a_signal_ends_a_run_in_code_of_others_that_does_not_return(tmp_path: Path, processes: Processes) -> None:
    tick = "recorder.sample(PlantSample(0, 385.0, (43.0, 75.0, 36.0), (1.0,) * 22, (1.0,) * 28))"
    solver = "with foreign('solver'):\n        print('stuck', flush=True)\n        while True: pass"
    run = in_one_process(f"{tick}\n    {solver}", tmp_path / "run", processes)
    run.popen.send_signal(signal.SIGTERM)
    ended = run.ended()
    assert (ended.code, "interrupted by SIGTERM; 1 of " in ended.err) == (143, True), ended
    assert read(tmp_path / "run" / "manifest.json")["recorded_ticks"] == 1


def test_a_command_ends_though_nobody_can_be_told(processes: Processes) -> None:
    program = "import os; from coldloop_rig.interruption import end_at_once; os.close(2); end_at_once(1)"
    assert processes.python("-c", program).ended(PATIENCE_S).code == 129


def fail_after(ticks: int, error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the recorder of the next run raise an error in the middle, when it has taken so many ticks."""
    take = Recorder.stretch

    def stretch(recorder: Recorder, block: SampleBlock, updates: Sequence[Optimization]) -> None:
        take(recorder, block, updates)
        if recorder.next_tick >= ticks:
            raise error

    monkeypatch.setattr(Recorder, "stretch", stretch)


@pytest.mark.usefixtures("programs")
def test_a_failure_in_the_middle_leaves_what_was_recorded(
    coldloop: "Coldloop", results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_after(BLOCK_TICKS, LinkError("the plant is gone"), monkeypatch)
    outcome = coldloop("run", "--in-process", "--duration", "5min", "--out", results)
    assert outcome.code == 1
    assert outcome.complaints[-1] == (
        f"coldloop: the plant is gone; {BLOCK_TICKS} of 1200 ticks are recorded in {results}"
    )  # fmt: skip
    assert assert_incomplete_but_readable(results, "the plant is gone") == BLOCK_TICKS


@pytest.mark.usefixtures("programs")
def test_a_failure_before_the_first_tick_leaves_no_folder(
    coldloop: "Coldloop", results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise LinkError("nobody there")

    monkeypatch.setattr(OneProcessRig, "run", fail)
    outcome = coldloop("run", "--in-process", "--duration", "5min", "--out", results)
    assert (outcome.code, outcome.complaints) == (1, ["coldloop: nobody there"])
    assert not results.exists()


class SmallDisk:
    """Lets the files of a run grow to a limit, then tells that the disk is full until the reserve is free."""

    def __init__(self, limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self._limit = limit
        write = coldloop_rig.results.file_sinks.ReservedFile.write

        def limited(file: coldloop_rig.results.file_sinks.ReservedFile, data: bytes) -> int:
            self._limit -= len(data)
            if self._limit < 0 and not file._reserve.released:  # noqa: SLF001
                file._reserve.release()  # noqa: SLF001
            return write(file, data)

        monkeypatch.setattr(coldloop_rig.results.file_sinks.ReservedFile, "write", limited)


@pytest.mark.usefixtures("compiles", "programs")
def test_a_disk_that_fills_up_leaves_what_was_recorded(
    coldloop: "Coldloop", results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    SmallDisk(1_000_000, monkeypatch)
    monkeypatch.setattr(coldloop_rig.results.file_sinks, "GROUP_TICKS", 1024)
    outcome = coldloop("run", "--in-process", "--load", "a", "--figures", "png", "--out", results)
    assert outcome.code == 1
    assert "the disk is full" in outcome.complaints[-1]
    assert assert_incomplete_but_readable(results, "the disk is full") > 3000


class Counter(Sink):
    """Counts ticks, and fails at a block."""

    def __init__(self, *, fails: bool) -> None:
        self.ticks = 0
        self._fails = fails

    def block(self, block: SampleBlock) -> None:
        self.ticks += len(block.load)
        if self._fails:
            raise OSError(5, "broken")


def test_a_sink_that_fails_does_not_keep_blocks_from_the_others() -> None:
    sinks = [Counter(fails=True), Counter(fails=False)]
    recorder = Recorder(2000, sinks)
    sample = PlantSample(0, 0.0, (0.0,) * 3, (0.0,) * 22, (0.0,) * 28)
    for tick in range(BLOCK_TICKS + KEPT_TICKS - 1):
        recorder.sample(sample._replace(tick=tick))
    with pytest.raises(OSError, match="broken"):
        recorder.sample(sample._replace(tick=BLOCK_TICKS + KEPT_TICKS - 1))
    assert [sink.ticks for sink in sinks] == [BLOCK_TICKS, BLOCK_TICKS]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_while_modules_are_imported_is_no_traceback(number: signal.Signals, processes: Processes) -> None:
    program = (
        "import os, sys\n"
        "from importlib.abc import MetaPathFinder\n"
        "class Interrupting(MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        f"        if name == 'coldloop_rig.cli': os.kill(os.getpid(), {number.value})\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        "from coldloop_rig.__main__ import main\n"
        "main()\n"
    )
    ended = processes.python("-c", program, stderr=subprocess.PIPE).ended()
    assert (ended.code, ended.err) == (128 + number, "coldloop: interrupted\n")
