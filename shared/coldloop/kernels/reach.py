"""Digests of code by what it reaches: the functions, classes and data that it names, recursively.

Kernels, gains and outcomes of studies are kept under such digests (`coldloop.kernels.compiled`,
`coldloop_studies.request`).
A digest is the same in every process and wherever the files are; it changes with whatever may change what the code
does, and not with code that is not reached. Code counts by its instructions and constants, not by its text: docstrings,
comments, line numbers and the names of local variables do not count. Data count by value, a file by its content, and
objects of other distributions by their names alone.

Each object is described once per process: what the names of a module mean must not change after its import.
"""

import contextlib
import dataclasses
import dis
import functools
import hashlib
import io
import sys
import sysconfig
import threading
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FunctionType, MappingProxyType, MethodType, ModuleType
from typing import Any, Final, NamedTuple

import numpy as np

from coldloop.kernels.intrinsics import Implementations, parts_of

Plain = Any
"""Nested tuples of text, numbers and bytes, whose `repr` is the same in every process."""
Key = tuple[int, bool]

# -- what is ours -----------------------------------------------------------------------------------------------------


NOT_DECISIVE: Final = frozenset({
    "coldloop.kernels.cache", "coldloop.kernels.compiled", "coldloop.kernels.reach", "coldloop.service.start",
})  # fmt: skip
"""Modules that decide where results are kept and what is logged, and not what results are."""


def label(value: Any) -> str:  # noqa: ANN401 anything
    """Return the full name of a function or a class, or that of an object's type."""
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    if not isinstance(name, str):
        return label(type(value))
    return f"{getattr(value, '__module__', None)}.{name}"


@functools.cache
def is_own(module: str | None) -> bool:
    """Return whether a module is ours: one of the project, or neither Python's nor of an installed distribution."""
    package = (module or "").partition(".")[0]
    if package == "tests" or package.partition("_")[0] == "coldloop":
        return True
    if not package or package in sys.builtin_module_names or package in sys.stdlib_module_names - {"__main__"}:
        return False
    found = sys.modules.get(package)
    places = [getattr(found, "__file__", None), *getattr(found, "__path__", ())]
    installed = {Path(sysconfig.get_path(kind)) for kind in ("purelib", "platlib")}
    return any(place and installed.isdisjoint(Path(place).parents) for place in places)


def is_decisive(holder: Any) -> bool:  # noqa: ANN401 anything
    """Return whether more counts of a function, a class or an instance than its name."""
    module = getattr(holder, "__module__", None)
    return module not in NOT_DECISIVE and is_own(module)


def is_decisive_module(name: str) -> bool:
    """Return whether what a module has counts."""
    return name not in NOT_DECISIVE and is_own(name)


# -- what counts of an object -----------------------------------------------------------------------------------------


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
"""Attributes of a pydantic model's field that count."""
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
    """Describes one object; `compiled`: it is referred to by compiled code."""

    def __init__(self, *, compiled: bool) -> None:
        self.compiled = compiled
        self.references: list[Reference] = []
        """Objects that it refers to, in the order in which the description names them."""
        self.finished = True
        """No module that it refers to is being imported, so that all names are there."""

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
            tuple(self.items([each]) for each in _overloads.get(function, ())) if self.compiled else (),
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
        return tuple(
            (name, self._attributes(value, names, {value.__name__})
             if isinstance(value, ModuleType) and is_decisive_module(value.__name__) else self.value(value))
            for name, value in found
        )  # fmt: skip

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
            (name, self.value(one._value_), self.items(sorted(e for e in vars(one).items() if e[0] not in OF_MEMBER)))
            for name, one in _members(kind).items()
        )

    def _fields(self, kind: type) -> Plain:
        """Describe the fields and validators of a pydantic model."""
        fields: Mapping[str, Any] = vars(kind).get("__pydantic_fields__", {})
        decorators = vars(kind).get("__pydantic_decorators__")
        groups = [getattr(decorators, each.name) for each in dataclasses.fields(decorators)] if decorators else []
        return (
            tuple((name, tuple(self.annotation(getattr(field, part)) for part in OF_FIELD))
                  for name, field in fields.items()),
            tuple((name, self.value(one.func), self.value(one.info)) for group in groups if isinstance(group, dict)
                  for name, one in group.items()),
        )  # fmt: skip

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
        kept = (
            each for each in content.items() if not isinstance(getattr(kind, each[0], None), functools.cached_property)
        )
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


# -- digests ----------------------------------------------------------------------------------------------------------


class _Node:
    """An object that counts: the digest of its description, and the objects that this refers to."""

    def __init__(self, reference: Reference) -> None:
        describer = Describer(compiled=reference.compiled)
        self.holder = reference.holder
        self.content = _hash(describer.describe(reference.holder))
        self.references = describer.references
        self.finished = describer.finished


_nodes: Final[dict[Key, _Node]] = {}
"""Nodes by the identity of their objects; none refers to a module that is being imported."""
_lock: Final = threading.RLock()


def digest(*roots: Any, compiled: bool = False) -> str:  # noqa: ANN401 functions, kernels, classes, data
    """Return a digest of functions, classes and data, and of all that they reach; a path counts as the file's content.

    `compiled`: they are used by compiled code, for which a class is the layout of its data.
    """
    with _lock:
        description, references, nodes = _described(roots, compiled=compiled)
    places = {key: place for place, key in enumerate(nodes)}
    groups = (references, *(node.references for node in nodes.values()))
    edges = [[places[_key(each)] for each in group] for group in groups]
    return _hash((description, [node.content for node in nodes.values()], edges)).hex()[:24]


def reached(*roots: Any) -> list[Any]:  # noqa: ANN401
    """Return the functions, classes and instances that the digest of `roots` is of."""
    with _lock:
        return [node.holder for node in _described(roots, compiled=False)[2].values()]


def _described(roots: Any, *, compiled: bool) -> tuple[Plain, list[Reference], dict[Key, _Node]]:  # noqa: ANN401
    """Return the description of roots, what it refers to, and all nodes that are reached from there, in an order.

    To describe some functions is to import what they import, which may register implementations of others that have
    been described: these are then described again.
    """
    while True:
        now = registrations()
        if now != _overloads.described:
            _nodes.clear()
            _overloads.described = now
        describer = Describer(compiled=compiled)
        description = describer.value(roots)
        found: dict[Key, _Node] = {}
        waiting = describer.references[::-1]
        while waiting:
            reference = waiting.pop()
            key = _key(reference)
            if key not in found:
                node = found[key] = _nodes[key] = _nodes.get(key) or _Node(reference)
                waiting += node.references[::-1]
        if not all(node.finished for node in found.values()):
            _nodes.clear()
        if registrations() == now:
            return description, describer.references, found


def _key(reference: Reference) -> Key:
    return id(reference.holder), reference.compiled


def _hash(plain: Plain) -> bytes:
    return hashlib.sha256(repr(plain).encode()).digest()


# -- what takes a function's place in compiled code -------------------------------------------------------------------


class _Overloads(dict[FunctionType, list[tuple[Any, Any]]]):
    """Overloads of functions in compiled code, and how they are compiled, as far as modules are imported."""

    read = 0
    """Entries of numba's registry that have been read."""
    described = 0
    """Registrations when the nodes were described."""

    def read_on(self) -> None:
        """Read the further entries of the registry."""
        templates = sys.modules.get("numba.core.typing.templates")
        if templates is None:
            return
        registered = templates.builtin_registry.globals
        for held, kind in registered[self.read :]:
            if isinstance(held, FunctionType) and is_own(held.__module__):
                found = [each for each in getattr(kind, "templates", ()) if hasattr(each, "_overload_func")]
                self.setdefault(held, []).extend(
                    (each._overload_func, {**each._jit_options, "strict": each._strict})  # noqa: SLF001 numba has no other way
                    for each in found
                )
        self.read = len(registered)


_overloads: Final = _Overloads()


def registrations() -> int:
    """Return how many overloads and implementations there are."""
    _overloads.read_on()
    return sum(map(len, _overloads.values())) + sum(map(len, Implementations.tables))


# -- data -------------------------------------------------------------------------------------------------------------


@functools.singledispatch
def described(value: Any, of: Describer) -> Plain:  # noqa: ANN401 anything
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


def _of_numba(value: Any, of: Describer) -> Plain:  # noqa: ANN401
    """Describe a kernel, or an intrinsic function."""
    if hasattr(value, "py_func"):
        options = tuple(sorted((name, repr(option)) for name, option in value.targetoptions.items()))
        return ("kernel", of.refer(value.py_func, compiled=True), options)
    if hasattr(value, "_defn"):
        return ("intrinsic", of.value(value._defn))  # noqa: SLF001 numba has no other way
    return ("named", label(value))


def _set(value: Any, of: Describer) -> Plain:  # noqa: ANN401
    """Describe a set in an order that is the same in every process."""
    alone = type(of)
    return (label(value), tuple(map(of.value, sorted(value, key=lambda each: repr(alone(compiled=True).value(each))))))


def _array(value: Any, of: Describer) -> Plain:  # noqa: ANN401
    content = of.value(value.tolist()) if value.dtype.hasobject else hashlib.sha256(value.tobytes()).digest()
    return ("array", repr(value.dtype), value.shape, content)


def _file(value: Path, _: Describer) -> Plain:
    """Describe a file by its content, wherever it is."""
    try:
        return ("file", value.name, hashlib.sha256(value.read_bytes()).digest())
    except OSError:
        return ("path", value.name)


_BY_TYPE: Final[dict[type, Callable[[Any, Describer], Plain]]] = {
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
    tuple: lambda value, of: (of.value(type(value)), tuple(map(of.value, value))),
    list: lambda value, of: (of.value(type(value)), tuple(map(of.value, value))),
    set: _set,
    frozenset: _set,
    dict: lambda value, of: (of.value(type(value)), of.items(value.items())),
    MappingProxyType: lambda value, of: (of.value(type(value)), of.items(value.items())),
    Implementations: lambda value, _: ("implementations", value.name),
    np.ndarray: _array,
    np.generic: lambda value, _: (repr(value.dtype), value.tobytes()),
    np.dtype: lambda value, _: ("dtype", repr(value), value.itemsize),
    io.TextIOBase: lambda *_: ("stream",),  # which another one may have taken the place of
    Path: _file,
}


for _type, _describe in _BY_TYPE.items():
    described.register(_type, _describe)
