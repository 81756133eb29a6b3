"""Configuration of the control PLC, checked when it is made and immutable after."""

from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from coldloop.endpoints import CONTROL_PORT, PLANT_PORT, Endpoint
from coldloop.limits import InputLimits
from coldloop.modbus.settings import ServerSettings
from coldloop.model_settings import ModelSettings
from coldloop.registers.codec import WordOrder
from coldloop.session import SessionSettings
from coldloop.telemetry import TelemetrySettings
from control_plc.classical import ClassicalSettings


class ControlServer(ServerSettings):
    """The control PLC's server."""

    port: Annotated[int, Field(ge=0, le=0xFFFF)] = CONTROL_PORT


class PlantEndpoint(Endpoint):
    """Where the plant's rack is."""

    port: Annotated[int, Field(ge=1, le=0xFFFF)] = PLANT_PORT


class Driver(StrEnum):
    """Who drives the inputs."""

    MPC = "mpc"
    """The optimiser's sequences."""
    CLASSICAL = "classical"
    """The classical loops; no update is latched, and the optimiser idles."""


class ControlSection(BaseModel):
    """Section `control_plc` of the configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    server: ControlServer = ControlServer()
    word_order: WordOrder = WordOrder.HIGH_FIRST
    plant: PlantEndpoint = PlantEndpoint()
    scan_tolerance_ms: Annotated[float, Field(gt=0)] = 5.0
    """Lateness of a scan, in real time, that counts as an overrun."""
    driver: Driver = Driver.MPC
    classical: ClassicalSettings = ClassicalSettings()


class ControlSettings(BaseModel):
    """What the control PLC reads of a configuration."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    limits: InputLimits = InputLimits()
    model: ModelSettings = ModelSettings()
    session: SessionSettings = SessionSettings()
    control_plc: ControlSection = ControlSection()
    telemetry: TelemetrySettings = TelemetrySettings()
