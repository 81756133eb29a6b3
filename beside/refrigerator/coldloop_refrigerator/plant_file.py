"""The plant file of a whole refrigerator: the cold box's sections, with those of its pre-cooler and its station.

Every key is optional; the defaults are the reference plant. A plant file with one of these sections is that of a
refrigerator. `boundaries` are then its pressures at rest, and the temperature from which the search begins.
"""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

from coldloop import config, errors
from coldloop.process.settings import InputLimits
from coldloop_plant.cold_box import plant_file
from coldloop_plant.components.expansion import Actuator, ReliefValve, Valve
from coldloop_refrigerator import physics, warm

KIND: Final = "refrigerator"  # Kind of the plant in model files, and `plant.kind`

CubicMetres = Annotated[float, plant_file.within(0.05, 1000)]
Area = Annotated[float, plant_file.within(0.05, 100_000)]
Lag = Annotated[float, plant_file.within(0.5, 1000)]
Speed = Annotated[float, plant_file.within(0.1, 1000)]
Share = Annotated[float, plant_file.within(0.05, 1)]


class Nef5Section(plant_file.Section):
    """The nitrogen bath, the fields of `NitrogenBath`, with its feed valve CV167."""

    ua_w_per_k: Annotated[float, plant_file.within(1, 100_000)] = 336.44
    volume_l: plant_file.Litres = 30.0
    wet_level_pct: Annotated[float, plant_file.within(1, 100)] = 25.0
    capacity_kj_per_k: Annotated[float, plant_file.within(0.1, 10_000)] = 20.0
    cv167_area_mm2: Annotated[float, plant_file.within(0.01, 1000)] = 1.3
    """Effective flow area of CV167 when fully open."""
    cv167_lag_s: Lag = 2.0
    cv167_fastest_pct_per_s: Speed = 10.0
    """Time constant and largest speed of its drive."""


class CompressorSection(plant_file.Section):
    """A screw compressor with its motor: the fields of `ScrewCompressor`."""

    displacement_l_per_s: Annotated[float, plant_file.within(0.1, 50_000)] = 380.0
    filling: Share = 0.92
    slip: Annotated[float, plant_file.within(0, 0.1)] = 0.006
    isothermal_efficiency: Annotated[float, plant_file.within(0.2, 1)] = 0.55
    built_in_ratio: Annotated[float, plant_file.within(1.1, 100)] = 10.0
    mismatch: Annotated[float, plant_file.within(0, 1)] = 0.05
    motor_efficiency: Share = 0.95


class StationSection(plant_file.Section):
    """Volumes, valves and cooler of the compression station."""

    hp_volume_m3: CubicMetres = 2.0
    lp_volume_m3: CubicMetres = 1.5
    """Volumes of the high-pressure and the low-pressure line, m3."""
    buffer_volume_m3: CubicMetres = 20.0
    buffer_bar: Annotated[float, plant_file.within(1, 20)] = 6.0
    """Volume of the medium-pressure vessel, m3, and its pressure at rest."""
    cv956_area_mm2: Area = 34.0
    cv952_area_mm2: Area = 20.0
    cv953_area_mm2: Area = 40.0
    """Effective flow areas when fully open of the bypass, the discharge and the charge valve."""
    valve_lag_s: Lag = 1.0
    valve_fastest_pct_per_s: Speed = 20.0
    """Time constant and largest speed of the drives of these three."""
    cooler_approach_k: Annotated[float, plant_file.within(0, 50)] = 5.0
    """Excess of the compressed gas's temperature over the surroundings, K."""
    run_up_s: Lag = 6.0
    run_down_s: Lag = 1.5
    """Time constants of a compressor that starts and of one that stops."""


class ReliefSection(plant_file.Section):
    """A relief valve into the atmosphere: the fields of `ReliefValve`."""

    pressure_bar: Annotated[float, plant_file.within(1.01, 50)]
    span_bar: Annotated[float, plant_file.within(0.01, 10)]
    area_mm2: Area

    @property
    def component(self) -> ReliefValve:
        """The valve, in SI units."""
        pressure, span, area = self.si
        return ReliefValve(pressure, span, Valve(area))


class RefrigeratorParameters(plant_file.BoxParameters):
    """The parameters of a refrigerator."""

    nef6: plant_file.ExchangerSection = plant_file.ExchangerSection(
        ua_w_per_k=21_500.0, volume_l=40.0, aluminium_kg=150.0
    )
    """The exchanger from ambient temperature to the nitrogen bath."""
    nef5: Nef5Section = Nef5Section()
    nc1: CompressorSection = CompressorSection()
    nc2: CompressorSection = CompressorSection()
    station: StationSection = StationSection()
    hp_relief: ReliefSection = ReliefSection(pressure_bar=18.0, span_bar=1.0, area_mm2=120.0)
    lp_relief: ReliefSection = ReliefSection(pressure_bar=1.5, span_bar=0.2, area_mm2=2500.0)
    buffer_relief: ReliefSection = ReliefSection(pressure_bar=13.0, span_bar=1.0, area_mm2=100.0)

    @property
    def refrigerator(self) -> physics.Refrigerator:
        """The refrigerator, in SI units."""
        conductance, volume, wet_level, capacity, area, feed_lag, feed_fastest = self.nef5.si
        bath = warm.NitrogenBath(conductance, volume, wet_level, capacity, Valve(area))
        precooler = warm.Precooler(self.nef6.component(warm.NEF6_CELLS), bath, Actuator(feed_lag, feed_fastest))
        hp, lp, buffer, _, bypass, discharge, charge, lag, fastest, *rest = self.station.si
        station = warm.CompressionStation(
            warm.GasVolume(hp), warm.GasVolume(lp), warm.GasVolume(buffer),
            warm.ScrewCompressor(*self.nc1.si), warm.ScrewCompressor(*self.nc2.si),
            Valve(bypass), Valve(discharge), Valve(charge), Actuator(lag, fastest),
            self.hp_relief.component, self.lp_relief.component, self.buffer_relief.component, *rest,
        )  # fmt: skip
        return physics.Refrigerator(self.box, precooler, station)


REFERENCE_REFRIGERATOR: Final = RefrigeratorParameters().refrigerator


class RefrigeratorPlantFile(RefrigeratorParameters, plant_file.PlantFile):
    """A refrigerator and its operating point."""

    kind: ClassVar[str] = KIND

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the plant in a model file; empty for the reference plant."""
        own = self.refrigerator == REFERENCE_REFRIGERATOR
        return {} if own else self.model_dump(exclude={"operating_point"})


WARM_SECTIONS: Final = set(RefrigeratorParameters.model_fields) - set(plant_file.BoxParameters.model_fields)
"""Sections that a cold box's file has not."""


def read_plant_file(path: Path | None, limits: InputLimits, *, whole: bool = False) -> plant_file.PlantFile:
    """Return what a plant file says: of a refrigerator if it has one of its sections, or if `whole` is set.

    Raises:
        ConfigurationError: As `read_refrigerator`.
    """
    file = read_refrigerator(path, limits)
    if whole or WARM_SECTIONS & file.model_fields_set:
        return file
    return plant_file.PlantFile.model_validate(file.model_dump(include=set(plant_file.PlantFile.model_fields)))


def read_refrigerator(path: Path | None, limits: InputLimits) -> RefrigeratorPlantFile:
    """Return what a plant file says of a refrigerator; the rest, all without a file, is as in the reference plant.

    Raises:
        ConfigurationError: One line: the file cannot be read, a key is unknown or out of range, or the operating point
            is outside the limits of the inputs.
    """
    if path is None:
        return RefrigeratorPlantFile()
    file = config.load_configuration(
        RefrigeratorPlantFile, file=path, environment={}, option="--plant", listing=plant_file.LISTING
    ).settings
    inputs = file.operating_point.model_dump(exclude={"level_pct"})
    for (key, value), low, high in zip(inputs.items(), limits.low, limits.high, strict=True):
        if not low <= value <= high:
            raise errors.ConfigurationError(
                f"{path}: operating_point.{key}: {value:g} is outside the limits of this input, {low:g} to {high:g};"
                " take a value within, or change limits.low and limits.high"
            )
    return file
