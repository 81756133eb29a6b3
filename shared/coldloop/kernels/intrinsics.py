"""Intrinsics that numba lacks: name plain tuples, borrow arrays, call an implementation by a class.

numba takes 30 us a call to recognise nested named tuples, 5 us for plain ones. So kernels that are called every tick
get their parameters as `plain_tuples`, and name them. numba also counts the references to each array that a kernel is
given, for every call that passes it on, by atomic operations; with records of many arrays a third of the samples of a
run's compiled code were there. What the caller holds for the whole call need not be counted.
"""

from collections.abc import Callable
from typing import Any, Final, TypeAlias, TypeVar, get_type_hints

from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic, overload

F = TypeVar("F")
T = TypeVar("T", bound=tuple[Any, ...])
V = TypeVar("V")
PlainTuples: TypeAlias = Any
"""Any nesting of tuples."""


def plain_tuples(value: PlainTuples) -> PlainTuples:
    """Return nested named tuples as nested plain ones."""
    return tuple(plain_tuples(part) for part in value) if isinstance(value, tuple) else value


def named(kind: type[T], fields: PlainTuples) -> T:
    """Return the named tuple of a class whose `plain_tuples` are `fields`; its fields' classes are those annotated."""
    parts = zip(parts_of(kind), fields, strict=True)
    return kind(*(named(part, value) if part else value for part, value in parts))


def parts_of(kind: type[Any]) -> list[type[Any] | None]:
    """Return for each field of a named tuple its class where that is a named tuple too."""
    hints = get_type_hints(kind)
    return [hints[name] if hasattr(hints[name], "_fields") else None for name in kind._fields]


@overload(named, strict=False)
def _named(kind: Any, fields: Any) -> Any:  # noqa: ANN401, ARG001 types of numba
    return lambda kind, fields: _rebuilt(kind, fields)  # type: ignore[call-arg]  # noqa: PLW0108 numba gives an intrinsic its context


@intrinsic
def _rebuilt(_: Any, kind: Any, fields: Any) -> Any:  # noqa: ANN401 types of numba
    made = _typed(kind.instance_class, fields)

    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        value = _converted(context, builder, signature.return_type, arguments[1])
        return impl_ret_borrowed(context, builder, signature.return_type, value)  # type: ignore[no-untyped-call]

    return made(kind, fields), code


def _typed(kind: type[Any] | None, plain: Any) -> Any:  # noqa: ANN401 a type of numba
    if kind is None:
        return plain
    parts = [_typed(part, field) for part, field in zip(parts_of(kind), plain.types, strict=True)]
    return types.BaseTuple.from_types(parts, kind)  # type: ignore[no-untyped-call]


def _converted(context: Any, builder: Any, kind: Any, value: Any) -> Any:  # noqa: ANN401
    if not isinstance(kind, types.BaseTuple):
        return value
    parts = [builder.extract_value(value, place) for place in range(len(kind.types))]  # type: ignore[attr-defined]
    converted = [_converted(context, builder, *each) for each in zip(kind.types, parts, strict=True)]  # type: ignore[attr-defined]
    return context.make_tuple(builder, kind, converted)


def borrowed(value: V) -> V:
    """Return an array, or nested tuples with arrays, as views without a reference.

    The caller keeps what is borrowed for as long as the views are used: they must not be returned to Python.
    """
    raise NotImplementedError("kernels alone call it")


@overload(borrowed, strict=False)
def _borrowed(value: Any) -> Any:  # noqa: ANN401, ARG001 types of numba
    return lambda value: _views(value)  # type: ignore[call-arg]  # noqa: PLW0108 numba gives an intrinsic its context


@intrinsic
def _views(_: Any, value: Any) -> Any:  # noqa: ANN401 types of numba
    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        return _without_references(context, builder, signature.return_type, arguments[0])

    return value(value), code


def _without_references(context: Any, builder: Any, kind: Any, value: Any) -> Any:  # noqa: ANN401
    if isinstance(kind, types.Array):
        view = context.make_array(kind)(context, builder, value=value)
        view.meminfo = cgutils.get_null_value(view.meminfo.type)  # type: ignore[no-untyped-call]
        return view._getvalue()  # noqa: SLF001 as numba's own intrinsics do
    if isinstance(kind, types.BaseTuple):
        for place, part in enumerate(kind.types):  # type: ignore[attr-defined]
            inner = builder.extract_value(value, place)
            value = builder.insert_value(value, _without_references(context, builder, part, inner), place)
    elif context.data_model_manager[kind].contains_nrt_meminfo():
        raise TypingError(f"{kind} cannot be borrowed")
    return value


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

    def register(self, kind: type) -> Callable[[F], F]:
        """Return a decorator that enters an implementation for a class."""

        def enter(implementation: F) -> F:
            self[kind] = implementation
            return implementation

        return enter
