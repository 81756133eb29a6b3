"""Configuration: a TOML file, then the environment, then the command line, each overriding the one before.

The environment spells `COLDLOOP__SECTION__KEY=value`, the command line `--set section.key=value`; both read the
value as TOML, or else as text. Every value remembers where it came from.

Some settings decide others, as a preset does. A section says so in a class variable `decides`: by key, the keys that
follow from it, both relative to the section. Such a setting on the command line also replaces what the environment and
the file have of them. What a section has to say of values that were not set is in its property `notes`.
"""

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from math import isfinite, isnan
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from pydantic import BaseModel, ValidationError

from coldloop.errors import ConfigurationError
from coldloop.text import MOST_LEVELS, TOO_DEEP, parsed_toml, read_text

PREFIX = "COLDLOOP__"
MODEL_FILE: Final = "COLDLOOP__MODEL__FILE"
"""Names the process of all programs that are started."""
GONE: Final = "COLDLOOP_PROCESS"
"""Named it until version 0.3."""
DEFAULT = "default"
DERIVED = "follows from other settings"
LISTING: Final = "`coldloop config` lists the keys"
MOST_BYTES: Final = 1_000_000
"""Size of a configuration file, at most."""
WHOLE: Final = "configuration"
"""Place of an error that is not in one key, but in several together."""
LARGEST: Final = 3.4e38
"""Largest number: registers and records have single precision."""
MOST_SHOWN: Final = 200
"""Characters of a wrong value that a message shows."""
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True)
class Configuration(Generic[M]):
    """Validated settings, and the source of each value that is not a default (by dotted key)."""

    settings: M
    sources: Mapping[str, str]

    def effective(self) -> list[tuple[str, Any, str]]:
        """Return (dotted key, value, source) of every value."""
        rows = flattened(self.settings.model_dump(mode="json"))
        usual = flattened(self.usual().model_dump(mode="json"))
        notes = self.notes()
        return [
            (key, value, self.sources.get(key) or notes.get(key, DEFAULT if value == usual.get(key) else DERIVED))
            for key, value in rows.items()
        ]

    def usual(self) -> M:
        """Return the settings without what was set; where there is a model, it is the one that was set."""
        model: BaseModel | None = getattr(self.settings, "model", None)
        return type(self.settings).model_validate({"model": model} if model else {})

    def notes(self) -> dict[str, str]:
        """Return what sections say (`notes`, by key) of values that nothing has set."""
        found = _notes(self.settings)
        return {key: note for key, note in found.items() if key not in self.sources}


class _Layers:
    """Values by section, with the source of each."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {}
        self.sources: dict[str, str] = {}
        self._layers: dict[str, int] = {}

    def put(self, layer: int, key: str, value: object, source: str) -> None:
        """Set the value of a dotted key; a layer of a higher number overrides."""
        *sections, last = key.split(".")
        if len(sections) > MOST_LEVELS:
            raise ConfigurationError(f"{source[:MOST_SHOWN]}...: {TOO_DEEP}; {LISTING}")
        place = self.values
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise ConfigurationError(f"{source}: {key} is not a section; see `coldloop config` for the keys")
        place[last] = value
        self.sources[key] = source
        self._layers |= dict.fromkeys(flattened({key: value}), layer)

    def drop_decided(self, decides: Mapping[str, Iterable[str]]) -> None:
        """Drop values that follow from others which were set in a higher layer."""
        for key, followers in decides.items():
            for follower in followers:
                if self._layers.get(follower, 0) < self._layers.get(key, 0):
                    *sections, last = follower.split(".")
                    place: Any = self.values
                    for section in sections:
                        place = place.get(section) if isinstance(place, dict) else None
                    if isinstance(place, dict):
                        place.pop(last, None)
                    self.sources.pop(follower, None)


def load_configuration(
    model: type[M], *, file: Path | None = None, environment: Mapping[str, str] | None = None,
    assignments: Iterable[str] = (), options: Mapping[str, tuple[object, str]] | None = None,
    others: Iterable[str] = (), option: str = "--config", listing: str = LISTING,
) -> Configuration[M]:  # fmt: skip
    """Return the validated configuration.

    Args:
        model: Pydantic model of the whole configuration.
        file: TOML file.
        environment: Where to look for `COLDLOOP__...`; the process's own by default.
        assignments: `section.key=value` from the command line.
        options: Values of dedicated command-line options, by dotted key, each with the option's name.
        others: Sections of other services, which the file and the environment may hold and `model` does not know.
        option: What names the file on the command line.
        listing: What lists the keys, for messages.

    Raises:
        ConfigurationError: One line that names the key, its source and the remedy.
    """
    layers = _Layers()
    command_line = [
        *(_assigned(assignment) for assignment in assignments),
        *((key, value, option) for key, (value, option) in (options or {}).items()),
    ]
    for layer, entries in enumerate(
        (_from_file(file, option), _from_environment(os.environ if environment is None else environment), command_line)
    ):
        for entry in entries:
            layers.put(layer, *entry)
    layers.drop_decided(_decided(model))
    for section in set(others) - set(model.model_fields):
        layers.values.pop(section, None)
    try:
        settings = model.model_validate(layers.values)
    except ValidationError as error:
        text = explained(error, layers.sources, model, listing)
        if file is not None and all(source == str(file) for source in layers.sources.values()):
            text = f"{file}: {text.removeprefix(f'{file}: ').removeprefix(f'{WHOLE}: ')}"
        raise ConfigurationError(text) from None
    _check_values(settings, layers.sources)
    return Configuration(settings, layers.sources)


def _check_values(settings: BaseModel, sources: Mapping[str, str]) -> None:
    """Refuse values that no key can have, in one line."""
    for key, value in flattened(settings.model_dump()).items():
        parts = list(_leaves(value))
        numbers = [part for part in parts if isinstance(part, float)]
        if not all(map(isfinite, numbers)):
            raise ConfigurationError(f"{_where(key, sources)}: input should be finite (got {value!r})")
        if any(abs(part) > LARGEST for part in numbers):
            wrong = f"is beyond {LARGEST:g}; give a smaller number"
            raise ConfigurationError(f"{_where(key, sources)}: {wrong} (got {value!r})")
        if any(isinstance(part, str | Path) and "\0" in str(part) for part in parts):
            raise ConfigurationError(f"{_where(key, sources)}: contains a NUL character; remove it")
        if value == Path():  # an empty text
            raise ConfigurationError(f"{_where(key, sources)}: is empty; name a file, or leave the key out")


def _notes(section: BaseModel, prefix: str = "") -> dict[str, str]:
    found = {prefix + key: note for key, note in getattr(section, "notes", {}).items()}
    for name, value in section:
        if isinstance(value, BaseModel):
            found |= _notes(value, f"{prefix}{name}.")
    return found


def _decided(model: type[BaseModel], prefix: str = "") -> dict[str, list[str]]:
    """Return the keys that follow from others, by the key that decides."""
    found = {
        prefix + key: [prefix + follower for follower in followers]
        for key, followers in getattr(model, "decides", {}).items()
    }
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            found |= _decided(field.annotation, f"{prefix}{name}.")
    return found


def _leaves(value: object) -> Iterator[object]:
    """Yield what a value consists of."""
    if isinstance(value, Mapping | list | tuple):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _leaves(part)
    else:
        yield value


Entry = tuple[str, object, str]
"""Dotted key, value, source."""


def _from_file(file: Path | None, option: str) -> list[Entry]:
    if file is None:
        return []
    text = read_text(file, f"name a readable TOML file with {option}", ConfigurationError, MOST_BYTES)
    try:
        content = parsed_toml(text)
    except ValueError as error:
        raise ConfigurationError(f"{file}: not TOML: {error}") from None
    return [(key, value, str(file)) for key, value in flattened(content).items()]


def _from_environment(environment: Mapping[str, str]) -> list[Entry]:
    if environment.get(GONE):
        raise ConfigurationError(
            f"{GONE}: a process is named by its model file: set {MODEL_FILE} to it, and unset this"
        )
    return [
        (name[len(PREFIX) :].lower().replace("__", "."), _parsed(value), name)
        for name, value in sorted(environment.items())
        if name.startswith(PREFIX)
    ]


def _assigned(assignment: str) -> Entry:
    key, separator, value = assignment.partition("=")
    if not separator:
        raise ConfigurationError(f"--set {assignment}: write --set section.key=value")
    return key.strip(), _parsed(value), f"--set {key.strip()}"


def to_environment(settings: BaseModel) -> dict[str, str]:
    """Return the variables that make a process load these settings."""
    flat = flattened(settings.model_dump(mode="json"))
    return {PREFIX + key.upper().replace(".", "__"): as_toml(value) for key, value in flat.items() if value is not None}


def as_toml(value: object) -> str:
    """Return a value as TOML writes it in one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {as_toml(part)}" for key, part in value.items() if part is not None) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_toml, value)) + "]"
    text = json.dumps(value, ensure_ascii=False)
    return text.replace("\x7f", "\\u007f")  # the one control character that JSON lets pass and TOML does not


def model_file_in(environment: Mapping[str, str], file: Path | None, assignments: Iterable[str]) -> object:
    """Return the model file that the environment, a configuration file and assignments name, or None.

    Raises:
        ConfigurationError: The file cannot be read, or the environment names a process as until version 0.3.
    """
    entries = (*_from_file(file, "--config"), *_from_environment(environment), *map(_assigned, assignments))
    return {key: value for key, value, _ in entries}.get("model.file")


def _parsed(value: str) -> object:
    try:
        return parsed_toml(f"value = {value}")["value"]
    except ValueError:
        return value


def flattened(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of nested sections by dotted key.

    Raises:
        ConfigurationError: Too many levels, in a mapping that was not read from a text.
    """
    if prefix.count(".") > MOST_LEVELS:
        raise ConfigurationError(f"{prefix[:MOST_SHOWN]}...: {TOO_DEEP}; {LISTING}")
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            flat.update(flattened(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def selected(settings: BaseModel, keys: Iterable[str]) -> dict[str, Any]:
    """Return the values of some keys, and of all that is in some sections, by dotted key."""
    wanted = tuple(f"{key}." for key in keys)
    values = flattened(settings.model_dump(mode="json"))
    return {key: value for key, value in values.items() if f"{key}.".startswith(wanted)}


def explained(
    error: ValidationError, sources: Mapping[str, str], model: type[BaseModel], listing: str = LISTING
) -> str:
    """Return the first of the errors that a model found, in one line: the key, where it comes from, what is wrong."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    where = _where(key, sources)
    if first["type"] == "extra_forbidden":
        section = key.rpartition(".")[0]
        complete = not any(field.is_required() for field in model.model_fields.values())
        known = flattened(model().model_dump()) if section and complete else model.model_fields
        close = get_close_matches(key, [each for each in known if each.startswith(section)], n=1)
        return f"{where}: no such key; {f'did you mean {close[0]}? ' if close else ''}{listing}"
    if first["type"] == "missing":
        return f"{where}: is missing; {listing}"
    message = first["msg"].removeprefix("Value error, ")
    if isinstance(first["input"], float) and isnan(first["input"]):
        message = "not a number (NaN); give one, or leave the key out"
    if isinstance(first["input"], Mapping):  # a section, of which the message says enough
        return f"{where}: {message[0].lower()}{message[1:]}"
    given = repr(first["input"])
    if len(given) > MOST_SHOWN:
        given = f"{given[:MOST_SHOWN]}... of {len(given)} characters"
    return f"{where}: {message[0].lower()}{message[1:]} (got {given})"


def _where(key: str, sources: Mapping[str, str]) -> str:
    """Name a key and the source of its value, or of a part of it, or of what it is a part of."""
    source = next((s for k, s in sources.items() if k == key or k.startswith(f"{key}.") or key.startswith(f"{k}.")), "")
    return f"{source}: {key}" if source and not source.endswith(key) else source or key or WHOLE
