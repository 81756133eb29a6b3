"""Plants by model file and configuration: a file's parameters, or those of the reference plant.

A model of neither is refused at once.
"""

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pydantic import ValidationError

from coldloop.config import explained
from coldloop.errors import ModelFileError
from coldloop.process.cold_box import INPUT_NAMES, OUTPUT_NAMES, STATE_NAMES
from coldloop.process.lti_model import LtiModel
from coldloop.process.model_file import COLD_BOX, ModelHeader, read_header
from coldloop_plant.cold_box.model import parameters_digest
from coldloop_plant.cold_box.physics import ColdBox
from coldloop_plant.cold_box.plant_file import LISTING, BoxParameters
from coldloop_plant.helium.properties import load_helium

if TYPE_CHECKING:
    from coldloop_plant.refrigerator.physics import Refrigerator
from functools import partial
from typing import TYPE_CHECKING, Final

from coldloop.errors import ConfigurationError
from coldloop.kernels.first_use import kernels_of
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.cold_box.program import ColdBoxProgram, MismatchedPlant
from coldloop_plant.components.valve import Valve
from coldloop_plant.program import HeatLoad, MakePlant, MeasurementNoise, PlantProgram
from coldloop_plant.refrigerator.settings import EventSchedule, StationControlKind
from coldloop_plant.settings import MismatchSettings, PlantKind, PlantSection, RefrigeratorStart, SensorSettings

if TYPE_CHECKING:
    from coldloop_plant.refrigerator.physics import Refrigerator
    from coldloop_plant.refrigerator.program import RefrigeratorFile


P = TypeVar("P", bound=BoxParameters)


def own_header(file: Path) -> ModelHeader:
    """Return the header of a model file whose plant can be made: a cold box alone, or the refrigerator.

    Raises:
        ModelFileError: The file cannot be read, its parameters cannot be used, or the model was made from others.
    """
    header = read_header(file)
    if header.process:
        from coldloop_plant.own_plants import check_files  # noqa: PLC0415 a cold box starts without it

        check_files(header)
        return header
    names = (header.state_names[: len(STATE_NAMES)], header.input_names, header.output_names)
    if header.plant == COLD_BOX:
        own = _box_digest(box_of(header, str(file)))
    else:
        own = _refrigerator_digest(refrigerator_in(header, str(file)))
    if header.parameters_digest != own or names != (STATE_NAMES, INPUT_NAMES, OUTPUT_NAMES):
        raise ModelFileError(f"{file}: a model of another plant; make one with `coldloop model --out FILE`")
    return header


def box_of(model: ModelHeader | LtiModel, where: str = "model.file") -> ColdBox:
    """Return the cold box that a model file describes, the reference plant if it describes none; `where` names it.

    Raises:
        ModelFileError: A parameter is unknown or out of range.
    """
    if model.plant == COLD_BOX:
        return _parameters(model, BoxParameters, where).box
    return refrigerator_in(model, where).box


def refrigerator_in(model: ModelHeader | LtiModel, where: str = "model.file") -> "Refrigerator":
    """Return the refrigerator that a model file describes, likewise."""
    from coldloop_plant.refrigerator.plant_file import RefrigeratorParameters  # noqa: PLC0415 a cold box starts without it

    return _parameters(model, RefrigeratorParameters, where).refrigerator


def _parameters(model: ModelHeader | LtiModel, kind: type[P], where: str) -> P:
    try:
        return kind.model_validate(model.plant_parameters)
    except ValidationError as error:
        wrong = explained(error, {}, kind, LISTING)
        raise ModelFileError(f"{where}: plant_parameters: {wrong}; make it with `coldloop model --plant`") from None


@cache
def _box_digest(box: ColdBox) -> str:
    return parameters_digest(box, load_helium())


@cache
def _refrigerator_digest(plant: "Refrigerator") -> str:
    from coldloop_plant.refrigerator.program import refrigerator_digest  # noqa: PLC0415

    return refrigerator_digest(plant, load_helium())


NO_MISMATCH: Final = MismatchSettings()


def plant_maker(header: ModelHeader, section: PlantSection) -> MakePlant:
    """Return what makes the plant at its operating point, for a load and a seed.

    Raises:
        ModelFileError: The refrigerator's file, or what the model file says of the plant, cannot be used.
        ConfigurationError: Its gains are not of the configured weights, or it is to differ from its model in what it
            cannot.
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
    if header.plant == COLD_BOX and box_of(header) != REFERENCE:
        raise ModelFileError("model.file: of another cold box than the refrigerator's; set plant.kind to cold-box")
    plant, file = _refrigerator_and_rest(header, section.refrigerator.file)
    if section.station.control is StationControlKind.LQ and section.station.weights != file.weights:
        raise ConfigurationError(
            "plant.station.weights: the gains of this refrigerator belong to other weights; make a file with"
            " `python -m coldloop_plant.refrigerator.model FILE` and name it in plant.refrigerator.file, or, with a"
            " plant file, its model file with `coldloop model --plant` and these weights"
        )
    return partial(_make_refrigerator, header, section, plant, file)


def _refrigerator_and_rest(header: ModelHeader, named: Path | None) -> "tuple[Refrigerator, RefrigeratorFile]":
    """Return the refrigerator that a model file describes, and its rest: of a file that is named, or of its own."""
    from coldloop_plant.refrigerator.plant_file import REFERENCE_REFRIGERATOR  # noqa: PLC0415 a cold box starts without it
    from coldloop_plant.refrigerator.program import SHIPPED, read_refrigerator_file, rest_in  # noqa: PLC0415 as below

    plant = REFERENCE_REFRIGERATOR if header.plant == COLD_BOX else refrigerator_in(header)
    if named is None and header.plant_rest:
        return plant, rest_in(header.plant_rest, plant, "model.file: plant_rest")
    return plant, read_refrigerator_file(named or SHIPPED, plant)


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


def _make_refrigerator(
    header: ModelHeader, section: PlantSection, plant: "Refrigerator", file: "RefrigeratorFile", load: HeatLoad,
    seed: int,
) -> PlantProgram:  # fmt: skip
    from coldloop_plant.refrigerator.program import RefrigeratorProgram  # noqa: PLC0415

    happening = section.refrigerator
    with kernels_of("the refrigerator", about_s=20):
        return RefrigeratorProgram(
            plant=plant,
            file=file,
            u0=header.u0,
            load=load,
            station=section.station,
            events=EventSchedule(happening.events, happening.ambient_k, happening.daily_swing_k),
            noise=noise_of(section.sensors, seed),
            seed=seed,
            warm=happening.start is RefrigeratorStart.WARM,
        )


def noise_of(sensors: SensorSettings, seed: int) -> MeasurementNoise | None:
    """Return the noise of the sensors; None where they are exact."""
    exact = not any(sensors.deviations + sensors.biases)
    return None if exact else MeasurementNoise(sensors.deviations, seed, sensors.biases)
