"""Configuration of the control PLC, checked when it is made and immutable after."""

import math
from enum import StrEnum
from typing import Annotated, Final, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveFloat, model_validator

from coldloop.modbus.settings import CONTROL_PORT, PLANT_PORT, Endpoint, ServerSettings
from coldloop.process import cold_box, sections, updating_periods
from coldloop.process.settings import InputLimits, ProcessSettings, RootSettings, declared, stretched, within
from coldloop.registers.codec import WordOrder
from coldloop.safety.retained import RetainSettings
from coldloop.service.settings import MetricsSettings, TelemetrySettings
from coldloop.session import SessionSettings
from coldloop_control_plc.alarms import AlarmSettings
from coldloop_control_plc.sensors import SensorCheckSettings

SHOWN: Final = (
    "limits", "control_plc.scan_tolerance_ms", "control_plc.skew_alarm_ppm", "control_plc.driver",
    "control_plc.classical", "control_plc.cool_down", "control_plc.ladder", "control_plc.sensors",
    "control_plc.alarms",
)  # fmt: skip
"""Keys of the configuration that decide results; the registers show them."""


class ControlServer(ServerSettings):
    """The control PLC's server."""

    port: Annotated[int, Field(ge=0, le=0xFFFF)] = CONTROL_PORT


class PlantEndpoint(Endpoint):
    """Address of the plant's rack."""

    port: Annotated[int, Field(ge=1, le=0xFFFF)] = PLANT_PORT
    """TCP port."""


class ControlStrategy(StrEnum):
    """Operating mode at the start."""

    MPC = "mpc"
    """The optimiser's sequences."""
    CLASSICAL = "classical"
    """The classical loops; no update is latched, and the optimiser idles."""


class PiSettings(BaseModel):
    """One PI loop, u = gain (e + 1/T_i integral of e) with e = setpoint - y: the gain has the sign of the process."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gain: FiniteFloat
    """K, in the unit of the input per unit of the output."""
    integral_time_s: PositiveFloat
    """T_i, s."""
    setpoint_offset: FiniteFloat = 0.0
    """Setpoint less the output at the operating point of the model file, in the unit of the output."""


def _declared(loop: sections.Loop, band: sections.Band) -> PiSettings:
    return PiSettings(gain=loop.gain, integral_time_s=loop.integral_time_s, setpoint_offset=band.setpoint_offset)


class TemperatureLoop(PiSettings):
    """T5 (K) by CV156 (%): gain in % per K."""

    gain: FiniteFloat = cold_box.T5_LOOP.gain
    integral_time_s: PositiveFloat = cold_box.T5_LOOP.integral_time_s


class LevelLoop(PiSettings):
    """L1 (%) by NCR22_A (W): gain in W per %."""

    gain: FiniteFloat = cold_box.LEVEL_LOOP.gain
    integral_time_s: PositiveFloat = cold_box.LEVEL_LOOP.integral_time_s


class ClassicalSettings(ProcessSettings):
    """The tuning of loops by the quantity of their output, as the cold box declares it; of others it is declared."""

    temperature: TemperatureLoop = TemperatureLoop()
    level: LevelLoop = LevelLoop()
    period_s: Annotated[float, within(lambda process: (process.tick_s, process.sampling_period_s))] = declared(
        lambda process: process.sampling_period_s
    )
    """How often the loops are executed: a whole number of ticks, and no longer than the window of the rate limits."""

    @property
    def pairs(self) -> "tuple[tuple[str, str, PiSettings], ...]":
        """Output, input and tuning of each loop."""
        return tuple(
            (output.name, loop.input, getattr(self, output.quantity) if output.quantity else _declared(loop, band))
            for output, band in zip(self.process.banded, self.process.bands, strict=True)
            if (loop := band.loop) is not None
        )

    @property
    def period_ticks(self) -> int:
        """The period, in ticks."""
        return round(self.period_s / self.process.tick_s)

    @model_validator(mode="after")
    def _whole_ticks(self) -> Self:
        if updating_periods.whole_ticks(self.period_s, self.process.tick_s) is None:
            raise ValueError(f"period_s must be a multiple of the tick, {self.process.tick_s} s")
        return self


class CoolDownSettings(BaseModel, frozen=True, extra="forbid"):
    """Settings of the cool-down: when it begins, and when its steps end."""

    warm_k: Annotated[float, Field(ge=5, le=300)] = 20.0
    """Its temperature at the beginning of a session, or after a restart, above which a bath without liquid is cooled
    down."""
    liquid_pct: Annotated[float, Field(gt=0, lt=50)] = 1.0
    """Level from which on there is liquid, and the bath is filled."""
    settled_s: Annotated[float, Field(ge=0, le=36_000)] = 600.0
    """How long level and turbine's outlet have to stay in their bands until the optimiser is invited, plant time."""


class LadderSettings(ProcessSettings):
    """How long each rung of the fail-safe ladder bears."""

    hold_s: Annotated[float, Field(ge=0)] = stretched(30.0)
    """How long the last value holds before the classical loops take over."""
    optimizer_timeout_s: Annotated[float, within(lambda process: (0, 64_000 * process.tick_s))] = declared(
        lambda process: max(15.0 * max(process.stretch, 1.0), 3 * process.sampling_period_s)
    )
    """An optimiser that gives no sign of life for so long is lost; 0 is never. Plant time, longer than any tau_u."""
    optimizer_patience_s: Annotated[float, Field(gt=0)] = 5.0
    """In lock-step plant time waits while the optimiser is waited for: it is lost after so long in real time."""

    @property
    def hold_ticks(self) -> int:
        """The hold, in ticks."""
        return round(self.hold_s / self.process.tick_s)

    @property
    def optimizer_ticks(self) -> int:
        """The time-out, in ticks."""
        return math.ceil(self.optimizer_timeout_s / self.process.tick_s)


class ControlSection(ProcessSettings):
    """Section `control_plc` of the configuration."""

    server: ControlServer = ControlServer()
    word_order: WordOrder = WordOrder.HIGH_FIRST
    metrics: MetricsSettings = MetricsSettings()
    plant: PlantEndpoint = PlantEndpoint()
    power_up_s: Annotated[float, Field(ge=0)] = 10.0
    """A rack that is powered up together with this PLC may take so long (real time) before it counts as lost."""
    scan_tolerance_ms: Annotated[float, Field(gt=0)] = 5.0
    """Lateness of a scan, in real time, that counts as an overrun."""
    skew_alarm_ppm: Annotated[float, Field(gt=0)] = 500.0
    """How much the rack's clock and ours may differ in real time before the alarm is raised."""
    driver: ControlStrategy = ControlStrategy.MPC
    classical: ClassicalSettings = Field(default_factory=ClassicalSettings)
    cool_down: CoolDownSettings = CoolDownSettings()
    """Cool-down of a cold box that is warm at the beginning."""
    ladder: LadderSettings = Field(default_factory=LadderSettings)
    sensors: SensorCheckSettings = Field(default_factory=SensorCheckSettings)
    alarms: AlarmSettings = Field(default_factory=AlarmSettings)
    retain: RetainSettings = RetainSettings()


class ControlSettings(RootSettings):
    """Settings that the control PLC reads of a configuration."""

    limits: InputLimits = Field(default_factory=InputLimits)
    session: SessionSettings = SessionSettings()
    control_plc: ControlSection = Field(default_factory=ControlSection)
    telemetry: TelemetrySettings = TelemetrySettings()
