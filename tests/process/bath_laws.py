"""What a process with a bath makes of situations.

Signals in situations have their names in the process; inputs and states in the answer are in its order.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coldloop.process.declaration import Process
from coldloop.process.lti_model import LtiModel, load
from coldloop.process.settings import InputLimits, settings_of
from coldloop_control_plc.program import ControlProgram, OperatingPoint
from coldloop_control_plc.scan import cool, follow_cool_down, want
from coldloop_control_plc.sensors import SensorCheckSettings, SensorMonitor, may_stand
from coldloop_control_plc.settings import ControlSection, CoolDownSettings
from coldloop_optimizer_plc.computing_settings import signals_of
from coldloop_optimizer_plc.decisions import Latched, begin_again, most_open, shortage
from coldloop_optimizer_plc.program import OptimizerProgram
from coldloop_optimizer_plc.qp.prediction import bounds_at, find_target, least_warm_load, loads_held, state_weights
from coldloop_optimizer_plc.scheme import problem_at
from coldloop_optimizer_plc.settings import ProgramSettings

Array = NDArray[np.float64]


def measured(process: Process, y: dict[str, float]) -> list[float]:
    return [y[name] for name in process.output_names]


class Laws:
    """What an optimiser says of a situation."""

    def __init__(self, model: LtiModel, settings: dict[str, Any]) -> None:
        self.model, self.process = model, model.declared
        self.program = OptimizerProgram(model, ProgramSettings.model_validate(settings), InputLimits())
        self.c = self.program.constants

    def of(self, given: dict[str, Any]) -> dict[str, list[float]]:
        """Return it by inputs, by states, and by nothing."""
        c = self.c
        x = np.array(
            [
                *given["states"],
                *(given["constants"][signals_of(self.process)[place]] for place in self.program.disturbances),
            ]
        )
        u, w = np.array([given["u"][name] for name in self.process.input_names]), given["w"]
        y = self.model.y0 + np.array([given["y"].get(name, 0.0) for name in self.process.output_names])
        limit = most_open(c, u, y[c.feed_temperature] - y[c.temperature])
        target = np.zeros(len(self.process.inputs))
        find_target(c.target, x, w, given["mismatch"], limit, -1, 0.0, target)
        low, high = bounds_at(c.target, x, limit, -1, 0.0)
        loads = [*loads_held(c.target, low, high), least_warm_load(c.target, low, high)]
        loads += [shortage(c, x, w, self.model.w0 + part * w, limit, -1, 0.0, 0.0, 0.0) for part in (0.0, 1.0, 3.0)]
        problem = problem_at(c, x, w, u, 1.0, target, limit, -1)
        return {
            "by input": [*target, *problem.high[: c.n_inputs]], "loads": loads, "limit": [limit],
            "rest": self.rest(self.model.w0 + w, u, y).tolist(),
        }  # fmt: skip

    def rest(self, watts: float, u: Array, y: Array) -> Array:
        """Return where the plant is believed to rest."""
        state, nothing = self.program.state, np.zeros(0)
        latched = Latched(0, 0, 0, watts, self.model.u0 + u, self.model.u0 + u, y, self.model.x0, nothing)
        begin_again(self.c, state, latched, u, False)  # noqa: FBT003 a kernel
        return state.belief.x[: len(self.model.x0)]


def cool_down(model: LtiModel, courses: list[dict[str, float]], by_loops: list[float]) -> list[list[float]]:
    """Return after each measurement the step and the wanted inputs."""
    point = OperatingPoint(tuple(model.u0.tolist()), tuple(model.y0.tolist()), 0)
    section = ControlSection(cool_down=CoolDownSettings(settled_s=0.0))
    program = ControlProgram(limits=InputLimits(), point=point, section=section)
    c, s, found = program.scan_constants, program.scan, []
    for tick, y in enumerate(courses):
        s.sensors.good[:] = measured(model.declared, y)
        follow_cool_down(c, s, tick)
        want(s.ladder, by_loops)
        cool(c, s.ladder)
        found.append([s.ladder.step, *s.ladder.wanted])
    return found


def answers(file: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Return what the process of a model file makes of situations."""
    model = load(file)
    with settings_of(model.declared):
        laws = Laws(model, given["settings"])
        names = model.declared.output_names
        constants = SensorMonitor(SensorCheckSettings(), model.y0.tolist()).constants
        return {
            "weights": state_weights(model, laws.program.settings.design).tolist(),
            "situations": [laws.of(each) for each in given["situations"]],
            "cool down": cool_down(model, given["courses"], given["by loops"]),
            "may stand": [
                [name for place, name in enumerate(names) if may_stand(constants, place, measured(model.declared, y))]
                for y in given["courses"]
            ],
        }
