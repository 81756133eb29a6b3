"""Declaration of registers.

A *record* is a `NamedTuple` whose fields are annotated with what the bus needs to know of them, some of it by the
process: names, units, ranges and the sizes of arrays. A *block* gives a record its place in the address space and its
writer; a *map* is all blocks of one server, for one process. Tables, accessors, checks and documentation follow from
these three.
"""

import hashlib
import json
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum, IntEnum, StrEnum
from functools import cache, cached_property, partial
from typing import NamedTuple, Self, TypeAlias, cast, get_type_hints

from coldloop.process import cold_box, declaration


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


class Worded(IntEnum):
    """An enumeration of registers, whose members carry their texts: `MPC = 1, "MPC"`; without one, it is the word."""

    text: str
    """Name of the member in registers, page and documentation."""

    def __new__(cls, value: int, _text: str = "") -> Self:
        """Make a member of its number."""
        member = int.__new__(cls, value)
        member._value_ = value
        return member

    def __init__(self, _value: int, text: str = "") -> None:
        self.text = text or self.word

    @property
    def word(self) -> str:
        """Its name in plain words, by which records and commands know it: ALARM_RAISED is "alarm raised"."""
        return self.name.lower().replace("_", " ")

    @classmethod
    def within(cls, low: float, high: float) -> list[Self]:
        """Return the members from one number to another."""
        return [one for one in cls if low <= one <= high]

    @classmethod
    def word_of(cls, number: int) -> str:
        """Return the word for a number of a peer; a newer one may have numbers without a word here."""
        return cls(number).word if number in cls._value2member_map_ else str(number)


@dataclass(frozen=True, slots=True)
class Field:
    """Declaration of one field of a record: type, unit, range and meaning.

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
    values: type[Worded] | None = None
    """Meaning of the numbers of an enumeration."""
    is_text: bool = False
    """The elements are the words of a text (`registers.codec`)."""
    finite: bool = True
    """No NaN and no infinity; where they are allowed, the user of the value checks it."""
    each: tuple["Field", ...] = ()
    """Declarations of the elements of an array whose elements are registers of their own names, meanings and ranges."""

    @property
    def registers(self) -> Iterator[tuple[str, "Field"]]:
        """The registers of the field: what is behind its name in theirs, and the declaration of each."""
        if self.each:
            yield from zip(self.elements, self.each, strict=True)
            return
        for place, element in enumerate(self.elements or ("",)):
            yield element, replace(self, unit=self.units[place]) if self.units else self

    @property
    def words(self) -> int:
        """Number of 16-bit words."""
        return self.kind.words * max(1, len(self.elements))


def u16(
    description: str, *, unit: str = "", low: int | None = None, high: int | None = None,
    values: type[Worded] | None = None,
) -> Field:  # fmt: skip
    """Declare an unsigned 16-bit register.

    `values` gives an enumeration's numbers their meaning, and their range; `{}` in the description lists them.
    """
    lowest, highest = (0, 0xFFFF) if values is None else (min(values), max(values))
    least, most = lowest if low is None else low, highest if high is None else high
    if values is not None:
        description = description.format(", ".join(f"{one.value} {one.text}" for one in values.within(least, most)))
    return Field(Kind.U16, description, unit, least, most, values=values)


u32 = partial(Field, Kind.U32)
"""Declare an unsigned 32-bit register pair."""
f32 = partial(Field, Kind.F32)
"""Declare an IEEE-754 single-precision register pair, or one for each of `elements`, in `units`, all of one range."""


def text(description: str, words: int) -> Field:
    """Declare a text of two ASCII characters a word, padded with zeros; `registers.codec` converts it."""
    return Field(Kind.U16, description, elements=tuple(f"{word}" for word in range(words)), is_text=True)


Numbers: TypeAlias = tuple[float, ...]
"""Values of an array."""
Declared: TypeAlias = Field | Callable[[declaration.Process], Field]
"""A declaration, or what it is for a process."""


def in_ticks(field: Field) -> Declared:
    """Declare a number of ticks."""
    return lambda process: replace(field, unit=process.tick_unit)


def of_load(description: str, *, in_span: bool = False, low: float | None = None, finite: bool = True) -> Declared:
    """Declare a value in the unit of the load: `{noun}` and `{word}` are what the load is called, `{name}` its name."""

    def declared(process: declaration.Process) -> Field:
        load = process.load
        least, largest = load.span if in_span else (low, None)
        words = description.format(noun=load.noun, name=load.name, word=load.word or load.name)
        return f32(words[0].upper() + words[1:], unit=load.unit, low=least, high=largest, finite=finite)

    return declared


def _of_each(
    signals: str, description: str, *, low: float | None = None, high: float | None = None, finite: bool = True,
    unit: str | None = None, in_span: bool = False,
) -> Declared:  # fmt: skip
    def declared(process: declaration.Process) -> Field:
        each = getattr(process, signals)
        names, units = tuple(one.name for one in each), tuple(one.unit if unit is None else unit for one in each)
        least, largest = process.span_of_inputs if in_span else (low, high)
        return f32(description, low=least, high=largest, elements=names, units=units, finite=finite)

    return declared


of_inputs = partial(_of_each, "inputs")
"""Declare a value for each input; `in_span`: none is outside of all their spans."""
of_outputs = partial(_of_each, "outputs")
"""Declare a value for each output, in its unit or in this one."""
of_states = partial(_of_each, "states")
"""Declare a value for each state of the model."""
of_banded = partial(_of_each, "banded")
"""Declare a value for each output that has a band."""


def each_input(description: str, *, in_span: bool = True) -> Declared:
    """Declare a register for each input, of its own name, span and meaning, which `{}` stands for."""

    def declared(process: declaration.Process) -> Field:
        inputs = process.inputs
        return Field(
            Kind.F32, description.format("Input"), elements=tuple(one.tag for one in inputs),
            units=process.input_units,
            each=tuple(
                f32(description.format(one.description), unit=one.unit, low=one.span[0] if in_span else None,
                    high=one.span[1] if in_span else None)
                for one in inputs
            ),
        )  # fmt: skip

    return declared


@cache
def fields_of(record: type[tuple[object, ...]], process: declaration.Process = cold_box.COLD_BOX) -> dict[str, Field]:
    """Return the declared fields of a record class for a process, in their order."""
    declared: dict[str, Field] = {}
    for name, hint in get_type_hints(record, include_extras=True).items():
        metadata = [item for item in getattr(hint, "__metadata__", ()) if isinstance(item, Field) or callable(item)]
        if len(metadata) != 1:
            raise TypeError(f"{record.__name__}.{name} needs exactly one register declaration")
        declared[name] = metadata[0] if isinstance(metadata[0], Field) else metadata[0](process)
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
    values: type[Worded] | None = None
    """Enumeration of its numbers."""

    @property
    def meanings(self) -> list[Worded]:
        """The members of its enumeration that are within its range; of other registers none."""
        return self.values.within(self.low or 0, self.high or 0) if self.values else []


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
    """Each row ends with the CRC-32 of the words before it (`coldloop.registers.codec`)."""
    process: declaration.Process = cold_box.COLD_BOX
    """Process that sizes, names, units and ranges are of."""

    def __hash__(self) -> int:
        return hash((self.name, self.address, self.record, self.process))  # codecs are found by it in each tick

    @cached_property
    def fields(self) -> Mapping[str, Field]:
        """The declared fields of its record."""
        return fields_of(self.record, self.process)

    @cached_property
    def elements(self) -> tuple[tuple[str, Field], ...]:
        """Name and declaration of each register of a row."""
        return tuple(
            (element if declared.each else f"{name}.{element}" if element else name, field)
            for name, declared in self.fields.items()
            for element, field in declared.registers
        )

    @cached_property
    def row_words(self) -> int:
        """Words of one row."""
        return sum(field.words for field in self.fields.values())

    @property
    def end(self) -> int:
        """First address behind the block."""
        return self.address + self.row_words * self.rows

    @cached_property
    def letters(self) -> str:
        """`struct` letters of one row, without byte order."""
        return "".join(field.kind.letter * max(1, len(field.elements)) for field in self.fields.values())

    def registers(self, row: int = 0) -> Iterator[Register]:
        """Yield the registers of one row."""
        address = self.address + row * self.row_words
        for name, field in self.elements:
            yield Register(
                self.name, name, address, field.kind, field.unit, field.low, field.high, self.writer,
                field.description, field.values,
            )  # fmt: skip
            address += field.kind.words


def placed(process: declaration.Process, blocks: Iterable[Block]) -> tuple[Block, ...]:
    """Return the blocks of a process, at their addresses, or after a longer one before them."""
    found: list[Block] = []
    for block in blocks:
        end = found[-1].end if found else 0
        found.append(replace(block, process=process, address=max(block.address, end)))
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
    def process(self) -> declaration.Process:
        """The process that it is for."""
        return self.blocks[0].process

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
