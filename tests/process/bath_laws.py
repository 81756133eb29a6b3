"""Prints what the process that is loaded makes of situations in `argv[1]`: `COLDLOOP_PROCESS=MODEL ...`, as JSON.

Signals in situations have their names in the process; inputs and states in the answer are in its order.
"""

import json
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coldloop.process.limits import InputLimits
from coldloop.process.loaded import PROCESS
from coldloop.process.lti_model import load
from coldloop.process.model_settings import DEFAULT_MODEL_FILE
from coldloop.process.signals import INPUT_NAMES, OUTPUT_NAMES
from control_plc.cool_down import CoolDown, CoolDownSettings
from control_plc.sensors import may_stand
from optimizer_plc.computing_settings import SIGNALS
from optimizer_plc.decisions import Latched, begin_again
from optimizer_plc.program import OptimizerProgram
from optimizer_plc.qp.prediction import state_weights
from optimizer_plc.qp.target import bounds_at, find_target, least_warm_load, loads_held
from optimizer_plc.scheme import FEED_TEMPERATURE, TEMPERATURE, most_open, problem_at, shortage
from optimizer_plc.settings import ProgramSettings
from tests.harness.records import Row

Array = NDArray[np.float64]

MODEL = load(DEFAULT_MODEL_FILE)


def measured(y: dict[str, float]) -> list[float]:
    return [y[name] for name in OUTPUT_NAMES]


class Laws:
    """What an optimiser says of a situation."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.program = OptimizerProgram(MODEL, ProgramSettings.model_validate(settings), InputLimits())
        self.c = self.program.constants

    def of(self, given: dict[str, Any]) -> dict[str, list[float]]:
        """Return it by inputs, by states, and by nothing."""
        c = self.c
        x = np.array([*given["states"], *(given["constants"][SIGNALS[place]] for place in self.program.disturbances)])
        u, w = np.array([given["u"][name] for name in INPUT_NAMES]), given["w"]
        y = MODEL.y0 + np.array([given["y"].get(name, 0.0) for name in OUTPUT_NAMES])
        limit = most_open(c, u, y[FEED_TEMPERATURE] - y[TEMPERATURE])
        target = np.zeros(len(PROCESS.inputs))
        find_target(c.target, x, w, given["mismatch"], limit, -1, 0.0, target)
        low, high = bounds_at(c.target, x, limit, -1, 0.0)
        loads = [*loads_held(c.target, low, high), least_warm_load(c.target, low, high)]
        loads += [shortage(c, x, w, MODEL.w0 + part * w, limit, -1, 0.0, 0.0, 0.0) for part in (0.0, 1.0, 3.0)]
        problem = problem_at(c, x, w, u, 1.0, target, limit, -1)
        return {
            "by input": [*target, *problem.high[: c.n_inputs]], "loads": loads, "limit": [limit],
            "rest": self.rest(MODEL.w0 + w, u, y).tolist(),
        }  # fmt: skip

    def rest(self, watts: float, u: Array, y: Array) -> Array:
        """Return where the plant is believed to rest."""
        state, nothing = self.program.state, np.zeros(0)
        latched = Latched(0, 0, 0, watts, MODEL.u0 + u, MODEL.u0 + u, y, MODEL.x0, nothing)
        begin_again(self.c, state, latched, u, False)  # noqa: FBT003 a kernel
        return state.belief.x[: len(MODEL.x0)]


def cool_down(courses: list[dict[str, float]], by_loops: list[float]) -> list[list[float]]:
    """Return after each measurement the step and the wanted inputs."""
    inputs = tuple(MODEL.u0.tolist())
    sequence = CoolDown(CoolDownSettings(settled_s=0.0), InputLimits(), inputs, MODEL.y0.tolist())
    found = []
    for tick, y in enumerate(courses):
        sequence.observe(tick, measured(y))
        found.append([sequence.step, *sequence.wanted(Row(*by_loops))])
    return found


def main() -> None:
    given = json.loads(sys.argv[1])
    laws = Laws(given["settings"])
    answer = {
        "weights": state_weights(MODEL, laws.program.settings.design).tolist(),
        "situations": [laws.of(each) for each in given["situations"]],
        "cool down": cool_down(given["courses"], given["by loops"]),
        "may stand": [
            [name for place, name in enumerate(OUTPUT_NAMES) if may_stand(place, measured(y))] for y in given["courses"]
        ],
    }
    sys.stdout.write(json.dumps(answer, default=float) + "\n")


if __name__ == "__main__":
    main()
