"""A prediction model of another operating point than the plant's: a download gone wrong."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from coldloop.process.cold_box import L1, TICK_S
from coldloop.process.lti_model import discretise, load
from coldloop_plant.cold_box.model import find_equilibrium, linearise
from coldloop_plant.helium.properties import load_helium
from coldloop_plant.kinds import box_of

WRONG_MODEL: Final = "wrong_model.json"
"""Its file in the folder of a run."""
MOVED_INPUTS: Final = (-3.0, -15.0, 2.0)
"""From those of the right model: CV155 %, NCR22_A W, CV156 %."""
GAIN: Final = 0.9
"""Of other processes: over those of the right model."""


def save_wrong_model(right: Path, wrong: Path) -> None:
    """Write the model of the same plant with its inputs moved by `MOVED_INPUTS`; of another process with less gain."""
    model, helium = load(right), load_helium()
    if model.process:
        replace(model, B=GAIN * model.B, D=GAIN * model.D, B_tick=GAIN * model.B_tick, declaration_digest="").save(
            wrong
        )
        return
    box = box_of(model)
    rest = find_equilibrium(model.u0 + np.array(MOVED_INPUTS), float(model.y0[L1]), box, helium)
    linear = linearise(rest.x, rest.u, rest.w, box, helium)
    tick = discretise(linear.A, linear.B, linear.F, TICK_S)
    replace(
        model, **linear._asdict(), A_tick=tick.A, B_tick=tick.B, F_tick=tick.F,
        x0=rest.x, u0=rest.u, w0=rest.w, y0=rest.y,
    ).save(wrong)  # fmt: skip
