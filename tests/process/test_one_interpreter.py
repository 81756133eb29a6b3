"""Several processes in one interpreter, interleaved and in threads: each leaves what it leaves alone."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import pytest

import coldloop
from coldloop.process.cold_box import COLD_BOX
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_rig import simulate
from coldloop_rig.cli import main
from tests.harness.process_files import COLUMN, TANK

RUNS: Final[dict[str, tuple[Path | None, float]]] = {
    "cold box": (None, 120.0), "tank": (TANK, 240.0), "column": (COLUMN, 3000.0),
}  # fmt: skip
"""Process file and length, s."""


def trace(name: str) -> str:
    process, duration_s = RUNS[name]
    return str(simulate("a", process=process, duration_s=duration_s).summary["trace_sha256"])


@pytest.fixture(scope="module")
def alone() -> dict[str, str]:
    """The trace of each."""
    return {name: trace(name) for name in RUNS}


def test_processes_follow_each_other_in_any_order(alone: dict[str, str]) -> None:
    assert len(set(alone.values())) == len(RUNS)
    for name in ("column", "cold box", "tank", "cold box"):
        assert trace(name) == alone[name], name


def test_processes_run_in_threads_beside_each_other(alone: dict[str, str]) -> None:
    names = 3 * [*RUNS]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(trace, names)) == [alone[name] for name in names]


@pytest.mark.usefixtures("programs")
def test_no_constant_of_a_module_follows_from_the_process_that_is_named_at_its_import() -> None:
    named = [subprocess.Popen(
        (sys.executable, "-P", "-m", "tests.harness.module_constants", file), stdout=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONHASHSEED": "0", "PYTHONPATH": os.pathsep.join(sys.path)},
    ) for file in (TANK, COLUMN)]  # fmt: skip
    of_tank, of_column = (one.communicate()[0].splitlines() for one in named)
    assert len(of_tank) > 1000
    assert of_tank == of_column
    assert not [line for line in of_tank if line.startswith("settings ")]


def test_a_process_is_read_from_either_file_and_the_cold_box_from_its_model() -> None:
    tank = coldloop.Process.read(TANK)
    assert tank.input_names == ("v1", "v2")
    assert tank == coldloop.Process.read(TANK)
    assert coldloop.Process.read(DEFAULT_MODEL_FILE) == COLD_BOX
    assert coldloop.simulate is simulate


def test_a_configuration_from_a_pipe_is_read_once_and_obeyed(capsys: pytest.CaptureFixture[str]) -> None:
    out, into = os.pipe()
    os.write(into, b"[plant]\nseed = 7\n")
    os.close(into)
    try:
        assert main(["config", "--config", f"/dev/fd/{out}"]) == 0
    finally:
        os.close(out)
    assert "plant.seed = 7 " in capsys.readouterr().out
