"""Makes the plant that a configuration asks for."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from coldloop.errors import ConfigurationError, ModelFileError
from coldloop.kernels.first_use import kernels_of
from coldloop.process.model_file import COLD_BOX, ModelHeader
from coldloop_plant.cold_box.physics import ColdBox
from coldloop_plant.cold_box.plant_file import REFERENCE
from coldloop_plant.cold_box.program import ColdBoxProgram
from coldloop_plant.components.valve import Valve
from coldloop_plant.mismatched import MismatchedPlant
from coldloop_plant.own_model import box_of, refrigerator_in
from coldloop_plant.program import HeatLoad, MeasurementNoise, PlantProgram
from coldloop_plant.rack.rack import MakePlant
from coldloop_plant.refrigerator.events import EventSchedule
from coldloop_plant.refrigerator.station_settings import StationControlKind
from coldloop_plant.settings import MismatchSettings, PlantKind, PlantSection, RefrigeratorStart, SensorSettings

if TYPE_CHECKING:
    from coldloop_plant.refrigerator.file import RefrigeratorFile
    from coldloop_plant.refrigerator.physics import Refrigerator

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
        from coldloop_plant.own.maker import own_plant_maker  # noqa: PLC0415 a cold box starts without it

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
    from coldloop_plant.refrigerator.file import SHIPPED, read_refrigerator_file, rest_in  # noqa: PLC0415 as below
    from coldloop_plant.refrigerator.plant_file import REFERENCE_REFRIGERATOR  # noqa: PLC0415 a cold box starts without it

    plant = REFERENCE_REFRIGERATOR if header.plant == COLD_BOX else refrigerator_in(header)
    if named is None and header.plant_rest:
        return plant, rest_in(header.plant_rest, plant, "model.file: plant_rest")
    return plant, read_refrigerator_file(named or SHIPPED, plant)


def make_program(
    header: ModelHeader,
    sensors: SensorSettings,
    load: HeatLoad,
    seed: int,
    mismatch: MismatchSettings = NO_MISMATCH,
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
    header: ModelHeader,
    section: PlantSection,
    plant: "Refrigerator",
    file: "RefrigeratorFile",
    load: HeatLoad,
    seed: int,
) -> PlantProgram:
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
