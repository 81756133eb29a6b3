"""Expressions of a kernel as typed expressions; what is known before a run (shapes, constants) is computed here."""

import ast
import builtins
import inspect
import math
import operator
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any, ClassVar, Final, TypeAlias, TypeGuard, cast

import numpy as np

from coldloop.kernels import compiled, single_precision
from coldloop_export import tree
from coldloop_export.tree import ArrayType, Expression, Field, Kind, Literal, Name, Operation, RowsType, View

Kernel: TypeAlias = Callable[..., Any]
"""A kernel, or a function of plain Python that is one for the exporter."""


class Source:
    """Syntax tree of a kernel, with what its names mean where it was written."""

    def __init__(self, function: Kernel) -> None:
        python = compiled.python_of(function) or function
        self.name = python.__name__
        self.file = inspect.getsourcefile(python) or python.__module__
        lines, first = inspect.getsourcelines(python)
        module = ast.parse(textwrap.dedent("".join(lines)))
        ast.increment_lineno(module, first - 1)
        definition = module.body[0]
        if not isinstance(definition, ast.FunctionDef):
            raise tree.UnfitKernelError(f"{self.file}:{first}: a kernel is a function")
        self.definition = definition
        self.meanings = {**python.__globals__, **inspect.getclosurevars(python).nonlocals}
        self.assigned, self.assigned_once = self._assigned()

    def refusal(self, node: ast.AST, why: str) -> tree.UnfitKernelError:
        """Return the error for a node, in one line."""
        line = getattr(node, "lineno", self.definition.lineno)
        raise tree.UnfitKernelError(
            f"{self.file}:{line}: {why}; an exported kernel has a smaller Python (`coldloop docs plc-export`)"
        )

    def refuse_if(self, wrong: object, node: ast.AST, why: str) -> None:
        """Raise the error for a node if it is wrong."""
        if wrong:
            raise self.refusal(node, why)

    def _assigned(self) -> tuple[set[str], set[str]]:
        names = [node.id for node in ast.walk(self.definition) if isinstance(node, ast.Name)
                 and isinstance(node.ctx, ast.Store)]  # fmt: skip
        parameters = {argument.arg for argument in self.definition.args.args}
        for name in {*names, *parameters}:
            if re.match(r"(new|result|at|stop)_\d", name):
                raise self.refusal(self.definition, f"the name {name} is kept for intermediate values")
        return set(names), {name for name in names if names.count(name) == 1} - parameters


BINARY: Final[dict[type[ast.operator], tuple[str, Callable[[Any, Any], Any]]]] = {
    ast.Add: ("+", operator.add), ast.Sub: ("-", operator.sub), ast.Mult: ("*", operator.mul),
    ast.Div: ("/", operator.truediv), ast.Mod: ("%", operator.mod), ast.FloorDiv: ("//", operator.floordiv),
    ast.Pow: ("power", operator.pow),
}  # fmt: skip
COMPARISONS: Final[dict[type[ast.cmpop], str]] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip
FUNCTIONS: Final[dict[object, str]] = {
    abs: "abs", min: "min", max: "max", np.sqrt: "sqrt", math.sqrt: "sqrt", np.isfinite: "isfinite",
    math.isfinite: "isfinite", np.isinf: "isinf", math.isnan: "isnan", math.log: "log", math.copysign: "copysign",
    round: "round", single_precision.single: "single",
}  # fmt: skip
OPERANDS: Final = {"min": 2, "max": 2, "copysign": 2}
"""Least number of operands of functions that take more than one."""
DTYPES: Final[dict[object, Kind]] = {np.int64: Kind.INT, np.uint64: Kind.UNSIGNED, np.bool_: Kind.BOOL}
NEW_ARRAYS: Final = (np.empty, np.zeros, np.empty_like, np.zeros_like)


class Untyped:
    """A value that is not one of the typed tree."""

    type: ClassVar[None] = None


@dataclass(frozen=True)
class Known(Untyped):
    """A number that is known before a run, as Python computes it."""

    value: Any
    """An integer, a float (Python's or numpy's) or a truth value."""


@dataclass(frozen=True)
class DType(Untyped):
    """A type used as a value."""

    kind: Kind


@dataclass(frozen=True)
class Shape(Untyped):
    """The shape of an array."""

    lengths: tuple[int, ...]


@dataclass(frozen=True)
class Python(Untyped):
    """Value of a global name: a module, a kernel, a function of Python's or numpy's."""

    value: object


@dataclass(frozen=True)
class Record(Untyped):
    """Several values: those of a tuple, which has no name, or of a NamedTuple."""

    name: str
    parts: tuple[tuple[str, "Value"], ...]
    variable: Name | None = None
    """Variable of the tree that holds the record; None if it has none."""


@dataclass(frozen=True)
class Elementwise:
    """A new array, element by element."""

    type: ArrayType
    at: Callable[[tuple[Expression, ...]], Expression]


Value: TypeAlias = Known | DType | Shape | Python | Record | Elementwise | Expression


def named(kind: tree.Type) -> str:
    """Return how a message names a type."""
    if isinstance(kind, Kind):
        return kind.value
    if isinstance(kind, ArrayType):
        return "array"
    return kind.struct.name if isinstance(kind, RowsType) else kind.name


ZERO = Literal(Kind.INT, 0)


class ExpressionReader:
    """Reads expressions without calls; `calls.py` has those, `reading.py` the statements.

    Args:
        source: The kernel.
        platform: Operators whose bits are the platform's library's and that are accepted all the same.
        double: What has no type is in double precision.
    """

    def __init__(self, source: Source, platform: frozenset[str], *, double: bool) -> None:
        self.source, self.platform, self.double = source, platform, double
        self.refusal, self.refuse_if = source.refusal, source.refuse_if
        self.scopes: list[dict[str, Value]] = [{}]
        self.before: list[tree.Statement] = []
        """Statements that an expression needs before it: calls whose results are arrays."""
        self.conditional = 0
        self.loop_variables: list[str] = []
        self.used: set[str] = set()

    def scalar(self, node: ast.expr) -> Expression:
        """Return a typed scalar."""
        value = self.read(node)
        if isinstance(value, Known):
            return self.literal(node, value)
        if isinstance(value, Untyped | Elementwise) or not isinstance(value.type, Kind):
            raise self.refusal(node, "this is not a number")
        return value

    def literal(self, node: ast.expr, known: Known) -> Literal:
        """Return an integer or a truth value; a number with a point has no type of its own."""
        if isinstance(known.value, bool | np.bool_):
            return Literal(Kind.BOOL, bool(known.value))
        if self.double and isinstance(known.value, float):
            return Literal(Kind.REAL, known.value)
        if not isinstance(known.value, int | np.integer):
            raise self.refusal(
                node, "a literal without a type would be computed in double: z.dtype.type(...) gives it one"
            )
        self.refuse_if(abs(int(known.value)) > 2**31 - 1, node, "an integer beyond 32 bits")
        return Literal(Kind.INT, int(known.value))

    def of_kind(self, node: ast.expr, kind: Kind) -> Expression:
        """Return a scalar of a certain type."""
        value = self.scalar(node)
        if value.type is not kind:
            raise self.refusal(node, f"a value of type {kind.value} is expected, this has type {named(value.type)}")
        return value

    def storage(self, node: ast.expr) -> tree.Storage:
        """Return an array or a record that has a name, or a part of one."""
        value = self.read(node)
        if isinstance(value, Record) and value.variable:
            return value.variable
        if not isinstance(value, Name | Field | View | tree.Item) or isinstance(value.type, Kind):
            raise self.refusal(node, "an array or a record with a name is expected")
        return value

    def known_integer(self, node: ast.expr) -> int:
        """Return an integer that is known before a run."""
        value = self.read(node)
        if not isinstance(value, Known) or not isinstance(value.value, int):
            raise self.refusal(node, "a length that is not known before a run")
        return value.value

    def read(self, node: ast.expr) -> Value:
        """Return what an expression is."""
        method = getattr(self, f"_{type(node).__name__.lower()}", None)
        if method is None:
            raise self.refusal(node, f"{type(node).__name__} is not in the subset")
        return cast("Value", method(node))

    def _constant(self, node: ast.Constant) -> Value:
        self.refuse_if(not isinstance(node.value, int | float), node, f"{node.value!r} is not a number")
        return Known(node.value)

    def _name(self, node: ast.Name) -> Value:
        for scope in reversed(self.scopes):
            if node.id in scope:
                value: Value = scope[node.id]
                if isinstance(value, Name):
                    self.used.add(value.name)
                return value
        self.refuse_if(node.id in self.source.assigned, node, f"{node.id} may have no value here")
        meaning = self.source.meanings.get(node.id, getattr(builtins, node.id, None))
        if meaning is None:
            raise self.refusal(node, f"{node.id} is not known")
        return Known(meaning) if isinstance(meaning, int | float | np.number) else Python(meaning)

    def _attribute(self, node: ast.Attribute) -> Value:  # noqa: C901, PLR0911 one case a kind of value
        base = self.read(node.value)
        if isinstance(base, Python):
            found = getattr(base.value, node.attr, None)
            if found in DTYPES:
                return DType(DTYPES[found])
            return Known(found) if isinstance(found, int | float) else Python(found)
        if isinstance(base, DType) and node.attr == "type":
            return base
        if isinstance(base, Record):
            if (part := dict(base.parts).get(node.attr)) is None:
                raise self.refusal(node, f"{base.name or 'a tuple'} has no {node.attr}")
            return part
        match base.type, node.attr:
            case tree.RecordType(_, fields) | tree.StructType(_, fields), name if name in dict(fields):
                kind = dict(fields)[name]
                if isinstance(kind, Kind) and isinstance(base.type, tree.StructType):
                    return tree.Member(kind, cast("Name", base), name)
                return Field(kind, cast("Name", base), name)
            case RowsType(_, length), "shape":
                return Shape((length,))
            case ArrayType(_, shape), "shape":
                return Shape(shape)
            case ArrayType() as array, "size":
                return Known(array.size)
            case ArrayType(number, _), "dtype":
                return DType(number)
        raise self.refusal(node, f"the attribute {node.attr} is not in the subset")

    def _subscript(self, node: ast.Subscript) -> Value:
        base = self.read(node.value)
        if isinstance(base, Shape):
            return Known(base.lengths[self.known_integer(node.slice)])
        if isinstance(base, Name | Field) and isinstance(base.type, RowsType):
            return tree.Item(base.type.struct, base, self.index(node.slice, base.type.length))
        return self.element(node)

    def element(self, node: ast.Subscript) -> tree.Element | View:
        """Return an element or, with a slice or fewer indices than dimensions, a part of an array."""
        array = self.storage(node.value)
        if not isinstance(array.type, ArrayType):
            raise self.refusal(node, "a record is read by the names of its fields")
        kind, shape = array.type.kind, array.type.shape
        if isinstance(node.slice, ast.Slice):
            return self._sliced(node, node.slice, array, array.type)
        places = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        self.refuse_if(len(places) > len(shape), node, "more indices than the array has")
        indices = tuple(self.index(place, length) for place, length in zip(places, shape, strict=False))
        if len(indices) == len(shape):
            return tree.Element(kind, cast("Name", array), indices)
        offset: Expression = ZERO
        for index, length in zip((*indices, ZERO), shape, strict=False):
            offset = added(scaled(offset, length), index)
        rest = ArrayType(kind, shape[len(indices) :])
        for length in rest.shape[1:]:
            offset = scaled(offset, length)
        return view_of(rest, array, offset)

    def _sliced(self, node: ast.Subscript, part: ast.Slice, array: tree.Storage, whole: ArrayType) -> View:
        if not (part.lower or part.upper or part.step):
            return view_of(whole, array, ZERO)
        self.refuse_if(len(whole.shape) != 1 or part.step, node, "only arrays of one dimension are cut, without a step")
        length = whole.size
        first = self.known_integer(part.lower) if part.lower else 0
        end = self.known_integer(part.upper) if part.upper else length
        first, end = (place + length if place < 0 else place for place in (first, end))
        self.refuse_if(not 0 <= first <= end <= length, node, f"{first} to {end} of an array of length {length}")
        return view_of(ArrayType(whole.kind, (end - first,)), array, Literal(Kind.INT, first))

    def index(self, node: ast.expr, length: int) -> Expression:
        """Return an index, which does not count from the end."""
        index = self.scalar(node)
        self.refuse_if(index.type not in {Kind.INT, Kind.UNSIGNED}, node, "an index is an integer")
        if isinstance(index, Literal) and not 0 <= index.value < length:
            raise self.refusal(node, f"index {index.value} of an array of length {length}")
        return index

    def _unaryop(self, node: ast.UnaryOp) -> Value:
        if isinstance(node.op, ast.Not):
            return Operation(Kind.BOOL, "not", (self.of_kind(node.operand, Kind.BOOL),))
        if not isinstance(node.op, ast.USub):
            raise self.refusal(node, "this operator is not in the subset")
        value = self.read(node.operand)
        if isinstance(value, Known):
            return Known(-value.value)

        def negative(operands: tuple[Expression, ...]) -> Expression:
            if (kind := operands[0].type) not in {Kind.REAL, Kind.INT}:
                raise self.refusal(node, f"minus of type {named(kind)}")
            return Operation(cast("Kind", kind), "negative", operands)

        return self.each(node, negative, (value,))

    def _binop(self, node: ast.BinOp) -> Value:
        self.refuse_if(type(node.op) not in BINARY, node, "this operator is not in the subset")
        sign, compute = BINARY[type(node.op)]
        one, other = self.read(node.left), self.read(node.right)
        if isinstance(one, Known) and isinstance(other, Known):
            return Known(compute(one.value, other.value))
        parts = (self.typed(node.left, one), self.typed(node.right, other))
        return self.each(node, lambda both: self.operation(node, sign, *both), parts)

    def typed(self, node: ast.expr, value: Value) -> Value:
        """Return a value with numbers that are known made literals."""
        return self.literal(node, value) if isinstance(value, Known) else value

    def operation(self, node: ast.AST, sign: str, one: Expression, other: Expression) -> Expression:
        """Return an operation whose operands have one type."""
        if self.double and sign == "/" and one.type is other.type is Kind.INT:
            one, other = (tree.Convert(Kind.REAL, each) for each in (one, other))
        if one.type is not other.type:
            raise self.refusal(node, f"{named(one.type)} {sign} {named(other.type)} would be computed in double")
        signs = ("+", "-", "*", "/", "power") if one.type is Kind.REAL else ("+", "-", "*", "%", "//")
        if one.type is Kind.BOOL or (one.type is Kind.UNSIGNED and sign == "-") or sign not in signs:
            raise self.refusal(node, f"{sign} of type {named(one.type)} is not in the subset")
        self.refuse_platform(node, sign)
        if sign in {"%", "//"} and not (isinstance(other, Literal) and other.value > 0):
            raise self.refusal(node, f"{sign} by anything but a positive literal is not in the subset")
        return Operation(cast("Kind", one.type), sign, (one, other))

    def refuse_platform(self, node: ast.AST, name: str) -> None:
        """Refuse an operator whose bits are the platform's, unless it is accepted."""
        if name in {"power", "log"} - self.platform:
            raise self.refusal(node, f"the bits of {name} are those of the platform's library")

    def each(
        self, node: ast.expr, combine: Callable[[tuple[Expression, ...]], Expression], parts: tuple[Value, ...]
    ) -> Value:
        """Return an operation on numbers, or the array of it where there are arrays of one shape."""
        shapes = {part.type.shape for part in parts if isinstance(part.type, ArrayType)}
        if any(isinstance(part, Untyped) for part in parts):
            raise self.refusal(node, "this is not a number")
        if not shapes:
            return combine(cast("tuple[Expression, ...]", parts))
        self.refuse_if(len(shapes) > 1, node, "arrays of different shapes")

        def at(indices: tuple[Expression, ...]) -> Expression:
            return combine(tuple(element_of(part, indices) for part in parts))

        (shape,) = shapes
        return Elementwise(ArrayType(cast("Kind", at((ZERO,) * len(shape)).type), shape), at)

    def _compare(self, node: ast.Compare) -> Value:
        operands = [node.left, *node.comparators]
        compared = []
        for sign, *both in zip(node.ops, operands, operands[1:], strict=False):
            self.refuse_if(type(sign) not in COMPARISONS, node, "this comparison is not in the subset")
            read = [self.read(each) for each in both]
            real = any(each.type is Kind.REAL for each in read)
            one, other = (
                Literal(Kind.REAL, value.value) if real and is_exact(value) else self.scalar(operand)
                for value, operand in zip(read, both, strict=True)
            )
            if one.type is not other.type or one.type is Kind.BOOL:
                raise self.refusal(node, f"{named(one.type)} compared with {named(other.type)}")
            compared.append(Operation(Kind.BOOL, COMPARISONS[type(sign)], (one, other)))
        return reduce(lambda before, last: Operation(Kind.BOOL, "and", (before, last)), compared)

    def _boolop(self, node: ast.BoolOp) -> Value:
        sign = "and" if isinstance(node.op, ast.And) else "or"
        result = self.of_kind(node.values[0], Kind.BOOL)
        self.conditional += 1
        for part in node.values[1:]:
            result = Operation(Kind.BOOL, sign, (result, self.of_kind(part, Kind.BOOL)))
        self.conditional -= 1
        return result

    def _ifexp(self, node: ast.IfExp) -> Value:
        condition = self.of_kind(node.test, Kind.BOOL)
        self.conditional += 1
        one, other = self.scalar(node.body), self.scalar(node.orelse)
        self.conditional -= 1
        self.refuse_if(one.type is not other.type, node, f"{named(one.type)} or {named(other.type)}")
        return tree.Select(cast("Kind", one.type), condition, one, other)


def is_exact(value: Value) -> TypeGuard[Known]:
    """Return whether a value is a known number that is exact in single precision: comparing it needs no type."""
    if not isinstance(value, Known) or isinstance(value.value, bool):
        return False
    return float(np.float32(value.value)) == float(value.value)


def added(one: Expression, other: Expression) -> Expression:
    """Return the sum of two integers; nothing is added to 0."""
    if ZERO in (one, other):
        return other if one == ZERO else one
    if isinstance(one, Literal) and isinstance(other, Literal):
        return Literal(Kind.INT, one.value + other.value)
    return Operation(Kind.INT, "+", (one, other))


def scaled(index: Expression, length: int) -> Expression:
    """Return an integer times a length."""
    if isinstance(index, Literal):
        return Literal(Kind.INT, index.value * length)
    return Operation(Kind.INT, "*", (index, Literal(Kind.INT, length)))


def view_of(kind: ArrayType, array: tree.Storage, offset: Expression) -> View:
    """Return a part of an array, which may be a part itself."""
    if isinstance(array, View):
        return View(kind, array.array, added(array.offset, offset))
    return View(kind, cast("Name", array), offset)


def element_of(part: Value, indices: tuple[Expression, ...]) -> Expression:
    """Return an element of an array; a number as it is."""
    if isinstance(part, Elementwise):
        return part.at(indices)
    if isinstance(part, Name | Field | View) and isinstance(part.type, ArrayType):
        return tree.Element(part.type.kind, part, indices)
    return cast("Expression", part)
