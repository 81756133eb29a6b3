"""Named tuples made again, inside a kernel, of the plain ones that it is called with.

numba takes 30 us a call to recognise nested named tuples, 5 us for plain ones. So kernels that are called every tick
get their parameters as `plain_tuples`, and name them.
"""

from typing import Any, TypeVar, get_type_hints

from numba.core import types
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic, overload

T = TypeVar("T", bound=tuple[Any, ...])


def plain_tuples(value: Any) -> Any:  # noqa: ANN401 - any nesting of tuples
    """Return nested named tuples as nested plain ones."""
    return tuple(plain_tuples(part) for part in value) if isinstance(value, tuple) else value


def named(kind: type[T], fields: Any) -> T:  # noqa: ANN401 - any nesting of tuples
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
