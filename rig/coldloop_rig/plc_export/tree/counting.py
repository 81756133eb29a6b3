"""Counts the operations of the typed tree by executing it: as Python that adds them up.

Additions, subtractions, multiplications, divisions, roots, powers and logarithms of numbers with a point count one
each; comparisons, minima, maxima, signs, conversions and what is done with integers count nothing.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coldloop_rig.plc_export.tree.nodes import (
    ArrayType,
    Assign,
    Convert,
    Copy,
    Declare,
    Element,
    Expression,
    Field,
    For,
    Function,
    If,
    Invocation,
    Invoke,
    Item,
    Kind,
    Literal,
    Make,
    Member,
    Name,
    Operation,
    Point,
    Return,
    Select,
    Statement,
    View,
    While,
)

COUNTED: Final = {"+", "-", "*", "/", "sqrt", "power", "log"}
INTEGERS: Final = {Kind.INT: np.int64, Kind.UNSIGNED: np.int64, Kind.BOOL: np.bool_}
KINDS: Final = [Kind.REAL, *INTEGERS]
CALLED: Final = {
    "sqrt": "np.sqrt", "abs": "abs", "log": "_log", "copysign": "np.copysign", "round": "np.rint", "not": "not ",
    "negative": "-", "single": "_single", "isfinite": "np.isfinite", "isinf": "np.isinf", "isnan": "np.isnan",
}  # fmt: skip


class CountedProgram:
    """Functions that can be called, and what their calls have taken so far.

    Args:
        functions: Callees before their callers.
        real: Single or double precision.
    """

    def __init__(self, functions: Iterable[Function], real: type[np.floating] = np.float32) -> None:
        self._count = [0]
        self._known: dict[str, Any] = {
            "np": np, "SimpleNamespace": SimpleNamespace, "_n": self._count, "_log": _log, "_copy": _copied,
            "_part": _part, "_of": self._of, "_r": real, "_t": [real, *INTEGERS.values()],
            "_single": lambda value: real(np.float32(value)),
        }  # fmt: skip
        for function in functions:
            exec("\n".join(_Printer(function).lines()), self._known)  # noqa: S102 text of this file

    def _of(self, count: int, value: object) -> object:
        self._count[0] += count
        return value

    def __getitem__(self, name: str) -> Callable[..., Any]:
        """Return a function: its arguments, arrays for results, and it returns those that are numbers."""
        called: Callable[..., Any] = self._known[name]
        return called

    def operations(self) -> int:
        """Return the operations since this was asked for."""
        count, self._count[0] = self._count[0], 0
        return count

    def noting(self, name: str) -> list[int]:
        """Return a list that gets the operations of each further call of a function."""
        called, found = self[name], list[int]()

        def noted(*arguments: Any) -> Any:  # noqa: ANN401 of any function
            before = self._count[0]
            result = called(*arguments)
            found.append(self._count[0] - before)
            return result

        self._known[name] = noted
        return found


def _log(value: np.float32) -> np.float32:
    return np.float32(math.log(value)) if value > 0 else np.float32(math.nan if value < 0 else -math.inf)


def _copied(target: Any, source: Any) -> None:  # noqa: ANN401 records
    for name in target.dtype.names:
        target[name] = source[name]


def _part(array: NDArray[Any], offset: int, shape: tuple[int, ...]) -> NDArray[Any]:
    return array.reshape(-1)[offset : offset + math.prod(shape)].reshape(shape)


class _Printer:
    """Prints one function as Python."""

    def __init__(self, function: Function) -> None:
        self.function = function
        self._numbers = [each.name for each in function.results if isinstance(each.type, Kind)]

    def lines(self) -> Iterator[str]:
        names = [each.name for each in self.function.parameters]
        names += [each.name for each in self.function.results if isinstance(each.type, ArrayType)]
        yield f"def {self.function.name}({', '.join(names)}):"
        yield from self._body(self.function.body)
        if not self.function.value:
            yield f" return ({''.join(f'{each}, ' for each in self._numbers)})"

    def _body(self, statements: Sequence[Statement]) -> list[str]:
        return [f" {line}" for each in statements for line in self._statement(each)] or [" pass"]

    def _statement(self, statement: Statement) -> Iterator[str]:  # noqa: C901, PLR0912 one case a statement
        if not isinstance(statement, While) and (count := sum(map(operations_in, expressions_of(statement)))):
            yield f"_n[0] += {count}"
        match statement:
            case Declare(Name(ArrayType(kind, shape), name), _):
                yield f"{name} = np.zeros({shape}, _t[{KINDS.index(kind)}])"
            case Declare(variable, value):
                yield f"{variable.name} = {self._of(value or Literal(variable.type, 0))}"  # type: ignore[arg-type]
            case Assign(target, value):
                yield f"{self._target(target)} = {self._of(value)}"
            case Point(variable, part):
                yield f"{variable.name} = {self._of(part)}"
            case Make(variable, parts):
                yield f"{variable.name} = SimpleNamespace({', '.join(f'{n}={self._of(part)}' for n, part in parts)})"
            case Copy(target, source):
                yield f"_copy({self._of(target)}, {self._of(source)})"
            case Invoke(function, arguments, results):
                passed = (*arguments, *(each for each in results if isinstance(each.type, ArrayType)))
                numbers = [each.name for each in results if isinstance(each.type, Kind)]
                to = f"{', '.join(numbers)}, = " if numbers else ""
                yield to + self._call(function, passed)
            case For(variable, start, stop, step, body):
                yield f"for {variable.name} in range({self._of(start)}, {self._of(stop)}, {step}):"
                yield from self._body(body)
            case While(condition, body):
                yield "while True:"
                yield f" _n[0] += {operations_in(condition)}"
                yield f" if not {self._of(condition)}: break"
                yield from self._body(body)
            case If(condition, body, other):
                yield f"if {self._of(condition)}:"
                yield from self._body(body)
                yield "else:"
                yield from self._body(other)
            case Return(None):
                yield f"return ({''.join(f'{each}, ' for each in self._numbers)})"
            case Return(value) if value:
                yield f"return {self._of(value)}"

    def _target(self, target: Expression) -> str:
        text = self._of(target)
        return text.removeprefix("int(").removesuffix(")") if text.startswith("int(") else text

    def _call(self, function: Function, arguments: Iterable[Expression]) -> str:
        return f"{function.name}({', '.join(map(self._of, arguments))})"

    def _of(self, expression: Expression) -> str:  # noqa: C901, PLR0911 one case a kind of expression
        match expression:
            case Literal(Kind.REAL, value):
                return f"_r({'np.' if not math.isfinite(value) else ''}{float(value)!r})"
            case Literal(_, value):
                return repr(value)
            case Name(_, name):
                return name
            case Field(_, record, name):
                return f"{self._of(record)}.{name}"
            case View(ArrayType(_, shape), array, offset):
                return f"_part({self._of(array)}, {self._of(offset)}, {shape})"
            case Item(_, rows, index):
                return f"{self._of(rows)}[{self._of(index)}]"
            case Member(kind, struct, name):
                return integer(kind, f"{self._of(struct)}[{name!r}]")
            case Element(kind, array, indices):
                return integer(kind, f"{self._of(array)}[{', '.join(map(self._of, indices))}]")
            case Operation():
                return self._operation(expression)
            case Select(_, condition, one, other):
                return f"({self._conditional(one)} if {self._of(condition)} else {self._conditional(other)})"
            case Convert(kind, operand):
                return f"{'_r' if kind is Kind.REAL else 'int'}({self._of(operand)})"
            case Invocation(_, function, arguments):
                return self._call(function, arguments)

    def _operation(self, operation: Operation) -> str:
        parts = [self._of(each) for each in operation.operands]
        match operation.operator:
            case "min" | "max" as name:
                return f"{name}({', '.join(parts)})"  # of two that are equal the first one, as in the kernels
            case "and" | "or" as name:
                return f"({parts[0]} {name} {self._conditional(operation.operands[1])})"
            case name if name in CALLED:
                return f"({CALLED[name]}({', '.join(parts)}))"
            case sign:
                return f"({parts[0]} {'**' if sign == 'power' else sign} {parts[1]})"

    def _conditional(self, expression: Expression) -> str:
        """Return an expression that counts its operations where it is computed."""
        count = operations_in(expression)
        return f"_of({count}, {self._of(expression)})" if count else self._of(expression)


def integer(kind: Kind, text: str) -> str:
    """Return an element; those that are integers as Python's."""
    return f"int({text})" if kind in {Kind.INT, Kind.UNSIGNED} else text


def expressions_of(statement: Statement) -> Iterator[Expression]:
    """Yield the expressions that a statement computes once."""
    match statement:
        case Declare(_, value) | Return(value):
            yield from [value] if value else []
        case Assign(target, value):
            yield from (target, value)
        case Point(_, part):
            yield part
        case Make(_, parts):
            yield from (part for _, part in parts)
        case Invoke(_, arguments, _):
            yield from arguments
        case For(_, start, stop):
            yield from (start, stop)
        case If(condition):
            yield condition


def operations_in(expression: Expression) -> int:
    """Return the operations of an expression, without those that it may not come to."""
    match expression:
        case Select(_, condition, _, _):
            return operations_in(condition)
        case Operation(_, "and" | "or", (one, _)):
            return operations_in(one)
        case Operation(Kind.REAL, operator, operands):
            return (operator in COUNTED) + sum(map(operations_in, operands))
        case Operation(_, _, operands) | Invocation(_, _, operands):
            return sum(map(operations_in, operands))
        case Convert(_, operand):
            return operations_in(operand)
    return 0
