"""Settings that follow from the process, the model file that says which process it is, and the limits of its inputs.

A section that has defaults or bounds of its process is a `ProcessSettings`. The whole of a configuration is a
`RootSettings`: its `model.file` decides the process, and all its sections are read for that one. A section that is made
by itself is for the cold box, or for what `settings_of` says; `model_named` says it for a command.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Final, Self

import pydantic
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, PositiveFloat, model_validator
from pydantic_core import CoreSchema, to_jsonable_python
from pydantic_core.core_schema import no_info_after_validator_function

from coldloop.process import cold_box, declaration, model_file

_DATA: Final = Path(__file__).parent / "data"
SHIPPED_MODELS: Final = {"cold-box": _DATA / "cold_box_model.json", "refrigerator": _DATA / "refrigerator_model.json"}
"""Models that have a name: of the cold box alone, and of the refrigerator with its pressure loop closed."""
DEFAULT_MODEL_FILE: Final = SHIPPED_MODELS["cold-box"]
_MODEL: Final[ContextVar[Path]] = ContextVar("model file of settings", default=DEFAULT_MODEL_FILE)
_PROCESS: Final[ContextVar[declaration.Process]] = ContextVar("process of settings", default=cold_box.COLD_BOX)


@contextmanager
def settings_of(process: declaration.Process) -> Iterator[None]:
    """Make settings for a process within the context."""
    token = _PROCESS.set(process)
    try:
        yield
    finally:
        _PROCESS.reset(token)


@contextmanager
def model_named(file: Path) -> Iterator[None]:
    """Let settings that name no model file have this one within the context.

    Raises:
        ModelFileError: It cannot be read, or its process is none.
    """
    token = _MODEL.set(file)
    try:
        with settings_of(process_of(file)):
            yield
    finally:
        _MODEL.reset(token)


def settings_process() -> declaration.Process:
    """Return the process that settings are made for here."""
    return _PROCESS.get()


def made_by(make: Callable[[], Any]) -> Any:  # noqa: ANN401 the default of any field
    """Return a field with a default that is made each time; its JSON schema shows what it is here."""

    def show(schema: dict[str, Any]) -> None:
        schema["default"] = to_jsonable_python(make())

    return Field(default_factory=make, json_schema_extra=show)


def declared(of: Callable[[declaration.Process], Any]) -> Any:  # noqa: ANN401 as above
    """Return a field whose default is what `of` finds in the process."""
    return made_by(lambda: of(_PROCESS.get()))


def stretched(seconds: float, least: float = 0.0) -> Any:  # noqa: ANN401 as above
    """Return a field whose default is a time of the cold box, longer where the ticks of the process are."""
    return declared(lambda process: seconds * max(process.stretch, least))


@dataclass(frozen=True)
class Checked:
    """Check of a value by the process, after its type's own, and what the JSON schema shows of it."""

    check: Callable[[declaration.Process, Any], None]
    """Raises ValueError."""
    shown: Callable[[declaration.Process], dict[str, Any]]

    def __get_pydantic_core_schema__(self, source: Any, handler: pydantic.GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401
        """Check what the type lets pass."""

        def checked(value: Any) -> Any:  # noqa: ANN401 of any type
            self.check(_PROCESS.get(), value)
            return value

        return no_info_after_validator_function(checked, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: pydantic.GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Show it."""
        return {**handler(schema), **self.shown(_PROCESS.get())}


def within(bounds: Callable[[declaration.Process], tuple[float, float]]) -> Checked:
    """Return a check that a number is within bounds that the process has."""

    def check(process: declaration.Process, value: float) -> None:
        low, high = bounds(process)
        if not value >= low:
            raise ValueError(f"input should be greater than or equal to {low:g}")
        if not value <= high:
            raise ValueError(f"input should be less than or equal to {high:g}")

    return Checked(check, lambda process: dict(zip(("minimum", "maximum"), bounds(process), strict=True)))


def one_of(what: str, names: Callable[[declaration.Process], tuple[str, ...]]) -> Checked:
    """Return a check that a name is one of those that the process has."""

    def check(process: declaration.Process, name: str) -> None:
        if name not in names(process):
            raise ValueError(f"unknown {what} {name}")

    return Checked(check, lambda process: {"enum": list(names(process))})


def _each(what: str, names: Callable[[declaration.Process], tuple[str, ...]]) -> Checked:
    def check(process: declaration.Process, values: tuple[float, ...]) -> None:
        if len(values) != len(names(process)):
            known = ", ".join(names(process))
            raise ValueError(f"give {len(names(process))} numbers, one for each {what}: {known}")

    return Checked(check, lambda process: {"each": what, "maxItems": len(names(process))})


_EACH_INPUT: Final = _each("input", lambda process: process.input_names)
_EACH_BAND: Final = _each("output with a band", lambda process: tuple(one.name for one in process.banded))
PerInput = Annotated[tuple[FiniteFloat, ...], _EACH_INPUT]
PositivePerInput = Annotated[tuple[PositiveFloat, ...], _EACH_INPUT]
PerBand = Annotated[tuple[FiniteFloat, ...], _EACH_BAND]
PositivePerBand = Annotated[tuple[PositiveFloat, ...], _EACH_BAND]


class ProcessSettings(BaseModel):
    """A section, of which some follows from the process."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    _process: declaration.Process = pydantic.PrivateAttr(default_factory=settings_process)

    @property
    def process(self) -> declaration.Process:
        """The process that it is made for."""
        return self._process


LARGEST: Final = 1e38
"""Largest magnitude of a bound."""


class RateReference(StrEnum):
    """Reference of the rate limit of an update; the paper leaves it open (`studies/slips.md`, 15)."""

    PER_UPDATE = "per-update"
    """The full limit of a sampling period of 5 s at each update, however soon the next one follows."""
    ELAPSED = "elapsed"
    """The limit scaled by the time since the update before, tau_u / 5 s."""


class InputLimits(ProcessSettings):
    """Bounds and rates of the inputs, in their order: of the cold box CV155 %, NCR22_A W, CV156 % (paper, table I)."""

    low: PerInput = declared(lambda process: tuple(one.low for one in process.inputs))
    """Least value."""
    high: PerInput = declared(lambda process: tuple(one.high for one in process.inputs))
    """Largest value."""
    rate: PerInput = declared(lambda process: tuple(one.rate for one in process.inputs))
    """Largest change in one sampling period, up or down."""
    rate_reference: RateReference = RateReference.PER_UPDATE
    slew_s: Annotated[float, within(lambda process: (process.tick_s, process.sampling_period_s))] = declared(
        lambda process: 2 * process.tick_s
    )
    """Absolute slew limit, however often updates follow one another: within any time shorter than this an input moves
    by at most `rate`. The default is the shortest updating period that there is: it never binds on our optimiser."""

    @property
    def slew_ticks(self) -> int:
        """Time of the slew limit, in ticks."""
        return max(1, round(self.slew_s / self.process.tick_s))

    def rate_share(self, elapsed_ticks: int) -> float:
        """Return the share of `rate` that an update may use, `elapsed_ticks` ticks after the one before."""
        if self.rate_reference is RateReference.PER_UPDATE:
            return 1.0
        return min(1.0, elapsed_ticks / self.process.ticks_per_sample)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if max(map(abs, (*self.low, *self.high))) > LARGEST:
            raise ValueError(f"a low or high beyond {LARGEST:g}: it does not cross the link, in single precision")
        if any(low >= high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("each low must be below its high")
        if min(self.rate) <= 0:
            raise ValueError("each rate must be positive")
        return self


class ModelSettings(BaseModel, frozen=True, extra="forbid"):
    """The LTI model file, downloaded into both PLCs."""

    file: Annotated[
        Path, BeforeValidator(lambda given: SHIPPED_MODELS.get(given, given) if isinstance(given, str) else given)
    ] = made_by(_MODEL.get)
    """A file, or `cold-box` or `refrigerator` for one that is shipped. It says which process it is."""


class RootSettings(ProcessSettings):
    """Settings that a program reads of a configuration, all for the process of its model file.

    Raises:
        ModelFileError: The model file cannot be read, or its process is none.
    """

    model: ModelSettings = Field(default_factory=ModelSettings)

    @model_validator(mode="wrap")
    @classmethod
    def _for_its_process(cls, values: Any, handler: pydantic.ModelWrapValidatorHandler[Self]) -> Self:  # noqa: ANN401 as given
        if not isinstance(values, Mapping):
            return handler(values)
        try:
            model = ModelSettings.model_validate(values.get("model", {}))
        except pydantic.ValidationError:
            return handler(values)  # which says so
        if model.file == Path() or "\0" in str(model.file):
            return handler(values)  # no file: that is said of any key
        with settings_of(process_of(model.file)):
            return handler(values)


def process_of(path: Path) -> declaration.Process:
    """Return the process of a model file (ModelFileError: the file cannot be read, or its process is none)."""
    if path in SHIPPED_MODELS.values():
        return cold_box.COLD_BOX
    found = path.stat() if path.exists() else None
    return _process_of(path, (found.st_mtime_ns, found.st_size, found.st_ino) if found else None)


@lru_cache(maxsize=8)
def _process_of(path: Path, _version: object) -> declaration.Process:
    return model_file.declared_process(model_file.read_document(path), path)
