"""Makes the plant that a configuration asks for."""

from functools import partial
from typing import TYPE_CHECKING, Final

from coldloop.errors import ConfigurationError, ModelFileError
from coldloop.kernels.first_use import kernels_of
from coldloop.process.model_file import COLD_BOX, ModelHeader
from plant.cold_box.physics import REFERENCE, ColdBox
from plant.components.valve import Valve
from plant.mismatched import MismatchedPlant
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
        ModelFileError: The refrigerator's file cannot be used.
        ConfigurationError: Its gains are not of the configured weights, or it is to differ from its model.
    """
    if section.kind is PlantKind.COLD_BOX:
        if header.plant != COLD_BOX:
            raise ModelFileError(f"model.file: a model of the {header.plant}; set plant.kind to that, or take another")
        return partial(make_program, header, section.sensors, mismatch=section.mismatch)
    if section.mismatch != NO_MISMATCH:
        raise ConfigurationError("plant.mismatch: for a cold box alone; set plant.kind to cold-box, or leave it out")
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
    """Return the cold box at the operating point of its model file."""
    with kernels_of("the cold box", about_s=10):
        box, noise = _box(mismatch), noise_of(sensors, seed)
        if mismatch.beside_the_box:
            return MismatchedPlant(box=box, x0=header.x0, u0=header.u0, load=load, noise=noise, mismatch=mismatch)
        return PlantProgram(box=box, x0=header.x0, u0=header.u0, load=load, noise=noise)


def _box(mismatch: MismatchSettings) -> ColdBox:
    box, ua = REFERENCE, mismatch.heat_transfer
    turbine = box.turbine
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
        )


def noise_of(sensors: SensorSettings, seed: int) -> MeasurementNoise | None:
    """Return the noise of the sensors; None where they are exact."""
    exact = not any(sensors.deviations + sensors.biases)
    return None if exact else MeasurementNoise(sensors.deviations, seed, sensors.biases)
