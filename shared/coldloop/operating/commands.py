"""Commands of operators: checked here, described in words, and carried out elsewhere."""

from typing import Annotated, Final, Literal

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from coldloop.errors import LoadFileError, UsageError
from coldloop.process import declaration, load_profile
from coldloop.process.settings import ProcessSettings, one_of, settings_of, settings_process, within
from coldloop.registers import common, plant
from coldloop.service.journal import alarm_word
from coldloop.text import value_text

LONGEST_FILE: Final = 1_000_000
"""Characters of a load file."""
MOST_STEPS: Final = 4000
"""Steps of a load that are sent at once; the plant keeps 4096."""


def duration_text(seconds: float) -> str:
    """Return a length of time as people say it, such as "1 h 30 min"."""
    whole = round(seconds)
    if whole < 1:
        return f"{seconds:.2g} s"
    parts = ((whole // 3600, "h"), (whole // 60 % 60, "min"), (whole % 60, "s"))
    return " ".join(f"{number} {unit}" for number, unit in parts if number)


def clock_text(seconds: float) -> str:
    """Return a time of the plant as the page shows it, h:mm:ss."""
    whole = int(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"


class _Command(ProcessSettings):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @property
    def text(self) -> str:
        """The command in words."""
        return self._words()

    def _words(self) -> str:
        raise NotImplementedError


class SetMode(_Command):
    """Operating mode. The change to manual is bumpless: setpoints begin at the applied inputs."""

    kind: Literal["mode"]
    mode: Literal["auto", "classical", "manual"]

    def _words(self) -> str:
        return {
            "auto": "Hand over to automatic: MPC, and the fail-safe ladder when MPC is unavailable",
            "classical": "Switch to the classical loops",
            "manual": "Take over in manual: the inputs stay where they are until a setpoint is written",
        }[self.mode]


class SetSetpoint(_Command):
    """An input in manual mode."""

    kind: Literal["setpoint"]
    input: Annotated[str, one_of("input", lambda process: process.input_names)]
    value: float

    @property
    def place(self) -> int:
        """Index of the input."""
        return self.process.input_names.index(self.input)

    @property
    def unit(self) -> str:
        """Unit of the value."""
        return self.process.inputs[self.place].unit

    def _words(self) -> str:
        return f"Move the setpoint of {self.input} to {value_text(self.value, self.unit)}"


class SetLoad(_Command):
    """The load from a tick on, in its unit: the heat load of the cold box, W."""

    kind: Literal["load"]
    watts: Annotated[float, within(lambda process: process.load.stored_span)]
    tick: Annotated[int, Field(ge=0, le=declaration.LAST_TICK)] = 0
    """0 is the next one."""

    def _words(self) -> str:
        load, tick_s = self.process.load, self.process.tick_s
        begin = clock_text(self.tick * tick_s) if self.tick else "the next tick"
        return f"Change the {load.title} to {value_text(self.watts, load.unit)} from {begin} on"


def _readable(content: str) -> str:
    try:
        steps = len(load_profile.load_profile_of(content, "load file", settings_process()).times)
    except LoadFileError as error:
        raise ValueError(str(error)) from None
    if steps > MOST_STEPS:
        raise ValueError(f"the load file has {steps} steps, more than {MOST_STEPS}: use `coldloop set load FILE`")
    return content


class PlayLoad(_Command):
    """A load file `time_s,load_w` (`load` in another unit) that begins now."""

    kind: Literal["load_file"]
    content: Annotated[str, Field(max_length=LONGEST_FILE), AfterValidator(_readable)]

    @property
    def profile(self) -> load_profile.LoadProfile:
        """The load in the file."""
        return load_profile.load_profile_of(self.content, "load file", self.process)

    def _words(self) -> str:
        times = self.profile.times
        length = duration_text(times[-1] * self.process.tick_s)
        return f"Play a load of {len(times)} steps, {length} long, from now on; its last value is held"


class SetFactor(_Command):
    """Speed of plant time."""

    kind: Literal["factor"]
    factor: Annotated[float, Field(ge=0.01, le=10_000)]

    def _words(self) -> str:
        return f"Run plant time {value_text(self.factor)} times as fast as real time"


class SetPaused(_Command):
    """Pause or resume."""

    kind: Literal["pause"]
    paused: bool

    def _words(self) -> str:
        return "Pause plant time" if self.paused else "Resume plant time"


class TreatAlarm(_Command):
    """Action on an alarm, or on all."""

    kind: Literal["alarm"]
    alarm: int
    action: Annotated[int, Field(ge=1, le=5)]
    time_s: Annotated[int, Field(ge=0, le=0xFFFF)] = 0
    """How long it is shelved, plant time; 0 is the time of the configuration."""
    seen: dict[str, int] | None = None
    """How often each alarm had been raised when the operator looked: those that were raised again are left alone.
    Without it all are meant, seen or not."""

    @field_validator("alarm")
    @classmethod
    def _known(cls, alarm: int) -> int:
        if alarm != common.ALL_ALARMS and alarm not in common.alarms_of(settings_process()):
            raise ValueError(f"unknown alarm {alarm}")
        return alarm

    def _words(self) -> str:
        name = "all alarms" if self.alarm == common.ALL_ALARMS else f"alarm {alarm_word(self.alarm, self.process)}"
        time = f" for {duration_text(self.time_s)}" if self.action == common.AlarmAction.SHELVE and self.time_s else ""
        return f"{common.AlarmAction(self.action).word.capitalize()}: {name}{time}"


class FaultSensor(_Command):
    """Puts a fault into a sensor, for training."""

    kind: Literal["sensor_fault"]
    output: Annotated[str, one_of("output", lambda process: process.output_names)]
    fault: Annotated[int, Field(ge=0, le=3)]
    value: float = 0.0

    def _words(self) -> str:
        value = f" ({value_text(self.value)})" if self.fault == plant.SensorFaultKind.VALUE else ""
        return f"Training: sensor of {self.output}: {plant.SensorFaultKind(self.fault).word}{value}"


Command = SetMode | SetSetpoint | SetLoad | PlayLoad | SetFactor | SetPaused | TreatAlarm | FaultSensor
_COMMAND: Final[TypeAdapter[Command]] = TypeAdapter(Annotated[Command, Field(discriminator="kind")])


def read_command(document: object, process: declaration.Process) -> Command:
    """Return a command for a process as it was sent.

    Raises:
        UsageError: It is none; one line that says what is wrong with it.
    """
    if not process.has_load and isinstance(document, dict) and document.get("kind") in {"load", "load_file"}:
        raise UsageError(f"{process.name} has no load")
    try:
        with settings_of(process):
            return _COMMAND.validate_python(document)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"][1:]) or "command"
        message = first["msg"].removeprefix("Value error, ")
        raise UsageError(f"{place}: {message[0].lower()}{message[1:]}") from None
