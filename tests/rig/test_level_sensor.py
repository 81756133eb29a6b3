"""L1 stuck behind its noise, frozen or spiking while MPC controls: noticed, and the true level stays in its band."""

import numpy as np
import pytest

from coldloop.process.cold_box import COLD_BOX, L1, OUTPUT_UNITS
from coldloop.registers.common import EventKind
from coldloop_optimizer_plc.settings import ControlDesign
from coldloop_plant.load import find_load
from coldloop_plant.program import PlantProgram
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

LOW, HIGH = (band[0] for band in (ControlDesign().output_low, ControlDesign().output_high))
SIGMA = np.array([{"%": 0.01, "Hz": 1.0, "K": 0.02, "bar": 0.001}[unit] for unit in OUTPUT_UNITS])
BEGIN, TEN_MINUTES, TICKS = 1200, 2400, 4800
"""Ticks."""
SUSPECT, BAD = 2, 1


@pytest.mark.parametrize(
    ("fault", "noticed"), [("held", SUSPECT), ("frozen", BAD), ("spiking", None), ("none", None)], ids=str
)
def test_a_level_sensor_fails(monkeypatch: pytest.MonkeyPatch, fault: str, noticed: int | None) -> None:
    """Before these rules the level was outside its band for 70 % of the time where it was held."""
    rng, measure = np.random.default_rng(4), PlantProgram.measure
    drawn, held, true = {-1: np.zeros(len(SIGMA))}, {}, []

    def measured(plant: PlantProgram) -> tuple[float, ...]:
        tick, exact = plant.tick, np.array(measure(plant))
        if tick not in drawn:
            drawn[tick] = SIGMA * rng.normal(size=len(SIGMA))
            true.append(exact[L1])
        y = exact + drawn[tick]
        if tick >= BEGIN:
            held.setdefault("held", exact[L1])
            held.setdefault("frozen", y[L1])
            spike = 5.0 * (-1) ** tick * (tick % 53 == 0)
            y[L1] = {"held": held["held"] + drawn[tick][L1], "frozen": held["frozen"], "spiking": y[L1] + spike}.get(
                fault, y[L1]
            )
        return tuple(y.tolist())

    monkeypatch.setattr(PlantProgram, "measure", measured)
    settings = Settings()
    rig = OneProcessRig(settings, compiled=False)
    rig.run(Scenario(TICKS, find_load("e@100", 385.0, COLD_BOX), 0.0, seed=1), Recorder(TICKS))
    events = [event for event in rig.control.journal.since(0) if event.kind == EventKind.SENSOR]
    assert [(event.subject, event.cause) for event in events[:1]] == ([] if noticed is None else [(L1, noticed)])
    assert all(event.tick <= BEGIN + TEN_MINUTES for event in events[:1])
    assert len(events) <= 1
    level = np.array(true)[BEGIN:TICKS]
    assert LOW <= level.min() <= level.max() <= HIGH
