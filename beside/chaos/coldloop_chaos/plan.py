"""Chaos plans: TOML files that say what is run, what goes wrong in it and when; and plans of a proxy in one link."""

import random
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from coldloop.config import Configuration
from coldloop.errors import LoadFileError, UsageError
from coldloop.parsing import parsed_toml
from coldloop.process.load_profile import LoadProfile
from coldloop.process.settings import ProcessSettings, one_of, settings_process, within
from coldloop.process.updating_periods import whole_ticks
from coldloop.session.settings import TimeMode
from coldloop.text_file import read_text
from coldloop_chaos.faults import AnyFault, AnyLinkFault, BoundaryFault, Link, LinkFault
from coldloop_plant.load import concatenated, find_load, named_families, telegraph
from coldloop_plant.settings import PlantKind
from coldloop_rig.cosim.scenario import Scenario
from coldloop_rig.settings import Settings

DAY_S = 86_400.0


class FaultTransition(NamedTuple):
    """A fault begins or ends."""

    at_s: float
    """Real time since the proxy has started."""
    begins: bool
    fault: LinkFault


class LinkPlan(BaseModel):
    """Faults of one link. Instants are real time, from the start of the proxy."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
        return {**content, "faults": [_completed(fault) for fault in content["faults"]]}

    def changes(self) -> list[FaultTransition]:
        """Return when faults begin and end, in the order of time."""
        changes = []
        for fault in self.faults:
            begin_s = fault.at_s or 0.0
            changes.append(FaultTransition(begin_s, begins=True, fault=fault))
            changes.append(FaultTransition(begin_s + fault.duration_s, begins=False, fault=fault))
        return sorted(changes, key=lambda change: change.at_s)


def _completed(fault: object) -> object:
    if not isinstance(fault, dict):
        return fault
    if "link" in fault:
        raise ValueError("faults: a proxy has one link; leave `link` out")
    return {"at_s": 0.0, "duration_s": DAY_S, "link": Link.PLANT, **fault}


P = TypeVar("P", bound=BaseModel)

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
    duration_s: Annotated[float, Field(gt=0, le=7 * 86_400), AfterValidator(_of_ticks)]
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
        _refuse_overlaps(self.schedule())
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

    def configured(self, effective: Configuration[Settings]) -> Configuration[Settings]:
        """Return a configuration with the values of the plan, as a manifest records it."""
        settings = self.with_plant(effective.settings)
        session = settings.session
        load = self.load if isinstance(self.load, str) else ", ".join(self.load)
        planned = settings.with_program(updating_period_s=self.updating_period_s).model_copy(
            update={
                "plant": settings.plant.model_copy(update={"load": load, "seed": self.seed}),
                "session": session.model_copy(update={"mode": self.mode, "factor": self.factor}),
            }
        )
        return Configuration(planned, {**effective.sources, **dict.fromkeys(OF_PLAN, f"plan {self.name}")})

    def scenario(self, mean_w: float) -> Scenario:
        """Return the run without its faults; `mean_w` is the load of the operating point."""
        return Scenario(
            ticks=self.ticks,
            load=self._profile(mean_w),
            updating_period_s=self.updating_period_s,
            seed=self.seed,
            realtime=self.realtime,
            factor=self.factor,
        )

    def _profile(self, mean_w: float) -> LoadProfile:
        if isinstance(self.load, str):
            return find_load(self.load, mean_w, self.process)
        families = []
        for name in self.load:
            here = named_families(name)
            if here is None:
                raise LoadFileError(f"load {name}: only named loads can follow each other; give a CSV file alone")
            families += here
        return concatenated([telegraph(family, mean_w) for family in families])


def _refuse_overlaps(schedule: list[AnyFault]) -> None:
    """Reject a second stop of a process that is already stopped."""
    for number, fault in enumerate(schedule):
        for later in schedule[number + 1 :]:
            if later.tick >= fault.end_tick:
                break
            if later.processes & fault.processes:
                raise ValueError(f"'{later.label}' at {later.at_s:g} s begins before '{fault.label}' has ended")


def shipped_plans() -> list[ChaosPlan]:
    """Return the plans that come with Coldloop, by name: those that suit the process."""
    plans = []
    for entry in SHIPPED.iterdir():
        if entry.name.endswith(".toml"):
            try:
                plans.append(parse_plan(entry.read_text(encoding="utf-8"), entry.name, {}))
            except UsageError:  # its signals or its plant are another process's
                continue
    return sorted(plans, key=lambda plan: plan.name)


def find_plan(name: str, changes: dict[str, Any]) -> ChaosPlan:
    """Return a shipped plan, or that of a file, with some of its values changed.

    Raises:
        UsageError: There is no such plan, or something in it is wrong; one line that says what.
    """
    shipped = SHIPPED / f"{name}.toml"
    if "/" not in name and shipped.is_file():
        return parse_plan(shipped.read_text(encoding="utf-8"), name, changes)
    if not Path(name).exists():
        raise UsageError(f"plan {name}: neither a file nor a shipped plan; `coldloop chaos --list` names them")
    return parse_plan(_text_of(name), name, changes)


def find_link_plan(name: str, changes: dict[str, Any]) -> LinkPlan:
    """Return the plan of a proxy's link that a file holds, with some of its values changed.

    Raises:
        UsageError: There is no such file, or something in it is wrong; one line that says what.
    """
    return _validated(LinkPlan, {**_content(_text_of(name), name), **changes}, name)


def _text_of(name: str) -> str:
    return read_text(Path(name), "name a readable TOML file")


def parse_plan(text: str, source: str, changes: dict[str, Any]) -> ChaosPlan:
    """Return the plan that a TOML text holds, with some of its values changed."""
    content = _content(text, source)
    if "duration_s" in changes:  # a shorter run has fewer faults
        content["faults"] = [
            fault for fault in content.get("faults", []) if _begins_before(fault, changes["duration_s"])
        ]
    return _validated(ChaosPlan, {**content, **changes}, source)


def _content(text: str, source: str) -> dict[str, Any]:
    try:
        return parsed_toml(text)
    except ValueError as error:
        raise UsageError(f"{source}: not TOML: {error}") from None


def _validated(kind: type[P], content: dict[str, Any], source: str) -> P:
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise UsageError(f"{source}: {_explained(error)}") from None


def _begins_before(fault: object, end_s: float) -> bool:
    at = fault.get("at_s") if isinstance(fault, dict) else None
    return not isinstance(at, int | float) or at < end_s


def _explained(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    message = " ".join(first["msg"].removeprefix("Value error, ").split())
    if first["type"] == "extra_forbidden":
        message = "no such key; `coldloop docs chaos` lists them"
    return f"{where}: {message}" if where else message
