"""The faults that a chaos plan may hold; each knows what belongs to it."""

from enum import StrEnum
from typing import Annotated, ClassVar, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, model_validator

from coldloop.process.settings import declared, settings_process
from coldloop_plant.refrigerator.settings import EventTarget, RefrigeratorEvent

Share = Annotated[float, Field(gt=0, le=1)]
Duration = Annotated[float, Field(gt=0, le=86_400)]
Milliseconds = Annotated[float, Field(ge=0, le=60_000)]

SERVICE_OF: Final = {"optimizer": "optimizer_plc", "control": "control_plc", "plant": "plant"}
"""Services by the names that plans have for their processes."""


class Link(StrEnum):
    """A connection between two of the services."""

    OPTIMIZER = "optimizer"
    """From the optimiser to the control PLC."""
    PLANT = "plant"
    """From the control PLC to the plant."""


class Direction(StrEnum):
    """Direction of the frames of a link that a fault affects."""

    BOTH = "both"
    REQUESTS = "requests"
    """From the client to the server."""
    ANSWERS = "answers"


class Fault(BaseModel):
    """A fault, from `at_s` on for `duration_s`, both in seconds of plant time."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    _tick_s: float = PrivateAttr(default_factory=lambda: settings_process().tick_s)
    at_s: Annotated[float, Field(ge=0)] | None = None
    """Left out where the instant is drawn."""
    duration_s: Duration
    kind: str

    @property
    def tick(self) -> int:
        """The tick before which it begins."""
        return round((self.at_s or 0.0) / self._tick_s)

    @property
    def end_tick(self) -> int:
        """The tick before which it is to end."""
        return self.tick + round(self.duration_s / self._tick_s)

    in_tables: ClassVar[str] = "{what}"
    """Template of its name in tables: `what` is its kind in words, the others are its fields."""

    @property
    def label(self) -> str:
        """Name in tables."""
        return self.in_tables.format(what=self.kind.replace("_", " "), **self.__dict__)

    @property
    def processes(self) -> frozenset[str]:
        """Services whose processes it stops."""
        return frozenset()

    @property
    def stops_time(self) -> bool:
        """Whether it stops plant time in lock-step: plant and control PLC advance it."""
        return bool(self.processes & {"plant", "control_plc"})


class LinkFault(Fault):
    """Something wrong with a link, as its proxy does it."""

    in_tables = "{what} link {link}"
    link: Link

    @property
    def in_words(self) -> str:
        """Kind of the fault, and the share of frames hit."""
        given = self.model_dump(mode="json", exclude={"at_s", "duration_s", "kind", "link"})
        return " ".join([self.kind, *(f"{name}={value}" for name, value in given.items())])


class FrameFault(LinkFault):
    """A fault of single frames."""

    direction: Direction = Direction.BOTH

    @property
    def label(self) -> str:
        """Name in tables."""
        which = "" if self.direction is Direction.BOTH else f" ({self.direction})"
        return f"{super().label}{which}"


class Delay(FrameFault):
    """Frames arrive late, in order."""

    kind: Literal["delay"]
    delay_ms: Milliseconds
    """Real time."""
    jitter_ms: Milliseconds = 0.0
    """Largest deviation from it, either way."""


class Drop(FrameFault):
    """Whole frames are lost."""

    kind: Literal["drop"]
    share: Share


class Duplicate(FrameFault):
    """Frames arrive twice."""

    kind: Literal["duplicate"]
    share: Share


class Reorder(FrameFault):
    """A frame is overtaken by the next one, if that comes soon enough."""

    kind: Literal["reorder"]
    share: Share
    hold_ms: Milliseconds = 20.0
    """Longest wait for a frame that overtakes it, ms of real time."""


class Reset(LinkFault):
    """All connections are reset (RST), and new ones while the fault lasts."""

    kind: Literal["reset"]


class Freeze(LinkFault):
    """Nothing passes; the connections stay open."""

    kind: Literal["freeze"]


class Truncate(FrameFault):
    """Half a frame passes, then the connection is closed."""

    kind: Literal["truncate"]
    share: Share = 1.0


class Abort(FrameFault):
    """The connection is reset (RST) in the place of a frame."""

    kind: Literal["abort"]
    share: Share


class Flip(FrameFault):
    """Bits of frames are flipped."""

    kind: Literal["flip"]
    share: Share
    bits: Annotated[int, Field(ge=1, le=64)] = 1


class WrongUnit(FrameFault):
    """Frames name another unit than they should."""

    kind: Literal["wrong_unit"]
    share: Share = 1.0


class ExceptionAnswer(FrameFault):
    """An exception instead of the server's answer; the server has carried out the request."""

    kind: Literal["exception"]
    direction: Literal[Direction.ANSWERS] = Direction.ANSWERS
    share: Share = 1.0
    code: Annotated[int, Field(ge=1, le=255)] = 4
    """4 is a failure of the server, 6 busy, 11 a gateway whose target does not answer."""


class ProcessFault(Fault):
    """Something done to a process."""

    in_tables = "{kind} {process}"
    process: Literal["optimizer", "control", "plant"]
    offset_ms: Milliseconds = 0.0
    """Real time by which the signal is sent later than the tick, while the rig moves on."""

    @property
    def processes(self) -> frozenset[str]:
        """Services whose processes it stops."""
        return frozenset({SERVICE_OF[self.process]})


class Kill(ProcessFault):
    """SIGKILL, and a new start at the end."""

    kind: Literal["kill"]


class Pause(ProcessFault):
    """SIGSTOP, and SIGCONT at the end."""

    kind: Literal["pause"]


class Restart(ProcessFault):
    """SIGTERM, and a new start at the end."""

    kind: Literal["restart"]
    duration_s: Duration = declared(lambda process: process.tick_s)


class Clock(Fault):
    """A jump of the clock as all three processes see it: all are suspended and resumed."""

    in_tables = "clock +{duration_s:g} s"
    kind: Literal["clock"]

    @property
    def processes(self) -> frozenset[str]:
        """Services whose processes it stops."""
        return frozenset(SERVICE_OF.values())


class Sensor(Fault):
    """A sensor of the plant shows something else."""

    kind: Literal["sensor"]
    output: str
    shows: Literal["nan", "frozen", "value"]
    value: Annotated[float, Field(allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = settings_process().output_names
        if self.output not in names:
            raise ValueError(f"unknown output '{self.output}'; choose one of {', '.join(names)}")
        if (self.shows == "value") != (self.value is not None):
            raise ValueError('give `value` with shows = "value", and only then')
        return self

    @property
    def label(self) -> str:
        """Name in tables."""
        return f"sensor {self.output} {self.shows if self.value is None else f'= {self.value:g}'}"


class BoundaryFault(Fault):
    """Something that a refrigerator is given is otherwise: a compressor trips, nitrogen runs out, helium leaks."""

    in_tables = "{target} = {value:g}"
    kind: Literal["given"]
    target: EventTarget
    value: Annotated[float, Field(allow_inf_nan=False)]

    @model_validator(mode="after")
    def _possible(self) -> Self:
        RefrigeratorEvent(at_s=0.0, target=self.target, value=self.value)
        return self


class WrongModel(Fault):
    """The optimiser is restarted with the model of another operating point, and with the right one at the end."""

    kind: Literal["wrong_model"]

    @property
    def processes(self) -> frozenset[str]:
        """Services whose processes it stops."""
        return frozenset({"optimizer_plc"})


AnyLinkFault = Annotated[
    Abort | Delay | Drop | Duplicate | ExceptionAnswer | Flip | Freeze | Reorder | Reset | Truncate | WrongUnit,
    Field(discriminator="kind"),
]
AnyFault = Annotated[
    AnyLinkFault
    | Kill | Pause | Restart | Clock | Sensor | BoundaryFault | WrongModel,
    Field(discriminator="kind"),
]  # fmt: skip
