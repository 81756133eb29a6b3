"""The cold box's own linear model in its place: a control, in which the optimiser's model is right.

What a setting gains on the plant and not here, it gains by what the model has wrong.
"""

from coldloop.errors import ConfigurationError
from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import LtiModel
from coldloop.process.lti_model import load as load_model
from plant.kinds import NO_MISMATCH, noise_of
from plant.numeric import RealArray
from plant.own_model import box_of
from plant.program import HeatLoad, MeasurementNoise, PlantProgram
from plant.settings import PlantKind
from rig.cosim.one_process import OneProcessRig
from rig.settings import Settings


class LinearPlant(PlantProgram):
    """x moves by the model's matrices from tick to tick, and y follows from it; valves do not saturate.

    Args:
        model: The linear model.
        load: The heat load over time.
        noise: Noise on the measurements; None measures exactly.
    """

    def __init__(self, model: LtiModel, load: HeatLoad, noise: MeasurementNoise | None = None) -> None:
        self._model = model
        super().__init__(box=box_of(model), x0=model.x0.tolist(), u0=model.u0.tolist(), load=load, noise=noise)

    def _step(self, w: float, *, held: bool) -> tuple[RealArray, RealArray]:  # noqa: ARG002 nothing is kept
        m = self._model
        u, w = self._u - m.u0, w - m.w0
        x = m.A_tick @ (self._x - m.x0) + m.B_tick @ u + m.F_tick * w
        return m.x0 + x, m.y0 + m.C @ x + m.D @ u + m.G * w


class LinearRig(OneProcessRig):
    """Control PLC and optimiser PLC with a linear plant; its loop is not compiled.

    Raises:
        ConfigurationError: The plant is to differ from its model.
    """

    def __init__(self, settings: Settings) -> None:
        if settings.plant.kind is not PlantKind.COLD_BOX or settings.plant.mismatch != NO_MISMATCH:
            raise ConfigurationError("plant: the linear plant is a cold box without mismatch")
        super().__init__(settings, compiled=False)
        self._model = load_model(settings.model.file)

    def _plant(self, load: LoadProfile, seed: int) -> PlantProgram:
        return LinearPlant(self._model, load, noise_of(self._settings.plant.sensors, seed))
