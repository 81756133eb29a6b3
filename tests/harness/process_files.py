"""Process files of tests, in a folder of their own: shipped ones, and small ones that have what those have not."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np

EXAMPLES: Final = Path(__file__).parents[2] / "examples" / "processes"
TANK, COLUMN = EXAMPLES / "quadruple_tank.toml", EXAMPLES / "wood_berry.toml"
OUTSIDE: Final = """
[load]
name = "feed"
at = 0.5
span = [-1.0, 2.0]
[[disturbances]]
name = "rain"
at = 0.0
span = [-1.0, 1.0]
noise = 0.01
course = "course.csv"
[[disturbances]]
name = "draw"
at = 0.2
span = [-1.0, 1.0]
[[disturbances]]
name = "wind"
at = 0.0
span = [-1.0, 1.0]
noise = 0.01
course = "course.csv"
"""
SIGNALS: Final = """
[[inputs]]
name = "u0"
at = 1.0
low = 0.0
high = 2.0
rate = 0.1
[[inputs]]
name = "u1"
at = 1.0
low = 0.0
high = 2.0
rate = 0.1
[[outputs]]
name = "y0"
at = 5.0
range = [-50.0, 50.0]
noise = 0.01
setpoint = 5.1
tolerance = 0.05
[[outputs]]
name = "y1"
at = 3.0
range = [-50.0, 50.0]
noise = 0.01
"""


def made(folder: Path, *, inputs: int, outputs: int, tick_s: float, load: bool, states: int = 6) -> Path:
    """Write a process of random stable matrices with so many signals; each output of an even place has a band."""
    random = np.random.default_rng(inputs + 10 * outputs)
    time_s = 40.0 * tick_s * (1.0 + np.arange(states))
    A = -np.diag(1.0 / time_s)
    B = random.uniform(0.5, 1.5, (states, inputs)) / time_s[:, None]
    C = random.uniform(0.2, 1.0, (outputs, states))
    np.savez(folder / "matrices.npz", A=A, B=B, C=C, F=(1.0 / time_s) * load)
    lines = [f'name = "made-{inputs}-{outputs}"', f"tick_s = {tick_s}", "[plant]", 'matrices = "matrices.npz"']
    for i in range(inputs):
        lines += ["[[inputs]]", f'name = "u{i}"', "at = 1.0", "low = 0.0", "high = 2.0", "rate = 0.1"]
    for i in range(outputs):
        lines += ["[[outputs]]", f'name = "y{i}"', "at = 5.0", "range = [-50.0, 50.0]", "noise = 0.01", "weight = 0.1"]
        lines += ["band = [4.5, 5.5]"] * (i % 2 == 0)
    if load:
        lines += ["[load]", 'name = "d"', "at = 0.0", "span = [-1.0, 1.0]"]
    (folder / "process.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder / "process.toml"


def small(folder: Path) -> Path:
    return made(folder, inputs=1, outputs=1, tick_s=0.01, load=False)


def large(folder: Path) -> Path:
    """Return one with bands that several outputs leave at times."""
    file = made(folder, inputs=6, outputs=10, tick_s=60.0, load=True)
    text = file.read_text(encoding="utf-8").replace("[4.5, 5.5]", "[4.98, 5.02]")
    file.write_text(text, encoding="utf-8")
    return file


def short_samples(folder: Path) -> Path:
    file = made(folder, inputs=3, outputs=5, tick_s=1.0, load=True)
    file.write_text("ticks_per_sample = 7\n" + file.read_text(encoding="utf-8"), encoding="utf-8")
    return file


def disturbed(folder: Path, plant: str) -> Path:
    """Return one of two inputs and outputs, a load, three disturbances of which two are measured, and a setpoint."""
    lines = ["time_s,rain,wind", "0,0,0", "60,0.5,0", "75.5,0.4,-0.5", "200,0,-0.5"]
    (folder / "course.csv").write_text("\n".join(lines), encoding="utf-8")
    file = folder / "process.toml"
    file.write_text(f'name = "disturbed"\n{plant}{SIGNALS}{OUTSIDE}', encoding="utf-8")
    return file


def matrices(folder: Path) -> Path:
    np.savez(
        folder / "matrices.npz", A=[[-0.05, 0.01], [0.0, -0.02]], B=[[0.05, 0.01], [0.0, 0.03]],
        C=[[1.0, 0.2], [0.0, 1.0]], F=[[0.02, 0.01, 0.01, 0.0], [0.0, 0.01, 0.0, 0.02]],
    )  # fmt: skip
    return disturbed(folder, '[plant]\nmatrices = "matrices.npz"\n')


def foreseen(folder: Path) -> Path:
    file = matrices(folder)
    (folder / "forecast.csv").write_text("time_s,feed\n0,0.5\n120,1.4\n", encoding="utf-8")
    text = file.read_text(encoding="utf-8").replace("[load]", '[load]\nforecast = "forecast.csv"')
    file.write_text(text, encoding="utf-8")
    return file


def lags(folder: Path) -> Path:
    delays = {"y0 u0": 3, "y0 feed": 0, "y1 u1": 0, "y1 rain": 7.5, "y0 draw": 1, "y0 wind": 2}
    lag = "[[plant.transfer_functions]]\noutput = {!r}\nsource = {!r}\ngain = 0.7\ntime_constant_s = 15\ndelay_s = {}\n"
    return disturbed(folder, "".join(lag.format(*pair.split(), delay) for pair, delay in delays.items()))


def fmu(folder: Path, *options: str) -> Path:
    """Build the example that is an FMU; return its process file."""
    for name in ("quadruple_tank.py", "quadruple_tank_fmu.py", "quadruple_tank_fmu.toml"):
        shutil.copy(EXAMPLES / name, folder)
    command = [sys.executable, "-m", "pythonfmu", "build", "-f", "quadruple_tank_fmu.py", *options, "quadruple_tank.py"]
    subprocess.run(command, check=True, cwd=folder, capture_output=True)
    return folder / "quadruple_tank_fmu.toml"


PROCESSES: Final[Mapping[str, Callable[[Path], Path]]] = {
    "tank": lambda _: TANK, "column": lambda _: COLUMN, "small": small, "large": large, "matrices": matrices,
    "foreseen": foreseen, "lags": lags, "short samples": short_samples,
    "record": lambda _: EXAMPLES / "quadruple_tank_record.toml", "fmu": fmu,
}  # fmt: skip
"""Functions that make the process file in a folder, by the name of the process."""
