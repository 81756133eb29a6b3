"""The model file's maker: `python -m coldloop_plant.cold_box.model FILE` writes the model of the reference cold box.

`coldloop model --plant` makes that of another one.
"""

import hashlib
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coldloop.process import cold_box as process
from coldloop.process.lti_model import LtiModel, discretise
from coldloop_plant.cold_box import physics as cold_box
from coldloop_plant.cold_box.equilibrium import Equilibrium, find_equilibrium
from coldloop_plant.cold_box.linearisation import linearise
from coldloop_plant.cold_box.physics import ColdBox
from coldloop_plant.cold_box.plant_file import OPERATING_INPUTS, OPERATING_LEVEL, REFERENCE
from coldloop_plant.helium.properties import ISOBAR_PRESSURE, Helium, load_helium


def build_model(box: ColdBox = REFERENCE) -> LtiModel:
    """Return the linear model of `box` at the operating point of the reference plant.

    Raises:
        coldloop_plant.cold_box.equilibrium.NoEquilibriumError: the box does not come to rest at the operating inputs.
    """
    helium = load_helium()
    return model_at(find_equilibrium(np.array(OPERATING_INPUTS), OPERATING_LEVEL, box, helium), box, helium)


def model_at(rest: Equilibrium, box: ColdBox, helium: Helium, parameters: Mapping[str, Any] | None = None) -> LtiModel:
    """Return the linear model of `box` at a state of rest; `parameters` are what its file says of the plant."""
    linear = linearise(rest.x, rest.u, rest.w, box, helium)
    tick = discretise(linear.A, linear.B, linear.F, process.TICK_S)
    return LtiModel(
        **linear._asdict(),
        A_tick=tick.A,
        B_tick=tick.B,
        F_tick=tick.F,
        x0=rest.x,
        u0=rest.u,
        w0=rest.w,
        y0=rest.y,
        state_names=process.STATE_NAMES,
        state_units=process.STATE_UNITS,
        input_names=process.INPUT_NAMES,
        input_units=process.INPUT_UNITS,
        output_names=process.OUTPUT_NAMES,
        output_units=process.OUTPUT_UNITS,
        load_name=cold_box.LOAD_NAME,
        load_unit=cold_box.LOAD_UNIT,
        parameters_digest=parameters_digest(box, helium),
        plant_parameters=dict(parameters or {}),
    )


def parameters_digest(box: ColdBox, helium: Helium) -> str:
    """Return the SHA-256 over every parameter and every table entry that the cold box reads, in hexadecimal."""
    digest = hashlib.sha256()
    _add(digest, (box, helium))
    if box.P_HP != ISOBAR_PRESSURE:
        _add(digest, helium.departure.nodes)
    return digest.hexdigest()


def _add(digest: Any, part: Any) -> None:  # noqa: ANN401 - hashlib's object and a nested tuple have no public type
    if isinstance(part, tuple):
        for name, value in zip(getattr(part, "_fields", ("",) * len(part)), part, strict=True):
            if name == "departure":
                continue  # from 16 bar, where the reference plant is
            digest.update(f"{name}:".encode())
            _add(digest, value)
    elif isinstance(part, np.ndarray):
        digest.update(part.astype("<f8").tobytes())
    else:
        digest.update(f"{part!r};".encode())


if __name__ == "__main__":
    build_model().save(Path(sys.argv[1]))
