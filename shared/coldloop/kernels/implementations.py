"""What takes a function's place in compiled code: implementations by the class of its first argument, and overloads."""

import sys
from types import FunctionType
from typing import Any, Final, TypeVar

from coldloop.kernels.ownership import is_own

F = TypeVar("F")


class Implementations(dict[type, F]):
    """Implementations of a function by the class of its first argument.

    A kernel's signature decides which one is called. So a class counts with its implementations, and the function does
    not count with those that this process happens to have.

    Args:
        name: Of the function.
    """

    tables: Final[list["Implementations[Any]"]] = []

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name
        self.tables.append(self)


def overloads_of(function: FunctionType) -> list[tuple[Any, Any]]:
    """Return what takes a function's place in compiled code, and how it is compiled, as far as modules are imported."""
    _read_overloads()
    return _overloads.by_function.get(function, [])


def registrations() -> int:
    """Return how many overloads and implementations there are."""
    _read_overloads()
    overloads, tables = _overloads.by_function.values(), Implementations.tables
    return sum(map(len, overloads)) + sum(map(len, tables))


def _read_overloads() -> None:
    templates = sys.modules.get("numba.core.typing.templates")
    if templates is None:
        return
    registered = templates.builtin_registry.globals
    for held, kind in registered[_overloads.seen :]:
        if isinstance(held, FunctionType) and is_own(held.__module__):
            found = [each for each in getattr(kind, "templates", ()) if hasattr(each, "_overload_func")]
            _overloads.by_function.setdefault(held, []).extend(
                (each._overload_func, {**each._jit_options, "strict": each._strict})  # noqa: SLF001 numba has no other way
                for each in found
            )
    _overloads.seen = len(registered)


class _Overloads:
    """What has been read of numba's registry."""

    def __init__(self) -> None:
        self.seen = 0
        self.by_function: dict[FunctionType, list[tuple[Any, Any]]] = {}


_overloads = _Overloads()
