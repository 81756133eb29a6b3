"""A prediction model of another operating point than the plant's: a download gone wrong."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from coldloop.process.lti_model import discretise, load
from coldloop.process.signals import TICK_S
from plant.cold_box.equilibrium import find_equilibrium
from plant.cold_box.linearisation import linearise
from plant.cold_box.model import OPERATING_LEVEL
from plant.cold_box.physics import REFERENCE
from plant.helium.properties import load_helium

WRONG_MODEL: Final = "wrong_model.json"
"""Its file in the folder of a run."""
OTHER_INPUTS: Final = (40.0, 60.0, 38.0)
"""CV155 %, NCR22_A W, CV156 %."""


def save_wrong_model(right: Path, wrong: Path) -> None:
    """Write the linear model of the same plant at `OTHER_INPUTS`."""
    helium = load_helium()
    rest = find_equilibrium(np.array(OTHER_INPUTS), OPERATING_LEVEL, REFERENCE, helium)
    linear = linearise(rest.x, rest.u, rest.w, REFERENCE, helium)
    tick = discretise(linear.A, linear.B, linear.F, TICK_S)
    replace(
        load(right), **linear._asdict(), A_tick=tick.A, B_tick=tick.B, F_tick=tick.F,
        x0=rest.x, u0=rest.u, w0=rest.w, y0=rest.y,
    ).save(wrong)  # fmt: skip
