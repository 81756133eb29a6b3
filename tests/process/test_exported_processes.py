"""The whole optimiser of another process, exported: its self-tests pass, and on the bus it leaves the trace of ours."""

from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.harness.processes import Processes
from tests.plc_export.c_programs import COMPILERS, NO_COMPILER, compiled, output
from tests.plc_export.st_interpreter import Machine
from tests.plc_export.test_command import FILES
from tests.process.runs import run, started
from tests.process.test_disturbances import FILE, pond

SHIPPED = Path(__file__).parents[2] / "examples" / "processes"
AS_EXPORTED = ("--preset", "paper", "--set", "optimizer_plc.program.arithmetic=float32")
WEATHER = "time_s,rain,draw,leak\n0,0,0,0\n60,1.5,1.0,0\n"


def process_file(name: str, folder: Path) -> Path:
    return pond(folder, FILE, WEATHER) if name == "pond" else SHIPPED / f"{name}.toml"


def exported(processes: Processes, file: Path, target: str, out: Path, ticks: int) -> Path:
    to = ("--target", target, "--out", out, "--ticks", ticks)
    code, _, complaints = started(processes, "--process", file, "export", "plc", *to)
    assert code == 0, complaints
    return out


PROCESSES = ["quadruple_tank", *(pytest.param(name, marks=pytest.mark.night) for name in ("wood_berry", "pond"))]


@pytest.mark.skipif(not COMPILERS, reason=NO_COMPILER)
@pytest.mark.parametrize("name", PROCESSES)
def test_in_c_its_self_test_passes_and_on_the_bus_it_leaves_the_trace_and_the_updates_of_ours(
    processes: Processes, tmp_path: Path, name: str
) -> None:
    file = process_file(name, tmp_path)
    out = exported(processes, file, "c", tmp_path / "out", 600)
    for folder in (out, out / "optimizer", out / "output_guard"):
        code, said = output(compiled(folder, COMPILERS[0], "-O2"))
        assert (code, said[-13:]) == (0, ", 0 failures\n")
    scenario = (*AS_EXPORTED, "--load", "e", "--duration", "600")
    ours = run(processes, file, tmp_path / "ours", "--in-process", *scenario)
    theirs = run(processes, file, tmp_path / "theirs", "--optimizer", f"export:{out}", *scenario)
    assert ours["trace_sha256"] == theirs["trace_sha256"]
    updates = [pq.read_table(tmp_path / way / "updates.parquet") for way in ("ours", "theirs")]
    assert updates[0].equals(updates[1])
    assert updates[0].num_rows > 10


@pytest.mark.night
def test_in_structured_text_its_self_tests_pass(processes: Processes, tmp_path: Path) -> None:
    out = exported(processes, process_file("pond", tmp_path), "st", tmp_path / "out", 600)
    for folder in ("optimizer/", "output_guard/"):
        texts = [name for name in FILES["st"] if name.startswith(folder) and name.endswith(".st")]
        test = Machine(*((out / name).read_text() for name in texts)).instance("cl_self_test")
        test.run = True
        while not (test.done or test.failures):
            test.run_()
        assert (test.done, test.passed, test.what) == (True, True, 0)


def test_with_a_forecast_it_is_the_solver_alone_and_says_so(processes: Processes, tmp_path: Path) -> None:
    file = pond(tmp_path, FILE.replace('name = "rain"', 'name = "rain"\nforecast = "weather.csv"'), WEATHER)
    out = exported(processes, file, "c", tmp_path / "out", 600)
    assert not (out / "optimizer").exists()
    readme = (out / "README.md").read_text()
    assert "The whole optimiser is not here" in readme
    assert "optimizer/" not in readme
