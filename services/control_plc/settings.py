"""Configuration of the control PLC, checked when it is made and immutable after."""

import math
from enum import StrEnum
from typing import Annotated, Final

from pydantic import BaseModel, ConfigDict, Field

from coldloop.modbus.endpoints import CONTROL_PORT, PLANT_PORT, Endpoint
from coldloop.modbus.settings import ServerSettings
from coldloop.process.limits import InputLimits
from coldloop.process.model_settings import ModelSettings
from coldloop.process.signals import SAMPLING_PERIOD_S, STRETCH, TICK_S
from coldloop.registers.codec import WordOrder
from coldloop.safety.retained import RetainSettings
from coldloop.service.metrics_settings import MetricsSettings
from coldloop.service.telemetry_settings import TelemetrySettings
from coldloop.session.settings import SessionSettings
from control_plc.alarm_settings import AlarmSettings
from control_plc.classical import ClassicalSettings
from control_plc.cool_down import CoolDownSettings
from control_plc.sensors import SensorCheckSettings

SHOWN: Final = (
    "limits", "control_plc.scan_tolerance_ms", "control_plc.skew_alarm_ppm", "control_plc.driver",
    "control_plc.classical", "control_plc.cool_down", "control_plc.ladder", "control_plc.sensors",
    "control_plc.alarms",
)  # fmt: skip
"""What of the configuration decides results: shown in the registers."""


class ControlServer(ServerSettings):
    """The control PLC's server."""

    port: Annotated[int, Field(ge=0, le=0xFFFF)] = CONTROL_PORT


class PlantEndpoint(Endpoint):
    """Where the plant's rack is."""

    port: Annotated[int, Field(ge=1, le=0xFFFF)] = PLANT_PORT
    """TCP port."""


class ControlStrategy(StrEnum):
    """Operating mode at the start."""

    MPC = "mpc"
    """The optimiser's sequences."""
    CLASSICAL = "classical"
    """The classical loops; no update is latched, and the optimiser idles."""


class LadderSettings(BaseModel):
    """How long each rung of the fail-safe ladder bears."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    hold_s: Annotated[float, Field(ge=0)] = 30.0 * STRETCH
    """How long the last value holds before the classical loops take over."""
    optimizer_timeout_s: Annotated[float, Field(ge=0, le=64_000 * TICK_S)] = max(
        15.0 * max(STRETCH, 1.0), 3 * SAMPLING_PERIOD_S
    )
    """An optimiser that gives no sign of life for so long is lost; 0 is never. Plant time, longer than any tau_u."""
    optimizer_patience_s: Annotated[float, Field(gt=0)] = 5.0
    """In lock-step plant time waits while the optimiser is waited for: it is lost after so long in real time."""

    @property
    def hold_ticks(self) -> int:
        """The hold, in ticks."""
        return round(self.hold_s / TICK_S)

    @property
    def optimizer_ticks(self) -> int:
        """The time-out, in ticks."""
        return math.ceil(self.optimizer_timeout_s / TICK_S)


class ControlSection(BaseModel):
    """Section `control_plc` of the configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    classical: ClassicalSettings = ClassicalSettings()
    cool_down: CoolDownSettings = CoolDownSettings()
    """Of a cold box that is warm at the beginning."""
    ladder: LadderSettings = LadderSettings()
    sensors: SensorCheckSettings = SensorCheckSettings()
    alarms: AlarmSettings = AlarmSettings()
    retain: RetainSettings = RetainSettings()


class ControlSettings(BaseModel):
    """What the control PLC reads of a configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    limits: InputLimits = InputLimits()
    model: ModelSettings = ModelSettings()
    session: SessionSettings = SessionSettings()
    control_plc: ControlSection = ControlSection()
    telemetry: TelemetrySettings = TelemetrySettings()
