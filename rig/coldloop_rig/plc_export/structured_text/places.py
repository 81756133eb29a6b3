"""Where the values of a function are once there are no records: in numbers and whole arrays, global or of a block.

A record of constants or of the one state is its path; names of what is in it have the path with points.
"""

from typing import NamedTuple, TypeAlias

from coldloop_rig.plc_export.tree.nodes import (
    ArrayType,
    Element,
    Expression,
    Kind,
    Literal,
    Name,
    Operation,
    Path,
    RecordType,
    RowsType,
    Type,
)

ZERO = Literal(Kind.INT, 0)


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
    """Return the name of what is at a path."""
    return ".".join(path)


def located(kind: Type, path: Path) -> Place:
    """Return what is at a path."""
    if isinstance(kind, RecordType):
        return Record(path)
    if isinstance(kind, RowsType):
        return Rows(path, kind.length)
    name = Name(kind, dotted(path))
    return Part(name, ZERO) if isinstance(kind, ArrayType) else name


def member(entry: Entry, kind: Kind, name: str) -> Name | Element:
    """Return a number of a record of numbers."""
    rows, path = entry.rows, dotted((*entry.rows.path, name))
    if rows.length == 1:
        return Name(kind, path)
    return Element(kind, Name(ArrayType(kind, (rows.length,)), path), (entry.at,))


def part_of(place: Place, name: str, kind: Type) -> Place:
    """Return a field of a record."""
    match place:
        case Made(parts):
            return dict(parts)[name]
        case Record(path):
            return located(kind, (*path, name))
        case Entry((path, length), at) if isinstance(kind, RecordType):
            return Entry(Rows((*path, name), length), at)
        case Entry() if isinstance(kind, Kind):
            return member(place, kind, name)
    raise AssertionError(place)  # a kernel that is read has no other


def summed(one: Expression, other: Expression) -> Expression:
    """Return the sum of two integers."""
    if ZERO in {one, other}:
        return other if one == ZERO else one
    if isinstance(one, Literal) and isinstance(other, Literal):
        return Literal(Kind.INT, one.value + other.value)
    return Operation(Kind.INT, "+", (one, other))
