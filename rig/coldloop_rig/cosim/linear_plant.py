"""The cold box's own linear model in its place: a control, in which the optimiser's model is right.

What a setting gains on the plant and not here, it gains by what the model has wrong.
"""

from coldloop.errors import ConfigurationError
from coldloop.process.load_profile import LoadProfile
from coldloop.process.lti_model import load as load_model
from coldloop_plant.kinds import NO_MISMATCH, noise_of
from coldloop_plant.own_plants import LinearPlant
from coldloop_plant.program import PlantProgram
from coldloop_plant.settings import PlantKind
from coldloop_rig.cosim.one_process import OneProcessRig
from coldloop_rig.settings import Settings


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
