"""The whole configuration: what the three services and the rig read."""

from typing import Self

from pydantic import Field

from coldloop.process.limits import InputLimits
from coldloop.process.settings import RootSettings
from coldloop.service.telemetry_settings import TelemetrySettings
from coldloop.session.settings import SessionSettings
from coldloop_control_plc.settings import ControlSection
from coldloop_hmi.settings import HmiSection
from coldloop_optimizer_plc.settings import OptimizerSection
from coldloop_plant.settings import PlantSection
from coldloop_rig.operator_settings import RigSection


class Settings(RootSettings):
    """All sections of a configuration file."""

    limits: InputLimits = Field(default_factory=InputLimits)
    session: SessionSettings = SessionSettings()
    plant: PlantSection = Field(default_factory=PlantSection)
    control_plc: ControlSection = Field(default_factory=ControlSection)
    optimizer_plc: OptimizerSection = Field(default_factory=OptimizerSection)
    telemetry: TelemetrySettings = TelemetrySettings()
    rig: RigSection = RigSection()
    hmi: HmiSection = HmiSection()

    def with_program(self, **changes: object) -> Self:
        """Return settings with some of the optimiser's program changed."""
        program = self.optimizer_plc.program.model_copy(update=changes)
        return self.model_copy(update={"optimizer_plc": self.optimizer_plc.model_copy(update={"program": program})})
