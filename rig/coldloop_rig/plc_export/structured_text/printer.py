"""Blocks as IEC 61131-3 Structured Text (third edition): REAL and DINT, arrays of one dimension, literals typed."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from coldloop_rig.plc_export.structured_text.names import PREFIX, Names, identifier
from coldloop_rig.plc_export.tree.nodes import (
    ArrayType,
    Assign,
    Block,
    Call,
    Convert,
    Count,
    Element,
    Expression,
    If,
    Kind,
    Literal,
    Name,
    Operation,
    Path,
    PausingCall,
    Return,
    Statement,
    Switch,
    Type,
    View,
    While,
)
from coldloop_rig.plc_export.tree.printing import TreePrinter

SCALARS: Final = {Kind.REAL: "REAL", Kind.INT: "DINT", Kind.UNSIGNED: "DINT", Kind.BOOL: "BOOL"}
DOUBLE: Final = {**SCALARS, Kind.REAL: "LREAL"}
BYTES: Final = {"REAL": 4, "LREAL": 8, "DINT": 4, "BOOL": 1}
INFIX: Final = {"and": "AND", "or": "OR", "==": "=", "!=": "<>"}
FUNCTIONS: Final = {
    "sqrt": "SQRT",
    "abs": "ABS",
    "power": "EXPT",
    "log": "LN",
    "round": f"{PREFIX}round",
    "copysign": f"{PREFIX}copysign",
    "%": f"{PREFIX}floor_mod",
    "//": f"{PREFIX}floor_div",
}
NO_NOTES: Final[Mapping[str, str]] = {}
TABLE: Final = f"{PREFIX}literals"
LARGEST: Final = np.finfo(np.float32).max
"""In the place of what is infinite or no number, for which there is no literal."""


class StructuredTextPrinter(TreePrinter):
    """Prints blocks; keeps the types of arrays that they use.

    Args:
        variables: Types of the fields of records that are global: constants and state.
        real: Single or double precision.
    """

    table = TABLE

    def __init__(self, variables: Mapping[Path, Type], real: type[np.floating] = np.float32) -> None:
        super().__init__(real)
        self.scalars = SCALARS if self.single else DOUBLE
        self.globals = variables
        self.arrays: dict[str, str] = {}
        """Definition of each type of arrays, by its name."""
        self._names, self._notes, self._uses_literals = Names(), NO_NOTES, False

    # -- numbers and types ---------------------------------------------------------------------------------------------

    def number(self, value: float) -> str:
        """Return an initial value with digits enough for its bits; the largest one for what is not finite.

        A type is named where there is no sign, as not every tool takes one behind `REAL#`.
        """
        finite = value if np.isfinite(value) else LARGEST * (-1 if value < 0 else 1)
        text = f"{np.float32(finite):.9E}" if self.single else f"{float(finite):.16E}"
        return text if text.startswith("-") else f"{self.scalars[Kind.REAL]}#{text}"

    def literal(self, value: float) -> str:
        """Return the element of the table that has this value."""
        self._uses_literals = True
        return super().literal(value)

    def type(self, kind: Type) -> str:
        """Return the name of a type of numbers or of arrays."""
        if isinstance(kind, Kind):
            return self.scalars[kind]
        assert isinstance(kind, ArrayType)  # noqa: S101 blocks have no records
        return self.array_type(self.scalars[kind.kind], kind.size)

    def array_type(self, scalar: str, size: int) -> str:
        """Return the name of a type of arrays, which is then among those to be defined."""
        name = f"{PREFIX}{scalar.lower()}s_{max(size, 1)}"
        self.arrays[name] = f"ARRAY [0..{max(size, 1) - 1}] OF {scalar}"
        return name

    def types(self) -> str:
        """Return the definitions of the types of arrays so far, and of the table of literals."""
        self.arrays[f"{TABLE}_table"] = f"ARRAY [0..{len(self.literals) - 1}] OF {self.scalars[Kind.REAL]}"
        return "".join(f"TYPE\n    {name} : {definition};\nEND_TYPE\n"
                       for name, definition in sorted(self.arrays.items()))  # fmt: skip

    # -- blocks --------------------------------------------------------------------------------------------------------

    def block(self, block: Block, notes: Mapping[str, str] = NO_NOTES) -> str:
        """Return a function block; variables that have a note are outputs, too."""
        self._names, self._uses_literals = Names(), False
        self._notes = notes
        inputs, shared = self._declared(block.inputs), self._declared(block.shared)
        outputs = self._declared([*block.outputs, *(each for each in block.variables if each.name in notes)])
        outside = {global_name(path): self.type(self.globals[path]) for path in block.constants}
        variables = self._declared([each for each in block.variables if each.name not in notes])
        body = [*self._body(block.body, 1)]
        variables |= {self._instance(each): block_name(each) for each in block.called}
        if self._uses_literals:
            outside[TABLE] = f"{TABLE}_table"
        where = "/".join(block.source.split("/")[-3:])
        return "".join([
            comment(f"{where}: {block.summary}"), f"FUNCTION_BLOCK {block_name(block)}\n", section("VAR_INPUT", inputs),
            section("VAR_IN_OUT", shared), section("VAR_OUTPUT", outputs), section("VAR_EXTERNAL", outside),
            section("VAR", variables), *(f"{line}\n" for line in body), "END_FUNCTION_BLOCK\n",
        ])  # fmt: skip

    def _declared(self, names: Iterable[Name]) -> dict[str, str]:
        return {self._local(each): self.type(each.type) + self._noted(each) for each in names}

    def _noted(self, name: Name) -> str:
        note = self._notes.get(name.name)
        return f" (* {note} *)" if note else ""

    def _local(self, name: Name) -> str:
        """Return the name of a variable; those of one name and type are one variable."""
        return self._names((name.name, self.type(name.type)), name.name)

    def _instance(self, block: Block) -> str:
        return self._names(block, f"do_{block.name}")

    # -- statements ----------------------------------------------------------------------------------------------------

    def _body(self, statements: Iterable[Statement], depth: int) -> Iterator[str]:
        for statement in statements:
            yield from ("    " * depth + line for line in self._statement(statement))

    def _statement(self, statement: Statement) -> Iterator[str]:  # noqa: C901 one case a statement
        match statement:
            case Assign(target, value):
                yield f"{self.expression(target)} := {self.expression(value)};"
            case Call():
                yield from self._call(statement)
            case PausingCall(call, anew, busy, following):
                yield from self._call(replace(call, results=()))
                yield f"{self._local(anew)} := FALSE;"
                paused = interface_names(call.block, self.type)[busy]
                yield f"IF (NOT {self._instance(call.block)}.{paused}) THEN"
                yield from ("    " + line for line in self._taken(call))
                yield from self._body(following, 1)
                yield "END_IF;"
            case Switch(number, cases):
                yield f"CASE {self._local(number)} OF"
                for case, body in cases:
                    yield f"    {case}:"
                    yield from self._body(body, 2)
                yield "END_CASE;"
            case Count(variable, first, last, step, body):
                by = f" BY {step}" if step != 1 else ""
                bounds = f"{self.expression(first)} TO {self.expression(last)}{by}"
                yield f"FOR {self._local(variable)} := {bounds} DO"
                yield from self._body(body, 1)
                yield "END_FOR;"
            case While(condition, body):
                yield f"WHILE {self.expression(condition)} DO"
                yield from self._body(body, 1)
                yield "END_WHILE;"
            case If(condition, body, other):
                yield f"IF {self.expression(condition)} THEN"
                yield from self._body(body, 1)
                if other:
                    yield "ELSE"
                    yield from self._body(other, 1)
                yield "END_IF;"
            case Return():
                yield "RETURN;"

    def _call(self, call: Call) -> Iterator[str]:
        """Yield a call with its arguments by name, and the assignments of what it puts out."""
        instance, inside = self._instance(call.block), interface_names(call.block, self.type)
        passed = [f"{inside[each]} := {self.expression(value)}" for each, value in call.arguments]
        yield f"{instance}({'' if passed else ');'}"
        yield from (f"    {each}{',' if each is not passed[-1] else ');'}" for each in passed)
        yield from self._taken(call)

    def _taken(self, call: Call) -> Iterator[str]:
        """Yield the assignments of what a call puts out."""
        instance, inside = self._instance(call.block), interface_names(call.block, self.type)
        yield from (f"{self._local(variable)} := {instance}.{inside[output]};" for variable, output in call.results)

    # -- expressions ---------------------------------------------------------------------------------------------------

    def expression(self, expression: Expression) -> str:  # noqa: C901, PLR0911 one case a kind of expression
        """Return an expression, with parentheses around each operation."""
        match expression:
            case Literal(Kind.REAL, value):
                return self.literal(value)
            case Literal(Kind.BOOL, value):
                return "TRUE" if value else "FALSE"
            case Literal(_, value):
                return f"{value}" if value >= 0 else f"({value})"
            case Name(_, name):
                path = tuple(name.split("."))
                return global_name(path) if path in self.globals else self._local(expression)
            case Element(_, array, _):
                whole = array.array if isinstance(array, View) else array
                return f"{self.expression(whole)}[{self.place(expression)}]"
            case Operation():
                return self._operation(expression)
            case Convert(Kind.REAL, operand):
                return f"DINT_TO_{self.scalars[Kind.REAL]}({self.expression(operand)})"
            case Convert(Kind.BOOL, operand):
                return f"({self.expression(operand)} <> 0)"
            case Convert(_, operand) if operand.type is Kind.BOOL:
                return f"BOOL_TO_DINT({self.expression(operand)})"
            case Convert(_, operand):
                return self.expression(operand)
        raise AssertionError(expression)  # lowering leaves no other

    def _operation(self, operation: Operation) -> str:  # noqa: PLR0911 one case an operator
        parts = [self.expression(each) for each in operation.operands]
        match operation.operator:
            case "min" | "max" as name:
                return f"{PREFIX}{name}_{self.type(operation.type).lower()}({', '.join(parts)})"
            case "isfinite":
                return f"{PREFIX}is_finite{'' if self.single else '_lreal'}({parts[0]})"
            case "isinf" | "isnan":
                return f"(NOT {PREFIX}is_finite({parts[0]}))"
            case "single":
                return parts[0] if self.single else f"REAL_TO_LREAL(LREAL_TO_REAL({parts[0]}))"
            case name if name in FUNCTIONS:
                return f"{FUNCTIONS[name]}({', '.join(parts)})"
            case "negative":
                return f"(-{parts[0]})"
            case "not":
                return f"(NOT {parts[0]})"
            case sign:
                return f"({parts[0]} {INFIX.get(sign, sign)} {parts[1]})"


def interface_names(block: Block, type_of: Callable[[Type], str]) -> dict[Name, str]:
    """Return the names of a block's parameters, as it is printed: they are named first."""
    names = Names()
    return {each: names((each.name, type_of(each.type)), each.name)
            for each in (*block.inputs, *block.shared, *block.outputs)}  # fmt: skip


def passed_by_name(block: Block, parameters: Iterable[Name], type_of: Callable[[Type], str], indent: int) -> str:
    """Return arguments of a call, a line each: variables with the last parts of the parameters' names."""
    names = interface_names(block, type_of)
    return ",\n".join(f"{' ' * indent}{names[each]} := {each.name.rstrip('.').rpartition('.')[2]}"
                      for each in parameters)  # fmt: skip


def block_name(block: Block) -> str:
    """Return the name of the type of a block."""
    return identifier(f"{PREFIX}{block.name}")


def global_name(path: Path) -> str:
    """Return the name of a constant or of the state: the fields that lead to it."""
    return identifier(PREFIX + "_".join(each for each in path[1:] if each != "numbers").lower())


def section(head: str, declared: Mapping[str, str]) -> str:
    """Return declarations under their keyword; nothing where there are none."""
    body = "".join(f"    {name} : {kind};\n" for name, kind in declared.items())
    return f"{head}\n{body}END_VAR\n" if body else ""


def comment(text: str) -> str:
    """Return a comment of one line."""
    return f"(* {text.replace('*)', '* )')} *)\n"


def memory(block: Block, scalars: Mapping[Kind, str] = SCALARS) -> int:
    """Return the bytes of an instance: numbers, arrays and the instances within; without references to arrays."""
    own = sum(size_of(each.type, scalars) for each in (*block.inputs, *block.outputs, *block.variables))
    return own + sum(memory(each, scalars) for each in block.called)


def size_of(kind: Type, scalars: Mapping[Kind, str] = SCALARS) -> int:
    """Return the bytes of a number or of an array."""
    if isinstance(kind, ArrayType):
        return max(kind.size, 1) * BYTES[scalars[kind.kind]]
    assert isinstance(kind, Kind)  # noqa: S101 blocks have no records
    return BYTES[scalars[kind]]
