"""Makes the plant that a configuration asks for."""

from functools import partial
from typing import TYPE_CHECKING, Final

from coldloop.errors import ConfigurationError, ModelFileError
from coldloop.kernels.first_use import kernels_of
from coldloop.process.model_file import COLD_BOX, ModelHeader
from plant.cold_box.physics import REFERENCE, ColdBox
from plant.components.valve import Valve
from plant.mismatched import MismatchedPlant
from plant.own_model import box_of
from plant.program import HeatLoad, MeasurementNoise, PlantProgram
from plant.rack.rack import MakePlant
from plant.refrigerator.events import EventSchedule
from plant.refrigerator.station_settings import StationControlKind
from plant.settings import MismatchSettings, PlantKind, PlantSection, SensorSettings

if TYPE_CHECKING:
    from plant.refrigerator.file import RefrigeratorFile

NO_MISMATCH: Final = MismatchSettings()


def plant_maker(header: ModelHeader, section: PlantSection) -> MakePlant:
    """Return what makes the plant at its operating point, for a load and a seed.

    Raises:
        ModelFileError: The refrigerator's file, or what the model file says of the plant, cannot be used.
        ConfigurationError: Its gains are not of the configured weights, or it is to differ from its model in what it
            cannot.
    """
    if section.kind is PlantKind.COLD_BOX:
        if header.plant != COLD_BOX:
            raise ModelFileError(f"model.file: a model of the {header.plant}; set plant.kind to that, or take another")
        efficiency = mismatched_box(box_of(header), section.mismatch).turbine.efficiency
        if efficiency >= 1.0:
            raise ConfigurationError(f"plant.mismatch.turbine_efficiency: that makes {efficiency:.2f} of this turbine")
        return partial(make_program, header, section.sensors, mismatch=section.mismatch)
    if section.mismatch != NO_MISMATCH:
        raise ConfigurationError("plant.mismatch: for a cold box alone; set plant.kind to cold-box, or leave it out")
    if box_of(header) != REFERENCE:
        raise ModelFileError("model.file: of another cold box than the refrigerator's; set plant.kind to cold-box")
    from plant.refrigerator.file import SHIPPED, read_refrigerator_file  # noqa: PLC0415 a cold box starts without it

    path = section.refrigerator.file or SHIPPED
    file = read_refrigerator_file(path)
    if section.station.control is StationControlKind.LQ and section.station.weights != file.weights:
        raise ConfigurationError(
            f"plant.station.weights: the gains in {path} belong to other weights; make a file with"
            " `python -m plant.refrigerator.model FILE` and name it in plant.refrigerator.file"
        )
    return partial(_make_refrigerator, header, section, file)


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
        return PlantProgram(box=box, x0=header.x0, u0=header.u0, load=load, noise=noise)


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
    header: ModelHeader, section: PlantSection, file: "RefrigeratorFile", load: HeatLoad, seed: int
) -> PlantProgram:
    from plant.refrigerator.program import RefrigeratorProgram  # noqa: PLC0415

    happening = section.refrigerator
    with kernels_of("the refrigerator", about_s=20):
        return RefrigeratorProgram(
            file=file,
            u0=header.u0,
            load=load,
            station=section.station,
            events=EventSchedule(happening.events, happening.ambient_k, happening.daily_swing_k),
            noise=noise_of(section.sensors, seed),
            seed=seed,
        )


def noise_of(sensors: SensorSettings, seed: int) -> MeasurementNoise | None:
    """Return the noise of the sensors; None where they are exact."""
    exact = not any(sensors.deviations + sensors.biases)
    return None if exact else MeasurementNoise(sensors.deviations, seed, sensors.biases)
