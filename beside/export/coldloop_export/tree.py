"""The typed tree between the kernels' Python and what is printed from it: functions of fixed shapes, no Python left."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from importlib.resources import files
from math import prod
from typing import ClassVar, TypeAlias, dataclass_transform

import numpy as np

from coldloop.errors import UsageError


def template(name: str) -> str:
    """Return a file of this package, by its path in it."""
    return files("coldloop_export").joinpath(name).read_text(encoding="ascii")


def filled(text: str, parts: Mapping[str, str]) -> str:
    """Return a template with its parts."""
    for name, part in parts.items():
        text = text.replace(f"@{name}@", part)
    return text


def place_of(source: str) -> str:
    """Return the last three parts of the path of a source, as printed text names it."""
    return "/".join(source.split("/")[-3:])


class Export:
    """Part of an export for a target: solver, whole optimiser or output guard."""

    outputs: tuple[str, ...] = ()
    """Outputs of the self-test in Structured Text besides those that every self-test has."""


class Kind(Enum):
    """Types of scalars."""

    REAL = "real"
    """The on-line type, single or double precision."""
    INT = "int"
    UNSIGNED = "unsigned"
    """An index that does not count from the end."""
    BOOL = "bool"


@dataclass_transform(frozen_default=True)
class Node:
    """Type, expression or statement; its classes are frozen dataclasses."""

    def __init_subclass__(cls) -> None:
        """Make a class one."""
        dataclass(frozen=True)(cls)


class ArrayType(Node):
    """An array whose shape is known when it is printed."""

    kind: Kind
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of elements."""
        return prod(self.shape)


class StructType(Node):
    """A record of numbers, all of which may be written to: an element of a structured array."""

    name: str
    fields: tuple[tuple[str, Kind], ...]


class RowsType(Node):
    """An array of such records."""

    struct: StructType
    length: int


class RecordType(Node):
    """A NamedTuple: constant, and so are its arrays, unless it is a state. Or a dataclass, which is one."""

    name: str
    fields: tuple[tuple[str, "Type"], ...]
    state: bool = False
    """Whether it has arrays of records of numbers, or is a dataclass: its arrays are its own, and may be written to."""
    mutable: bool = False
    """Whether it is a dataclass, whose numbers may be written to as well."""


Type: TypeAlias = Kind | ArrayType | StructType | RowsType | RecordType

# -- expressions -------------------------------------------------------------------------------------------------------


class Literal(Node):
    """A number of a stated type."""

    type: Kind
    value: float


class Name(Node):
    """A parameter or a variable."""

    type: Type
    name: str


class Field(Node):
    """A field of a record."""

    type: Type
    record: "Name | Field"
    name: str


class View(Node):
    """A part of an array in a row, from the element `offset` on; all dimensions counted."""

    type: ArrayType
    array: "Name | Field"
    offset: "Expression"


class Item(Node):
    """A record of numbers in an array of them."""

    type: StructType
    rows: "Name | Field"
    index: "Expression"


class Member(Node):
    """A number of a record of numbers."""

    type: Kind
    struct: "Item | Name"
    name: str


class Element(Node):
    """An element of an array."""

    type: Kind
    array: "Name | Field | View"
    indices: tuple["Expression", ...]


class Operation(Node):
    """An operator with one or two operands, in Python's spelling; or the name of a function, such as sqrt."""

    type: Kind
    operator: str
    operands: tuple["Expression", ...]


class Select(Node):
    """The one or the other; only that one is computed."""

    type: Kind
    condition: "Expression"
    one: "Expression"
    other: "Expression"


class Convert(Node):
    """A number or a truth value as another type."""

    type: Kind
    operand: "Expression"


class Invocation(Node):
    """The result of a function with one scalar result that writes to no argument."""

    type: Kind
    function: "Function"
    arguments: tuple["Expression", ...]


Place: TypeAlias = Name | Field | View | Item | Member | Element
Expression: TypeAlias = Literal | Place | Operation | Select | Convert | Invocation
Storage: TypeAlias = Name | Field | View | Item
Target: TypeAlias = Name | Element | Member | Field

# -- statements --------------------------------------------------------------------------------------------------------


class Declare(Node):
    """A new variable; without a value it is zero everywhere."""

    variable: Name
    value: Expression | None = None


class Assign(Node):
    """A new value of a variable, of an element or of a number in a record."""

    target: Target
    value: Expression


class Point(Node):
    """A name for a part of an array, or for a record in one."""

    variable: Name
    part: View | Item
    constant: bool


class Make(Node):
    """A new constant record, of numbers and of arrays that have names."""

    variable: Name
    parts: tuple[tuple[str, Expression], ...]


class Copy(Node):
    """All numbers of a record become those of another."""

    target: Item | Name
    source: Item | Name


class Invoke(Node):
    """A call for what it writes; results go to variables."""

    function: "Function"
    arguments: tuple[Expression, ...]
    results: tuple[Name, ...]


class For(Node):
    """A counted loop; bounds are computed once."""

    variable: Name
    start: Expression
    stop: Expression
    step: int
    body: tuple["Statement", ...]


class While(Node):
    """A loop."""

    condition: Expression
    body: tuple["Statement", ...]


class If(Node):
    """A decision."""

    condition: Expression
    body: tuple["Statement", ...]
    other: tuple["Statement", ...]


class Return(Node):
    """The end of a function, with its value where it has one that is not a result parameter."""

    value: Expression | None = None


class Count(Node):
    """A counted loop that includes its last value; only in blocks (`lowering.py`)."""

    variable: Name
    first: Expression
    last: Expression
    step: int
    body: tuple["Statement", ...]


class Call(Node):
    """A call of a block, with its arguments by name and the variables that get its outputs; only in blocks."""

    block: "Block"
    arguments: tuple[tuple[Name, Expression], ...]
    results: tuple[tuple[Name, Name], ...]
    """Variable, output."""


class PausingCall(Node):
    """A call of a block that may pause: its outputs are taken, and what follows is done, once it is no longer busy."""

    call: Call
    anew: Name
    """The variable that says that it begins: false from then on."""
    busy: Name
    """Output of the block that says that it has paused."""
    following: tuple["Statement", ...]


class Switch(Node):
    """Statements for each value of a number; only in blocks that pause (`st_pausing.py`)."""

    number: Name
    cases: tuple[tuple[int, tuple["Statement", ...]], ...]


Statement: TypeAlias = (
    Declare | Assign | Point | Make | Copy | Invoke | For | While | If | Return | Count | Call | PausingCall | Switch
)

# -- results -----------------------------------------------------------------------------------------------------------


class Group(Node):
    """Results that belong together: a tuple, or a NamedTuple of this name with its fields."""

    name: str
    parts: tuple[tuple[str, "Name | Field | Group"], ...]
    """Results of the function, or fields of its parameters."""


@dataclass
class Function:
    """A kernel for arguments of certain types.

    One scalar result is returned by value; arrays, and results that are several, are parameters behind the others.
    """

    name: str
    source: str
    """File and line of the kernel."""
    summary: str
    """Sentence that says what the kernel does."""
    parameters: tuple[Name, ...]
    written: set[str] = field(default_factory=set)
    """Parameters that it writes to: arrays and states."""
    used: set[str] = field(default_factory=set)
    results: tuple[Name, ...] = ()
    returned: Name | Field | Group | None = None
    """Structure of the results: a single one, or tuples of them."""
    value: Kind | None = None
    body: tuple[Statement, ...] = ()


Path: TypeAlias = tuple[str, ...]
"""A record's field: the names from the first record to it."""


@dataclass(eq=False)
class Block:
    """A function without records, whose every call is a statement: what a function block is printed from."""

    name: str
    source: str
    summary: str
    inputs: tuple[Name, ...]
    """Numbers."""
    shared: tuple[Name, ...]
    """Arrays of the caller, read or written."""
    outputs: tuple[Name, ...]
    variables: tuple[Name, ...]
    constants: tuple[Path, ...]
    """Constants, and fields of the state, that it uses."""
    body: tuple[Statement, ...]

    @property
    def called(self) -> list["Block"]:
        """Blocks that it calls, each once."""
        return list(dict.fromkeys(node.block for node in walk(self.body) if isinstance(node, Call)))


def parts_of(node: object) -> tuple[object, ...]:
    """Return the elements of a tuple, or the fields of a node; not what is called."""
    if is_dataclass(node):
        node = tuple(getattr(node, each.name) for each in fields(node))
    return tuple(part for part in node if not isinstance(part, Function | Block)) if isinstance(node, tuple) else ()


def walk(node: object) -> Iterator[object]:
    """Yield a node and those below it; not what is called."""
    yield node
    for part in parts_of(node):
        yield from walk(part)


KINDS = {"f": Kind.REAL, "i": Kind.INT, "u": Kind.UNSIGNED, "b": Kind.BOOL}


class UnfitKernelError(UsageError):
    """A kernel uses a construct that is not in the subset."""


def type_of(value: object, records: str = "") -> Type:  # noqa: PLR0911 one case a type
    """Return the type of an argument: an array, numbers in a row, a NamedTuple, a dataclass, or a number.

    A structured array is an argument where its records have a name, `records`.

    Raises:
        UnfitKernelError: It is something else.
    """
    if records and isinstance(value, np.ndarray) and value.dtype.fields:
        numbers = tuple((name, KINDS[kind.kind]) for name, (kind, *_) in value.dtype.fields.items())
        return RowsType(StructType(records, numbers), len(value))
    if isinstance(value, np.ndarray) and value.dtype.kind in KINDS and value.ndim:
        return ArrayType(KINDS[value.dtype.kind], value.shape)
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        own = type(value).__name__
        parts = tuple((name, type_of(part, f"{own}{name.capitalize()}"))
                      for name, part in zip(value._fields, value, strict=True))  # fmt: skip
        state = any(isinstance(kind, RowsType) or (isinstance(kind, RecordType) and kind.state) for _, kind in parts)
        return RecordType(own, parts, state)
    if is_dataclass(value) and not isinstance(value, type):
        parts = tuple((each.name, type_of(getattr(value, each.name))) for each in fields(value))
        return RecordType(type(value).__name__, parts, state=True, mutable=True)
    if isinstance(value, list | tuple) and (listed := np.array(value)).dtype.kind in KINDS:
        return ArrayType(KINDS[listed.dtype.kind], listed.shape)
    if isinstance(value, bool | np.bool_):
        return Kind.BOOL
    if isinstance(value, int | np.integer):
        return Kind.INT
    if isinstance(value, float | np.floating):
        return Kind.REAL
    raise UnfitKernelError(f"an argument of type {type(value).__name__} cannot be exported: arrays, records, numbers")


def spelt(operators: Mapping[str, str], operator: str, operands: Iterable[str], **parts: str) -> str:
    """Return an operation by the format of its operator; one without a format stands between its operands."""
    return operators.get(operator, f"({{0}} {operator} {{1}})").format(*operands, **parts)


class TreePrinter:
    """Prints the tree for one floating-point type.

    Numbers with a point are elements of a constant array, which the self-test sums up with the other constants.
    """

    table: str
    """Name of that array."""
    truth: ClassVar[tuple[str, str]]
    """False, true."""
    operators: Mapping[str, str]
    """Formats of operators and functions (`spelt`); `kind` is the type of the operands in `kinds`."""
    kinds: Mapping[Kind, str]

    def __init__(self, real: type[np.floating]) -> None:
        self.single = real is np.float32
        self.literals: list[str] = []

    def number(self, value: float) -> str:
        """Return a number with a point such that it is read back with the same bits."""
        raise NotImplementedError

    def _statement(self, statement: Statement) -> Iterator[str]:
        raise NotImplementedError

    def _body(self, statements: Iterable[Statement]) -> Iterator[str]:
        """Yield the lines of statements, indented."""
        for statement in statements:
            yield from (f"    {line}" for line in self._statement(statement))

    def _nested(self, head: str, statements: Iterable[Statement], end: str) -> Iterator[str]:
        yield head
        yield from self._body(statements)
        yield end

    def _other(self, expression: Expression) -> str:
        """Return an expression that is not the same in every language."""
        raise NotImplementedError

    def expression(self, expression: Expression) -> str:
        """Return an expression, with parentheses around each operation."""
        match expression:
            case Literal(Kind.REAL, value):
                return self.literal(value)
            case Literal(Kind.BOOL, value):
                return self.truth[bool(value)]
            case Literal(_, value):
                return f"{value}" if value >= 0 else f"({value})"
            case Element(_, array):
                return f"{self.expression(array.array if isinstance(array, View) else array)}[{self.place(expression)}]"
            case Operation(_, operator, operands):
                kind = self.kinds[operands[0].type]  # type: ignore[index]
                return spelt(self.operators, operator, map(self.expression, operands), kind=kind)
        return self._other(expression)

    def literal(self, value: float) -> str:
        """Return the element of the table that has this value."""
        text = self.number(value)
        if text not in self.literals:
            self.literals.append(text)
        return f"{self.table}[{self.literals.index(text)}]"

    def place(self, element: Element) -> str:
        """Return the index of an element in its array, which is stored row by row."""
        assert isinstance(element.array.type, ArrayType)  # noqa: S101 by construction
        place = ""
        for index, length in zip(element.indices, element.array.type.shape, strict=True):
            place = f"{place} * {length} + {self.expression(index)}" if place else self.expression(index)
            place = f"({place})" if index is not element.indices[-1] and place.count(" ") else place
        if isinstance(element.array, View) and element.array.offset != Literal(Kind.INT, 0):
            return f"{self.expression(element.array.offset)} + {place}"
        return place
