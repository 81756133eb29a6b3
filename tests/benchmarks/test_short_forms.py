"""Benchmarks that measure speed run in a short form and print their figures, which a busy machine may make any."""

import json
import re
import subprocess
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.harness.processes import Processes

FOLDER = Path(__file__).parents[2] / "benchmarks"
PATIENCE_S = 600.0
"""The first one may have to compile the kernels."""

Benchmark = Callable[..., str]


@pytest.fixture
def printed_by(processes: Processes) -> Benchmark:
    """What a benchmark prints."""

    def run(program: str, *arguments: str) -> str:
        pipe = subprocess.PIPE
        ended = processes.python(str(FOLDER / program), *arguments, stdout=pipe, stderr=pipe).ended(PATIENCE_S)
        if ended.code == 1 and "the machine is too busy" in ended.err:
            pytest.skip(ended.err.strip())
        assert ended.code == 0, ended.err
        return ended.out

    return run


def numbers(pattern: str, text: str) -> list[float]:
    return [float(found.replace(",", "")) for found in re.findall(pattern, text, re.MULTILINE)]


TIMED = {
    "ode_iteration.py --problems 20 --minutes 2 --repeat 1": (r"ratio ([0-9.]+)", 1),
    "limits.py --ticks 2400 --repeat 1 --calls 300": (r"([0-9.]+) times the sum", 3),
    "lockstep.py --ticks 200": (r"ratio ([0-9.]+)", 1),
    "start.py --repeat 1": (r"warm: ([0-9.]+) s", 4),
    "run_speed.py --load a --duration 20s --repeat 1": (r"one trace: True()", 2),
}
"""Benchmarks with what they print of it, and how often."""


@pytest.mark.night
@pytest.mark.parametrize("words", TIMED)
def test_a_benchmark_prints_its_figures(words: str, printed_by: Benchmark) -> None:
    """A busy machine decides which they are."""
    pattern, count = TIMED[words]
    text = printed_by(*words.split())
    assert len(re.findall(pattern, text)) == count, text


@pytest.mark.night
def test_all_solvers_take_part_in_the_comparison(printed_by: Benchmark) -> None:
    text = printed_by("qp_solvers.py", "--hours", "e", "--minutes", "5", "--iterations", "5")
    for name in ("ode", "qpoases", "osqp", "fast-gradient", "interior-point", "hybrid", "daqp"):
        assert len(re.findall(rf"^{name} ", text, re.MULTILINE)) == 2 + (name in {"ode", "interior-point"}), text
    for name, module in {"piqp": "piqp", "proxqp": "proxsuite", "clarabel": "clarabel"}.items():
        found = numbers(rf"^{name} .*?([0-9.]+) /\s+[0-9.e+]+\s+[0-9.]+$", text)
        assert found == ([] if find_spec(module) is None else [pytest.approx(1.0, abs=0.02)]), "converged at the end"
        assert (f"without {name}" in text or f", {name}" in text) == (find_spec(module) is None)


@pytest.mark.night
def test_the_problem_for_peers_costs_less_where_every_sample_is_free(printed_by: Benchmark) -> None:
    told = json.loads(printed_by("peer_problem.py"))
    assert len(told["problem"]["A"]) == 28
    (_, free), (_, seven) = told["own"]["every sample"], told["own"]["seven instants"]
    assert 0 < free < seven < 2 * free


def test_a_refrigerator_far_from_rest_is_written_and_drawn(printed_by: Benchmark, tmp_path: Path) -> None:
    case = "5,385 W for 30 s"
    text = printed_by("far_from_rest.py", "write", str(tmp_path / "now"), "--cases", case)
    (made, lost) = numbers(r"(-?[0-9.e+-]+) kg of helium made", text) + numbers(r"([0-9.]+) kg lost", text)
    assert abs(made) < 1e-9, text
    assert 3.0 < lost < 6.0, text
    printed_by("far_from_rest.py", "draw", str(tmp_path / "figure.png"), str(tmp_path / "now"))
    assert (tmp_path / "figure.png").stat().st_size > 1000
