"""Configuration of the plant service, checked when it is made and immutable after."""

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field, FiniteFloat, field_validator

from coldloop.modbus.settings import PLANT_PORT, ServerSettings
from coldloop.process.sections import Section
from coldloop.process.settings import (
    InputLimits,
    PerInput,
    ProcessSettings,
    RootSettings,
    declared,
    settings_process,
    stretched,
    within,
)
from coldloop.registers.codec import WordOrder
from coldloop.safety.retained import RetainSettings
from coldloop.service.settings import MetricsSettings, TelemetrySettings
from coldloop.session import SessionSettings
from coldloop_plant.refrigerator.settings import RANGES, EventTarget, RefrigeratorEvent, StationSettings

SHOWN: Final = (
    "plant.kind", "plant.station", "plant.refrigerator", "plant.mismatch", "plant.sensors", "plant.clock_error_ppm",
    "plant.watchdog", "plant.rate_limited", "limits.rate",
)  # fmt: skip
"""Keys of the configuration that decide results; the registers show them. Load and seed are those of a session."""

Deviation = Annotated[float, Field(ge=0)]

Factor = Annotated[float, Field(ge=0.5, le=1.4)]


class MismatchSettings(Section):
    """Mismatch of the cold box to its model: most values are factors. It begins at the model's point of rest."""

    heat_transfer: Factor = 1.0
    """UA of the three heat exchangers."""
    turbine_efficiency: Factor = 1.0
    """Isentropic efficiency of the turbine over that of the model."""
    jt_valve: Factor = 1.0
    """Flow area of CV155."""
    turbine_valve: Factor = 1.0
    """Flow area of CV156."""
    heater: Factor = 1.0
    """Power of NCR22_A, as the next three in a loop that is not compiled."""
    load: Factor = 1.0
    """Heat load over what is announced."""
    level_gauge: Factor = 1.0
    """Factor of the reading of L1."""
    delay_ticks: Annotated[int, Field(ge=0, le=20)] = 0
    """Ticks by which inputs act later."""

    @property
    def beside_the_box(self) -> bool:
        """Whether something is off that is no parameter of the cold box."""
        return (self.heater, self.load, self.level_gauge, self.delay_ticks) != (1.0, 1.0, 1.0, 0)


class SensorSettings(ProcessSettings):
    """Standard deviations of the sensors' noise, and what they show too much; 0 is an exact sensor."""

    level: Deviation = 0.0
    """%."""
    speed: Deviation = 0.0
    """Hz."""
    temperature: Deviation = 0.0
    """K."""
    pressure: Deviation = 0.0
    """bar."""
    declared: Deviation = 0.0
    """Noise of other processes than the cold box: over the noise that the process declares."""
    level_bias: FiniteFloat = 0.0
    """%: that much is shown too much, as by the next two."""
    temperature_bias: FiniteFloat = 0.0
    """K, at each of the ten."""
    pressure_bias: FiniteFloat = 0.0
    """bar, at each of the ten."""

    @property
    def deviations(self) -> tuple[float, ...]:
        """Standard deviation of each output."""
        return tuple(
            getattr(self, output.quantity) if output.quantity else self.declared * output.noise
            for output in self.process.outputs
        )

    @property
    def biases(self) -> tuple[float, ...]:
        """Bias of each output."""
        return tuple(getattr(self, f"{output.quantity}_bias", 0.0) for output in self.process.outputs)


class SafeAction(StrEnum):
    """Action of the rack on its outputs when the control PLC is silent."""

    HOLD = "hold"
    """It leaves them as they are."""
    SAFE = "safe"
    """It applies `safe_state`."""


class WatchdogSettings(ProcessSettings):
    """The rack's watchdog over the control PLC."""

    timeout_s: Annotated[float, within(lambda process: (0, 64_000 * process.tick_s))] = stretched(10.0, least=1.0)
    """Plant time without new outputs after which it expires; 0 is never. In lock-step plant time then stops."""
    action: SafeAction = SafeAction.HOLD
    safe_state: PerInput = declared(lambda process: tuple(one.safe for one in process.inputs))
    """Safe value of each input: for the cold box CV155 %, NCR22_A W, CV156 %."""

    @field_validator("safe_state")
    @classmethod
    def _within_registers(cls, values: tuple[float, ...]) -> tuple[float, ...]:
        for one, value in zip(settings_process().inputs, values, strict=True):
            low, high = one.span
            if not low <= value <= high:
                raise ValueError(f"{one.name} = {value:g} is outside {low:g} to {high:g} {one.unit}".rstrip())
        return values

    @property
    def ticks(self) -> int:
        """The time-out, in ticks."""
        return math.ceil(self.timeout_s / self.process.tick_s)


class PlantServer(ServerSettings):
    """The rack's server."""

    port: Annotated[int, Field(ge=0, le=0xFFFF)] = PLANT_PORT


class PlantKind(StrEnum):
    """Kind of the simulated plant."""

    COLD_BOX = "cold-box"
    """S1 and S2; pressures and inlet temperature are constant."""
    REFRIGERATOR = "refrigerator"
    """S1 to S4: with nitrogen pre-cooler and compression station."""
    OF_PROCESS = "of-process"
    """The plant of the process in the model file."""


class RefrigeratorStart(StrEnum):
    """State of a refrigerator at the beginning of a session."""

    OPERATING_POINT = "operating-point"
    """At rest, with the bath filled."""
    WARM = "warm"
    """At ambient temperature, its helium in the buffer, its compressors about to start."""


class RefrigeratorSettings(Section):
    """Start and disturbances of a refrigerator."""

    file: Path | None = None
    """Its operating point and the gains of its pressure controller; by default those of the reference plant."""
    start: RefrigeratorStart = RefrigeratorStart.OPERATING_POINT
    ambient_k: Annotated[float, Field(ge=RANGES[EventTarget.AMBIENT][0], le=RANGES[EventTarget.AMBIENT][1])] = 300.0
    """Temperature of the surroundings."""
    daily_swing_k: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Amplitude of a day's sine about it; the first six hours are the warmer."""
    events: tuple[RefrigeratorEvent, ...] = ()
    """Events and their times: `{at_s = 600, target = "nc1", value = 0}` trips a compressor after ten minutes."""


class PlantSection(ProcessSettings):
    """Section `plant` of the configuration."""

    kind: PlantKind = declared(lambda process: PlantKind(process.plants[0]))
    refrigerator: RefrigeratorSettings = RefrigeratorSettings()
    """Read by the refrigerator only, as is `station`."""
    station: StationSettings = StationSettings()
    server: PlantServer = PlantServer()
    word_order: WordOrder = WordOrder.HIGH_FIRST
    metrics: MetricsSettings = MetricsSettings()
    load: Annotated[str, Field(min_length=1)] = "2h"
    """Named load or CSV file."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    """Seed of the sensors' noise."""
    mismatch: MismatchSettings = MismatchSettings()
    """Mismatch of a cold box alone."""
    sensors: SensorSettings = Field(default_factory=SensorSettings)
    clock_error_ppm: Annotated[float, Field(ge=-50_000, le=50_000)] = 0.0
    """How much too fast the rack's clock is in real time, in millionths: for tests of those who follow it."""
    watchdog: WatchdogSettings = Field(default_factory=WatchdogSettings)
    rate_limited: bool = True
    """No output moves by more than `limits.rate` in one tick of the rack, for any writer; the safe state does."""
    retain: RetainSettings = RetainSettings()


class PlantSettings(RootSettings):
    """Settings that the plant service reads of a configuration."""

    limits: InputLimits = Field(default_factory=InputLimits)
    session: SessionSettings = SessionSettings()
    plant: PlantSection = Field(default_factory=PlantSection)
    telemetry: TelemetrySettings = TelemetrySettings()
