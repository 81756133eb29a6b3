"""What an expression of a kernel is: something known before a run, something of the typed tree, or several of them."""

import ast
import math
import operator
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from coldloop.kernels.single_precision import single
from coldloop_rig.plc_export.tree.nodes import ArrayType, Expression, Kind, Name, RecordType, RowsType, StructType, Type

BINARY: Final[dict[type[ast.operator], tuple[str, Callable[[Any, Any], Any]]]] = {
    ast.Add: ("+", operator.add), ast.Sub: ("-", operator.sub), ast.Mult: ("*", operator.mul),
    ast.Div: ("/", operator.truediv), ast.Mod: ("%", operator.mod), ast.FloorDiv: ("//", operator.floordiv),
    ast.Pow: ("power", operator.pow),
}  # fmt: skip
COMPARISONS: Final[dict[type[ast.cmpop], str]] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip
OF_INTEGERS, OF_REALS = ("+", "-", "*", "%", "//"), ("+", "-", "*", "/", "power")
FUNCTIONS: Final[dict[object, str]] = {
    abs: "abs", min: "min", max: "max", np.sqrt: "sqrt", math.sqrt: "sqrt", np.isfinite: "isfinite",
    math.isfinite: "isfinite", np.isinf: "isinf", math.isnan: "isnan", math.log: "log", math.copysign: "copysign",
    round: "round", single: "single",
}  # fmt: skip
OPERANDS: Final = {"min": 2, "max": 2, "copysign": 2}
"""At least, of functions that take more than one."""
OF_PLATFORM: Final = ("power", "log")
"""Operators whose bits are those of the platform's library."""
LARGEST_INTEGER: Final = 2**31 - 1
DTYPES: Final[dict[object, Kind]] = {np.int64: Kind.INT, np.uint64: Kind.UNSIGNED, np.bool_: Kind.BOOL}
NEW_ARRAYS: Final = (np.empty, np.zeros, np.empty_like, np.zeros_like)


class Known(NamedTuple):
    """A number that is known before a run, as Python computes it."""

    value: Any
    """An integer, a float (Python's or numpy's) or a truth value."""


class DType(NamedTuple):
    """A type used as a value."""

    kind: Kind


class Elementwise(NamedTuple):
    """A new array, element by element."""

    type: ArrayType
    at: Callable[[tuple[Expression, ...]], Expression]


class Shape(NamedTuple):
    """The shape of an array."""

    lengths: tuple[int, ...]


class Python(NamedTuple):
    """What a global name means: a module, a kernel, a function of Python's or numpy's."""

    value: object


class Record(NamedTuple):
    """Several values: those of a tuple, which has no name, or of a NamedTuple."""

    name: str
    parts: tuple[tuple[str, "Value"], ...]
    variable: Name | None = None
    """Where it is a record of the tree."""


Value: TypeAlias = Known | DType | Elementwise | Shape | Python | Record | Expression


def is_number(value: Value) -> bool:
    """Return whether a value is a typed scalar."""
    return not isinstance(value, Known | DType | Shape | Python | Elementwise | Record) and isinstance(value.type, Kind)


def array_type(value: Value) -> ArrayType | None:
    """Return the type of an array; None of anything else."""
    if isinstance(value, Known | DType | Shape | Python | Record) or not isinstance(value.type, ArrayType):
        return None
    return value.type


def named(kind: Type) -> str:
    """Return how a message names a type."""
    if isinstance(kind, Kind):
        return kind.value
    if isinstance(kind, ArrayType):
        return "array"
    return kind.struct.name if isinstance(kind, RowsType) else kind.name


def is_aggregate(kind: Type) -> bool:
    """Return whether a type is of records."""
    return isinstance(kind, RecordType | StructType | RowsType)
