"""The whole configuration: what the three services and the rig read, from files or from Python arguments."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, Self

from pydantic import Field

from coldloop.config import Configuration, flattened, load_configuration
from coldloop.errors import UsageError
from coldloop.process.settings import InputLimits, RootSettings
from coldloop.service.settings import TelemetrySettings
from coldloop.session import SessionSettings
from coldloop_control_plc.settings import ControlSection
from coldloop_hmi.settings import HmiSection
from coldloop_optimizer_plc.settings import OptimizerSection
from coldloop_plant.settings import PlantSection
from coldloop_rig.cosim.wiring import RigSection


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


Period = float | Literal["adaptive"]
Sections = Mapping[str, Mapping[str, object] | object]


def configured(
    *,
    load: str | Path | None,
    solver: str | None,
    updating_period: Period | None,
    seed: int | None,
    config: str | Path | None,
    sections: Sections,
    process: str | Path | None = None,
    mode: str | None = None,
    factor: float | None = None,
) -> Configuration[Settings]:
    """Return the configuration; arguments that are None are left to the file, and the environment has no influence.

    Raises:
        UsageError: An argument cannot be used; one line that says why.
    """
    if not isinstance(process, str | Path | None):
        raise UsageError(f"process: a path of a process file or a model file, not {type(process).__name__}")
    model: Path | None = None
    if process is not None:
        from coldloop_rig.process_file.reading import model_file_of  # noqa: PLC0415 it is made with these settings

        model, told = model_file_of(Path(process))
        for line in told:
            warnings.warn(f"{process}: {line}", stacklevel=3)
    arguments: dict[str, tuple[object, str]] = {
        "model.file": (model and str(model), "process"),
        "plant.load": (None if load is None else str(load), "load"),
        "plant.seed": (seed, "seed"),
        "optimizer_plc.program.solver": (solver, "solver"),
        "optimizer_plc.program.updating_period_s": (0.0 if updating_period == "adaptive" else updating_period,
                                                    "updating_period"),
        "session.mode": (mode, "mode"),
        "session.factor": (factor, "factor"),
    }  # fmt: skip
    given = {key: (value, name) for key, (value, name) in arguments.items() if value is not None}
    own = {key: (value, key) for key, value in flattened(sections).items() if value != {}}
    if twice := sorted(given.keys() & own.keys()):
        raise UsageError(f"{given[twice[0]][1]}: {twice[0]} is given, too; drop one of them")
    options = given | own
    return load_configuration(Settings, file=None if config is None else Path(config), environment={}, options=options)
