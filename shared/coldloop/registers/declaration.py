"""How a register is declared.

A *record* is a `NamedTuple` whose fields are annotated with what the bus needs to know of them. A *block* gives a
record its place in the address space and its writer; a *map* is all blocks of one server. Tables, accessors, checks
and documentation follow from these three.
"""

import hashlib
import json
import struct
from collections import namedtuple
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, IntEnum, StrEnum
from functools import cache, cached_property
from typing import Any, NamedTuple, cast, get_type_hints


class Kind(Enum):
    """Type of a register: its name, its `struct` letter and the number of 16-bit words that it takes."""

    U16 = ("uint16", "H", 1)
    U32 = ("uint32", "I", 2)
    F32 = ("float32", "f", 2)

    def __init__(self, label: str, letter: str, words: int) -> None:
        self.label = label
        self.letter = letter
        self.words = words


class Role(StrEnum):
    """Who may write a block."""

    OPTIMIZER = "optimizer"
    CONTROL = "control"
    OPERATOR = "operator"


@dataclass(frozen=True, slots=True)
class Field:
    """What the bus knows of one field of a record: type, unit, range and meaning.

    A field with `elements` is an array: its value is a tuple with one number for each named element, and `units`
    gives each its unit.
    """

    kind: Kind
    description: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    elements: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    values: type[IntEnum] | None = None
    """Meaning of the numbers of an enumeration."""
    is_text: bool = False
    """The elements are the words of a text (`registers.text`)."""
    finite: bool = True
    """No NaN and no infinity; where they are allowed, the user of the value checks it."""

    @property
    def words(self) -> int:
        """Number of 16-bit words."""
        return self.kind.words * max(1, len(self.elements))


def u16(
    description: str,
    *,
    unit: str = "",
    low: int | None = None,
    high: int | None = None,
    values: type[IntEnum] | None = None,
) -> Field:
    """Declare an unsigned 16-bit register; `values` gives an enumeration's numbers their meaning, and their range."""
    lowest, highest = (0, 0xFFFF) if values is None else (min(values), max(values))
    return Field(
        Kind.U16, description, unit, lowest if low is None else low, highest if high is None else high, values=values
    )


def u32(description: str, *, unit: str = "", low: int | None = None, high: int | None = None) -> Field:
    """Declare an unsigned 32-bit register pair."""
    return Field(Kind.U32, description, unit, low, high)


def u16_array(description: str, elements: tuple[str, ...], *, unit: str = "") -> Field:
    """Declare one unsigned 16-bit register for each element."""
    return Field(Kind.U16, description, unit, elements=elements)


def text(description: str, words: int) -> Field:
    """Declare a text of two ASCII characters a word, padded with zeros; `registers.text` converts it."""
    return Field(Kind.U16, description, elements=tuple(f"{word}" for word in range(words)), is_text=True)


def f32(
    description: str, *, unit: str = "", low: float | None = None, high: float | None = None, finite: bool = True
) -> Field:
    """Declare an IEEE-754 single-precision register pair."""
    return Field(Kind.F32, description, unit, low, high, finite=finite)


def f32_array(
    description: str,
    elements: tuple[str, ...],
    units: tuple[str, ...],
    *,
    low: float | None = None,
    high: float | None = None,
    finite: bool = True,
) -> Field:
    """Declare one single-precision register pair for each element, all with the same range."""
    return Field(Kind.F32, description, "", low, high, elements, units, finite=finite)


def record(name: str, module: str, description: str, declared: Mapping[str, Any], defaults: Sequence[Any] = ()) -> Any:  # noqa: ANN401 a class
    """Return a record class whose fields depend on the process: `declared` are their annotations, in order.

    Args:
        name: Of the class.
        module: In which it stands under that name.
        description: Of the class.
        declared: Annotation of each field, as in a `NamedTuple`.
        defaults: Of the last fields.
    """
    make: Any = namedtuple  # noqa: PYI024 the fields vary
    made = make(name, list(declared), defaults=defaults, module=module)
    made.__doc__, made.__annotations__ = description, dict(declared)
    return made


@cache
def fields_of(record: type[tuple[object, ...]]) -> dict[str, Field]:
    """Return the declared fields of a record class, in their order."""
    declared: dict[str, Field] = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        metadata = [item for item in getattr(hint, "__metadata__", ()) if isinstance(item, Field)]
        if len(metadata) != 1:
            raise TypeError(f"{record.__name__}.{name} needs exactly one register declaration")
        declared[name] = metadata[0]
    return declared


class Register(NamedTuple):
    """One register of a map, as documentation and clients see it. `address` is 0-based."""

    block: str
    name: str
    address: int
    kind: Kind
    unit: str
    low: float | None
    high: float | None
    writer: Role | None
    description: str
    values: type[IntEnum] | None = None
    """Meaning of the numbers of an enumeration."""


@dataclass(frozen=True)
class Block:
    """A record's place in a map: `rows` copies of it one after the other from `address` on."""

    name: str
    address: int
    record: type[tuple[object, ...]]
    description: str
    writer: Role | None = None
    rows: int = 1
    sealed: bool = False
    """Each row ends with the CRC-32 of the words before it (`coldloop.registers.seal`)."""

    @cached_property
    def row_words(self) -> int:
        """Words of one row."""
        return sum(field.words for field in fields_of(self.record).values())

    @property
    def end(self) -> int:
        """First address behind the block."""
        return self.address + self.row_words * self.rows

    @cached_property
    def letters(self) -> str:
        """`struct` letters of one row, without byte order."""
        return "".join(field.kind.letter * max(1, len(field.elements)) for field in fields_of(self.record).values())

    def registers(self, row: int = 0) -> Iterator[Register]:
        """Yield the registers of one row."""
        address = self.address + row * self.row_words
        for name, field in fields_of(self.record).items():
            for position, element in enumerate(field.elements or ("",)):
                label = f"{name}.{element}" if element else name
                unit = field.units[position] if field.units else field.unit
                yield Register(
                    self.name, label, address, field.kind, unit, field.low, field.high, self.writer, field.description,
                    field.values,
                )  # fmt: skip
                address += field.kind.words


def placed(blocks: Iterable[Block]) -> tuple[Block, ...]:
    """Return blocks at their addresses, or after the one before where the process has made that one longer."""
    found: list[Block] = []
    for block in blocks:
        end = found[-1].end if found else 0
        found.append(block if block.address >= end else replace(block, address=end))
    return tuple(found)


@dataclass(frozen=True)
class RegisterMap:
    """All blocks of one server. `version` rises when the meaning of a register changes.

    Addresses between two blocks are reserved: they read 0, so that a client may read across them, and take no writes.
    """

    service: str
    version: int
    blocks: tuple[Block, ...]
    unused: tuple[type[tuple[object, ...]], ...] = ()
    """Records that mean nothing in this process: they keep their addresses, and nobody is shown them."""

    def __post_init__(self) -> None:
        end = 0
        for block in self.blocks:
            if block.address < end or block.end > 0x10000:
                raise ValueError(f"block {block.name} of {self.service} overlaps another one or the end of the map")
            end = block.end

    @property
    def end(self) -> int:
        """First address behind the last block."""
        return self.blocks[-1].end

    @property
    def shown(self) -> Iterator[Block]:
        """The blocks that mean something in this process."""
        return (block for block in self.blocks if block.record not in self.unused)

    def block_of(self, record: type[tuple[object, ...]]) -> Block:
        """Return the block that holds `record`."""
        return self._by_record[record]

    @cached_property
    def _by_record(self) -> dict[type[tuple[object, ...]], Block]:
        return {block.record: block for block in self.blocks}

    @cached_property
    def digest(self) -> int:
        """32-bit digest of everything a client depends on: addresses, types, units, ranges and writers."""
        layout = [
            (
                block.rows,
                [(r.name, r.address, r.kind.label, r.unit, r.low, r.high, r.writer) for r in block.registers()],
            )
            for block in self.blocks
        ]
        canonical = json.dumps([self.service, self.version, layout]).encode()
        return cast("int", struct.unpack(">I", hashlib.sha256(canonical).digest()[:4])[0])
