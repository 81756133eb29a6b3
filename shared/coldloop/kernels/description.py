"""What an object consists of, as plain data that is the same in every process, and which objects it refers to.

Code counts by its instructions and constants, not by its text: docstrings, comments, line numbers and the names of
local variables do not count. Data count by value, and objects of other distributions by their names alone.
"""

import contextlib
import dataclasses
import dis
import functools
import hashlib
import sys
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import Enum
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, NamedTuple

from coldloop.kernels.data import Plain, described
from coldloop.kernels.implementations import Implementations, overloads_of
from coldloop.kernels.named import parts_of
from coldloop.kernels.ownership import is_decisive, is_decisive_module, is_own, label

OF_MODULE: Final = frozenset({
    "__builtins__", "__cached__", "__doc__", "__file__", "__loader__", "__name__", "__package__", "__path__", "__spec__"
})  # fmt: skip
"""Names in a module that do not count."""
OF_CLASS: Final = frozenset({
    "__annotate__", "__annotate_func__", "__annotations__", "__annotations_cache__", "__dict__", "__doc__",
    "__firstlineno__", "__module__", "__non_callable_proto_members__", "__orig_bases__", "__parameters__",
    "__protocol_attrs__", "__qualname__", "__signature__", "__slotnames__", "__static_attributes__", "__weakref__",
    "_abc_impl",
})  # fmt: skip
"""Names in a class that do not count."""
OF_MEMBER: Final = frozenset({"__objclass__", "_hash_", "_inverted_", "_name_", "_sort_order_", "_value_"})
"""Names in a member of an enumeration that do not count."""
OF_FIELD: Final = ("annotation", "default", "default_factory", "alias", "validation_alias", "discriminator", "metadata")
"""What counts of a field of a pydantic model."""
IMPORT: Final = dis.opmap["IMPORT_NAME"]
HAS_DOCSTRING: Final = 0x4000000
"""Flag of code whose first constant is its docstring, from Python 3.13 on."""
OF_FUNCTION: Final = 0x3
"""Flags of the code of each function, which numba takes away from kernels that are profiled."""
PLAIN: Final = (bool, int, float, complex, str, bytes, type(None), type(Ellipsis), type(NotImplemented), range, slice)


class Reference(NamedTuple):
    """An object that another one refers to."""

    holder: Any
    compiled: bool
    """It is referred to by compiled code, for which a class is no more than the layout of its data."""


class Describer:
    """Describes one object.

    Args:
        compiled: It is referred to by compiled code.

    Attributes:
        references: The objects that it refers to, in the order in which the description names them.
        finished: No module that it refers to is being imported, so that all names are there.
    """

    def __init__(self, *, compiled: bool) -> None:
        self.compiled = compiled
        self.references: list[Reference] = []
        self.finished = True

    def describe(self, holder: Any) -> Plain:  # noqa: ANN401 anything
        """Return the description of an object that counts for itself: a function, a class or an instance of ours."""
        if isinstance(holder, FunctionType):
            return self._function(holder)
        if isinstance(holder, type):
            return self._layout(holder) if self.compiled else self._class(holder)
        return self._instance(holder)

    def refer(self, holder: Any, *, compiled: bool | None = None) -> Plain:  # noqa: ANN401
        """Refer to an object that counts for itself; to others by name."""
        if not is_decisive(holder):
            return ("named", label(holder))
        self.references.append(Reference(holder, self.compiled if compiled is None else compiled))
        return ("reference", label(holder))

    def value(self, value: Any) -> Plain:  # noqa: ANN401
        """Return the description of data, or of what is used like data."""
        if type(value) in PLAIN:
            return (type(value).__name__, "" if value == sys.executable else repr(value))
        return described(value, self)

    def items(self, items: Iterable[tuple[Any, Any]]) -> Plain:
        """Return the description of pairs, in their order."""
        return tuple((self.value(key), self.value(value)) for key, value in items)

    # -- functions ----------------------------------------------------------------------------------------------------

    def _function(self, function: FunctionType) -> Plain:
        module = sys.modules.get(function.__module__)
        self.finished = self.finished and not getattr(getattr(module, "__spec__", None), "_initializing", False)
        names: set[str] = set()
        code = self._code(function.__code__, names)
        return (
            "function", label(function), code, self.value(function.__defaults__), self.value(function.__kwdefaults__),
            tuple(self._cell(cell) for cell in function.__closure__ or ()),
            self._globals(function.__globals__, names),
            () if self.compiled else tuple(self._imported(*each, names) for each in _imports(function.__code__)),
            tuple(self.items([each]) for each in overloads_of(function)) if self.compiled else (),
        )  # fmt: skip

    def _code(self, code: CodeType, names: set[str]) -> Plain:
        names.update(code.co_names)
        constants = list(code.co_consts)
        if _has_docstring(code):
            constants[0] = None
        arguments = code.co_argcount + code.co_kwonlyargcount
        return (
            code.co_code,
            tuple(self._code(one, names) if isinstance(one, CodeType) else self.value(one) for one in constants),
            code.co_names, code.co_varnames[:arguments], code.co_freevars, code.co_cellvars,
            code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_nlocals,
            (code.co_flags | OF_FUNCTION) & ~HAS_DOCSTRING, code.co_exceptiontable,
        )  # fmt: skip

    def _cell(self, cell: Any) -> Plain:  # noqa: ANN401
        try:
            return self.value(cell.cell_contents)
        except ValueError:
            return "empty"

    def _globals(self, there: Mapping[str, Any], names: set[str]) -> Plain:
        """Describe what names mean: a name may be an attribute that is called like something else, which counts too."""
        found = ((name, there[name]) for name in sorted(names - OF_MODULE) if name in there)
        return tuple((name, self._named(value, names)) for name, value in found)

    def _named(self, value: Any, names: set[str]) -> Plain:  # noqa: ANN401
        if isinstance(value, ModuleType) and is_decisive_module(value.__name__):
            return self._attributes(value, names, {value.__name__})
        return self.value(value)

    def _attributes(self, module: ModuleType, names: set[str], seen: set[str]) -> Plain:
        """Describe the attributes of a module that may be meant."""
        found: list[Plain] = []
        for name in sorted(names - OF_MODULE):
            value = vars(module).get(name, module)
            if value is module:
                continue
            if not isinstance(value, ModuleType):
                found.append((name, self.value(value)))
            elif is_decisive_module(value.__name__) and value.__name__ not in seen:
                found.append((name, self._attributes(value, names, seen | {value.__name__})))
        return ("module", module.__name__, tuple(found))

    def _imported(self, name: str, parts: Sequence[str], names: set[str]) -> Plain:
        """Describe what a function imports when it is called."""
        if not is_decisive_module(name):
            return ("named", name)
        try:
            module = import_module(name)
            for part in parts:
                if part not in vars(module) and find_spec(f"{name}.{part}"):
                    import_module(f"{name}.{part}")
        except (ImportError, AttributeError, KeyError, ValueError, StopIteration):  # what another process is made of
            return ("not imported", name, _source(name))
        return self._attributes(module, names, {name})

    # -- classes and instances ----------------------------------------------------------------------------------------

    def _layout(self, kind: type) -> Plain:
        """Describe a class as compiled code knows it."""
        members = self.items((name, one.value) for name, one in _members(kind).items())
        parts: list[type[Any] | None] = []
        with contextlib.suppress(NameError):  # annotations that are there for checkers of types alone
            parts = parts_of(kind) if hasattr(kind, "_fields") else []
        fields = self.value((getattr(kind, "_fields", ()), getattr(kind, "_field_defaults", {}), parts))
        return ("layout", label(kind), members, fields, self._implementations(kind))

    def _class(self, kind: type) -> Plain:
        entries = sorted((name, value) for name, value in vars(kind).items() if _counts(kind, name))
        return (
            "class", label(kind), tuple(map(self.value, kind.__bases__)), self.items(entries), self._members(kind),
            self._fields(kind), self._implementations(kind),
        )  # fmt: skip

    def _members(self, kind: type) -> Plain:
        return tuple(
            (name, self.value(one._value_), self.items(sorted(_without(vars(one), OF_MEMBER).items())))
            for name, one in _members(kind).items()
        )

    def _fields(self, kind: type) -> Plain:
        """Describe the fields and validators of a pydantic model."""
        fields: Mapping[str, Any] = vars(kind).get("__pydantic_fields__", {})
        decorators = vars(kind).get("__pydantic_decorators__")
        groups = [getattr(decorators, each.name) for each in dataclasses.fields(decorators)] if decorators else []
        return (
            tuple((name, self._field(field)) for name, field in fields.items()),
            tuple((name, self.value(one.func), self.value(one.info)) for group in groups if isinstance(group, dict)
                  for name, one in group.items()),
        )  # fmt: skip

    def _field(self, field: Any) -> Plain:  # noqa: ANN401
        return tuple(self.annotation(getattr(field, part)) for part in OF_FIELD)

    def annotation(self, annotation: Any) -> Plain:  # noqa: ANN401
        """Return the description of a type that is written down, with its arguments."""
        origin = typing.get_origin(annotation)
        if origin is None:
            return self.value(annotation)
        return (self.value(origin), tuple(map(self.annotation, typing.get_args(annotation))))

    def _implementations(self, kind: type) -> Plain:
        tables = sorted((table.name, table[kind]) for table in Implementations.tables if kind in table)
        return self.items(tables)

    def _instance(self, holder: Any) -> Plain:  # noqa: ANN401
        kind = type(holder)
        slots = (name for base in kind.__mro__ for name in _slots(base) if hasattr(holder, name))
        content = {name: getattr(holder, name) for name in slots} | getattr(holder, "__dict__", {})
        kept = ((name, value) for name, value in content.items() if not _is_computed(kind, name))
        return ("instance", self.value(kind), self.items(sorted(kept, key=lambda item: item[0])))


def _has_docstring(code: CodeType) -> bool:
    if sys.version_info >= (3, 13):
        return bool(code.co_flags & HAS_DOCSTRING)
    # of functions it is the first constant, which is None where there is none; of comprehensions it is a constant
    named = not code.co_name.startswith("<") and code.co_flags & 0x2  # newlocals: no body of a class
    return bool(named and code.co_consts and isinstance(code.co_consts[0], str))


def _imports(code: CodeType) -> Iterator[tuple[str, list[str]]]:
    """Yield the modules that code imports, and what it takes from them."""
    for one in code.co_consts:
        if isinstance(one, CodeType):
            yield from _imports(one)
    if IMPORT in code.co_code[::2]:
        found: list[tuple[str, list[str]]] = []
        for step in dis.get_instructions(code):
            if step.opname == "IMPORT_NAME":
                found.append((step.argval, []))
            elif step.opname == "IMPORT_FROM":
                found[-1][1].append(step.argval)
        yield from found


def _source(module: str) -> Plain:
    """Return a digest of the text of a module that cannot be imported here."""
    try:
        spec = find_spec(module)
        return hashlib.sha256(Path(str(spec and spec.origin)).read_bytes()).hexdigest()
    except (ImportError, OSError, ValueError):
        return ""


def _members(kind: type) -> Mapping[str, Any]:
    """Return the members of an enumeration; other classes have none."""
    return kind.__members__ if issubclass(kind, Enum) else {}


def _counts(kind: type, name: str) -> bool:
    if name in OF_CLASS or name.startswith("__pydantic"):
        return False
    is_private = name.startswith("_") and name.endswith("_") and not name.startswith("__")
    return not (issubclass(kind, Enum) and (name in kind.__members__ or is_private))


def _slots(kind: type) -> tuple[str, ...]:
    slots = vars(kind).get("__slots__", ()) if is_own(kind.__module__) else ()
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _is_computed(kind: type, name: str) -> bool:
    """Return whether an attribute is one that was computed at its first use."""
    return isinstance(getattr(kind, name, None), functools.cached_property)


def _without(content: Mapping[str, Any], names: frozenset[str]) -> dict[str, Any]:
    return {name: value for name, value in content.items() if name not in names}
