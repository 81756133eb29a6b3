"""Somebody else's solver, rule or estimator, by an entry point: nothing is edited here to use it."""

from contextlib import AbstractContextManager
from enum import StrEnum
from importlib.metadata import entry_points
from typing import Any

from coldloop.errors import ConfigurationError
from coldloop.foreign import foreign


class Part(StrEnum):
    """What may be somebody else's: a key of `optimizer_plc.program.outside`, and the group `coldloop.<part>s`."""

    SOLVER = "solver"
    RULE = "rule"
    ESTIMATOR = "estimator"


def made(part: Part, name: str, *given: object) -> Any:  # noqa: ANN401 the caller knows its protocol
    """Return what the entry point of this name makes of what it is given.

    Raises:
        ConfigurationError: There is none, or it cannot be made.
    """
    with in_its_name(part, name, "cannot be made: "):
        return loaded(part, name)(*given)


def loaded(part: Part, name: str) -> Any:  # noqa: ANN401 as above
    """Return what the entry point of this name points at, a class or a function.

    Raises:
        ConfigurationError: There is none, or it cannot be imported.
    """
    group = f"coldloop.{part}s"
    there = entry_points(group=group)
    if name not in there.names:
        known = ", ".join(sorted(there.names)) or "none is installed"
        raise ConfigurationError(
            f"optimizer_plc.program.outside.{part}: no {part} '{name}' among the entry points {group}: {known}"
        )
    with in_its_name(part, name, "cannot be made: "):
        return there[name].load()


def in_its_name(part: Part, name: str, what: str = "") -> AbstractContextManager[None]:
    """Call what is not ours: what it raises is a `ConfigurationError` of one line, with its name unless it is one."""
    called = f"{part} {name}: {what}".removesuffix(": ")
    return foreign(called, "the optimiser ends here: mend it, or choose another", kind=ConfigurationError)
