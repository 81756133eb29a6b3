"""A plant that is a linear model: x moves by its matrices from tick to tick, and y follows from it."""

from coldloop.process.lti_model import LtiModel
from plant.numeric import RealArray
from plant.own.disturbances import NO_DISTURBANCES, Disturbances
from plant.program import HeatLoad, MeasurementNoise, PlantProgram


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
        self._model = model
        self._disturbances = disturbances
        super().__init__(x0=model.x0.tolist(), u0=model.u0.tolist(), load=load, noise=noise)

    def _outputs(self, x: RealArray, w: float) -> RealArray:
        m = self._model
        return m.y0 + m.C @ (x - m.x0) + m.D @ (self._u - m.u0) + m.G * (w - m.w0)

    def _read(self, w: float) -> RealArray:
        return self._outputs(self._x, w)

    def _step(self, w: float) -> tuple[RealArray, RealArray]:
        m = self._model
        x = m.x0 + (m.A_tick @ (self._x - m.x0) + m.B_tick @ (self._u - m.u0) + m.F_tick * (w - m.w0))
        met = self._disturbances.at(self.tick + 1)
        x[len(x) - len(met) :] = met
        return x, self._outputs(x, w)
