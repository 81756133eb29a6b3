"""What the closed loop costs under a load: J_BF of a run of its natural length."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from coldloop.errors import StudyError
from coldloop.process.lti_model import load
from coldloop_plant.load import find_load
from coldloop_rig.cosim.scenario import Scenario, natural_ticks
from coldloop_rig.results.indicators import evaluate
from coldloop_rig.results.recording import Recorder
from coldloop_rig.settings import Settings

ADAPTIVE: Final = 0.0
"""An updating period, s."""


def loop_cost(settings: Settings, name: str, period_s: float, run: Callable[[Scenario, Recorder], None]) -> float:
    """Return J_BF under a load, a named one or a file, with what runs a scenario."""
    model = load(settings.model.file)
    profile = find_load(name, model.w0, settings.process)
    scenario = Scenario(natural_ticks(name, profile), profile, period_s, settings.plant.seed)
    recorder = Recorder(scenario.ticks)
    run(scenario, recorder)
    return evaluate(recorder.recording(), model, settings.optimizer_plc.program.design).J_BF


def require_costs(costs: ArrayLike) -> None:
    """Refuse costs of which a ratio would say nothing, those of loops in which nothing happens (`StudyError`)."""
    if not np.all(np.asarray(costs) > 0.0):
        raise StudyError(
            "under some load the loop costs nothing (J_BF is 0): with the inputs at rest all outputs stay in their "
            "bands. Give the process a load or disturbances that drive them out, or a setpoint where it does not rest"
        )
