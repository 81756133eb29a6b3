"""Each benchmark that measures speed runs in a short form, and prints figures of the right order."""

import json
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
PATIENCE_S = 600.0
"""The first one may have to compile the kernels."""


def printed_by(*command: str) -> str:
    """Return what a benchmark prints."""
    done = subprocess.run(
        [sys.executable, *command], cwd=FOLDER, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers(pattern: str, text: str) -> list[float]:
    return [float(found.replace(",", "")) for found in re.findall(pattern, text, re.MULTILINE)]


def test_an_ode_iteration_costs_some_cholesky_factorisations() -> None:
    text = printed_by("ode_iteration.py", "--problems", "20", "--minutes", "2", "--repeat", "1")
    (ratio,) = numbers(r"ratio ([0-9.]+)", text)
    assert 0.3 < ratio < 30, text


def test_a_run_takes_a_multiple_of_the_sum_of_its_kernels() -> None:
    text = printed_by("limits.py", "--ticks", "2400", "--repeat", "1", "--calls", "300")
    ratios = numbers(r"([0-9.]+) times the sum", text)
    assert len(ratios) == 3
    assert all(0.5 < ratio < 20 for ratio in ratios), text
    assert all(speed > 50 for speed in numbers(r": ([0-9,]+) times real time", text)), text


def test_all_solvers_take_part_in_the_comparison() -> None:
    text = printed_by("qp_solvers.py", "--hours", "e", "--minutes", "5", "--iterations", "5")
    for name in ("ode", "qpoases", "osqp", "fast-gradient", "interior-point", "hybrid", "daqp"):
        assert len(re.findall(rf"^{name} ", text, re.MULTILINE)) == 2 + (name in {"ode", "interior-point"}), text
    for name, module in {"piqp": "piqp", "proxqp": "proxsuite", "clarabel": "clarabel"}.items():
        found = numbers(rf"^{name} .*?([0-9.]+) /\s+[0-9.e+]+\s+[0-9.]+$", text)
        assert found == ([] if find_spec(module) is None else [pytest.approx(1.0, abs=0.02)]), "converged at the end"
        assert (f"without {name}" in text or f", {name}" in text) == (find_spec(module) is None)


def test_one_process_and_three_leave_one_trace_in_the_speed_benchmark() -> None:
    text = printed_by("run_speed.py", "--load", "a", "--duration", "20s", "--repeat", "1")
    assert text.count("one trace: True") == 2, text


def test_lock_step_is_a_share_of_the_bare_exchanges() -> None:
    text = printed_by("lockstep.py", "--ticks", "200")
    (ratio,) = numbers(r"ratio ([0-9.]+)", text)
    assert 0.01 < ratio < 1, text


def test_programs_start_in_seconds() -> None:
    text = printed_by("start.py", "--repeat", "1")
    seconds = numbers(r"warm: ([0-9.]+) s", text)
    assert len(seconds) == 4, text
    assert all(0.05 < each < 60 for each in seconds), text


def test_the_problem_for_peers_costs_less_where_every_sample_is_free() -> None:
    told = json.loads(printed_by("peer_problem.py"))
    assert len(told["problem"]["A"]) == 28
    (slow, free), (fast, seven) = told["own"]["every sample"], told["own"]["seven instants"]
    assert 0 < free < seven < 2 * free
    assert 0 < fast < slow
