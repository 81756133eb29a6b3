"""Faults, and the plans that hold them: TOML files that say what is run, what goes wrong in it and when.

The plan of a chaos run has everything; that of a proxy has the faults of its one link.
"""

import random
from enum import StrEnum
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self, TypeVar

import pydantic
from pydantic import BaseModel, ConfigDict, Field, model_validator

from coldloop import config, errors
from coldloop.process.settings import ProcessSettings, declared, one_of, settings_process, within
from coldloop.process.updating_periods import whole_ticks
from coldloop.session import TimeMode
from coldloop.text import parsed_toml, read_text
from coldloop_plant.load import concatenated, find_load, named_families, telegraph
from coldloop_plant.settings import EventTarget, PlantKind, RefrigeratorEvent
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.settings import Settings

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

    _tick_s: float = pydantic.PrivateAttr(default_factory=lambda: settings_process().tick_s)
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
    stopped: ClassVar[tuple[str, ...]] = ()

    @property
    def label(self) -> str:
        """Name in tables."""
        return self.in_tables.format(what=self.kind.replace("_", " "), **self.__dict__)

    @property
    def processes(self) -> frozenset[str]:
        """Services whose processes it stops."""
        return frozenset(self.stopped)


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


class ShareFault(FrameFault):
    """A fault of a share of the frames, drawn one by one."""

    share: Share


class FrameLoss(ShareFault):
    """Whole frames are lost, or arrive twice; or the connection is reset (RST) in the place of a frame."""

    kind: Literal["drop", "duplicate", "abort"]


class FrameDamage(ShareFault):
    """Half a frame passes, then the connection is closed; or frames name another unit than they should."""

    kind: Literal["truncate", "wrong_unit"]
    share: Share = 1.0


class Reorder(ShareFault):
    """A frame is overtaken by the next one, if that comes soon enough."""

    kind: Literal["reorder"]
    hold_ms: Milliseconds = 20.0
    """Longest wait for a frame that overtakes it, ms of real time."""


class LinkCut(LinkFault):
    """All connections are reset (RST), and new ones while the fault lasts; or they stay open, and nothing passes."""

    kind: Literal["reset", "freeze"]


class Flip(ShareFault):
    """Bits of frames are flipped."""

    kind: Literal["flip"]
    bits: Annotated[int, Field(ge=1, le=64)] = 1


class ExceptionAnswer(ShareFault):
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


class ProcessStop(ProcessFault):
    """SIGKILL, and a new start at the end; or SIGSTOP, and SIGCONT at the end."""

    kind: Literal["kill", "pause"]


class Restart(ProcessFault):
    """SIGTERM, and a new start at the end."""

    kind: Literal["restart"]
    duration_s: Duration = declared(lambda process: process.tick_s)


class Clock(Fault):
    """A jump of the clock as all three processes see it: all are suspended and resumed."""

    in_tables = "clock +{duration_s:g} s"
    stopped = tuple(SERVICE_OF.values())
    kind: Literal["clock"]


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

    stopped = ("optimizer_plc",)
    kind: Literal["wrong_model"]


AnyLinkFault = Annotated[
    Delay | ExceptionAnswer | Flip | FrameDamage | FrameLoss | LinkCut | Reorder, Field(discriminator="kind")
]
AnyFault = Annotated[
    AnyLinkFault | ProcessStop | Restart | Clock | Sensor | BoundaryFault | WrongModel, Field(discriminator="kind")
]


class LinkPlan(BaseModel, frozen=True, extra="forbid"):
    """Faults of one link. Instants are real time, from the start of the proxy."""

    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    """Decides which frames are hit."""
    faults: Annotated[tuple[AnyLinkFault, ...], Field(min_length=1)]
    """As in a chaos plan, with no `link`. Without `at_s` they begin at once, without `duration_s` they last a day."""

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, content: Any) -> Any:  # noqa: ANN401 any content of a file
        if not isinstance(content, dict) or not isinstance(content.get("faults"), list):
            return content
        if "load" in content:
            raise ValueError(
                "this is a chaos plan; a proxy's plan has only `seed` and `faults` (`coldloop docs chaos`)"
            )
        found = [fault for fault in content["faults"] if isinstance(fault, dict)]
        if any("link" in fault for fault in found):
            raise ValueError("faults: a proxy has one link; leave `link` out")
        usual = {"at_s": 0.0, "duration_s": 86_400.0, "link": Link.PLANT}
        return {**content, "faults": [usual | one if isinstance(one, dict) else one for one in content["faults"]]}

    def changes(self) -> list[tuple[float, bool, AnyLinkFault]]:
        """Return times since the start of the proxy, s, and which fault begins (True) or ends then, in order."""
        begins = [(fault.at_s or 0.0, True, fault) for fault in self.faults]
        ends = [(at_s + fault.duration_s, False, fault) for at_s, _, fault in begins]
        return sorted([*begins, *ends], key=lambda change: change[0])


P = TypeVar("P", bound=BaseModel)
REMEDY: Final = "name a readable TOML file"
SHIPPED: Final = files("coldloop_chaos") / "plans"

OF_PLAN: Final = {
    "plant.load": "--load", "plant.seed": "--seed", "session.mode": "--mode", "session.factor": "--factor",
    "optimizer_plc.program.updating_period_s": "updating_period_s of the plan",
}  # fmt: skip
"""Keys of the configuration whose values a plan has, and what changes them there."""

SPREAD_S: Final = 20.0
"""Drawn faults begin up to so much after their multiple of `every_s`: anywhere in an updating period."""


def _of_ticks(seconds: float) -> float:
    tick_s = settings_process().tick_s
    if whole_ticks(seconds, tick_s) is None:
        raise ValueError(f"input should be a multiple of {tick_s:g}")
    return seconds


class ChaosPlan(ProcessSettings):
    """A run and its faults."""

    name: str
    description: str
    load: str | tuple[str, ...] = "a"
    """Named load or CSV file; or named loads, one after the other."""
    duration_s: Annotated[float, Field(gt=0, le=7 * 86_400), pydantic.AfterValidator(_of_ticks)]
    plant: Annotated[PlantKind, one_of("plant", lambda process: process.plants)] | None = None
    """Kind of the plant; that of the configuration if not given."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    """Seed of all random draws: instants, frames that are hit, the sensors' noise."""
    mode: TimeMode = TimeMode.LOCKSTEP
    factor: Annotated[float, Field(ge=0.01, le=10_000)] = 1.0
    updating_period_s: Annotated[float, within(lambda process: (0, process.sampling_period_s))] = 0.0
    """0 is adaptive."""
    standstill_s: Annotated[float, Field(gt=0, le=600)] = 8.0
    """In lock-step a fault that stops plant time ends after this real time. The control PLC drops an
    optimiser that is silent for `control_plc.ladder.optimizer_patience_s`, and continues."""
    faults: tuple[AnyFault, ...] = ()
    every_s: Annotated[float, Field(ge=2 * SPREAD_S)] | None = None
    """Draw a fault so often, from `draw`."""
    draw: tuple[AnyFault, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if any(fault.at_s is None for fault in self.faults):
            raise ValueError("each of `faults` needs at_s")
        if any(fault.at_s is not None for fault in self.draw):
            raise ValueError("those in `draw` have no at_s: their instants are drawn")
        if (self.every_s is None) != (not self.draw):
            raise ValueError("give every_s and `draw` together")
        if any(fault.tick >= self.ticks for fault in self.faults):
            raise ValueError(f"a fault begins after the end of the run, {self.duration_s:g} s")
        schedule = self.schedule()
        for number, fault in enumerate(schedule):
            for later in schedule[number + 1 :]:
                if later.tick < fault.end_tick and later.processes & fault.processes:
                    raise ValueError(f"'{later.label}' at {later.at_s:g} s begins before '{fault.label}' has ended")
        if any(isinstance(fault, BoundaryFault) for fault in (*self.faults, *self.draw)) and (
            self.plant is not PlantKind.REFRIGERATOR
        ):
            raise ValueError('a fault of kind "given" needs plant = "refrigerator"')
        return self

    @property
    def realtime(self) -> bool:
        """Whether plant time follows the clock."""
        return self.mode is TimeMode.REALTIME

    @property
    def ticks(self) -> int:
        """Length of the run."""
        return round(self.duration_s / self.process.tick_s)

    def schedule(self) -> list[AnyFault]:
        """Return all faults, those drawn too, in the order in which they begin."""
        drawn, tick_s = [], self.process.tick_s
        if self.every_s is not None:
            draw = random.Random(self.seed)  # noqa: S311 not for secrets
            for number in range(1, int(self.duration_s / self.every_s) + 1):
                at = number * self.every_s + tick_s * draw.randrange(round(SPREAD_S / tick_s))
                fault = self.draw[draw.randrange(len(self.draw))]
                if at + fault.duration_s < self.duration_s:
                    drawn.append(fault.model_copy(update={"at_s": at}))
        return sorted([*self.faults, *drawn], key=lambda fault: fault.tick)

    def with_plant(self, settings: Settings) -> Settings:
        """Return settings with the plant that the plan asks for."""
        if self.plant is None:
            return settings
        return settings.model_copy(update={"plant": settings.plant.model_copy(update={"kind": self.plant})})

    def configured(self, effective: config.Configuration[Settings]) -> config.Configuration[Settings]:
        """Return a configuration with the values of the plan, as a manifest records it."""
        settings = self.with_plant(effective.settings)
        load = self.load if isinstance(self.load, str) else ", ".join(self.load)
        plant = settings.plant.model_copy(update={"load": load, "seed": self.seed})
        session = settings.session.model_copy(update={"mode": self.mode, "factor": self.factor})
        planned = settings.with_program(updating_period_s=self.updating_period_s)
        planned = planned.model_copy(update={"plant": plant, "session": session})
        return config.Configuration(planned, {**effective.sources, **dict.fromkeys(OF_PLAN, f"plan {self.name}")})

    def scenario(self, mean_w: float) -> Scenario:
        """Return the run without its faults; `mean_w` is the load of the operating point."""
        if isinstance(self.load, str):
            load = find_load(self.load, mean_w, self.process)
        else:
            families = []
            for name in self.load:
                if (here := named_families(name)) is None:
                    raise errors.LoadFileError(
                        f"load {name}: only named loads can follow each other; give a CSV file alone"
                    )
                families += here
            load = concatenated([telegraph(family, mean_w) for family in families])
        return Scenario(
            ticks=self.ticks, load=load, updating_period_s=self.updating_period_s, seed=self.seed,
            realtime=self.realtime, factor=self.factor,
        )  # fmt: skip


def shipped_plans() -> list[ChaosPlan]:
    """Return the plans that come with Coldloop, by name: those that suit the process."""
    plans = []
    for entry in SHIPPED.iterdir():
        if entry.name.endswith(".toml"):
            try:
                plans.append(parsed_plan(ChaosPlan, entry.read_text(encoding="utf-8"), entry.name, {}))
            except errors.UsageError:  # its signals or its plant are another process's
                continue
    return sorted(plans, key=lambda plan: plan.name)


def find_plan(name: str, changes: dict[str, Any]) -> ChaosPlan:
    """Return a shipped plan, or that of a file, with changes. Raises UsageError: there is none, or it is wrong."""
    shipped = SHIPPED / f"{name}.toml"
    if "/" not in name and shipped.is_file():
        return parsed_plan(ChaosPlan, shipped.read_text(encoding="utf-8"), name, changes)
    if not Path(name).exists():
        raise errors.UsageError(f"plan {name}: neither a file nor a shipped plan; `coldloop chaos --list` names them")
    return parsed_plan(ChaosPlan, read_text(Path(name), REMEDY), name, changes)


def find_link_plan(name: str, changes: dict[str, Any]) -> LinkPlan:
    """Return the plan of a proxy's link in a file, with changes. Raises UsageError: there is none, or it is wrong."""
    return parsed_plan(LinkPlan, read_text(Path(name), REMEDY), name, changes)


def parsed_plan(kind: type[P], text: str, source: str, changes: dict[str, Any]) -> P:
    """Return the plan that a TOML text holds, with some of its values changed; a shorter run has fewer faults."""
    try:
        content = parsed_toml(text)
    except ValueError as error:
        raise errors.UsageError(f"{source}: not TOML: {error}") from None
    if "duration_s" in changes:
        end_s = changes["duration_s"]
        content["faults"] = [
            fault for fault in content.get("faults", [])
            if not (isinstance(fault, dict) and isinstance(at := fault.get("at_s"), int | float) and at >= end_s)
        ]  # fmt: skip
    try:
        return kind.model_validate({**content, **changes})
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        message = " ".join(first["msg"].removeprefix("Value error, ").split())
        if first["type"] == "extra_forbidden":
            message = "no such key; `coldloop docs chaos` lists them"
        raise errors.UsageError(f"{source}: {f'{where}: ' if where else ''}{message}") from None
