"""Sensors that die while MPC controls: the estimate does without them, and the process stays in its bands."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from coldloop.process.cold_box import L1, OUTPUT_NAMES, T5
from coldloop.process.load_profile import LoadProfile
from coldloop.registers.control_plc import Plan, Update
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.settings import ControlDesign, OptimizerSection, Preset, ProgramSettings
from coldloop_plant.program import PlantProgram
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

BANDS = ControlDesign()
BEGIN, TEN_MINUTES, HALF_HOUR = 1200, 2400, 7200
"""Ticks; sensors die after five minutes."""
OTHERS = [name for output, name in enumerate(OUTPUT_NAMES) if output not in (L1, T5)]

Outside = Callable[..., NDArray[np.bool_]]


@pytest.fixture
def outside(load_a: LoadProfile, monkeypatch: pytest.MonkeyPatch) -> Outside:
    """Return whether L1 and T5 are outside their bands in each tick since sensors showed no number.

    They are `dead` for so many ticks; with `stale` the optimiser gets their last good values. No loop is compiled: what
    the programs see can then be changed.
    """

    def run(
        dead: Sequence[str], ticks: int, preset: Preset = Preset.TUNED, *, stale: bool = False
    ) -> NDArray[np.bool_]:
        one_process = OneProcessRig(
            Settings(optimizer_plc=OptimizerSection(program=ProgramSettings(preset=preset))), compiled=False
        )
        outputs = [OUTPUT_NAMES.index(name) for name in dead]
        missing: set[tuple[int, ...]] = set()
        measure, plan = PlantProgram.measure, OptimizerProgram.plan

        def measured(plant: PlantProgram) -> tuple[float, ...]:
            y = list(measure(plant))
            for output in outputs:
                y[output] = math.nan if BEGIN <= plant.tick < BEGIN + ticks else y[output]
            return tuple(y)

        def planned(program: OptimizerProgram, update: Update) -> Plan:
            missing.add(tuple(np.flatnonzero(np.isnan(update.y)).tolist()))
            process = one_process.control.process
            return plan(program, update._replace(y=process.y) if stale and process is not None else update)

        recorder = Recorder(BEGIN + ticks + TEN_MINUTES)
        with monkeypatch.context() as patch:
            patch.setattr(PlantProgram, "measure", measured)
            patch.setattr(OptimizerProgram, "plan", planned)
            one_process.run(Scenario(BEGIN + ticks + TEN_MINUTES, load_a, 0.0, seed=1), recorder)
        assert missing == {(), tuple(outputs)}
        y = recorder.recording().y[BEGIN:, [L1, T5]]
        return (y < BANDS.output_low) | (y > BANDS.output_high)

    return run


@pytest.mark.night
def test_the_estimate_does_without_a_dead_sensor_whose_last_value_would_mislead_it(outside: Outside) -> None:
    """With the preset `paper` all that a stale pressure shows is taken for state and load; `tuned` adds a constant."""
    assert outside(["P1"], HALF_HOUR, Preset.PAPER, stale=True)[:, 0].any()
    assert not outside(["P1"], HALF_HOUR, Preset.PAPER).any()


@pytest.mark.parametrize("dead", [["P1"], ["V1", "T4", "P2"], OTHERS[-10:]], ids=" ".join)
def test_the_bands_are_kept_without_some_sensors_and_when_they_are_back(outside: Outside, dead: list[str]) -> None:
    assert not outside(dead, TEN_MINUTES).any()


@pytest.mark.night
@pytest.mark.parametrize("dead", OTHERS)
def test_the_bands_are_kept_for_half_an_hour_without_any_one_sensor(outside: Outside, dead: str) -> None:
    assert not outside([dead], HALF_HOUR).any()
