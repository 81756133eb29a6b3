"""A plant that is a linear model: x moves by its matrices from tick to tick, and y follows from it."""

from typing import Any, NamedTuple

import numpy as np

from coldloop.kernels.compiled import inlined, kernel
from coldloop.process.lti_model import LtiModel
from coldloop_plant.numeric import RealArray
from coldloop_plant.own.disturbances import NO_DISTURBANCES, Disturbances
from coldloop_plant.program import HeatLoad, MeasurementNoise, PlantProgram


class Matrices(NamedTuple):
    """Those of `LtiModel` for a tick."""

    A_tick: RealArray
    B_tick: RealArray
    F_tick: RealArray
    C: RealArray
    D: RealArray
    G: RealArray
    x0: RealArray
    u0: RealArray
    y0: RealArray
    w0: float


@inlined
def times(row: RealArray, values: RealArray, rest: RealArray) -> float:
    """Return a row of a matrix times the deviations of values from rest."""
    total = 0.0
    for j in range(row.shape[0]):
        total += row[j] * (values[j] - rest[j])
    return total


@kernel
def advance_linear(m: Matrices, x: RealArray, u: RealArray, w: float, met: RealArray, y: RealArray) -> None:
    """Let x and y become those of the next tick, under u and w held; disturbances are `met` there."""
    before = x.copy()
    for i in range(x.shape[0]):
        x[i] = m.x0[i] + (times(m.A_tick[i], before, m.x0) + times(m.B_tick[i], u, m.u0) + m.F_tick[i] * (w - m.w0))
    x[x.shape[0] - met.shape[0] :] = met
    read_linear(m, x, u, w, y)


@kernel
def read_linear(m: Matrices, x: RealArray, u: RealArray, w: float, y: RealArray) -> None:
    """Write the outputs."""
    for i in range(y.shape[0]):
        y[i] = m.y0[i] + times(m.C[i], x, m.x0) + times(m.D[i], u, m.u0) + m.G[i] * (w - m.w0)


class LinearPlant(PlantProgram):
    """The model in its own place; actuators do not saturate.

    Args:
        model: The linear model, of as many states as the process declares.
        load: The load over time.
        noise: Noise on the measurements; None measures exactly.
        disturbances: Others than the load.
    """

    def __init__(
        self,
        model: LtiModel,
        load: HeatLoad,
        noise: MeasurementNoise | None = None,
        disturbances: Disturbances = NO_DISTURBANCES,
    ) -> None:
        parts: dict[str, Any] = {name: getattr(model, name) for name in Matrices._fields}
        self.constants = Matrices(**{name: part if name == "w0" else part.copy() for name, part in parts.items()})
        self.disturbances = disturbances
        super().__init__(x0=model.x0.tolist(), u0=model.u0.tolist(), load=load, noise=noise, process=model.declared)

    def _read(self, w: float) -> RealArray:
        y = np.empty(len(self.constants.y0))
        read_linear(self.constants, self._x, self._u, w, y)
        return y

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        x, y = self._x.copy(), np.empty(len(self.constants.y0))
        advance_linear(self.constants, x, self._u, w, self.disturbances.at(self.tick + 1), y)
        return x, y
