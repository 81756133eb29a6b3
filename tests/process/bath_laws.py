"""Prints what the process that is loaded makes of situations in `argv[1]`: `COLDLOOP_PROCESS=MODEL ...`, as JSON.

Signals in situations have their names in the process; inputs and states in the answer are in its order.
"""

import json
import sys
from typing import Any

import numpy as np

from coldloop.process.limits import InputLimits
from coldloop.process.loaded import PROCESS
from coldloop.process.lti_model import load
from coldloop.process.model_settings import DEFAULT_MODEL_FILE
from coldloop.process.signals import OUTPUT_NAMES
from coldloop.registers.control_plc import SequenceRow
from control_plc.cool_down import CoolDown, CoolDownSettings
from control_plc.sensors import may_stand
from optimizer_plc.computing_settings import SIGNALS, EstimatorSettings
from optimizer_plc.qp.design import ControlDesign, Target
from optimizer_plc.qp.prediction import PredictionModel, state_weights
from optimizer_plc.qp.target import bounds_at, find_target, least_warm_load, loads_held, target_search

MODEL = load(DEFAULT_MODEL_FILE)


def targets(given: dict[str, Any], design: ControlDesign) -> list[list[float]]:
    """Return for each situation its target, the least and largest load that can be held, and the least warm one."""
    disturbed = EstimatorSettings(disturbances=tuple(given["disturbed"])).disturbed
    prediction = PredictionModel(MODEL).with_disturbances(disturbed)
    search = target_search(prediction, design, InputLimits())
    found = []
    for each in given["situations"]:
        x = np.array([*each["states"], *(each["constants"][SIGNALS[place]] for place in disturbed)])
        target = np.zeros(len(PROCESS.inputs))
        find_target(search, x, each["w"], each["mismatch"], each["most_open"], target)
        low, high = bounds_at(search, x, each["most_open"])
        found.append([*target.tolist(), *loads_held(search, low, high), least_warm_load(search, low, high)])
    return found


def measured(y: dict[str, float]) -> list[float]:
    return [y[name] for name in OUTPUT_NAMES]


def cool_down(courses: list[dict[str, float]], by_loops: list[float]) -> list[list[float]]:
    """Return after each measurement the step and the wanted inputs."""
    bands = tuple((band.low, band.high) for band in PROCESS.bands)
    inputs = tuple(MODEL.u0.tolist())
    sequence = CoolDown(CoolDownSettings(settled_s=0.0), InputLimits(), inputs, MODEL.y0.tolist(), bands)
    found = []
    for tick, y in enumerate(courses):
        sequence.observe(tick, measured(y))
        found.append([sequence.step, *sequence.wanted(SequenceRow(*by_loops))])
    return found


def main() -> None:
    given = json.loads(sys.argv[1])
    design = ControlDesign(target=Target.LOAD, band_margin=(0.1, 0.1), **given["design"])
    answer = {
        "weights": state_weights(MODEL, design).tolist(),
        "targets": targets(given, design),
        "cool down": cool_down(given["courses"], given["by loops"]),
        "may stand": [
            [name for place, name in enumerate(OUTPUT_NAMES) if may_stand(place, measured(y))] for y in given["courses"]
        ],
    }
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
