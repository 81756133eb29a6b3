"""Plants by model file and configuration: a file's parameters, or those of the reference plant.

A model of neither is refused at once. A plant around the cold box comes with a package of its own, by an entry point.
"""

from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Final, Protocol, TypeVar

from pydantic import ValidationError

from coldloop.config import explained
from coldloop.errors import ConfigurationError, ModelFileError
from coldloop.kernels.cache import kernels_of
from coldloop.process.cold_box import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES
from coldloop.process.lti_model import LtiModel
from coldloop.process.model_file import COLD_BOX, ModelHeader, read_header
from coldloop.process.settings import InputLimits
from coldloop_plant.cold_box import ColdBox, ColdBoxProgram, MismatchedPlant, plant_file
from coldloop_plant.cold_box.model import AtRest, parameters_digest
from coldloop_plant.components.expansion import Valve
from coldloop_plant.helium import load_helium
from coldloop_plant.program import HeatLoad, MakePlant, MeasurementNoise, NoiseOfSeed, PlantProgram
from coldloop_plant.settings import MismatchSettings, PlantKind, PlantSection, SensorSettings, StationSettings

GROUP: Final = "coldloop.plant_kinds"
"""Group of entry points: classes of `Kind`, by the names of kinds in `plant.kind` and in model files."""
P = TypeVar("P", bound=plant_file.BoxParameters)


class Kind(Protocol):
    """A kind of plant around the cold box; models and plant files name it."""

    def plant_in(self, model: ModelHeader | LtiModel, where: str) -> tuple[ColdBox, str]:
        """Return the cold box in the plant that a model file, named by `where`, describes, and the plant's digest.

        It raises `ModelFileError`.
        """

    def maker_of(self, header: ModelHeader, section: PlantSection, noise_of_seed: NoiseOfSeed) -> MakePlant:
        """Return what makes the plant of a model file, or around its reference cold box (`ColdloopError`)."""

    def read_plant_file(self, path: Path | None, limits: InputLimits, *, whole: bool) -> plant_file.PlantFile:
        """Return what a plant file says: of this kind if it has one of its sections, or if `whole` is set.

        It is the reference plant without a file; `limits` are those of the inputs (`ConfigurationError`).
        """

    def at_rest(self, file: plant_file.PlantFile, control: StationSettings) -> AtRest:
        """Return the plant of a file of this kind at rest (`NoEquilibriumError`)."""


@cache
def kind_named(name: str, where: str = "plant.kind") -> Kind:
    """Return the kind of plant that a package brings; `where` says in a message what names it.

    Raises:
        ModelFileError: None brings one of this name.
    """
    there = entry_points(group=GROUP)
    if name not in there.names:
        known = ", ".join(sorted(there.names)) or "none is installed"
        raise ModelFileError(f"{where}: no plant '{name}' among the entry points {GROUP}: {known}")
    kind: Kind = there[name].load()()
    return kind


def own_header(file: Path) -> ModelHeader:
    """Return the header of a model file whose plant can be made: a cold box alone, or one of the further kinds.

    Raises:
        ModelFileError: The file cannot be read, its parameters cannot be used, or the model was made from others.
    """
    header = read_header(file)
    if header.process:
        from coldloop_plant.own_plants import FMU, fmu_of  # noqa: PLC0415 a cold box starts without it

        if header.plant == FMU:
            fmu_of(header)
        return header
    names = (header.state_names[: len(STATE_NAMES)], header.input_names, header.output_names)
    if header.plant == COLD_BOX:
        own = _box_digest(box_of(header, str(file)))
    else:
        own = kind_named(header.plant, str(file)).plant_in(header, str(file))[1]
    if header.parameters_digest != own or names != (STATE_NAMES, INPUT_NAMES, OUTPUT_NAMES):
        raise ModelFileError(f"{file}: a model of another plant; make one with `coldloop model --out FILE`")
    return header


def box_of(model: ModelHeader | LtiModel, where: str = "model.file") -> ColdBox:
    """Return the cold box that a model file describes, the reference plant if it describes none; `where` names it.

    Raises:
        ModelFileError: A parameter is unknown or out of range.
    """
    if model.plant == COLD_BOX:
        return parameters_in(model, plant_file.BoxParameters, where).box
    return kind_named(model.plant, where).plant_in(model, where)[0]


def parameters_in(model: ModelHeader | LtiModel, kind: type[P], where: str) -> P:
    """Return the parameters of a plant in a model file (`ModelFileError`: unknown or out of range)."""
    try:
        return kind.model_validate(model.plant_parameters)
    except ValidationError as error:
        wrong = explained(error, {}, kind, plant_file.LISTING)
        raise ModelFileError(f"{where}: plant_parameters: {wrong}; make it with `coldloop model --plant`") from None


@cache
def _box_digest(box: ColdBox) -> str:
    return parameters_digest(box, load_helium())


NO_MISMATCH: Final = MismatchSettings()


def plant_maker(header: ModelHeader, section: PlantSection) -> MakePlant:
    """Return what makes the plant at its operating point, for a load and a seed.

    Raises:
        ModelFileError: What the model file, or a further one, says of the plant cannot be used.
        ConfigurationError: The plant is to differ from its model in what it cannot, or is not as it is configured.
    """
    if bool(header.process) != (section.kind is PlantKind.OF_PROCESS):
        kinds = "of-process" if header.process else "cold-box or refrigerator"
        raise ConfigurationError(f"plant.kind={section.kind}: with this model file it is {kinds}")
    if header.process:
        if section.mismatch != NO_MISMATCH:
            raise ConfigurationError("plant.mismatch: for a cold box alone; leave it out")
        from coldloop_plant.own_plants import own_plant_maker  # noqa: PLC0415 a cold box starts without it

        return own_plant_maker(header, partial(noise_of, section.sensors))
    if section.kind is PlantKind.COLD_BOX:
        if header.plant != COLD_BOX:
            raise ModelFileError(f"model.file: a model of the {header.plant}; set plant.kind to that, or take another")
        efficiency = mismatched_box(box_of(header), section.mismatch).turbine.efficiency
        if efficiency >= 1.0:
            raise ConfigurationError(f"plant.mismatch.turbine_efficiency: that makes {efficiency:.2f} of this turbine")
        return partial(make_program, header, section.sensors, mismatch=section.mismatch)
    if section.mismatch != NO_MISMATCH:
        raise ConfigurationError("plant.mismatch: for a cold box alone; set plant.kind to cold-box, or leave it out")
    return kind_named(section.kind).maker_of(header, section, partial(noise_of, section.sensors))


def make_program(
    header: ModelHeader, sensors: SensorSettings, load: HeatLoad, seed: int, mismatch: MismatchSettings = NO_MISMATCH
) -> PlantProgram:
    """Return the cold box that a model file describes, at its operating point."""
    with kernels_of("the cold box", about_s=10):
        box, noise = mismatched_box(box_of(header), mismatch), noise_of(sensors, seed)
        if mismatch.beside_the_box:
            return MismatchedPlant(box=box, x0=header.x0, u0=header.u0, load=load, noise=noise, mismatch=mismatch)
        return ColdBoxProgram(box=box, x0=header.x0, u0=header.u0, load=load, noise=noise)


def mismatched_box(box: ColdBox, mismatch: MismatchSettings) -> ColdBox:
    """Return a cold box whose parameters are off by the factors of a mismatch."""
    ua, turbine = mismatch.heat_transfer, box.turbine
    return box._replace(
        nef1=box.nef1._replace(UA=ua * box.nef1.UA),
        nef2=box.nef2._replace(UA=ua * box.nef2.UA),
        nef34=box.nef34._replace(UA=ua * box.nef34.UA),
        jt_valve=Valve(mismatch.jt_valve * box.jt_valve.flow_area),
        turbine=turbine._replace(
            inlet_valve=Valve(mismatch.turbine_valve * turbine.inlet_valve.flow_area),
            efficiency=mismatch.turbine_efficiency * turbine.efficiency,
        ),
    )


def noise_of(sensors: SensorSettings, seed: int) -> MeasurementNoise | None:
    """Return the noise of the sensors; None where they are exact."""
    exact = not any(sensors.deviations + sensors.biases)
    return None if exact else MeasurementNoise(sensors.deviations, seed, sensors.biases)
