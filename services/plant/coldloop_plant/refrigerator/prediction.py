"""A prediction model that includes the closed pressure loop: `python -m coldloop_plant.refrigerator.prediction FILE`.

Its inputs, load and outputs are those of the cold box's model, so that the optimiser and the control PLC take it in the
other's place. Beside the cold box's states it has those of the pre-cooler's exchangers, the masses of both lines, the
flows through bypass and inventory valves, and the integrals of the LQ controller. Left out is what has no influence on
them: the nitrogen's level while the coil is wet, the buffer while its valves are choked, the compressors' speed.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from coldloop.process import cold_box as process
from coldloop.process.lti_model import LtiModel, discretise
from coldloop_plant.cold_box import physics as cold_box
from coldloop_plant.helium.properties import load_helium
from coldloop_plant.numeric import RealArray
from coldloop_plant.refrigerator.file import (
    KIND,
    SHIPPED,
    RefrigeratorFile,
    read_refrigerator_file,
    refrigerator_digest,
)
from coldloop_plant.refrigerator.linearisation import jacobian
from coldloop_plant.refrigerator.physics import DISTURBANCE_NAMES, STATE_NAMES, STATE_UNITS, Refrigerator, read
from coldloop_plant.refrigerator.plant_file import REFERENCE_REFRIGERATOR
from coldloop_plant.refrigerator.station_design import LINES, PRESSURE_ROWS

KEPT: Final = (*range(STATE_NAMES.index("T_nef5") + 1), *LINES)
"""States of the refrigerator that are states of the model; the lines come last."""
M_HP, CV956 = (STATE_NAMES.index(name) for name in ("M_HP", "CV956"))
LOOP_NAMES: Final = ("bypass", "inventory", "integral_HP", "integral_LP")
LOOP_UNITS: Final = ("kg/s", "kg/s", "bar s", "bar s")


def prediction_model(
    file: RefrigeratorFile,
    plant: Refrigerator = REFERENCE_REFRIGERATOR,
    parameters: Mapping[str, Any] | None = None,
    rest: Mapping[str, Any] | None = None,
) -> LtiModel:
    """Return the linear model of a refrigerator with its pressure loop closed by the gains of its file.

    `parameters` and `rest` are what the model file is to carry of the plant, beside the linear model.
    """
    helium = load_helium()
    x0, u0, v0 = np.array(file.x0), np.array(file.u0), np.array(file.v0)
    d0 = np.array([file.w0, 300.0, 0.0, 1.0, 1.0, 1.0])
    J = jacobian(x0, u0, v0, d0, plant, helium)
    y0, _ = read(x0, u0, v0, d0, plant, helium)
    n, extra = len(STATE_NAMES), len(LOOP_NAMES)
    inputs, load = slice(n, n + 3), n + 7 + DISTURBANCE_NAMES.index("NCR22_HL")
    outputs = slice(n, n + len(process.OUTPUT_NAMES))
    rows = list(KEPT)
    A = _closed(J, np.array(file.gains), plant.station.actuator.lag)
    B = np.vstack([J[rows, inputs], np.zeros((extra, 3))])
    F = np.concatenate([J[rows, load], np.zeros(extra)])
    tick = discretise(A, B, F, process.TICK_S)
    return LtiModel(
        A=A, B=B, F=F, C=np.hstack([J[outputs, rows], np.zeros((len(y0), extra))]), D=J[outputs, inputs],
        G=J[outputs, load], A_tick=tick.A, B_tick=tick.B, F_tick=tick.F,
        x0=np.concatenate([x0[rows], np.zeros(extra)]), u0=u0, w0=file.w0, y0=y0,
        state_names=(*(STATE_NAMES[i] for i in rows), *LOOP_NAMES),
        state_units=(*(STATE_UNITS[i] for i in rows), *LOOP_UNITS),
        input_names=process.INPUT_NAMES, input_units=process.INPUT_UNITS,
        output_names=process.OUTPUT_NAMES, output_units=process.OUTPUT_UNITS,
        load_name=cold_box.LOAD_NAME, load_unit=cold_box.LOAD_UNIT,
        parameters_digest=refrigerator_digest(plant, helium), plant=KIND,
        plant_parameters=dict(parameters or {}), plant_rest=dict(rest or {}),
    )  # fmt: skip


def _closed(J: RealArray, K: RealArray, lag_s: float) -> RealArray:
    """Return dx/dt over x of the kept states and the loop, whose flows follow -K (pressures, flows, integrals)."""
    kept = len(KEPT)
    LP = kept - 1
    A = np.zeros((kept + 4, kept + 4))
    A[:kept, :kept] = J[np.ix_(KEPT, KEPT)]
    A[:kept, kept] = J[KEPT, CV956] / -J[M_HP, CV956]  # the bypass flow leaves the high-pressure side, whose gas cools,
    A[LP, kept : kept + 2] = 1.0  # and reaches, with that from the buffer, the low-pressure line
    pressures = np.zeros((2, kept + 4))
    pressures[:, :kept] = J[np.ix_(PRESSURE_ROWS, KEPT)]  # the high pressure also follows the passes' temperatures
    loop = np.vstack([pressures, np.zeros((4, kept + 4))])
    loop[2:, kept:] = np.eye(4)
    A[kept : kept + 2] = -K @ loop / lag_s
    A[kept : kept + 2, kept : kept + 2] -= np.eye(2) / lag_s
    A[kept + 2 :] = pressures
    return A


if __name__ == "__main__":
    prediction_model(read_refrigerator_file(SHIPPED)).save(Path(sys.argv[1]))
