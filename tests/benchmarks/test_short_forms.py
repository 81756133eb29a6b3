"""Every benchmark runs in a short form and prints its figures, which a busy machine may make any."""

import json
import re
import subprocess
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.conftest import Coldloop
from tests.harness.processes import Processes

FOLDER, EXAMPLES = (Path(__file__).parents[2] / name for name in ("benchmarks", "examples"))
PATIENCE_S = 600.0
"""The first one may have to compile the kernels."""

Benchmark = Callable[..., str]

SHORT_FORMS = {
    "clock_skew": ("--ppm 200 --factor 200 --hours 0.02", r"\+200 ppm.* at tick \d+"),
    "crowd": ("--flood --clients 5 --seconds 15", r"5 clients and a flood: .* deadline misses\. \d+ answers"),
    "fuzz_servers": ("--frames 300 --bytes 3000", r"(?s)plant .*control_plc .*optimizer_plc "),
    "interrupted_runs": ("--count 2 --only networked --latest 3", r"^0 did not end as they should"),
    "kill_instants": ("--count 1 --gap 60", r"first alarm at most"),
    "lanes": ("--ticks 50 --look-ups 1000 --repeat 1", r"(?s)8 plants: .*independent: ratio [0-9.]+"),
    "long_run_memory": ("--hours 1 --out {folder}/runs", r"^14400 ticks, "),
    "page_crowd": ("--seconds 15 --browsers 2", r"the page and 2 browsers: .* deadline misses\. \S"),
    "page_truth": ("--only single --short", r"single: \d+ compared .*, 0 wrong"),
    "peers": ("--help", r"an interpreter that has Coldloop"),
    "realtime": ("--case 20 20s", r"in 80 scans"),
    "study_workers": ("--duration 20s", r"two workers \d+ s, ratio [0-9.]+"),
}
"""Arguments of those that have no test of their own below, and a pattern of what they print; `peers` needs packages
that are not installed here."""


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


def test_every_benchmark_is_run_by_a_test() -> None:
    named = {
        *SHORT_FORMS,
        *(one.partition(".")[0] for one in TIMED),
        *re.findall(r'printed_by\("(\w+)\.py"', Path(__file__).read_text(encoding="utf-8")),
    }
    parts = {"qp_peers", "page_rig", "bare_link"}  # of qp_solvers, page_truth and lockstep
    assert named | parts == {file.stem for file in FOLDER.glob("*.py")}


@pytest.mark.night
@pytest.mark.parametrize("name", SHORT_FORMS)
def test_a_short_form_ends_and_prints(printed_by: Benchmark, tmp_path: Path, name: str) -> None:
    arguments, pattern = SHORT_FORMS[name]
    text = printed_by(f"{name}.py", *arguments.format(folder=tmp_path).split())
    assert re.search(pattern, text, re.MULTILINE), text


def test_a_dead_sensor_is_noticed(printed_by: Benchmark) -> None:
    text = printed_by("sensor_faults.py", "--outputs", "L1", "--faults", "dead", "--minutes", "6")
    assert re.search(r"^a \| L1 \| dead \| 0 s bad \|", text, re.MULTILINE), text


@pytest.mark.night
@pytest.mark.usefixtures("undrawn")
def test_a_cool_down_is_drawn(printed_by: Benchmark, coldloop: Coldloop, tmp_path: Path) -> None:
    files = ("--config", EXAMPLES / "cool_down.toml", "--load", EXAMPLES / "cool_down.csv")
    assert coldloop("run", "--in-process", *files, "--duration", "1min", "--out", tmp_path / "run").code == 0
    printed_by("cool_down_figure.py", str(tmp_path / "run"), str(tmp_path / "figure.png"))
    assert (tmp_path / "figure.png").stat().st_size > 1000


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
    for name, module in {"piqp": "piqp", "proxqp": "proxsuite", "clarabel": "clarabel", "qpalm": "qpalm"}.items():
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
