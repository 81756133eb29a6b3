"""The typed tree as C99: every literal typed, operations in the order of the tree, memory on the stack."""

import re
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from rig.plc_export.printing import TreePrinter
from rig.plc_export.tree import (
    ArrayType,
    Assign,
    Convert,
    Declare,
    Element,
    Expression,
    Field,
    For,
    Function,
    If,
    Invocation,
    Invoke,
    Kind,
    Literal,
    Name,
    Operation,
    RecordType,
    Return,
    Select,
    Statement,
    Type,
    While,
)

KEYWORDS: Final = """
    auto break case char const continue default do double else enum extern float for goto if inline int long register
    restrict return short signed sizeof static struct switch typedef union unsigned void volatile while bool true false
    main y0 y1 j0 j1 gamma
"""
INFIX: Final = {"and": "&&", "or": "||"}


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
        if isinstance(kind, ArrayType):
            return f"{'const ' * constant}{self.scalars[kind.kind]} *{name}"
        return f"const {kind.name} *{name}"

    def structure(self, record: RecordType) -> str:
        """Return the declaration of a record's type."""
        fields = [f"{kind.name} {identifier(name)}" if isinstance(kind, RecordType)
                  else self.declaration(kind, identifier(name)) for name, kind in record.fields]  # fmt: skip
        body = "".join(f"    {each};\n" for each in fields)
        return f"typedef struct {{\n{body}}} {record.name};\n"

    # -- functions -----------------------------------------------------------------------------------------------------

    def signature(self, function: Function) -> str:
        """Return the head of a function."""
        parameters = [self.declaration(each.type, identifier(each.name), constant=each.name not in function.written)
                      for each in function.parameters]  # fmt: skip
        parameters += [f"{self.scalars[each.type.kind if isinstance(each.type, ArrayType) else each.type]} *{each.name}"
                       for each in function.results if not isinstance(each.type, RecordType)]  # fmt: skip
        value = self.scalars[function.value] if function.value else "void"
        listed = ",\n    ".join(parameters)
        return f"{value} {identifier(function.name)}(\n    {listed}\n)"

    def function(self, function: Function, storage: str = "") -> str:
        """Return a function."""
        self._results = function.results
        unused = [f"    (void){identifier(each.name)};" for each in function.parameters
                  if each.name not in function.used]  # fmt: skip
        lines = [*unused, *self._block(function.body, 1)]
        where = "/".join(function.source.split("/")[-3:])
        body = "".join(f"{line}\n" for line in lines)
        return f"/* {where} */\n{storage}{self.signature(function)} {{\n{body}}}\n"

    def _block(self, statements: Iterable[Statement], depth: int) -> Iterator[str]:
        for statement in statements:
            yield from self._statement(statement, depth)

    def _statement(self, statement: Statement, depth: int) -> Iterator[str]:
        pad = "    " * depth
        match statement:
            case Declare(variable, value):
                yield pad + self._declared(variable, value)
            case Assign(target, value):
                yield f"{pad}{self._target(target)} = {self.expression(value)};"
            case Invoke(function, arguments, results):
                yield f"{pad}{self._call(function, (*arguments, *results), len(arguments))};"
            case For():
                yield from self._for(statement, depth)
            case While(condition, body):
                yield f"{pad}while {self._condition(condition)} {{"
                yield from self._block(body, depth + 1)
                yield f"{pad}}}"
            case If(condition, body, other):
                yield f"{pad}if {self._condition(condition)} {{"
                yield from self._block(body, depth + 1)
                if other:
                    yield f"{pad}}} else {{"
                    yield from self._block(other, depth + 1)
                yield f"{pad}}}"
            case Return(value):
                yield f"{pad}return {self.expression(value)};" if value else f"{pad}return;"

    def _condition(self, condition: Expression) -> str:
        """Return a condition in one pair of parentheses: compilers warn of two around `==`."""
        text = self.expression(condition)
        return text if isinstance(condition, Operation) and text.startswith("(") else f"({text})"

    def _declared(self, variable: Name, value: Expression | None) -> str:
        name, kind = identifier(variable.name), variable.type
        if isinstance(kind, ArrayType):
            return f"{self.scalars[kind.kind]} {name}[{max(kind.size, 1)}] = {{0}};"
        initial = self.expression(value or Literal(kind, 0)) if isinstance(kind, Kind) else ""
        return f"{self.declaration(kind, name)} = {initial};"

    def _target(self, target: Name | Element) -> str:
        if isinstance(target, Name) and target in self._results:
            return f"*{target.name}"
        return self.expression(target)

    def _for(self, loop: For, depth: int) -> Iterator[str]:
        pad, name = "    " * depth, identifier(loop.variable.name)
        start, stop = self.expression(loop.start), self.expression(loop.stop)
        if not isinstance(loop.stop, Literal):
            self._loops += 1
            yield f"{pad}const int32_t stop_{self._loops} = {stop};"
            stop = f"stop_{self._loops}"
        sign, step = ("<", f"{name} += {loop.step}") if loop.step > 0 else (">", f"{name} -= {-loop.step}")
        yield f"{pad}for (int32_t {name} = {start}; {name} {sign} {stop}; {step}) {{"
        yield from self._block(loop.body, depth + 1)
        yield f"{pad}}}"

    # -- expressions ---------------------------------------------------------------------------------------------------

    def expression(self, expression: Expression) -> str:  # noqa: C901, PLR0911 one case a kind of expression
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
                return f"{self.expression(record)}{'->' if isinstance(record, Name) else '.'}{identifier(name)}"
            case Element():
                return f"{self.expression(expression.array)}[{self.place(expression)}]"
            case Operation():
                return self._operation(expression)
            case Select(_, condition, one, other):
                return f"({self.expression(condition)} ? {self.expression(one)} : {self.expression(other)})"
            case Convert(kind, operand):
                return f"(({self.scalars[kind]}){self.expression(operand)})"
            case Invocation(_, function, arguments):
                return self._call(function, arguments, len(arguments))

    def _operation(self, operation: Operation) -> str:  # noqa: PLR0911 one case an operator
        parts = [self.expression(each) for each in operation.operands]
        kind = "real" if operation.operands[0].type is Kind.REAL else "int"
        match operation.operator:
            case "sqrt" | "abs" | "power" as name:
                function = {"sqrt": "sqrt", "abs": "fabs", "power": "pow"}[name] + "f" * self.single
                return f"{function}({', '.join(parts)})"
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
            text = self.expression(argument)
            by_address = isinstance(argument, Field) and isinstance(argument.type, RecordType)
            scalar_result = place >= results_from and isinstance(argument.type, Kind)
            own = isinstance(argument, Name) and argument in self._results
            printed.append(f"&{text}" if by_address or (scalar_result and not own) else text)
        return f"{identifier(function.name)}({', '.join(printed)})"


def helpers(real: str, used_in: str) -> str:
    """Return min and max as the kernels have them, and division that rounds down; those that are used in a text."""
    texts = {
        "min_real": f"{real} min_real({real} one, {real} other) {{ return other < one ? other : one; }}",
        "max_real": f"{real} max_real({real} one, {real} other) {{ return other > one ? other : one; }}",
        "min_int": "int32_t min_int(int32_t one, int32_t other) { return other < one ? other : one; }",
        "max_int": "int32_t max_int(int32_t one, int32_t other) { return other > one ? other : one; }",
        "floor_mod": """int32_t floor_mod(int32_t one, int32_t other) {
    const int32_t rest = one % other;
    return rest < 0 ? rest + other : rest;
}""",
        "floor_div": "int32_t floor_div(int32_t one, int32_t other) { return (one - floor_mod(one, other)) / other; }",
    }
    used = [name for name in texts if f"{name}(" in used_in or (name == "floor_mod" and "floor_div(" in used_in)]
    return "".join(f"static inline {texts[name]}\n" for name in used)


def records_in(types: Iterable[Type]) -> list[RecordType]:
    """Return the types of records, once for each name, fields before what has them."""
    found: dict[str, RecordType] = {}

    def visit(kind: Type) -> None:
        if isinstance(kind, RecordType):
            for _, field in kind.fields:
                visit(field)
            found.setdefault(kind.name, kind)

    for kind in types:
        visit(kind)
    return list(found.values())
