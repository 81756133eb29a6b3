"""Data as they count for a digest: by value, a file by its content, what is not ours by name."""

import dataclasses
import functools
import hashlib
import io
import typing
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from types import FunctionType, MappingProxyType, MethodType, ModuleType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from coldloop.kernels.implementations import Implementations
from coldloop.kernels.ownership import is_decisive, label

if TYPE_CHECKING:
    from coldloop.kernels.description import Describer

Plain = Any
"""Nested tuples of text, numbers and bytes, whose `repr` is the same in every process."""


@functools.singledispatch
def described(value: Any, of: "Describer") -> Plain:  # noqa: ANN401 anything
    """Return the description of data, or of what is used like data, with references to what counts for itself."""
    if type(value).__module__.startswith("numba."):
        return _of_numba(value, of)
    plain = tuple(kind.__repr__(value) for kind in (int, float, str, bytes) if isinstance(value, kind))
    if is_decisive(type(value)):
        return (of.refer(value), plain)
    if dataclasses.is_dataclass(value):
        return (label(value), of.items((f.name, getattr(value, f.name)) for f in dataclasses.fields(value)))
    if typing.get_origin(value) is not None:
        return of.annotation(value)
    return ("named", label(value), plain)


def _of_numba(value: Any, of: "Describer") -> Plain:  # noqa: ANN401
    """Describe a kernel, or an intrinsic function."""
    if hasattr(value, "py_func"):
        options = tuple(sorted((name, repr(option)) for name, option in value.targetoptions.items()))
        return ("kernel", of.refer(value.py_func, compiled=True), options)
    if hasattr(value, "_defn"):
        return ("intrinsic", of.value(value._defn))  # noqa: SLF001 numba has no other way
    return ("named", label(value))


def _sequence(value: Any, of: "Describer") -> Plain:  # noqa: ANN401
    return (of.value(type(value)), tuple(map(of.value, value)))


def _set(value: Any, of: "Describer") -> Plain:  # noqa: ANN401
    """Describe a set in an order that is the same in every process."""
    alone = type(of)
    return (label(value), tuple(map(of.value, sorted(value, key=lambda each: repr(alone(compiled=True).value(each))))))


def _mapping(value: Any, of: "Describer") -> Plain:  # noqa: ANN401
    return (of.value(type(value)), of.items(value.items()))


def _array(value: Any, of: "Describer") -> Plain:  # noqa: ANN401
    content = of.value(value.tolist()) if value.dtype.hasobject else hashlib.sha256(value.tobytes()).digest()
    return ("array", repr(value.dtype), value.shape, content)


def _file(value: Path, _: "Describer") -> Plain:
    """Describe a file by its content, wherever it is."""
    try:
        return ("file", value.name, hashlib.sha256(value.read_bytes()).digest())
    except OSError:
        return ("path", value.name)


_BY_TYPE: Final[dict[type, Callable[[Any, "Describer"], Plain]]] = {
    FunctionType: lambda value, of: of.refer(value),
    type: lambda value, of: of.refer(value),
    MethodType: lambda value, of: ("method", of.value(value.__func__), of.value(value.__self__)),
    ModuleType: lambda value, _: ("module", value.__name__),
    classmethod: lambda value, of: (type(value).__name__, of.value(value.__func__)),
    staticmethod: lambda value, of: (type(value).__name__, of.value(value.__func__)),
    property: lambda value, of: ("property", of.value((value.fget, value.fset, value.fdel))),
    functools.cached_property: lambda value, of: ("cached property", of.value(value.func)),
    functools.partial: lambda value, of: ("partial", of.value((value.func, value.args, value.keywords))),
    type(functools.cache(label)): lambda value, of: ("cached", of.value(value.__wrapped__)),
    Enum: lambda value, of: ("member", of.value(type(value)), value.name),
    tuple: _sequence,
    list: _sequence,
    set: _set,
    frozenset: _set,
    dict: _mapping,
    MappingProxyType: _mapping,
    Implementations: lambda value, _: ("implementations", value.name),
    np.ndarray: _array,
    np.generic: lambda value, _: (repr(value.dtype), value.tobytes()),
    np.dtype: lambda value, _: ("dtype", repr(value), value.itemsize),
    io.TextIOBase: lambda *_: ("stream",),  # which another one may have taken the place of
    Path: _file,
}
for _type, _describe in _BY_TYPE.items():
    described.register(_type, _describe)
