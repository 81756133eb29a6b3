"""Expressions of a kernel as typed expressions; what is known before a run (shapes, constants) is computed here."""

import ast
import builtins
import math
import operator
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeAlias, cast

import numpy as np
from numba.core.dispatcher import Dispatcher

from rig.plc_export.subset import Source
from rig.plc_export.tree import (
    ArrayType,
    Convert,
    Element,
    Expression,
    Field,
    Function,
    Invocation,
    Invoke,
    Kind,
    Literal,
    Name,
    Operation,
    RecordType,
    Select,
    Statement,
    Storage,
    Type,
)

BINARY: Final[dict[type[ast.operator], tuple[str, Callable[[Any, Any], Any]]]] = {
    ast.Add: ("+", operator.add), ast.Sub: ("-", operator.sub), ast.Mult: ("*", operator.mul),
    ast.Div: ("/", operator.truediv), ast.Mod: ("%", operator.mod), ast.FloorDiv: ("//", operator.floordiv),
    ast.Pow: ("power", operator.pow),
}  # fmt: skip
COMPARISONS: Final[dict[type[ast.cmpop], str]] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip
OF_INTEGERS, OF_REALS = ("+", "-", "*", "%", "//"), ("+", "-", "*", "/", "power")
FUNCTIONS: Final = {abs: "abs", min: "min", max: "max", np.sqrt: "sqrt", math.sqrt: "sqrt"}
LARGEST_INTEGER: Final = 2**31 - 1


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


Value: TypeAlias = Known | DType | Elementwise | Shape | Python | Expression


class ExpressionReader:
    """Reads expressions; `reading.py` has the statements.

    Args:
        source: The kernel.
        specialised: Returns the function of a kernel for arguments of these types.
        platform: Operators whose bits are the platform's library's and that are accepted all the same.
    """

    def __init__(
        self, source: Source, specialised: Callable[[Dispatcher, tuple[Type, ...]], Function], platform: frozenset[str]
    ) -> None:
        self.source, self.specialised, self.platform = source, specialised, platform
        self.scopes: list[dict[str, Value]] = [{}]
        self.before: list[Statement] = []
        """Statements that an expression needs before it: calls whose results are arrays."""
        self.conditional = 0
        self.written: set[str] = set()
        self.used: set[str] = set()

    # -- kinds of results ----------------------------------------------------------------------------------------------

    def scalar(self, node: ast.expr) -> Expression:
        """Return a typed scalar."""
        value = self.read(node)
        if isinstance(value, Known):
            return self.literal(node, value)
        if isinstance(value, DType | Elementwise | Shape | Python) or not isinstance(value.type, Kind):
            raise self.source.refusal(node, "this is not a number")
        return value

    def literal(self, node: ast.expr, known: Known) -> Literal:
        """Return an integer or a truth value; a number with a point has no type of its own."""
        if isinstance(known.value, bool | np.bool_):
            return Literal(Kind.BOOL, bool(known.value))
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
        """Return an array or a record that has a name."""
        value = self.read(node)
        if not isinstance(value, Name | Field) or isinstance(value.type, Kind):
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

    def _attribute(self, node: ast.Attribute) -> Value:
        base = self.read(node.value)
        if isinstance(base, Python):
            found = getattr(base.value, node.attr, None)
            if found in DTYPES:
                return DType(DTYPES[found])
            return Known(found) if isinstance(found, int | float) else Python(found)
        if isinstance(base, DType) and node.attr == "type":
            return base
        base_type = None if isinstance(base, Known | DType | Shape) else base.type
        if isinstance(base, Name | Field) and isinstance(base_type, RecordType):
            for name, kind in base_type.fields:
                if name == node.attr:
                    return Field(kind, base, name)
        if isinstance(base_type, ArrayType) and node.attr == "shape":
            return Shape(base_type.shape)
        if isinstance(base_type, ArrayType) and node.attr == "dtype":
            return DType(base_type.kind)
        raise self.source.refusal(node, f"the attribute {node.attr} is not in the subset")

    def _subscript(self, node: ast.Subscript) -> Value:
        base = self.read(node.value)
        if isinstance(base, Shape):
            return Known(base.lengths[self.known_integer(node.slice)])
        element = self.element(node)
        if not isinstance(element, Element):
            raise self.source.refusal(node, "a part of an array is not in the subset: a loop over its elements is")
        return element

    def element(self, node: ast.Subscript) -> Element | Elementwise:
        """Return an element; of an array with more dimensions than there are indices, its row."""
        array = self.storage(node.value)
        if not isinstance(array.type, ArrayType):
            raise self.source.refusal(node, "a record is read by the names of its fields")
        places = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        indices = tuple(self.index(place, length) for place, length in zip(places, array.type.shape, strict=False))
        if len(places) > len(array.type.shape):
            raise self.source.refusal(node, "more indices than the array has")
        kind, rest = array.type.kind, array.type.shape[len(places) :]
        if not rest:
            return Element(kind, array, indices)
        return Elementwise(ArrayType(kind, rest), lambda inner: Element(kind, array, indices + inner))

    def index(self, node: ast.expr, length: int) -> Expression:
        """Return an index, which does not count from the end."""
        if isinstance(node, ast.Slice):
            raise self.source.refusal(node, "a slice is not in the subset: a loop over its elements is")
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
        return self._each(node, lambda parts: self._negative(node, parts[0]), (value,))

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
        return self._each(node, lambda both: self.operation(node, sign, *both), parts)

    def typed(self, node: ast.expr, value: Value) -> Value:
        """Return a value with numbers that are known made literals."""
        return self.literal(node, value) if isinstance(value, Known) else value

    def operation(self, node: ast.AST, sign: str, one: Expression, other: Expression) -> Expression:
        """Return an operation whose operands have one type."""
        if one.type is not other.type:
            raise self.source.refusal(node, f"{named(one.type)} {sign} {named(other.type)} would be computed in double")
        if one.type is Kind.BOOL or (one.type is Kind.UNSIGNED and sign == "-"):
            raise self.source.refusal(node, f"{sign} of type {named(one.type)} is not in the subset")
        if sign not in (OF_REALS if one.type is Kind.REAL else OF_INTEGERS):
            raise self.source.refusal(node, f"{sign} of type {named(one.type)} is not in the subset")
        if sign == "power" and sign not in self.platform:
            raise self.source.refusal(node, "the bits of ** are those of the platform's library")
        if sign in {"%", "//"} and not (isinstance(other, Literal) and other.value > 0):
            raise self.source.refusal(node, f"{sign} by anything but a positive literal is not in the subset")
        return Operation(cast("Kind", one.type), sign, (one, other))

    def _each(
        self, node: ast.expr, combine: Callable[[tuple[Expression, ...]], Expression], parts: tuple[Value, ...]
    ) -> Value:  # fmt: skip
        """Return an operation on numbers, or the array of it where there are arrays of one shape."""
        arrays = [part.type for part in parts if isinstance(part, Name | Field | Elementwise)
                  and isinstance(part.type, ArrayType)]  # fmt: skip
        if any(isinstance(part, DType | Shape | Python | Known) for part in parts):
            raise self.source.refusal(node, "this is not a number")
        if not arrays:
            return combine(cast("tuple[Expression, ...]", parts))
        if any(array.shape != arrays[0].shape for array in arrays):
            raise self.source.refusal(node, "arrays of different shapes")

        def at(indices: tuple[Expression, ...]) -> Expression:
            return combine(tuple(
                part.at(indices) if isinstance(part, Elementwise)
                else Element(part.type.kind, part, indices)
                if isinstance(part, Name | Field) and isinstance(part.type, ArrayType) else cast("Expression", part)
                for part in parts
            ))  # fmt: skip

        zero = tuple(Literal(Kind.INT, 0) for _ in arrays[0].shape)
        return Elementwise(ArrayType(cast("Kind", at(zero).type), arrays[0].shape), at)

    def _compare(self, node: ast.Compare) -> Value:
        if len(node.ops) != 1 or type(node.ops[0]) not in COMPARISONS:
            raise self.source.refusal(node, "this comparison is not in the subset")
        one, other = self.scalar(node.left), self.scalar(node.comparators[0])
        if one.type is not other.type or one.type is Kind.BOOL:
            raise self.source.refusal(node, f"{named(one.type)} compared with {named(other.type)}")
        return Operation(Kind.BOOL, COMPARISONS[type(node.ops[0])], (one, other))

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

    # -- calls ---------------------------------------------------------------------------------------------------------

    def _call(self, node: ast.Call) -> Value:
        if node.keywords or any(isinstance(argument, ast.Starred) for argument in node.args):
            raise self.source.refusal(node, "arguments are given by their places")
        if isinstance(node.func, ast.Attribute) and node.func.attr == "copy" and not node.args:
            return self._copy(node, self.storage(node.func.value))
        called = self.read(node.func)
        if isinstance(called, DType):
            return self._converted(node, called.kind)
        if not isinstance(called, Python):
            raise self.source.refusal(node, "this cannot be called")
        if isinstance(called.value, Dispatcher):
            return self._invocation(node, called.value)
        if called.value in FUNCTIONS:
            return self._function(node, FUNCTIONS[called.value])
        if called.value in NEW_ARRAYS:
            return self._new_array(node)
        name = ast.unparse(node.func)
        raise self.source.refusal(
            node, f"{name} is not in the subset: its order of operations or its bits are not defined"
        )

    def _copy(self, node: ast.expr, array: Storage) -> Value:
        if not isinstance(array.type, ArrayType):
            raise self.source.refusal(node, "only arrays are copied")
        kind = array.type.kind
        return Elementwise(array.type, lambda indices: Element(kind, array, indices))

    def _converted(self, node: ast.Call, kind: Kind) -> Value:
        if len(node.args) != 1:
            raise self.source.refusal(node, "a type takes one argument")
        value = self.read(node.args[0])
        if isinstance(value, Known):
            return Literal(kind, value.value)
        operand = self.scalar(node.args[0])
        if operand.type is kind:
            return operand
        if operand.type is not Kind.INT:
            raise self.source.refusal(node, f"{named(operand.type)} to {kind.value} is not in the subset")
        return Convert(kind, operand)

    def _function(self, node: ast.Call, name: str) -> Value:
        operands = [self.scalar(argument) for argument in node.args]
        least = 2 if name in {"min", "max"} else 1
        if len(operands) < least or any(one.type is not operands[0].type for one in operands):
            raise self.source.refusal(node, f"{name} of operands of different types, or of too few")
        kind = cast("Kind", operands[0].type)
        if name in {"sqrt", "abs"} and (kind is not Kind.REAL or len(operands) != 1):
            raise self.source.refusal(node, f"{name} of type {kind.value} is not in the subset")
        result = operands[0] if least > 1 else Operation(kind, name, (operands[0],))
        for operand in operands[1:]:
            result = Operation(kind, name, (result, operand))
        return result

    def _new_array(self, node: ast.Call) -> Value:
        name = cast("ast.Attribute", node.func).attr
        if name.endswith("_like"):
            like = self.storage(node.args[0])
            if not isinstance(like.type, ArrayType):
                raise self.source.refusal(node, "an array is expected")
            made = like.type
        else:
            if len(node.args) != 2:
                raise self.source.refusal(node, "a new array needs its type")
            dtype = self.read(node.args[1])
            if not isinstance(dtype, DType):
                raise self.source.refusal(node, "a new array needs its type")
            lengths = node.args[0].elts if isinstance(node.args[0], ast.Tuple) else [node.args[0]]
            made = ArrayType(dtype.kind, tuple(map(self.known_integer, lengths)))
        return Elementwise(made, lambda _indices: Literal(made.kind, 0))

    def call(self, node: ast.Call, kernel: Dispatcher) -> tuple[Function, tuple[Expression, ...]]:
        """Return the function that is called, and its arguments; those that are new arrays get names."""
        arguments = tuple(self._argument(argument) for argument in node.args)
        function = self.specialised(kernel, tuple(argument.type for argument in arguments))
        if len(arguments) != len(function.parameters):
            raise self.source.refusal(node, f"{function.name} takes {len(function.parameters)} arguments")
        for parameter, argument in zip(function.parameters, arguments, strict=True):
            if parameter.name in function.written:
                self.write_to(node, cast("Storage", argument))
        return function, arguments

    def _argument(self, node: ast.expr) -> Expression:
        value = self.typed(node, self.read(node))
        if isinstance(value, Elementwise):
            return self.named_array(node, value)
        if isinstance(value, DType | Shape | Python | Known):
            raise self.source.refusal(node, "arguments are arrays, records and numbers")
        return value

    def write_to(self, node: ast.AST, target: Storage) -> None:
        """Note that an array is written to."""
        if isinstance(target, Field):
            raise self.source.refusal(node, "arrays in records are constant")
        self.written.add(target.name)

    def _invocation(self, node: ast.Call, kernel: Dispatcher) -> Value:
        function, arguments = self.call(node, kernel)
        if function.value is not None and not function.written:
            return Invocation(function.value, function, arguments)
        if (
            function.value is not None
            or len(function.results) != 1
            or not isinstance(function.results[0].type, ArrayType)
        ):
            raise self.source.refusal(
                node, f"the call of {function.name} is a statement: it writes, or has several results"
            )
        result = self.new_name(node, function.results[0].type)
        self.before.append(Invoke(function, arguments, (result,)))
        return result

    def new_name(self, node: ast.AST, kind: Type) -> Name:
        """Return a new variable for an intermediate array."""
        raise NotImplementedError

    def named_array(self, node: ast.AST, value: Elementwise) -> Name:
        """Return a new variable that has the elements of an array."""
        raise NotImplementedError


DTYPES: Final[dict[object, Kind]] = {np.int64: Kind.INT, np.uint64: Kind.UNSIGNED, np.bool_: Kind.BOOL}
NEW_ARRAYS: Final = (np.empty, np.zeros, np.empty_like, np.zeros_like)


def named(kind: Type) -> str:
    """Return how a message names a type."""
    return kind.value if isinstance(kind, Kind) else "array" if isinstance(kind, ArrayType) else kind.name
