"""Arrays that a kernel borrows from its caller, without counting references to them.

numba counts the references to each array that a kernel is given, for every call that passes it on, by atomic
operations; with records of many arrays a third of the samples of a run's compiled code were there. What the caller
holds for the whole call need not be counted.
"""

from typing import Any, TypeVar

from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.extending import intrinsic, overload

T = TypeVar("T")


def borrowed(value: T) -> T:
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
