"""The typed tree as C99: every literal typed, operations in the order of the tree, memory on the stack."""

import re
from collections.abc import Iterable, Iterator
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
    RecordType,
    Return,
    RowsType,
    Select,
    Statement,
    StructType,
    Target,
    Type,
    View,
    While,
    walk,
)
from coldloop_rig.plc_export.tree.printing import TreePrinter

Array = NDArray[Any]

KEYWORDS: Final = """
    auto break case char const continue default do double else enum extern float for goto if inline int long register
    restrict return short signed sizeof static struct switch typedef union unsigned void volatile while bool true false
    main y0 y1 j0 j1 gamma
"""
INFIX: Final = {"and": "&&", "or": "||"}
OF_MATH: Final = {"sqrt": "sqrt", "abs": "fabs", "power": "pow", "log": "log", "copysign": "copysign", "round": "rint"}
"""Functions of <math.h>; rint rounds a half to the even number, as Python does."""


def identifier(name: str) -> str:
    """Return a name that C and its library leave free."""
    return f"{name}_" if re.search(rf"\b{name}\b", KEYWORDS) else name


class Printer(TreePrinter):
    """Prints for one floating-point type."""

    table = "literals"

    def __init__(self, real: type[np.floating]) -> None:
        super().__init__(real)
        self.scalars = {Kind.REAL: "float" if self.single else "double", Kind.INT: "int32_t",
                        Kind.UNSIGNED: "int32_t", Kind.BOOL: "bool"}  # fmt: skip
        self._loops = 0
        self._results: tuple[Name, ...] = ()
        self._made: set[Name] = set()
        self._constant: set[str] = set()

    # -- numbers -------------------------------------------------------------------------------------------------------

    def number(self, value: float) -> str:
        """Return a number with a point such that it is read back with the same bits; what is not finite as a macro."""
        if np.isinf(value):
            return "-INFINITY" if value < 0 else "INFINITY"
        if np.isnan(value):
            return "NAN"
        return f"{np.float32(value):.9e}f" if self.single else f"{value:.17e}"

    # -- types ---------------------------------------------------------------------------------------------------------

    def declaration(self, kind: Type, name: str, *, constant: bool = True) -> str:
        """Return the declaration of a parameter or of a field."""
        if isinstance(kind, Kind):
            return f"{self.scalars[kind]} {name}"
        return f"{'const ' * constant}{self._element(kind)} *{name}"

    def _element(self, kind: Type) -> str:
        """Return the type of what a pointer to it points to."""
        if isinstance(kind, Kind):
            return self.scalars[kind]
        if isinstance(kind, ArrayType):
            return self.scalars[kind.kind]
        return kind.struct.name if isinstance(kind, RowsType) else kind.name

    def structure(self, record: RecordType | StructType) -> str:
        """Return the declaration of a record's type; the arrays of a state are in it."""
        state = isinstance(record, RecordType) and record.state
        body = "".join(f"    {self._field(identifier(name), kind, state=state)};\n" for name, kind in record.fields)
        return f"typedef struct {{\n{body}}} {record.name};\n"

    def _field(self, name: str, kind: Type, *, state: bool) -> str:
        if isinstance(kind, RecordType):
            return f"{kind.name} {name}"
        if state and isinstance(kind, ArrayType | RowsType):
            length = kind.length if isinstance(kind, RowsType) else max(kind.size, 1)
            return f"{self._element(kind)} {name}[{length}]"
        return self.declaration(kind, name)

    def made_in(self, function: Function) -> Iterator[Type]:
        """Yield the types of records that a function makes."""
        yield from (node.variable.type for node in walk(function.body) if isinstance(node, Make))

    # -- constant arrays -----------------------------------------------------------------------------------------------

    def scalar(self, values: Array) -> str:
        """Return the type of an array's elements."""
        return self.scalars[Kind.REAL] if values.dtype.kind == "f" else "int32_t"

    def array(self, name: str, values: Array, storage: str = "static ") -> str:
        """Return the definition of a constant array; one without elements has a zero."""
        listed = values.ravel() if values.size else np.zeros(1, values.dtype)
        rows = "".join(f"    {row},\n" for row in self._rows(listed, 6))
        return f"{storage}const {self.scalar(values)} {name}[{listed.size}] = {{\n{rows}}};\n"

    def tabulated(self, name: str, values: Array) -> str:
        """Return the definition of a constant array, of numbers or of rows; its name has the lengths."""
        lines = (f"{{{', '.join(self._rows(row, 6))}}}" for row in values) if values.ndim > 1 else self._rows(values, 6)
        rows = "".join(f"    {line},\n" for line in lines)
        return f"const {self.scalar(values)} {name} = {{\n{rows}}};\n"

    def _rows(self, values: Array, width: int) -> Iterator[str]:
        printed = [self.number(each) if values.dtype.kind == "f" else str(int(each)) for each in values]
        yield from (", ".join(printed[place : place + width]) for place in range(0, len(printed), width))

    # -- functions -----------------------------------------------------------------------------------------------------

    def signature(self, function: Function) -> str:
        """Return the head of a function."""
        parameters = [self.declaration(each.type, identifier(each.name), constant=each.name not in function.written)
                      for each in function.parameters]  # fmt: skip
        parameters += [f"{self.scalars[each.type.kind if isinstance(each.type, ArrayType) else each.type]} *{each.name}"
                       for each in function.results if isinstance(each.type, ArrayType | Kind)]  # fmt: skip
        value = self.scalars[function.value] if function.value else "void"
        listed = ",\n    ".join(parameters)
        return f"{value} {identifier(function.name)}(\n    {listed}\n)"

    def function(self, function: Function, storage: str = "") -> str:
        """Return a function."""
        self._results, self._made = function.results, set()
        self._constant = {each.name for each in function.parameters if each.name not in function.written}
        unused = [f"    (void){identifier(each.name)};" for each in function.parameters
                  if each.name not in function.used]  # fmt: skip
        lines = [*unused, *self._block(function.body, 1)]
        where = "/".join(function.source.split("/")[-3:])
        body = "".join(f"{line}\n" for line in lines)
        return f"/* {where} */\n{storage}{self.signature(function)} {{\n{body}}}\n"

    def _block(self, statements: Iterable[Statement], depth: int) -> Iterator[str]:
        for statement in statements:
            yield from self._statement(statement, depth)

    def _statement(self, statement: Statement, depth: int) -> Iterator[str]:  # noqa: C901 one case a statement
        pad = "    " * depth
        match statement:
            case Declare(variable, value):
                yield pad + self._declared(variable, value)
            case Assign(target, value):
                yield f"{pad}{self._target(target)} = {self._bare(value)};"
            case Point():
                yield pad + self._pointed(statement)
            case Make(variable, parts):
                self._made.add(variable)
                listed = ", ".join(f".{identifier(name)} = {self._argument(part)}" for name, part in parts)
                yield f"{pad}const {self._element(variable.type)} {identifier(variable.name)} = {{{listed}}};"
            case Copy(target, source):
                yield f"{pad}*{self._argument(target)} = *{self._argument(source)};"
            case Invoke(function, arguments, results):
                yield f"{pad}{self._call(function, (*arguments, *results), len(arguments))};"
            case For():
                yield from self._for(statement, depth)
            case While(condition, body):
                yield f"{pad}while ({self._bare(condition)}) {{"
                yield from self._block(body, depth + 1)
                yield f"{pad}}}"
            case If():
                yield from self._if(statement, depth)
            case Return(value):
                yield f"{pad}return {self._bare(value)};" if value else f"{pad}return;"

    def _if(self, statement: If, depth: int) -> Iterator[str]:
        pad, head = "    " * depth, "if"
        other: tuple[Statement, ...] = (statement,)
        while len(other) == 1 and isinstance(other[0], If):
            yield f"{pad}{head} ({self._bare(other[0].condition)}) {{"
            yield from self._block(other[0].body, depth + 1)
            head, other = "} else if", other[0].other
        if other:
            yield f"{pad}}} else {{"
            yield from self._block(other, depth + 1)
        yield f"{pad}}}"

    def _declared(self, variable: Name, value: Expression | None) -> str:
        name, kind = identifier(variable.name), variable.type
        if isinstance(kind, ArrayType):
            return f"{self.scalars[kind.kind]} {name}[{max(kind.size, 1)}] = {{0}};"
        initial = self._bare(value or Literal(kind, 0)) if isinstance(kind, Kind) else ""
        return f"{self.declaration(kind, name)} = {initial};"

    def _pointed(self, point: Point) -> str:
        root: Expression = point.part.array if isinstance(point.part, View) else point.part.rows
        while isinstance(root, Field):
            root = root.record
        name = point.variable.name
        constant = point.constant or (isinstance(root, Name) and root.name in self._constant)
        if constant:
            self._constant.add(name)
        declared = self.declaration(point.variable.type, identifier(name), constant=constant)
        return f"{declared} = {self._argument(point.part)};"

    def _target(self, target: Target) -> str:
        if isinstance(target, Name) and target in self._results:
            return f"*{target.name}"
        return self.expression(target)

    def _for(self, loop: For, depth: int) -> Iterator[str]:
        pad, name = "    " * depth, identifier(loop.variable.name)
        start, stop = self._bare(loop.start), self._bare(loop.stop)
        if not isinstance(loop.stop, Literal):
            self._loops += 1
            yield f"{pad}const int32_t stop_{self._loops} = {stop};"
            stop = f"stop_{self._loops}"
        sign, step = ("<", f"{name} += {loop.step}") if loop.step > 0 else (">", f"{name} -= {-loop.step}")
        yield f"{pad}for (int32_t {name} = {start}; {name} {sign} {stop}; {step}) {{"
        yield from self._block(loop.body, depth + 1)
        yield f"{pad}}}"

    # -- expressions ---------------------------------------------------------------------------------------------------

    def expression(self, expression: Expression) -> str:  # noqa: C901, PLR0911, PLR0912 one case a kind
        """Return an expression, with parentheses around each operation."""
        match expression:
            case Literal(Kind.REAL, value):
                return self.literal(value)
            case Literal(Kind.BOOL, value):
                return "true" if value else "false"
            case Literal(_, value):
                return f"{value}" if value >= 0 else f"({value})"
            case Name(_, name):
                return identifier(name)
            case Field(_, record, name):
                pointed = isinstance(record, Name) and record not in self._made
                return f"{self.expression(record)}{'->' if pointed else '.'}{identifier(name)}"
            case Member(_, record, name):
                return f"{self.expression(record)}{'->' if isinstance(record, Name) else '.'}{identifier(name)}"
            case Item(_, rows, index):
                return f"{self.expression(rows)}[{self.expression(index)}]"
            case Element(_, View(_, array), _):
                return f"{self.expression(array)}[{bare(self.place(expression))}]"
            case Element():
                return f"{self.expression(expression.array)}[{bare(self.place(expression))}]"
            case View():
                return self._argument(expression)
            case Operation():
                return self._operation(expression)
            case Select(_, condition, one, other):
                return f"({self.expression(condition)} ? {self.expression(one)} : {self.expression(other)})"
            case Convert(kind, operand):
                return f"(({self.scalars[kind]}){self.expression(operand)})"
            case Invocation(_, function, arguments):
                return self._call(function, arguments, len(arguments))

    def _bare(self, expression: Expression) -> str:
        """Return an expression that stands alone."""
        return bare(self.expression(expression))

    def _operation(self, operation: Operation) -> str:  # noqa: PLR0911 one case an operator
        parts = [self.expression(each) for each in operation.operands]
        kind = "real" if operation.operands[0].type is Kind.REAL else "int"
        match operation.operator:
            case name if name in OF_MATH:
                return f"{OF_MATH[name]}{'f' * self.single}({', '.join(parts)})"
            case "single":
                return f"(({self.scalars[Kind.REAL]})(float){parts[0]})"
            case "isfinite" | "isinf" | "isnan" as name:
                return f"({name}({parts[0]}) != 0)"
            case "min" | "max" as name:
                return f"{name}_{kind}({', '.join(parts)})"
            case "%":
                return f"floor_mod({', '.join(parts)})"
            case "//":
                return f"floor_div({', '.join(parts)})"
            case "negative":
                return f"(-{parts[0]})"
            case "not":
                return f"(!{parts[0]})"
            case sign:
                return f"({parts[0]} {INFIX.get(sign, sign)} {parts[1]})"

    def _call(self, function: Function, arguments: tuple[Expression, ...], results_from: int) -> str:
        printed = []
        for place, argument in enumerate(arguments):
            scalar_result = place >= results_from and isinstance(argument.type, Kind)
            own = isinstance(argument, Name) and argument in self._results
            printed.append(f"&{self.expression(argument)}" if scalar_result and not own else self._argument(argument))
        return f"{identifier(function.name)}({', '.join(printed)})"

    def _argument(self, argument: Expression) -> str:
        """Return a number; of anything else where it is."""
        if isinstance(argument, View):
            text, offset = self.expression(argument.array), self.expression(argument.offset)
            return text if offset == "0" else f"&{text}[{bare(offset)}]"
        by_address = isinstance(argument, Item) or (isinstance(argument, Name) and argument in self._made)
        by_address = by_address or (isinstance(argument, Field) and isinstance(argument.type, RecordType))
        return f"{'&' * by_address}{self.expression(argument)}"


def bare(text: str) -> str:
    """Return an operation without the parentheses around it."""
    depth = 0
    for place, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if not depth:
            return text[1:-1] if place == len(text) - 1 and text[0] == "(" else text
    return text
