"""The whole configuration: what the three services and the rig read."""

from typing import Self

from pydantic import BaseModel, ConfigDict

from coldloop.process.limits import InputLimits
from coldloop.process.model_settings import ModelSettings
from coldloop.service.telemetry_settings import TelemetrySettings
from coldloop.session.settings import SessionSettings
from control_plc.settings import ControlSection
from hmi.settings import HmiSection
from optimizer_plc.settings import OptimizerSection
from plant.settings import PlantSection
from rig.operator_settings import RigSection


class Settings(BaseModel):
    """All sections of a configuration file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    limits: InputLimits = InputLimits()
    model: ModelSettings = ModelSettings()
    session: SessionSettings = SessionSettings()
    plant: PlantSection = PlantSection()
    control_plc: ControlSection = ControlSection()
    optimizer_plc: OptimizerSection = OptimizerSection()
    telemetry: TelemetrySettings = TelemetrySettings()
    rig: RigSection = RigSection()
    hmi: HmiSection = HmiSection()

    def with_program(self, **changes: object) -> Self:
        """Return settings with some of the optimiser's program changed."""
        program = self.optimizer_plc.program.model_copy(update=changes)
        return self.model_copy(update={"optimizer_plc": self.optimizer_plc.model_copy(update={"program": program})})
