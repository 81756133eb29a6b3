"""Functions of the typed tree as blocks: no records, no choices within an expression, each call a statement.

A record is where its fields are: those that never change are global constants, the others are parameters of every
block that needs them. Both operands of a logical operator may be computed, as in Structured Text; where the second one
must not be, there is a decision instead.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, cast

from rig.plc_export.tree.nodes import (
    BEYOND_BLOCKS,
    ArrayType,
    Assign,
    Block,
    Call,
    Convert,
    Count,
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
    Path,
    RecordType,
    Return,
    Select,
    Statement,
    Type,
    While,
    walk,
)
from rig.plc_export.tree.subset import UnfitKernelError

Bindings = Mapping[str, Path]
VALUE: Final = "result"
"""The output that is a function's value."""


class Lowering:
    """Blocks of functions and of all that they call, callees first.

    Args:
        constants: Fields of records that never change.
    """

    def __init__(self, constants: Mapping[Path, object]) -> None:
        self.constants = constants
        self.blocks: list[Block] = []
        self._known: dict[tuple[str, tuple[tuple[str, Path], ...]], Block] = {}

    def block(self, function: Function, bindings: Bindings) -> Block:
        """Return the block of a function whose records are certain ones."""
        if any(isinstance(node, BEYOND_BLOCKS) for node in walk(function.body)):
            raise UnfitKernelError(f"{function.source}: records of numbers and parts of arrays are for C99 alone")
        key = (function.name, tuple(sorted(bindings.items())))
        if key not in self._known:
            made = FunctionLowering(self, function, bindings).block()
            name = function.name.replace("__", "_")
            taken = {each.name for each in self.blocks}
            names = (f"{name}_{number}" if number else name for number in range(len(taken) + 1))
            made.name = next(each for each in names if each not in taken)
            self._known[key] = made
            self.blocks.append(made)
        return self._known[key]


class FunctionLowering:
    """Lowers one function."""

    def __init__(self, lowering: Lowering, function: Function, bindings: Bindings) -> None:
        self.lowering, self.function, self.bindings = lowering, function, bindings
        self.constants: dict[Path, None] = {}
        self.fields: dict[Path, Name] = {}
        self.before: list[Statement] = []
        self._ranges: dict[str, range] = {}
        self._made = 0

    def block(self) -> Block:
        """Return the block."""
        function = self.function
        numbers = [each for each in function.parameters if isinstance(each.type, Kind)]
        arrays = [each for each in function.parameters
                  if isinstance(each.type, ArrayType) and each.name not in self.bindings]  # fmt: skip
        changed = [each for each in numbers if each in assigned(function.body)]
        body = (*(Assign(each, given(each)) for each in changed), *self._body(function.body))
        body = body[:-1] if body and body[-1] == Return() else body
        results = [*function.results, *([Name(function.value, VALUE)] if function.value else [])]
        arrays += [each for each in [*results, *self.fields.values()] if isinstance(each.type, ArrayType)]
        inputs = [given(each) if each in changed else each for each in numbers]
        inputs += [each for each in self.fields.values() if isinstance(each.type, Kind)]
        outputs = [each for each in results if isinstance(each.type, Kind)]
        known = {*inputs, *arrays, *outputs}
        variables = dict.fromkeys(each for each in assigned(body) if each not in known)
        return Block(function.name, function.source, function.summary, tuple(inputs), tuple(arrays), tuple(outputs),
                     tuple(variables), tuple(self.constants), body)  # fmt: skip

    # -- statements ----------------------------------------------------------------------------------------------------

    def _body(self, statements: Sequence[Statement]) -> tuple[Statement, ...]:
        result: list[Statement] = []
        for place, statement in enumerate(statements):
            if isinstance(statement, Declare) and is_filled(statement.variable, statements[place + 1 :]):
                continue
            outer, self.before = self.before, []
            read = list(self._statement(statement))
            result += [*self.before, *read]
            self.before = outer
        return tuple(result)

    def _statement(self, statement: Statement) -> Iterator[Statement]:
        match statement:
            case Declare(variable, value):
                yield from self._declared(variable, value)
            case Assign(target, value):
                yield from self._assigned(cast("Name | Element", self._expression(target)), value)
            case Invoke(function, arguments, results):
                yield self._call(function, arguments, results)
            case For():
                yield self._counted(statement)
            case While(condition, body):
                tested = self._expression(condition)
                yield While(tested, (*self._body(body), *self.before))
            case If(condition, body, other):
                yield If(self._expression(condition), self._body(body), self._body(other))
            case Return(None):
                yield statement
            case Return(value) if value:
                yield from self._assigned(Name(cast("Kind", value.type), VALUE), value)
                yield Return()

    def _declared(self, variable: Name, value: Expression | None) -> Iterator[Statement]:
        if isinstance(variable.type, ArrayType):
            kind, size = variable.type.kind, variable.type.size
            at = Name(Kind.INT, "at.0")
            row = Name(ArrayType(kind, (size,)), variable.name)
            zero = Assign(Element(kind, row, (at,)), Literal(kind, 0))
            yield Count(at, Literal(Kind.INT, 0), Literal(Kind.INT, size - 1), 1, (zero,))
        else:
            yield from self._assigned(variable, value or Literal(cast("Kind", variable.type), 0))

    def _assigned(self, target: Name | Element, value: Expression) -> Iterator[Statement]:
        """Yield an assignment; of a choice, a decision between two."""
        if not isinstance(value, Select):
            yield Assign(target, self._expression(value))
            return
        condition = self._expression(value.condition)
        yield If(condition, self._body((Assign(target, value.one),)), self._body((Assign(target, value.other),)))

    def _counted(self, loop: For) -> Count:
        first, stop = self._expression(loop.start), self._expression(loop.stop)
        last: Expression
        if isinstance(stop, Literal):
            last = Literal(Kind.INT, stop.value - (1 if loop.step > 0 else -1))
        else:
            last = self._temporary(Kind.INT, "last")
            sign = "-" if loop.step > 0 else "+"
            self.before.append(Assign(last, Operation(Kind.INT, sign, (stop, Literal(Kind.INT, 1)))))
        if isinstance(first, Literal) and isinstance(last, Literal):
            ends = int(min(first.value, last.value)), int(max(first.value, last.value)) + 1
            self._ranges[loop.variable.name] = range(*ends)
        body = self._body(loop.body)
        self._ranges.pop(loop.variable.name, None)
        return Count(loop.variable, first, last, loop.step, body)

    def _call(self, function: Function, arguments: Sequence[Expression], results: Sequence[Name]) -> Call:
        """Return the call of a function's block: results are arrays that it writes to, or numbers it puts out."""
        given_fields = {parameter.name: path for parameter, argument in zip(function.parameters, arguments, strict=True)
                        if not isinstance(parameter.type, Kind) and (path := self._path(argument))}  # fmt: skip
        block = self.lowering.block(function, given_fields)
        named: dict[str, Expression] = {
            parameter.name: self._expression(argument)
            for parameter, argument in zip(function.parameters, arguments, strict=True)
            if parameter.name not in given_fields
        }
        taken = [*function.results, *([Name(function.value, VALUE)] if function.value else [])]
        kept: list[tuple[Name, Name]] = []
        for output, variable in zip(taken, results, strict=True):
            if isinstance(output.type, Kind):
                kept.append((variable, output))
            else:
                named[output.name] = variable
        passed = tuple((each, self._passed(each, named)) for each in (*block.inputs, *block.shared))
        return Call(block, passed, tuple(kept))

    def _passed(self, parameter: Name, named: Mapping[str, Expression]) -> Expression:
        name = parameter.name.removesuffix(GIVEN)
        return named[name] if name in named else self._field(tuple(name.split(".")), parameter.type)

    # -- expressions ---------------------------------------------------------------------------------------------------

    def _expression(self, expression: Expression) -> Expression:  # noqa: PLR0911 one case a kind of expression
        match expression:
            case Name(kind) | Field(kind):
                path = self._path(expression)
                return self._field(path, kind) if path else expression
            case Element(kind, array, indices):
                return Element(kind, cast("Name", self._expression(array)), tuple(map(self._expression, indices)))
            case Operation(_, "and" | "or"):
                return self._logical(expression)
            case Operation(kind, operator, operands):
                return Operation(kind, operator, tuple(map(self._expression, operands)))
            case Select(kind):
                chosen = self._temporary(kind, "chosen")
                self.before += self._assigned(chosen, expression)
                return chosen
            case Convert(kind, operand):
                return Convert(kind, self._expression(operand))
            case Invocation(kind, function, arguments):
                value = self._temporary(kind, "value")
                self.before.append(self._call(function, arguments, (value,)))
                return value
        return expression

    def _logical(self, operation: Operation) -> Expression:
        one = self._expression(operation.operands[0])
        outer, self.before = self.before, []
        other = self._expression(operation.operands[1])
        own, self.before = self.before, outer
        if not own and self._may_be_computed(other):
            return Operation(Kind.BOOL, operation.operator, (one, other))
        part = self._temporary(Kind.BOOL, "part")
        undecided: Expression = part if operation.operator == "and" else Operation(Kind.BOOL, "not", (part,))
        self.before += [Assign(part, one), If(undecided, (*own, Assign(part, other)), ())]
        return part

    def _may_be_computed(self, expression: Expression) -> bool:
        """Return whether the indices of an expression are within their arrays whatever has been decided before."""
        return all(
            self._is_within(index, length)
            for node in walk(expression) if isinstance(node, Element) and isinstance(node.array.type, ArrayType)
            for index, length in zip(node.indices, node.array.type.shape, strict=True)
        )  # fmt: skip

    def _is_within(self, index: Expression, length: int) -> bool:
        if isinstance(index, Literal):
            return True
        reached = self._ranges.get(index.name) if isinstance(index, Name) else None
        return reached is not None and reached.start >= 0 and reached.stop <= length

    def _path(self, storage: Expression) -> Path | None:
        match storage:
            case Name(_, name):
                return self.bindings.get(name)
            case Field(_, record, name):
                path = self._path(record)
                return (*path, name) if path else None
        return None

    def _field(self, path: Path, kind: Type) -> Name:
        """Return a field of a record: a constant, or else a parameter."""
        name = Name(kind, ".".join(path))
        if isinstance(kind, RecordType):
            return name
        if path in self.lowering.constants:
            self.constants[path] = None
        else:
            self.fields[path] = name
        return name

    def _temporary(self, kind: Kind, what: str) -> Name:
        self._made += 1
        return Name(kind, f"{what}.{self._made}")


GIVEN: Final = ".given"


def given(parameter: Name) -> Name:
    """Return the input whose value a parameter begins with that is written to: inputs are not."""
    return replace(parameter, name=f"{parameter.name}{GIVEN}")


def assigned(body: object) -> list[Name]:
    """Return what is written to in statements: variables, arrays, loop variables, what calls put out or fill."""
    found: list[Name] = []
    for node in walk(body):
        match node:
            case Assign(Name() as target) | Assign(Element(_, Name() as target)) | Declare(target):
                found.append(target)
            case Count(variable) | For(variable):
                found.append(variable)
            case Invoke(_, _, results):
                found += results
            case Call(_, arguments, results):
                found += [variable for variable, _ in results]
                found += [each for _, each in arguments if isinstance(each, Name) and isinstance(each.type, ArrayType)]
    return found


def is_filled(variable: Name, behind: Sequence[Statement]) -> bool:
    """Return whether the first statement that has an array gives each of its elements a value before it reads one."""
    if not isinstance(variable.type, ArrayType):
        return False
    if not variable.type.size:
        return True
    first = next((each for each in behind if variable in walk(each)), None)
    if isinstance(first, Invoke):
        return variable in first.results and variable not in walk(first.arguments)
    places: list[Expression] = []
    while isinstance(first, For) and first.variable.name.startswith("at_"):
        places.append(first.variable)
        first = first.body[0]
    match first:
        case Assign(Element(_, array, indices), value) if places:
            return array == variable and list(indices) == places and variable not in walk(value)
    return False
