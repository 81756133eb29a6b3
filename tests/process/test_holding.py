"""How long a plant with a mode that grows can wait for an update: by hand, and against closed loops."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from coldloop_rig.plc_sizing.holding import Waiting, waiting
from coldloop_rig.process_file.judgement import described
from coldloop_rig.process_file.making import Made, made_from
from tests.harness.processes import Processes
from tests.harness.unstable_plants import pendulum, stirred_tank
from tests.process.runs import started

FILE = """
name = "grower"
tick_s = 0.1
ticks_per_sample = 10
plant = {{ matrices = "plant.json" }}
load = {{ name = "wind", at = 0.0, unit = "N", span = [-0.2, 0.2] }}
inputs = [{{ name = "pull", unit = "N", at = 0.0, low = -1.0, high = 1.0, rate = {rate} }}]
outputs = [{{ name = "place", unit = "m", range = [{least}, 100.0], at = 0.0, noise = 0.001, band = [-1.0, 1.0] }}]
prediction = {{ decision_instants = [1, 2, 4, 8, 16], constraint_instants = [1, 2, 4, 8, 16] }}
"""
SCALAR = '{"A": [[0.2]], "B": [[1.0]], "F": [[1.0]], "C": [[1.0]]}'
OSCILLATION = '{"A": [[0.0, 1.0], [-1.0, 0.3]], "B": [[0.0], [1.0]], "F": [[0.0], [1.0]], "C": [[1.0, 0.0]]}'
STILL = "".join(f'[[states]]\nname = "x{k}"\nwalk = 1e-9\n' for k in (1, 2))


def grower(folder: Path, rate: float = 2.0, plant: str = SCALAR, least: float = -100.0) -> Path:
    """Write a process file whose states do not walk."""
    (folder / "plant.json").write_text(plant, encoding="utf-8")
    walks = STILL if plant == OSCILLATION else STILL[: len(STILL) // 2]
    (folder / "process.toml").write_text(FILE.format(rate=rate, least=least) + walks, encoding="utf-8")
    return folder / "process.toml"


def needs(made: Made) -> Waiting | None:
    limits = np.array([[one.low, one.high, one.rate] for one in made.process.inputs]).T
    return waiting(made.model, made.process, limits)


def comes_back(ticks: int, rate: float) -> bool:
    """Return whether z' = 0.2 z + u + w does, when nothing answers a step of w from -0.2 to 0.2 for two periods."""
    grow, z, u, push = np.exp(0.02), 0.0, 0.2, (np.exp(0.02) - 1.0) / 0.2
    for _ in range(2 * ticks):
        z = grow * z + push * (u + 0.2)
    for tick in range(10_000):
        u = max(-1.0, u - rate) if tick % ticks == 0 else u
        z = grow * z + push * (u + 0.2)
        if not 0.0 < z < 100.0:
            return bool(z <= 0.0)
    return False


def test_the_periods_of_a_scalar_by_hand(tmp_path: Path) -> None:
    """1 = 0.2 + k 0.4 (exp(0.4 tau) - 1): tau = 2.747 s for k = 1, and with a reserve, k = 2, 1.733 s."""
    assert needs(made_from(grower(tmp_path))) == pytest.approx((0.2, 1.7, 2.7))


@pytest.mark.parametrize("rate", [0.2, 0.45, 0.6, 1.3])
def test_an_input_with_a_rate_limit_as_it_is_stepped_through(tmp_path: Path, rate: float) -> None:
    found = needs(made_from(grower(tmp_path, rate)))
    longest = max((ticks for ticks in range(1, 60) if comes_back(ticks, rate)), default=0)
    assert found is not None
    assert found.limit_s == pytest.approx(0.1 * longest, abs=0.1001)
    assert 0.0 < found.longest_s < found.limit_s < 2.75


def test_a_sensor_that_ends_before_the_inputs_do(tmp_path: Path) -> None:
    """2 (exp(0.4 tau) - 1) = 2 has tau = 1.733 s."""
    assert needs(made_from(grower(tmp_path, least=-2.0))) == pytest.approx((0.2, 1.0, 1.7))


def test_an_oscillation_that_grows_is_updated_more_than_twice_a_cycle(tmp_path: Path) -> None:
    found = needs(made_from(grower(tmp_path, plant=OSCILLATION)))
    assert found == pytest.approx((0.15, 1.5, 3.1))  # pi / omega is 3.18 s


def test_a_load_beyond_the_inputs_and_a_plant_that_stays(tmp_path: Path) -> None:
    weak, stable = SCALAR.replace("1.0", "6.0", 2).replace("6.0", "1.0", 1), SCALAR.replace("0.2", "-0.2")
    assert "its inputs cannot hold it within the span" in described(made_from(grower(tmp_path, plant=weak)))
    made = made_from(grower(tmp_path, plant=stable.replace("1.0", "2.0", 2)))
    assert needs(made) is None
    assert "no mode grows: no period loses the plant; place leaves its band 3.5 s after" in described(made)


def test_an_oscillation_faster_than_two_sampling_periods_is_named(tmp_path: Path) -> None:
    for omega, is_named in ((25.0, True), (4.0, False)):
        plant = OSCILLATION.replace("-1.0, 0.3", f"-{omega}, -0.1")
        assert (
            "is faster than two sampling periods" in described(made_from(grower(tmp_path, plant=plant)))
        ) is is_named


def test_a_run_says_what_its_period_means_and_enforce_refuses(processes: Processes, tmp_path: Path) -> None:
    file = grower(tmp_path)
    file.write_text(file.read_text(encoding="utf-8").replace("sample = 10", "sample = 30"), encoding="utf-8")
    options = ("run", "--in-process", "--load", "a", "--duration", "3s", "--updating-period", "3", "--out")
    code, told, _ = started(processes, "--process", file, *options, tmp_path / "out")
    assert code == 0
    assert told.startswith(
        "a mode of the plant grows with 0.2 /s: any step of the load is held with updating periods up"
    )
    assert "none above 2.7 s; the updating period is 3 s: it cannot hold this plant" in told
    code, _, complaints = started(processes, "--process", file, *options, tmp_path / "b", "--enforce")
    assert code == 2
    assert "it cannot hold this plant; take a faster PLC" in complaints


# -- closed loops ------------------------------------------------------------------------------------------------------

POWER = "optimizer_plc.program.budget.power=100"
STEPS = {"pendulum": (2.04, (1.0, -1.0)), "stirred-tank": (244.0, (355.0, 345.0))}
"""Between steps of the load from one end of its span to the other, s, which meet periods at any phase."""


def outside(processes: Processes, folder: Path, file: Path, ticks: int, horizon_s: float) -> dict[str, float]:
    """Return the share of time, %, outside the bands with a sampling period, and updating period, of so many ticks."""
    made = made_from(file)
    samples, tick_s = round(horizon_s / (ticks * made.process.tick_s)), made.process.tick_s
    instants = sorted({k for k in (1, 2, 3, 5, 8, 12, 18) if k < samples} | {samples})
    lines = file.read_text(encoding="utf-8").splitlines()
    kept = [f"ticks_per_sample = {ticks}" if line.startswith("ticks_per_sample") else line for line in lines]
    prediction = ["[prediction]", f"decision_instants = {instants}", f"constraint_instants = {instants}"]
    (folder / f"{ticks}.toml").write_text("\n".join(kept + prediction), encoding="utf-8")
    (gap_s, ends), load = STEPS[made.process.name], folder / "load.csv"
    steps = [f"{round((k + 1) * gap_s * 1.013 / tick_s) * tick_s:.6g},{ends[k % 2]}" for k in range(7)]
    load.write_text("\n".join(["time_s,load", f"0,{sum(ends) / 2}", *steps]), encoding="utf-8")
    options = ("--in-process", "--load", str(load), "--duration", f"{round(8 * gap_s):d}s", "--set", POWER)
    period = ("--set", f"optimizer_plc.program.updating_period_s={ticks * tick_s:.6g}", "--solver", "interior-point")
    out = folder / f"out{ticks}"
    code, _, complaints = started(
        processes, "--process", folder / f"{ticks}.toml", "run", "--out", out, *options, *period
    )
    assert code in {0, 3}, complaints  # 3: some update of a loop that is lost has no answer
    found = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    return {one.name: found[f"{one.name}_outside_band_pct"] for one in made.process.banded}


@pytest.mark.night
@pytest.mark.parametrize(("plant", "horizon_s", "name"), [(pendulum, 1.1, "angle"), (stirred_tank, 120.0, "T")])
def test_plants_are_held_at_their_longest_period_and_lost_beyond_their_limit(
    processes: Processes, tmp_path: Path, plant: Callable[[Path], Path], horizon_s: float, name: str
) -> None:
    """The tank is outside its band for as long as a step of 10 K lasts unanswered; it ignites where it is lost."""
    file = plant(tmp_path)
    made = made_from(file)
    found, tick_s = needs(made), made.process.tick_s
    assert found is not None
    held, lost = round(found.longest_s / tick_s), round(1.5 * found.limit_s / tick_s)
    assert outside(processes, tmp_path, file, held, horizon_s)[name] < 50.0
    assert outside(processes, tmp_path, file, lost, horizon_s)[name] > 65.0
