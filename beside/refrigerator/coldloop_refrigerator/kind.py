"""The refrigerator as the plant service and the command line ask for it: an entry point of `coldloop.plant_kinds`."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from coldloop.errors import ConfigurationError, ModelFileError
from coldloop.kernels.cache import kernels_of
from coldloop.process.lti_model import LtiModel
from coldloop.process.model_file import COLD_BOX, ModelHeader
from coldloop.process.settings import InputLimits
from coldloop_plant.cold_box import ColdBox
from coldloop_plant.cold_box.model import AtRest
from coldloop_plant.cold_box.plant_file import REFERENCE, PlantFile
from coldloop_plant.kinds import box_of, parameters_in
from coldloop_plant.program import HeatLoad, MakePlant, MeasurementNoise, PlantProgram
from coldloop_plant.settings import PlantSection, RefrigeratorStart, StationControlKind, StationSettings
from coldloop_refrigerator import plant_file, program
from coldloop_refrigerator.physics import Refrigerator


class RefrigeratorKind:
    """The refrigerator as a `coldloop_plant.kinds.Kind`."""

    def box_of(self, model: ModelHeader | LtiModel, where: str) -> ColdBox:
        """Return the cold box of the refrigerator that a model file describes."""
        return _refrigerator_in(model, where).box

    def digest_of(self, model: ModelHeader, where: str) -> str:
        """Return the digest of that refrigerator's parameters."""
        return program.refrigerator_digest(_refrigerator_in(model, where))

    def maker_of(
        self, header: ModelHeader, section: PlantSection, noise_of_seed: Callable[[int], MeasurementNoise | None]
    ) -> MakePlant:
        """Return what makes the refrigerator of a model file, for a load and a seed.

        Raises:
            ModelFileError: The refrigerator's file, or what the model file says of the plant, cannot be used.
            ConfigurationError: Its gains are not of the configured weights.
        """
        if header.plant == COLD_BOX and box_of(header) != REFERENCE:
            raise ModelFileError("model.file: of another cold box than the refrigerator's; set plant.kind to cold-box")
        plant, named = plant_file.REFERENCE_REFRIGERATOR, section.refrigerator.file
        if header.plant != COLD_BOX:
            plant = _refrigerator_in(header, "model.file")
        if named is None and header.plant_rest:
            file = program.rest_in(header.plant_rest, plant, "model.file: plant_rest")
        else:
            file = program.read_refrigerator_file(named or program.SHIPPED, plant)
        if section.station.control is StationControlKind.LQ and section.station.weights != file.weights:
            raise ConfigurationError(
                "plant.station.weights: the gains of this refrigerator belong to other weights; make a file with"
                " `python -m coldloop_refrigerator.model FILE` and name it in plant.refrigerator.file, or, with a"
                " plant file, its model file with `coldloop model --plant` and these weights"
            )
        return partial(_made, header, section, plant, file, noise_of_seed)

    def read_plant_file(self, path: Path | None, limits: InputLimits, *, whole: bool) -> PlantFile:
        """Return what a plant file says: of a refrigerator if it has one of its sections, or if `whole` is set."""
        return plant_file.read_plant_file(path, limits, whole=whole)

    def at_rest(self, file: PlantFile, control: StationSettings) -> AtRest:
        """Return the refrigerator of a plant file at rest, and its model with the gains of the controller's weights."""
        from coldloop_refrigerator.model import described_at_rest  # noqa: PLC0415 it needs SciPy, the service does not

        return described_at_rest(plant_file.RefrigeratorPlantFile.model_validate(file), control)


def _refrigerator_in(model: ModelHeader | LtiModel, where: str) -> Refrigerator:
    return parameters_in(model, plant_file.RefrigeratorParameters, where).refrigerator


def _made(
    header: ModelHeader, section: PlantSection, plant: Refrigerator, file: program.RefrigeratorFile,
    noise_of_seed: Callable[[int], MeasurementNoise | None], load: HeatLoad, seed: int,
) -> PlantProgram:  # fmt: skip
    happening = section.refrigerator
    with kernels_of("the refrigerator", about_s=20):
        return program.RefrigeratorProgram(
            plant=plant,
            file=file,
            u0=header.u0,
            load=load,
            station=section.station,
            events=program.EventSchedule(happening.events, happening.ambient_k, happening.daily_swing_k),
            noise=noise_of_seed(seed),
            seed=seed,
            warm=happening.start is RefrigeratorStart.WARM,
        )
