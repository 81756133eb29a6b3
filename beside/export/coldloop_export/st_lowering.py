"""Functions of the typed tree as blocks: no records, no parts of arrays, each call a statement, no choice within one.

A record is where its fields are: those of constants and of the one state are global, and names of what is in them have
the path with points; the others are parameters of every block that needs them. A block is for certain places: one that
is called with two records of the state is there twice. Both operands of a logical operator may be computed, as in
Structured Text; where the second one must not be, there is a decision instead.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final, NamedTuple, TypeAlias, cast

from coldloop_export import expressions, tree
from coldloop_export.tree import ArrayType, Assign, Element, Expression, If, Kind, Literal, Name, Operation, Path


class Part(NamedTuple):
    """An array, from an element on."""

    array: Name
    offset: Expression


class Record(NamedTuple):
    """A record that has a path."""

    path: Path


class Rows(NamedTuple):
    """Records of numbers: an array for each of their numbers, or a number where there is one record."""

    path: Path
    length: int


class Entry(NamedTuple):
    """One of these records."""

    rows: Rows
    at: Expression


class Made(NamedTuple):
    """A record that a kernel makes, of what is elsewhere."""

    parts: tuple[tuple[str, "Place"], ...]


Place: TypeAlias = Part | Record | Rows | Entry | Made | Expression


def dotted(path: Path) -> str:
    """Return the name of the value at a path."""
    return ".".join(path)


def member(entry: Entry, kind: Kind, name: str) -> Name | Element:
    """Return a number of a record of numbers."""
    rows, path = entry.rows, dotted((*entry.rows.path, name))
    if rows.length == 1:
        return Name(kind, path)
    return Element(kind, Name(ArrayType(kind, (rows.length,)), path), (entry.at,))


def part_of(place: Place, name: str, kind: tree.Type) -> Place:
    """Return a field of a record."""
    match place:
        case Made(parts):
            return dict(parts)[name]
        case Record(path) if isinstance(kind, tree.RecordType):
            return Record((*path, name))
        case Record(path) if isinstance(kind, tree.RowsType):
            return Rows((*path, name), kind.length)
        case Record(path):
            named = Name(kind, dotted((*path, name)))
            return Part(named, expressions.ZERO) if isinstance(kind, ArrayType) else named
        case Entry((path, length), at) if isinstance(kind, tree.RecordType):
            return Entry(Rows((*path, name), length), at)
        case Entry() if isinstance(kind, Kind):
            return member(place, kind, name)
    raise AssertionError(place)  # a kernel that is read has no other


Bindings = Mapping[str, Place]
Split = Mapping[Path, Sequence[tuple[Path, int]]]
"""Arrays that are too large for one list of constants: the pieces, with their elements; each has whole rows."""
VALUE: Final = "result"
"""The output that is a function's value."""
NOT_SPLIT: Final[Split] = MappingProxyType({})


class Lowering:
    """Blocks of functions and of all that they call, callees first.

    Args:
        globals_: Paths of what is global: fields of constants and of the state.
        split: Those that are in pieces.
    """

    def __init__(self, globals_: Collection[Path], split: Split = NOT_SPLIT) -> None:
        self.globals, self.split = globals_, split
        self.blocks: list[tree.Block] = []
        self._known: dict[tuple[str, tuple[tuple[str, Place], ...]], tree.Block] = {}

    def block(self, function: tree.Function, bindings: Bindings) -> tree.Block:
        """Return the block of a function whose records and arrays are certain ones."""
        key = (function.name, tuple(sorted(bindings.items(), key=lambda each: each[0])))
        if key not in self._known:
            made = FunctionLowering(self, function, bindings).block()
            name = function.name.replace("__", "_")
            taken = {each.name for each in self.blocks}
            names = (f"{name}_{number}" if number else name for number in range(len(taken) + 1))
            made.name = next(each for each in names if each not in taken)
            self._known[key] = made
            self.blocks.append(made)
        return self._known[key]

    def is_global(self, name: Name) -> bool:
        """Return whether a name is that of a constant or of the state."""
        return tuple(name.name.split(".")) in self.globals


class FunctionLowering:
    """Lowers one function."""

    def __init__(self, lowering: Lowering, function: tree.Function, bindings: Bindings) -> None:
        self.lowering, self.function = lowering, function
        self.places: dict[str, Place] = dict(bindings)
        self.constants: dict[Path, None] = {}
        self.fields: dict[str, Name] = {}
        self.before: list[tree.Statement] = []
        self._given = {
            node for node in tree.walk(tuple(bindings.values())) if isinstance(node, Name) and "." in node.name
        }
        self._ranges: dict[str, range] = {}
        self._made = 0

    def block(self) -> tree.Block:
        """Return the block."""
        function = self.function
        numbers = [each for each in function.parameters if isinstance(each.type, Kind)]
        shared = [place.array for each in function.parameters if isinstance(each.type, ArrayType)
                  and isinstance(place := self._place(each), Part)
                  and not self.lowering.is_global(place.array)]  # fmt: skip
        changed = [each for each in numbers if each in assigned(function.body)]
        body = (*(Assign(each, given(each)) for each in changed), *self._body(function.body))
        body = body[:-1] if body and body[-1] == tree.Return() else body
        results = [*function.results, *([Name(function.value, VALUE)] if function.value else [])]
        shared += [each for each in [*results, *self.fields.values()] if isinstance(each.type, ArrayType)]
        inputs = [given(each) if each in changed else each for each in numbers]
        inputs += [each for each in self.fields.values() if isinstance(each.type, Kind)]
        outputs = [each for each in results if isinstance(each.type, Kind)]
        known = {each.name for each in (*inputs, *shared, *outputs)}
        variables = {(each.name, size_of(each.type)): each for each in assigned(body)
                     if each.name not in known and not self.lowering.is_global(each)}  # fmt: skip
        return tree.Block(
            function.name, function.source, function.summary, tuple(inputs), tuple(shared), tuple(outputs),
            tuple(variables.values()), tuple(self.constants), body,
        )  # fmt: skip

    def _body(self, statements: Sequence[tree.Statement]) -> tuple[tree.Statement, ...]:
        result: list[tree.Statement] = []
        for place, statement in enumerate(statements):
            if isinstance(statement, tree.Declare) and is_filled(statement.variable, statements[place + 1 :]):
                continue
            outer, self.before = self.before, []
            read = list(self._statement(statement))
            result += [*self.before, *read]
            self.before = outer
        return tuple(result)

    def _statement(self, statement: tree.Statement) -> Iterator[tree.Statement]:  # noqa: C901, PLR0912 one case a statement
        match statement:
            case tree.Declare(variable, value):
                if isinstance(variable.type, ArrayType):
                    yield zeroed(variable)
                else:
                    yield from self._assigned(variable, value or Literal(cast("Kind", variable.type), 0))
            case Assign(target, value):
                yield from self._assigned(cast("tree.Target", self._expression(target)), value)
            case tree.Point(variable, part):
                self.places[variable.name] = self._place(part)
            case tree.Make(variable, parts):
                self.places[variable.name] = Made(tuple((name, self._kept(part)) for name, part in parts))
            case tree.Copy(target, source):
                one, other = self._place(target), self._place(source)
                for name, kind in target.type.fields:  # type: ignore[union-attr]
                    pair = (cast("tree.Target", part_of(each, name, kind)) for each in (one, other))
                    yield Assign(*map(self._noted, pair))  # type: ignore[arg-type]
            case tree.Invoke(function, arguments, results):
                yield self._call(function, arguments, results)
            case tree.For():
                yield self._counted(statement)
            case tree.While(condition, body):
                tested = self._expression(condition)
                yield tree.While(tested, (*self._body(body), *self.before))
            case If(condition, body, other):
                yield If(self._expression(condition), self._body(body), self._body(other))
            case tree.Return(None):
                yield statement
            case tree.Return(value) if value:
                yield from self._assigned(Name(cast("Kind", value.type), VALUE), value)
                yield tree.Return()

    def _assigned(self, target: tree.Target, value: Expression) -> Iterator[tree.Statement]:
        """Yield an assignment; of a choice, a decision between two."""
        if not isinstance(value, tree.Select):
            yield Assign(target, self._expression(value))
            return
        condition = self._expression(value.condition)
        yield If(condition, self._body((Assign(target, value.one),)), self._body((Assign(target, value.other),)))

    def _counted(self, loop: tree.For) -> tree.Count:
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
        return tree.Count(loop.variable, first, last, loop.step, body)

    def _call(self, function: tree.Function, arguments: Sequence[Expression], results: Sequence[Name]) -> tree.Call:
        """Return the call of a function's block: results are arrays that it writes to, or numbers it puts out."""
        passed: dict[str, Expression] = {}
        bindings: dict[str, Place] = {}
        for parameter, argument in zip(function.parameters, arguments, strict=True):
            if isinstance(parameter.type, Kind):
                passed[parameter.name] = self._expression(argument)
            else:
                bindings[parameter.name] = self._handed(parameter.name, self._place(argument), passed)
        block = self.lowering.block(function, bindings)
        taken = [*function.results, *([Name(function.value, VALUE)] if function.value else [])]
        kept: list[tuple[Name, Name]] = []
        for output, variable in zip(taken, results, strict=True):
            if isinstance(output.type, Kind):
                kept.append((variable, output))
            else:
                passed[output.name] = variable
        listed = []
        for each in (*block.inputs, *block.shared):
            if (given_ := passed.get(each.name.removesuffix(GIVEN))) is None:
                self._given.add(each)
            listed.append((each, self._noted(given_ or each)))
        return tree.Call(block, tuple(listed), tuple(kept))

    def _handed(self, name: str, place: Place, passed: dict[str, Expression]) -> Place:
        """Return where a parameter is in what is called; what that needs goes into `passed`."""
        match place:
            case Part(array, offset):
                inner = array
                if not self.lowering.is_global(array):
                    inner = Name(array.type, name)
                    passed[name] = array
                return Part(inner, self._number_handed(f"{name}.from", offset, passed))
            case Entry(rows, at):
                return Entry(rows, self._number_handed(f"{name}.at", at, passed))
            case Made(parts):
                return Made(tuple((field, self._handed(f"{name}.{field}", part, passed)) for field, part in parts))
            case Record() | Rows():
                return place
        return self._number_handed(name, place, passed)

    def _number_handed(self, name: str, number: Expression, passed: dict[str, Expression]) -> Expression:
        if isinstance(number, Literal) or (isinstance(number, Name) and self.lowering.is_global(number)):
            return number
        passed[name] = number
        return Name(number.type, name)

    def _expression(self, expression: Expression) -> Expression:  # noqa: PLR0911 one case a kind of expression
        match expression:
            case Name() | tree.Field() | tree.Member():
                return self._noted(cast("Expression", self._place(expression)))
            case Element(kind, array, indices):
                return self._noted(self._element(kind, array, tuple(map(self._expression, indices))))
            case Operation(_, "and" | "or"):
                return self._logical(expression)
            case Operation(kind, operator, operands):
                return Operation(kind, operator, tuple(map(self._expression, operands)))
            case tree.Select(kind):
                chosen = self._temporary(kind, "chosen")
                self.before += self._assigned(chosen, expression)
                return chosen
            case tree.Convert(kind, operand):
                return tree.Convert(kind, self._expression(operand))
            case tree.Invocation(kind, function, arguments):
                value = self._temporary(kind, "value")
                self.before.append(self._call(function, arguments, (value,)))
                return value
        return expression

    def _logical(self, operation: Operation) -> Expression:
        one = self._expression(operation.operands[0])
        outer, self.before = self.before, []
        other = self._expression(operation.operands[1])
        own, self.before = self.before, outer
        if not own and all(map(self._is_within, tree.walk(other))):
            return Operation(Kind.BOOL, operation.operator, (one, other))
        part = self._temporary(Kind.BOOL, "part")
        undecided: Expression = part if operation.operator == "and" else Operation(Kind.BOOL, "not", (part,))
        self.before += [Assign(part, one), If(undecided, (*own, Assign(part, other)), ())]
        return part

    def _is_within(self, node: object) -> bool:
        """Return whether a part of an expression is no element, or one whose indices are within their array always."""
        if not (isinstance(node, Element) and isinstance(node.array.type, ArrayType)):
            return True
        for index, length in zip(node.indices, node.array.type.shape, strict=True):
            reached = self._ranges.get(index.name, range(-1, 0)) if isinstance(index, Name) else range(-1, 0)
            if not isinstance(index, Literal) and not 0 <= reached.start <= reached.stop <= length:
                return False
        return True

    def _place(self, expression: Expression) -> Place:
        match expression:
            case Name(kind, name):
                unbound = Part(expression, expressions.ZERO) if isinstance(kind, ArrayType) else expression
                return self.places.get(name, unbound)
            case tree.Field(kind, record, name):
                whole = self._place(record)
                found = part_of(whole, name, kind)
                return found if isinstance(whole, Made) else self._own(found)
            case tree.View(kind, array, offset):
                return self._cut(kind, self._place(array), self._captured(self._expression(offset)))
            case tree.Item(_, rows, index):
                return Entry(cast("Rows", self._place(rows)), self._captured(self._expression(index)))
            case tree.Member(kind, struct, name):
                return self._own(member(cast("Entry", self._place(struct)), kind, name))
        raise AssertionError(expression)  # no other is where something is

    def _own(self, place: Place) -> Place:
        """Return a place; fields of records that are not global are parameters."""
        name = place.array if isinstance(place, Part) else place
        if isinstance(name, Name):
            self._given.add(name)
        return place

    def _kept(self, part: Expression) -> Place:
        """Return where a part of a record is that is made: a number as it is now."""
        return self._captured(self._expression(part)) if isinstance(part.type, Kind) else self._place(part)

    def _element(self, kind: Kind, array: Expression, indices: tuple[Expression, ...]) -> Element:
        whole, offset = cast("Part", self._place(array))
        if tuple(whole.name.split(".")) in self.lowering.split:
            raise tree.UnfitKernelError(f"{self.function.source}: {whole.name} is in pieces; take a part of it first")
        if offset == expressions.ZERO and whole.type == array.type:
            return Element(kind, whole, indices)
        return Element(kind, tree.View(cast("ArrayType", array.type), whole, offset), indices)

    def _cut(self, kind: ArrayType, place: Place, offset: Expression) -> Part:
        """Return a part of an array; where that is in pieces, a copy of the part."""
        whole, before = cast("Part", place)
        pieces = self.lowering.split.get(tuple(whole.name.split(".")))
        if not pieces:
            return Part(whole, self._captured(expressions.added(before, offset)))
        copy = self._temporary(ArrayType(kind.kind, (kind.size,)), "part")
        statements: tuple[tree.Statement, ...] = ()
        first = 0
        for path, size in pieces:
            piece, at = Name(ArrayType(kind.kind, (size,)), dotted(path)), Name(Kind.INT, "at.0")
            within = Operation(Kind.INT, "-", (offset, Literal(Kind.INT, first)))
            source = Element(kind.kind, piece, (Operation(Kind.INT, "+", (within, at)),))
            taken = Assign(Element(kind.kind, copy, (at,)), self._noted(source))
            loop = tree.Count(at, expressions.ZERO, Literal(Kind.INT, kind.size - 1), 1, (taken,))
            behind = Operation(Kind.BOOL, ">=", (offset, Literal(Kind.INT, first)))
            statements = (If(behind, (loop,), statements),) if statements else (loop,)
            first += size
        self.before += statements
        return Part(copy, expressions.ZERO)

    def _captured(self, number: Expression) -> Expression:
        """Return a number that stays as it is now."""
        if isinstance(number, Literal):
            return number
        kept = self._temporary(number.type, "kept")
        self.before.append(Assign(kept, number))
        return kept

    def _noted(self, expression: Expression) -> Expression:
        """Return an expression; what it has of constants, state and fields is noted."""
        for node in tree.walk(expression):
            if isinstance(node, Name):
                if self.lowering.is_global(node):
                    self.constants[tuple(node.name.split("."))] = None
                elif node in self._given:
                    self.fields[node.name] = node
        return expression

    def _temporary(self, kind: tree.Type, what: str) -> Name:
        self._made += 1
        return Name(kind, f"{what}.{self._made}")


GIVEN: Final = ".given"


def given(parameter: Name) -> Name:
    """Return the input whose value a parameter begins with that is written to: inputs are not."""
    return replace(parameter, name=f"{parameter.name}{GIVEN}")


def zeroed(array: Name) -> tree.Count:
    """Return the loop that makes an array zero."""
    kind = cast("ArrayType", array.type)
    at, row = Name(Kind.INT, "at.0"), Name(ArrayType(kind.kind, (kind.size,)), array.name)
    zero = Assign(Element(kind.kind, row, (at,)), Literal(kind.kind, 0))
    return tree.Count(at, expressions.ZERO, Literal(Kind.INT, kind.size - 1), 1, (zero,))


def size_of(kind: tree.Type) -> tuple[Kind, int]:
    """Return what variables of one name differ in: of what and how many."""
    return (kind.kind, kind.size) if isinstance(kind, ArrayType) else (cast("Kind", kind), 0)


def assigned(body: object) -> list[Name]:
    """Return what is written to in statements: variables, arrays, loop variables, what calls put out or fill."""
    found: list[Name] = []
    for node in tree.walk(body):
        match node:
            case (Assign(Name() as target) | Assign(Element(_, Name() as target)) | tree.Declare(target)
                  | Assign(Element(_, tree.View(_, Name() as target)))):  # fmt: skip
                found.append(target)
            case tree.Count(variable) | tree.For(variable):
                found.append(variable)
            case tree.Invoke(_, _, results):
                found += results
            case tree.Call(_, arguments, results):
                found += [variable for variable, _ in results]
                found += [each for _, each in arguments if isinstance(each, Name) and isinstance(each.type, ArrayType)]
    return found


def is_filled(variable: Name, behind: Sequence[tree.Statement]) -> bool:
    """Return whether the first statement that has an array gives each of its elements a value before it reads one."""
    if not isinstance(variable.type, ArrayType):
        return False
    if not variable.type.size:
        return True
    first = next((each for each in behind if variable in tree.walk(each)), None)
    if isinstance(first, tree.Invoke):
        return variable in first.results and variable not in tree.walk(first.arguments)
    places: list[Expression] = []
    while isinstance(first, tree.For) and first.variable.name.startswith("at_"):
        places.append(first.variable)
        first = first.body[0]
    match first:
        case Assign(Element(_, array, indices), value) if places:
            return array == variable and list(indices) == places and variable not in tree.walk(value)
    return False
