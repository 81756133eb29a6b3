"""A step test as the source of a plant: what is found in a record, against the system that made it."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.errors import ColdloopError
from coldloop.process.lti_model import discretise
from coldloop_rig.process_file.judgement import described
from coldloop_rig.process_file.making import Made, made_from
from coldloop_rig.process_file.step_test import Record, gains_after, half_widths, identified

Array = NDArray[np.float64]

EXAMPLES: Final = Path(__file__).parents[2] / "examples" / "processes"
PERIOD_S: Final = 5.0
A: Final = np.array([[-0.02, 0.0, 0.0], [0.0, -0.05, 0.0], [0.0, 0.0, -0.1]])
B: Final = np.array([[0.04, 0.0], [0.05, 0.1], [0.0, 0.3]])
C: Final = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, -1.0]])
GAINS: Final = np.array([[2.0, 3.0], [1.0, -1.0]])
"""C (-A)^-1 B, by hand."""
FILE: Final = """
name = "found"
[plant]
step_test = "record.csv"
[[inputs]]
name = "a"
at = 10.0
low = 0.0
high = 20.0
rate = 1.0
[[inputs]]
name = "b"
at = 5.0
low = 0.0
high = 10.0
rate = 1.0
[[outputs]]
name = "y"
range = [-100.0, 200.0]
noise = 0.02
band = [40.0, 60.0]
[[outputs]]
name = "z"
range = [-100.0, 100.0]
noise = 0.02
band = [-10.0, 10.0]
"""


def steps(samples: int, seed: int) -> Array:
    """Return two inputs that step by turns, shape (samples, 2)."""
    random, found = np.random.default_rng(seed), np.empty((samples, 2))
    for column in found.T:
        k = 0
        while k < samples:
            hold = int(random.integers(3, 40))
            column[k : k + hold] = random.choice([-1.0, 0.0, 1.0])
            k += hold
    return found


def answered(u: Array, noise: float = 0.0, a: Array = A) -> Array:
    """Return the outputs of the system about (50, 2), from rest, shape (N, 2)."""
    held, x, y = discretise(a, B, np.zeros(3), PERIOD_S), np.zeros(3), np.empty((len(u), 2))
    for k, row in enumerate(u):
        y[k] = C @ x + (50.0, 2.0)
        x = held.A @ x + held.B @ row
    return y + noise * np.random.default_rng(7).standard_normal(y.shape)


def written(folder: Path, u: Array, y: Array, text: str = FILE) -> Path:
    """Write a record, as a historian does, and its process file."""
    rows = np.column_stack([PERIOD_S * np.arange(len(u)), u + np.array([10.0, 5.0]), y])
    lines = ["time_s,a,b,y,z", *(",".join(f"{value:.6g}" for value in row) for row in rows)]
    (folder / "record.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "process.toml").write_text(text, encoding="utf-8")
    return folder / "process.toml"


def made(file: Path) -> Made:
    """Return what is made from a process file."""
    return made_from(file)


def gains(model: object) -> Array:
    """Return what the outputs rest at for 1 of each input."""
    found: Array = model.C @ np.linalg.solve(-model.A, model.B)  # type: ignore[attr-defined]
    return found


# -- what is found ----------------------------------------------------------------------------------------------------


def test_a_record_without_noise_gives_the_system_that_made_it() -> None:
    u = steps(400, seed=1)
    found = identified(Record(PERIOD_S, u, answered(u), np.zeros(2), ("a", "b"), "here"))
    assert np.sort(np.linalg.eigvals(found.A).real) == pytest.approx([-0.1, -0.05, -0.02], rel=1e-5)
    assert gains(found) == pytest.approx(GAINS, rel=1e-5)
    assert found.fit == pytest.approx([1.0, 1.0], abs=1e-5)
    assert found.constant == pytest.approx([50.0, 2.0], rel=1e-5)
    assert found.rests


def test_noise_leaves_gains_within_some_percent_and_the_slow_poles_near(tmp_path: Path) -> None:
    """Sensors of 0.05 on moves of some 3."""
    u = steps(600, seed=2)
    found = made(written(tmp_path, u, answered(u, noise=0.05)))
    assert gains(found.model) == pytest.approx(GAINS, rel=0.04)
    assert -np.linalg.eigvals(found.model.A).real.max() == pytest.approx(0.02, rel=0.1)
    assert found.model.y0 == pytest.approx([50.0, 2.0], abs=0.1)
    text = described(found)
    assert "of the last third, held back, it explains  y 9" in text
    assert "modes " in text
    assert "gains      all within +- with a probability of 99 %" in text
    (widths,) = re.findall(r"after 300 s of \+1 a: y \S+ \+- (\S+)  z \S+ \+- (\S+)\n", text)
    assert [float(each) for each in widths] == pytest.approx([0.02, 0.015], rel=0.6)


@pytest.mark.night
@pytest.mark.parametrize(("noise", "memory", "samples"), [(0.05, 0.0, 600), (0.1, 0.8, 400), (0.5, 0.0, 400)])
def test_joint_intervals_of_gains_cover_them(noise: float, memory: float, samples: int) -> None:
    """Noise is white, or follows itself with a factor from sample to sample."""
    true, inside, draws = C @ discretise(A, B, np.zeros(3), 300.0).B, 0, 200
    for seed in range(draws):
        u, errors = steps(samples, seed=1000 + seed), np.random.default_rng(seed).standard_normal((samples, 2))
        for k in range(1, len(errors)):
            errors[k] = memory * errors[k - 1] + np.sqrt(1.0 - memory**2) * errors[k]
        record = Record(PERIOD_S, u, answered(u) + noise * errors, np.zeros(2), ("a", "b"), "here")
        found = identified(record)
        inside += bool((np.abs(gains_after(found, 300.0) - true) <= half_widths(record, found, 300.0)).all())
    assert inside >= 0.98 * draws


def test_a_record_in_which_inputs_step_once_each_is_enough() -> None:
    u = np.zeros((300, 2))
    u[20:120, 0], u[160:250, 1], u[270:, 0] = 1.0, 1.0, -1.0
    found = identified(Record(PERIOD_S, u, answered(u, noise=0.01), np.zeros(2), ("a", "b"), "here"))
    assert gains(found) == pytest.approx(GAINS, rel=0.05)


def test_an_oscillation_is_found() -> None:
    """Poles of -0.02 +- 0.1 i."""
    a = np.array([[-0.02, 0.1, 0.0], [-0.1, -0.02, 0.0], [0.0, 0.0, -0.1]])
    u = steps(400, seed=3)
    found = identified(Record(PERIOD_S, u, answered(u, noise=0.01, a=a), np.zeros(2), ("a", "b"), "here"))
    poles = np.linalg.eigvals(found.A)
    nearest = poles[np.argmin(np.abs(poles - (-0.02 + 0.1j)))]
    assert nearest == pytest.approx(-0.02 + 0.1j, abs=1e-3)


def test_a_historian_that_is_faster_than_the_controller_is_averaged(tmp_path: Path) -> None:
    """A record every second of a plant that steps every 5 s."""
    u = steps(400, seed=4)
    file = written(tmp_path, u, answered(u))
    lines = (tmp_path / "record.csv").read_text(encoding="utf-8").splitlines()
    fast = [lines[0]]
    for line in lines[1:]:
        time_s, rest = line.split(",", 1)
        fast += [f"{float(time_s) + k:g},{rest}" for k in range(5)]
    (tmp_path / "record.csv").write_text("\n".join(fast) + "\n", encoding="utf-8")
    assert gains(made(file).model) == pytest.approx(GAINS, rel=1e-3)


def test_the_example_has_the_gains_of_the_equations_that_made_its_record() -> None:
    found, known = (made_from(EXAMPLES / f"quadruple_tank{name}.toml").model for name in ("_record", ""))
    for of in ("B", "F"):
        one, other = (model.C @ getattr(model.discretised(300.0), of) for model in (found, known))
        assert one == pytest.approx(other, rel=0.04, abs=0.03)
    assert found.y0 == pytest.approx(known.y0, abs=0.02)


def test_a_plant_that_does_not_rest_needs_its_outputs_and_then_has_a_model(tmp_path: Path) -> None:
    """A tank: its level is the integral of what flows in."""
    u = steps(400, seed=5)
    y = answered(u)
    y[:, 0] = 50.0 + 0.05 * np.concatenate([[0.0], np.cumsum(u[:-1, 0])])
    with pytest.raises(ColdloopError, match="y needs at"):
        made(written(tmp_path, u, y))
    text = FILE.replace('name = "y"', 'name = "y"\nat = 50.0').replace('name = "z"', 'name = "z"\nat = 2.0')
    model = made(written(tmp_path, u, y, text)).model
    assert np.sort(np.linalg.eigvals(model.A).real) == pytest.approx([-0.1, -0.05, 0.0], abs=1e-4)
    assert (model.C @ model.discretised(100.0).B)[0, 0] == pytest.approx(0.05 * 20, rel=1e-3)


def test_a_record_that_inputs_do_not_explain_is_said_to_be_one(tmp_path: Path) -> None:
    u = steps(400, seed=6)
    y = answered(u)
    y[:, 1] = np.random.default_rng(8).standard_normal(400)
    assert "warning    fit: the record does not explain z" in described(made(written(tmp_path, u, y)))


def test_a_load_that_is_no_column_is_said_to_be_unknown(tmp_path: Path) -> None:
    u = steps(400, seed=9)
    text = FILE + '[load]\nname = "d"\nat = 0.0\nspan = [-1.0, 1.0]\n'
    found = made(written(tmp_path, u, answered(u), text))
    assert not found.model.F.any()
    assert "record.csv has no column d" in described(found)


# -- what is refused --------------------------------------------------------------------------------------------------


CHANGED: Final[dict[str, tuple[int, Callable[[list[str]], str]]]] = {
    "an input that never moves": (2, lambda _: "5"),
    "inputs that move together": (2, lambda row: str(float(row[1]) / 2)),
    "an output that never moves": (3, lambda _: "7"),
    "another unit": (3, lambda row: str(1000.0 * float(row[3]))),
    "time that stands still": (0, lambda _: "0"),
}
"""A column, and what is in it from line to line."""


def edited(lines: list[str], case: str) -> list[str]:
    """Return the lines of a record with something wrong."""
    cells = [line.split(",") for line in lines]
    if case == "too short":
        return lines[:40]
    if case == "a gap":
        return lines[:50] + lines[60:]
    if case == "no column":
        cells[0][3] = "yy"
    if case == "an empty cell":
        cells[30][2] = ""
    if case == "text":
        cells[30][4] = "Bad Input"
    if case in CHANGED:
        column, value = CHANGED[case]
        for row in cells[1:]:
            row[column] = value(row)
    return [",".join(row) for row in cells]


REFUSED: Final = {
    "too short": "39 samples of 5 s are too short a record",
    "a gap": "line 51: 55 s after the line before, others are 5 s apart",
    "no column": "no column y; its header is 'time_s,a,b,yy,z'",
    "an empty cell": "line 31, b: '' is no finite number",
    "text": "line 31, z: 'Bad Input' is no finite number",
    "an input that never moves": "b never moves",
    "inputs that move together": "a and b move together",
    "an output that never moves": "y never moves",
    "another unit": "is outside the range of its sensor, -100 to 200; give the record in the unit of the process file",
    "time that stands still": "time_s does not rise",
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_record_that_cannot_be_used_gets_one_line(case: str, tmp_path: Path) -> None:
    u = steps(300, seed=10)
    file = written(tmp_path, u, answered(u))
    lines = (tmp_path / "record.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "record.csv").write_text("\n".join(edited(lines, case)) + "\n", encoding="utf-8")
    with pytest.raises(ColdloopError) as refused:
        made(file)
    assert REFUSED[case] in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_record_that_is_not_there_gets_one_line(tmp_path: Path) -> None:
    (tmp_path / "process.toml").write_text(FILE, encoding="utf-8")
    with pytest.raises(ColdloopError, match=r"record\.csv: No such file"):
        made(tmp_path / "process.toml")
