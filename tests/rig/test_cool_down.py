"""A refrigerator is cooled down from 300 K by the programs, until MPC holds it under its load."""

from pathlib import Path

import numpy as np
import pytest

from coldloop.kernels.intrinsics import plain_tuples
from coldloop.process.cold_box import COLD_BOX, L1, STATE_NAMES, STATION_SIGNAL_NAMES, T5
from coldloop.process.settings import DEFAULT_MODEL_FILE
from coldloop_plant.helium import load_helium
from coldloop_plant.kinds import own_header, plant_maker
from coldloop_plant.load import find_load
from coldloop_plant.numeric import RealArray
from coldloop_plant.settings import PlantSettings
from coldloop_refrigerator.program import RefrigeratorProgram
from coldloop_rig import Simulation, simulate
from coldloop_rig.cosim.one_process import load_table
from tests.harness.energy_account import CROSSED, SIZE, WORST, accounted_program_tick
from tests.harness.refrigerator_energy import stored_energy

EXAMPLES = Path(__file__).parents[2] / "examples"
LOAD = EXAMPLES / "cool_down.csv"
HEADER = own_header(DEFAULT_MODEL_FILE)
HELIUM = load_helium()
HELD, LOST = STATION_SIGNAL_NAMES.index("helium"), STATION_SIGNAL_NAMES.index("lost")
AMBIENT_K = 300.0
EVERY = 4000
"""Ticks from one comparison with the run to the next."""


def cooled_down_for(duration: str) -> Simulation:
    return simulate(LOAD, duration_s=duration, config=EXAMPLES / "cool_down.toml")


def assert_balanced(run: Simulation) -> None:
    """The plant with the inputs of a run: its helium is constant, and it has gained what crossed its boundary."""
    section = {"kind": "refrigerator", "refrigerator": {"start": "warm"}}
    maker = plant_maker(HEADER, PlantSettings.model_validate({"plant": section}).plant)
    plant = maker(load_table(find_load(str(LOAD), HEADER.w0, COLD_BOX), COLD_BOX), 1)
    assert isinstance(plant, RefrigeratorProgram)
    parameters, tables, sums = plain_tuples(plant.plant), plain_tuples(HELIUM), np.zeros(4)
    before, block = plant.memory, run.recording.block

    def energy(x: RealArray) -> float:
        return float(stored_energy(x, AMBIENT_K, plant.plant, HELIUM))

    for tick, u in enumerate(block.u.astype(float)):
        m, d = plant.memory, plant.ahead(0)[0]
        d[0] = plant.load
        x = accounted_program_tick(
            m.x, m.y, m.signals, m.equipment, u, m.commands, d, parameters, tables, plant.law.equipment, sums
        )
        if tick % EVERY == 0:
            assert np.array_equal(block.x[tick], m.x[: len(STATE_NAMES)].astype(np.float32))
            assert m.signals[HELD] == pytest.approx(before.signals[HELD], rel=1e-9)
        plant.apply(tuple(u))
        plant.advance()
        assert np.array_equal(x, plant.memory.x)
    assert plant.memory.signals[LOST] == 0.0
    assert sums[WORST] < 1e-6
    assert energy(x) - energy(before.x) == pytest.approx(sums[CROSSED], abs=1e-6 * sums[SIZE])


@pytest.mark.usefixtures("compiles")
def test_a_cool_down_begins_without_a_loss_of_helium_or_energy() -> None:
    run = cooled_down_for("20min")
    assert_balanced(run)
    events = run.events.to_dict()
    assert [str(each) for each in events["subject"]] == ["hold", "turbine", "classical"]


@pytest.mark.night
def test_mpc_takes_over_a_refrigerator_that_was_cooled_down_from_300_k_and_holds_it_under_its_load() -> None:
    run = cooled_down_for("22h")
    events = run.events.to_dict()
    happened = list(zip(events["kind"], events["subject"], events["cause"], strict=True))
    steps = [subject for kind, subject, _ in happened if kind == "cool down"]
    assert steps == ["turbine", "bath", "filling", "settling", "finished"]
    modes = [(subject, cause) for kind, subject, cause in happened if kind == "mode"]
    assert modes == [("hold", "session started"), ("classical", "cool down"), ("mpc", "sequence began")]
    assert len(happened) == len(steps) + len(modes), "no sensor is called bad, and nothing is alarmed"
    block = run.recording.block
    held = block.y[-4 * 7200 :]
    assert np.all(block.load[-4 * 7200 :] > 380.0)
    assert np.all((held[:, L1] >= 59.0) & (held[:, L1] <= 61.0))
    assert np.all((held[:, T5] >= 9.0) & (held[:, T5] <= 16.0))
    assert_balanced(run)
