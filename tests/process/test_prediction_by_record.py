"""A model found in a step test, in the closed loop of the plant that the test was made on.

An interpreter is loaded with one process, so each run is a process of its own.
"""

import importlib.util
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.errors import ColdloopError
from coldloop_rig.process_file.judgement import described
from coldloop_rig.process_file.making import made_from
from tests.harness.processes import Processes
from tests.process.runs import run

EXAMPLES: Final = Path(__file__).parents[2] / "examples" / "processes"
AT: Final = {"h1": 12.26, "h2": 12.78}
"""What an operator reads off the tanks at rest."""
QUANTUM_CM: Final = 0.26
"""1 % of the sensors' range."""
SAMPLES: Final = 1200
RATIO: Final = 1.1
"""Of the cost with the model found to that with the true linearisation."""


def tank() -> Any:  # noqa: ANN401 of an example, which is no package
    """Return the equations of the example."""
    path = EXAMPLES / "quadruple_tank.py"
    specification = importlib.util.spec_from_file_location("quadruple_tank", path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module.QuadrupleTank()


def step_test(seed: int) -> NDArray[np.float64]:
    """Return a record: time, two pumps stepped by 0.5 V, the leak, two levels with noise and quantised."""
    equations, random = tank(), np.random.default_rng(seed)
    x, rows = np.array(made_from(EXAMPLES / "quadruple_tank.toml").model.x0), []
    at, step, moved, until = np.array([3.0, 3.0, 0.0]), np.array([0.5, 0.5, 0.5]), np.zeros(3), np.zeros(3)
    for k in range(SAMPLES):
        for i in np.flatnonzero(until <= k):
            moved[i], until[i] = random.choice([-1.0, 0.0, 1.0]), k + random.integers(6, 40)
        given = at + step * moved
        y = np.array(equations.outputs(x, given[:2], given[2])) + 0.02 * random.standard_normal(2)
        rows.append([5.0 * k, *given, *(QUANTUM_CM * np.round(y / QUANTUM_CM))])
        for _ in range(10):  # of half a second, by the rule of the midpoint
            half = x + 0.25 * np.array(equations.derivatives(x, given[:2], given[2]))
            x = x + 0.5 * np.array(equations.derivatives(half, given[:2], given[2]))
    return np.array(rows)


def written(folder: Path, seed: int = 1) -> Path:
    """Write the tank's process file with a model from a record of the tank."""
    lines = [",".join(f"{value:.6g}" for value in row) for row in step_test(seed)]
    (folder / "record.csv").write_text("\n".join(["time_s,v1,v2,leak,h1,h2", *lines]) + "\n", encoding="utf-8")
    for name in ("quadruple_tank.py", "quadruple_tank.toml", "quadruple_tank.svg"):
        (folder / name).write_text((EXAMPLES / name).read_text(encoding="utf-8"), encoding="utf-8")
    file = folder / "quadruple_tank.toml"
    text = file.read_text(encoding="utf-8")
    for name, value in AT.items():
        text = text.replace(f'name = "{name}"', f'name = "{name}"\nat = {value}')
    file.write_text(text + '\n[prediction]\nstep_test = "record.csv"\n', encoding="utf-8")
    return file


def test_a_record_of_another_plant_is_told_by_its_gains(tmp_path: Path) -> None:
    """Levels upside down; and a pump's voltage in tenths."""
    file = written(tmp_path)
    record = tmp_path / "record.csv"
    assert "warning" not in described(made_from(file))
    header, *lines = record.read_text(encoding="utf-8").splitlines()
    rows = np.array([line.split(",") for line in lines], float)
    for changed, told in (
        ([1, 1, 1, 1, -1, 1], "gain: of h1 by v1 -5"),
        ([1, 0.1, 1, 1, 1, 1], "gain: of h2 by v1 26"),
    ):
        moved = rows.mean(axis=0) + (rows - rows.mean(axis=0)) * changed
        moved[:, 0] = rows[:, 0]
        lines = [",".join(f"{value:.6g}" for value in row) for row in moved]
        record.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
        text = described(made_from(file))
        assert f"warning    {told}" in text
        assert "of h2 by v2" not in text
        assert "is the record of this plant" in text


@pytest.mark.parametrize("seed", [1, 7, 8])
@pytest.mark.parametrize(("header", "told"), [("v1,v2,leak,h2,h1", True), ("v2,v1,leak,h1,h2", True),
                                              ("v1,v2,leak,h1,h2", False)])  # fmt: skip
def test_columns_that_are_exchanged_are_told_by_what_the_plant_explains(
    header: str, told: bool, seed: int, tmp_path: Path  # noqa: FBT001
) -> None:  # fmt: skip
    """Gains of the tanks differ by less than a factor of 2 from one pump to the other."""
    file = written(tmp_path, seed)
    record = tmp_path / "record.csv"
    _, _, lines = record.read_text(encoding="utf-8").partition("\n")
    record.write_text(f"time_s,{header}\n{lines}", encoding="utf-8")
    text = described(made_from(file))
    assert all((f"of {name} the plant itself explains" in text) == told for name in ("h1", "h2"))


@pytest.mark.parametrize("load", ["a", pytest.param("c", marks=pytest.mark.night)])
def test_a_model_from_a_step_test_costs_hardly_more_than_the_true_one(
    load: str, processes: Processes, tmp_path: Path
) -> None:
    """Both on the same plant, with the sensors' noise."""
    options = ("--in-process", "--load", load, "--duration", "1h", "--set", "plant.sensors.declared=1")
    true = run(processes, EXAMPLES / "quadruple_tank.toml", tmp_path / "true", *options)
    found = run(processes, written(tmp_path), tmp_path / "found", *options)
    assert found["J_BF"] <= RATIO * true["J_BF"]
    assert found["h1_outside_band_pct"] == found["h2_outside_band_pct"] == 0.0


def test_such_a_plant_is_the_same_over_the_link_and_hides_its_states(processes: Processes, tmp_path: Path) -> None:
    file = written(tmp_path)
    options = ("--load", "a", "--duration", "10min")
    here = run(processes, file, tmp_path / "here", "--in-process", *options)
    there = run(processes, file, tmp_path / "there", *options)
    assert here["trace_sha256"] == there["trace_sha256"]
    found = made_from(file).model
    assert found.plant == "python"
    assert found.plant_parameters["rest"] == pytest.approx([12.263, 12.783, 1.634, 1.409], abs=1e-3)
    assert not found.x0.any()


@pytest.mark.night
def test_a_forecast_is_worth_what_it_is_with_the_true_model(processes: Processes, tmp_path: Path) -> None:
    """A leak from one tick on, and pumps that are slow, 0.02 V in 5 s."""
    (tmp_path / "leak.csv").write_text("time_s,leak,load\n0,0,0\n240,2,2\n", encoding="utf-8")
    options = ("--load", str(tmp_path / "leak.csv"), "--duration", "15min", "--set", "limits.rate_reference=elapsed")
    file = written(tmp_path)
    slow = file.read_text(encoding="utf-8").replace("rate = 0.5", "rate = 0.02")
    file.write_text(slow, encoding="utf-8")
    unknown = run(processes, file, tmp_path / "unknown", "--in-process", *options)
    file.write_text(slow.replace('name = "leak"', 'name = "leak"\nforecast = "leak.csv"'), encoding="utf-8")
    here = run(processes, file, tmp_path / "here", "--in-process", *options)
    there = run(processes, file, tmp_path / "there", *options)
    assert here["trace_sha256"] == there["trace_sha256"]
    assert here["J_BF"] < 0.7 * unknown["J_BF"]


def test_a_load_that_moves_one_output_is_not_taken_for_an_error_of_its_sensor(tmp_path: Path) -> None:
    """By a record the leak moves h2 too, by next to nothing: an error of h1 and the leak hardly differ."""
    assert made_from(written(tmp_path)).process.constants == ("h2",)


def test_a_plant_that_is_a_model_already_needs_no_second_one(tmp_path: Path) -> None:
    text = written(tmp_path).read_text(encoding="utf-8")
    text = text.replace('python = "quadruple_tank.py:QuadrupleTank"', 'step_test = "record.csv"')
    (tmp_path / "both.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ColdloopError, match=r"prediction\.step_test: plant\.matrices and plant\.step_test are a model"):
        made_from(tmp_path / "both.toml")
