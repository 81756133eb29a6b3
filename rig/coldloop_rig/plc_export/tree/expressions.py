"""Expressions of a kernel as typed expressions; what is known before a run (shapes, constants) is computed here."""

import ast
import builtins
from collections.abc import Callable
from typing import cast

import numpy as np

from coldloop_rig.plc_export.tree.nodes import (
    ArrayType,
    Convert,
    Element,
    Expression,
    Field,
    Item,
    Kind,
    Literal,
    Member,
    Name,
    Operation,
    RecordType,
    RowsType,
    Select,
    Statement,
    Storage,
    StructType,
    View,
)
from coldloop_rig.plc_export.tree.subset import Source
from coldloop_rig.plc_export.tree.values import (
    BINARY,
    COMPARISONS,
    DTYPES,
    LARGEST_INTEGER,
    OF_INTEGERS,
    OF_PLATFORM,
    OF_REALS,
    DType,
    Elementwise,
    Known,
    Python,
    Record,
    Shape,
    Value,
    array_type,
    named,
)

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
        self.scopes: list[dict[str, Value]] = [{}]
        self.before: list[Statement] = []
        """Statements that an expression needs before it: calls whose results are arrays."""
        self.conditional = 0
        self.loop_variables: list[str] = []
        self.used: set[str] = set()

    # -- kinds of results ----------------------------------------------------------------------------------------------

    def scalar(self, node: ast.expr) -> Expression:
        """Return a typed scalar."""
        value = self.read(node)
        if isinstance(value, Known):
            return self.literal(node, value)
        if isinstance(value, DType | Elementwise | Shape | Python | Record) or not isinstance(value.type, Kind):
            raise self.source.refusal(node, "this is not a number")
        return value

    def literal(self, node: ast.expr, known: Known) -> Literal:
        """Return an integer or a truth value; a number with a point has no type of its own."""
        if isinstance(known.value, bool | np.bool_):
            return Literal(Kind.BOOL, bool(known.value))
        if self.double and isinstance(known.value, float):
            return Literal(Kind.REAL, known.value)
        if not isinstance(known.value, int | np.integer):
            raise self.source.refusal(
                node, "a literal without a type would be computed in double: z.dtype.type(...) gives it one"
            )
        if abs(int(known.value)) > LARGEST_INTEGER:
            raise self.source.refusal(node, "an integer beyond 32 bits")
        return Literal(Kind.INT, int(known.value))

    def of_kind(self, node: ast.expr, kind: Kind) -> Expression:
        """Return a scalar of a certain type."""
        value = self.scalar(node)
        if value.type is not kind:
            raise self.source.refusal(
                node, f"a value of type {kind.value} is expected, this has type {named(value.type)}"
            )
        return value

    def storage(self, node: ast.expr) -> Storage:
        """Return an array or a record that has a name, or a part of one."""
        value = self.read(node)
        if isinstance(value, Record) and value.variable:
            return value.variable
        if not isinstance(value, Name | Field | View | Item) or isinstance(value.type, Kind):
            raise self.source.refusal(node, "an array or a record with a name is expected")
        return value

    def known_integer(self, node: ast.expr) -> int:
        """Return an integer that is known before a run."""
        value = self.read(node)
        if not isinstance(value, Known) or not isinstance(value.value, int):
            raise self.source.refusal(node, "a length that is not known before a run")
        return value.value

    # -- one method a kind of node -------------------------------------------------------------------------------------

    def read(self, node: ast.expr) -> Value:
        """Return what an expression is."""
        method = getattr(self, f"_{type(node).__name__.lower()}", None)
        if method is None:
            raise self.source.refusal(node, f"{type(node).__name__} is not in the subset")
        return cast("Value", method(node))

    def _constant(self, node: ast.Constant) -> Value:
        if not isinstance(node.value, int | float):
            raise self.source.refusal(node, f"{node.value!r} is not a number")
        return Known(node.value)

    def _name(self, node: ast.Name) -> Value:
        for scope in reversed(self.scopes):
            if node.id in scope:
                value: Value = scope[node.id]
                if isinstance(value, Name):
                    self.used.add(value.name)
                return value
        if node.id in self.source.assigned:
            raise self.source.refusal(node, f"{node.id} may have no value here")
        meaning = self.source.meanings.get(node.id, getattr(builtins, node.id, None))
        if meaning is None:
            raise self.source.refusal(node, f"{node.id} is not known")
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
            return self._part(node, base)
        base_type = None if isinstance(base, Known | DType | Shape) else base.type
        if isinstance(base_type, RecordType | StructType):
            for name, kind in base_type.fields:
                if name == node.attr:
                    return self._field(kind, base, name)
        if isinstance(base_type, RowsType) and node.attr == "shape":
            return Shape((base_type.length,))
        if isinstance(base_type, ArrayType) and node.attr == "shape":
            return Shape(base_type.shape)
        if isinstance(base_type, ArrayType) and node.attr == "size":
            return Known(base_type.size)
        if isinstance(base_type, ArrayType) and node.attr == "dtype":
            return DType(base_type.kind)
        raise self.source.refusal(node, f"the attribute {node.attr} is not in the subset")

    def _part(self, node: ast.Attribute, record: Record) -> Value:
        for name, part in record.parts:
            if name == node.attr:
                return part
        raise self.source.refusal(node, f"{record.name or 'a tuple'} has no {node.attr}")

    @staticmethod
    def _field(kind: object, base: Value, name: str) -> Value:
        if isinstance(kind, Kind) and isinstance(base, Name | Item) and isinstance(base.type, StructType):
            return Member(kind, base, name)
        return Field(cast("Kind", kind), cast("Name", base), name)

    def _subscript(self, node: ast.Subscript) -> Value:
        base = self.read(node.value)
        if isinstance(base, Shape):
            return Known(base.lengths[self.known_integer(node.slice)])
        if isinstance(base, Name | Field) and isinstance(base.type, RowsType):
            return Item(base.type.struct, base, self.index(node.slice, base.type.length))
        return self.element(node)

    def element(self, node: ast.Subscript) -> Element | View:
        """Return an element or, with a slice or fewer indices than dimensions, a part of an array."""
        array = self.storage(node.value)
        if not isinstance(array.type, ArrayType):
            raise self.source.refusal(node, "a record is read by the names of its fields")
        kind, shape = array.type.kind, array.type.shape
        if isinstance(node.slice, ast.Slice):
            return self._sliced(node, node.slice, array, array.type)
        places = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if len(places) > len(shape):
            raise self.source.refusal(node, "more indices than the array has")
        indices = tuple(self.index(place, length) for place, length in zip(places, shape, strict=False))
        if len(indices) == len(shape):
            return Element(kind, cast("Name", array), indices)
        offset: Expression = ZERO
        for index, length in zip((*indices, ZERO), shape, strict=False):
            offset = added(scaled(offset, length), index)
        rest = ArrayType(kind, shape[len(indices) :])
        for length in rest.shape[1:]:
            offset = scaled(offset, length)
        return view_of(rest, array, offset)

    def _sliced(self, node: ast.Subscript, part: ast.Slice, array: Storage, whole: ArrayType) -> View:
        if not (part.lower or part.upper or part.step):
            return view_of(whole, array, ZERO)
        if len(whole.shape) != 1 or part.step:
            raise self.source.refusal(node, "only arrays of one dimension are cut, without a step")
        length = whole.size
        first = self.known_integer(part.lower) if part.lower else 0
        end = self.known_integer(part.upper) if part.upper else length
        first, end = (place + length if place < 0 else place for place in (first, end))
        if not 0 <= first <= end <= length:
            raise self.source.refusal(node, f"{first} to {end} of an array of length {length}")
        return view_of(ArrayType(whole.kind, (end - first,)), array, Literal(Kind.INT, first))

    def index(self, node: ast.expr, length: int) -> Expression:
        """Return an index, which does not count from the end."""
        index = self.scalar(node)
        if index.type not in {Kind.INT, Kind.UNSIGNED}:
            raise self.source.refusal(node, "an index is an integer")
        if isinstance(index, Literal) and not 0 <= index.value < length:
            raise self.source.refusal(node, f"index {index.value} of an array of length {length}")
        return index

    def _unaryop(self, node: ast.UnaryOp) -> Value:
        if isinstance(node.op, ast.Not):
            return Operation(Kind.BOOL, "not", (self.of_kind(node.operand, Kind.BOOL),))
        if not isinstance(node.op, ast.USub):
            raise self.source.refusal(node, "this operator is not in the subset")
        value = self.read(node.operand)
        if isinstance(value, Known):
            return Known(-value.value)
        return self.each(node, lambda parts: self._negative(node, parts[0]), (value,))

    def _negative(self, node: ast.expr, operand: Expression) -> Expression:
        if operand.type not in {Kind.REAL, Kind.INT}:
            raise self.source.refusal(node, f"minus of type {named(operand.type)}")
        return Operation(cast("Kind", operand.type), "negative", (operand,))

    def _binop(self, node: ast.BinOp) -> Value:
        if type(node.op) not in BINARY:
            raise self.source.refusal(node, "this operator is not in the subset")
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
            one, other = (Convert(Kind.REAL, each) for each in (one, other))
        if one.type is not other.type:
            raise self.source.refusal(node, f"{named(one.type)} {sign} {named(other.type)} would be computed in double")
        if one.type is Kind.BOOL or (one.type is Kind.UNSIGNED and sign == "-"):
            raise self.source.refusal(node, f"{sign} of type {named(one.type)} is not in the subset")
        if sign not in (OF_REALS if one.type is Kind.REAL else OF_INTEGERS):
            raise self.source.refusal(node, f"{sign} of type {named(one.type)} is not in the subset")
        self.refuse_platform(node, sign)
        if sign in {"%", "//"} and not (isinstance(other, Literal) and other.value > 0):
            raise self.source.refusal(node, f"{sign} by anything but a positive literal is not in the subset")
        return Operation(cast("Kind", one.type), sign, (one, other))

    def refuse_platform(self, node: ast.AST, name: str) -> None:
        """Refuse an operator whose bits are the platform's, unless it is accepted."""
        if name in OF_PLATFORM and name not in self.platform:
            raise self.source.refusal(node, f"the bits of {name} are those of the platform's library")

    def each(
        self, node: ast.expr, combine: Callable[[tuple[Expression, ...]], Expression], parts: tuple[Value, ...]
    ) -> Value:  # fmt: skip
        """Return an operation on numbers, or the array of it where there are arrays of one shape."""
        arrays = [kind for part in parts if (kind := array_type(part))]
        if any(isinstance(part, DType | Shape | Python | Known | Record) for part in parts):
            raise self.source.refusal(node, "this is not a number")
        if not arrays:
            return combine(cast("tuple[Expression, ...]", parts))
        if any(array.shape != arrays[0].shape for array in arrays):
            raise self.source.refusal(node, "arrays of different shapes")

        def at(indices: tuple[Expression, ...]) -> Expression:
            return combine(tuple(element_of(part, indices) for part in parts))

        zero = tuple(ZERO for _ in arrays[0].shape)
        return Elementwise(ArrayType(cast("Kind", at(zero).type), arrays[0].shape), at)

    def _compare(self, node: ast.Compare) -> Value:
        operands = [node.left, *node.comparators]
        result: Expression | None = None
        for sign, left, right in zip(node.ops, operands, operands[1:], strict=False):
            one = self._compared(node, sign, left, right)
            result = Operation(Kind.BOOL, "and", (result, one)) if result else one
        return cast("Expression", result)

    def _compared(self, node: ast.Compare, sign: ast.cmpop, left: ast.expr, right: ast.expr) -> Expression:
        if type(sign) not in COMPARISONS:
            raise self.source.refusal(node, "this comparison is not in the subset")
        read = [self.read(left), self.read(right)]
        real = any(is_real(each) for each in read)
        one, other = (
            Literal(Kind.REAL, each.value)
            if real and isinstance(each, Known) and is_exact(each)
            else self.scalar(operand)
            for each, operand in zip(read, (left, right), strict=True)
        )
        if one.type is not other.type or one.type is Kind.BOOL:
            raise self.source.refusal(node, f"{named(one.type)} compared with {named(other.type)}")
        return Operation(Kind.BOOL, COMPARISONS[type(sign)], (one, other))

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
        if one.type is not other.type:
            raise self.source.refusal(node, f"{named(one.type)} or {named(other.type)}")
        return Select(cast("Kind", one.type), condition, one, other)


def added(one: Expression, other: Expression) -> Expression:
    """Return the sum of two integers; nothing is added to 0."""
    if one == ZERO:
        return other
    if other == ZERO:
        return one
    if isinstance(one, Literal) and isinstance(other, Literal):
        return Literal(Kind.INT, one.value + other.value)
    return Operation(Kind.INT, "+", (one, other))


def scaled(index: Expression, length: int) -> Expression:
    """Return an integer times a length."""
    if isinstance(index, Literal):
        return Literal(Kind.INT, index.value * length)
    return Operation(Kind.INT, "*", (index, Literal(Kind.INT, length)))


def view_of(kind: ArrayType, array: Storage, offset: Expression) -> View:
    """Return a part of an array, which may be a part itself."""
    if isinstance(array, View):
        return View(kind, array.array, added(array.offset, offset))
    return View(kind, cast("Name", array), offset)


def element_of(part: Value, indices: tuple[Expression, ...]) -> Expression:
    """Return an element of an array; a number as it is."""
    if isinstance(part, Elementwise):
        return part.at(indices)
    if isinstance(part, Name | Field | View) and isinstance(part.type, ArrayType):
        return Element(part.type.kind, part, indices)
    return cast("Expression", part)


def is_real(value: Value) -> bool:
    """Return whether a value is a number with a point and a type."""
    return not isinstance(value, Known | DType | Shape | Python | Record | Elementwise) and value.type is Kind.REAL


def is_exact(known: Known) -> bool:
    """Return whether a number is the same in single precision, so that comparing it needs no type."""
    return not isinstance(known.value, bool) and float(np.float32(known.value)) == known.value
