"""Records to register words and back: their ranges, their values in words, their seals, their texts.

Servers check writes by the declared ranges, clients what they read, and programs the records of a file.
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from enum import Enum, StrEnum
from functools import cache, lru_cache, partial
from itertools import accumulate, chain
from operator import itemgetter
from typing import Any, Final, NamedTuple, TypeVar, cast

from coldloop.registers.declaration import Block, Field, Kind, RegisterMap

R = TypeVar("R", bound=tuple[Any, ...])

WIDEST: Final = {Kind.U16: (0, 0xFFFF), Kind.U32: (0, 0xFFFF_FFFF), Kind.F32: (-math.inf, math.inf)}
"""Range of the values that a register can hold."""


class DomainError(ValueError):
    """A value that its register cannot have."""


class _Run(NamedTuple):
    """Neighbouring values with the same range."""

    start: int
    end: int
    low: float
    high: float


class Domain:
    """The ranges of a run of registers: one field for each, also of an array; their names are for messages."""

    def __init__(self, fields: Sequence[Field], names: Sequence[str]) -> None:
        self._fields = fields
        self._names = names
        self._runs: list[_Run] = []
        """Runs of values whose range is narrower than what their registers can hold."""
        for place, field in enumerate(fields):
            low, high = _stored_range(field)
            if (low, high) == WIDEST[field.kind]:
                continue
            if self._runs and self._runs[-1][1:] == (place, low, high):
                self._runs[-1] = self._runs[-1]._replace(end=place + 1)
            else:
                self._runs.append(_Run(place, place + 1, low, high))

    def check(self, values: Sequence[Any]) -> None:
        """Check values, one for each register.

        Raises:
            DomainError: One is out of its range, or not finite where it has to be.
        """
        if math.isfinite(sum(values)):  # one pass instead of a look at each
            for start, end, low, high in self._runs:
                if end == start + 1:
                    if not low <= values[start] <= high:
                        break
                elif min(run := values[start:end]) < low or max(run) > high:
                    break
            else:
                return
        for value, field, name in zip(values, self._fields, self._names, strict=True):
            _check_value(value, field, name)


def _stored_range(field: Field) -> tuple[float, float]:
    """Return the range as values are rounded: 0.01 is stored as a little less, and is still in a range from 0.01."""
    lowest, highest = WIDEST[field.kind]
    low, high = lowest if field.low is None else field.low, highest if field.high is None else field.high
    if field.kind is Kind.F32:
        low, high = struct.unpack("2f", struct.pack("2f", low, high))
    return low, high


def _check_value(value: float, field: Field, name: str) -> None:
    if not math.isfinite(value):
        if field.finite:
            raise DomainError(f"{name} is not a finite number")
        return
    low, high = _stored_range(field)
    if value < low:
        raise DomainError(f"{name} = {value:g} is below {field.low:g} {field.unit}".rstrip())
    if value > high:
        raise DomainError(f"{name} = {value:g} is above {field.high:g} {field.unit}".rstrip())


@cache
def domain_of(block: Block) -> Domain:
    """Return the (shared) domain of the rows of a block."""
    names, fields = zip(*block.elements, strict=True)
    return Domain(fields, names)


class WordOrder(StrEnum):
    """Order of the halves of a 32-bit value: which is at the lower address."""

    HIGH_FIRST = "high-first"
    LOW_FIRST = "low-first"  # the habit of Schneider's PLCs


_Places = Callable[[tuple[Any, ...]], tuple[Any, ...]]
"""Takes a tuple apart, or puts one together."""


class ValueCodec:
    """Packs a run of registers, given by their `struct` letters, as they travel on the bus."""

    def __init__(self, letters: str, order: WordOrder) -> None:
        self._struct = struct.Struct(">" + letters)
        self._swaps: list[int] | None = None
        """Place of each word in the other order."""
        if order is WordOrder.LOW_FIRST:
            self._swaps = []
            for letter in letters:
                place = len(self._swaps)
                self._swaps += [place] if letter == "H" else [place + 1, place]
        self._words = struct.Struct(f">{self._struct.size // 2}H")
        self.size = self._struct.size

    def pack(self, values: Iterable[Any]) -> bytes:
        """Return the bytes of `values`.

        Raises:
            struct.error, OverflowError: A value does not fit its register.
        """
        raw = self._struct.pack(*values)
        return raw if self._swaps is None else self._reordered(raw)

    def unpack(self, data: bytes | bytearray | memoryview, offset: int = 0) -> tuple[Any, ...]:
        """Return the values that stand in `data` at `offset` (bytes)."""
        if self._swaps is not None:
            data, offset = self._reordered(data[offset : offset + self.size]), 0
        return self._struct.unpack_from(data, offset)

    def canonical(self, data: bytes | bytearray | memoryview, offset: int = 0) -> bytes:
        """Return the bytes of the values that stand in `data` at `offset`, with the high words first, bit for bit."""
        raw = data if len(data) == self.size else data[offset : offset + self.size]
        return bytes(raw) if self._swaps is None else self._reordered(raw)

    def _reordered(self, raw: bytes | bytearray | memoryview) -> bytes:
        words = self._words.unpack(raw)
        return self._words.pack(*[words[source] for source in self._swaps or ()])


CRC_BYTES: Final = 4
_ABSENT: Final = bytes(CRC_BYTES)


class Seal(Enum):
    """Result of the check of a record's seal.

    TCP's checksum does not see what a gateway, a proxy or a memory does to a value. A sealed record ends with the
    CRC-32 of all before it, as big-endian words whatever the word order of the link; 0 is "not sealed", as a simple
    client leaves it. A seal is checked on the bytes that arrived: decoding changes some of them (a signalling NaN
    becomes a quiet one).
    """

    ABSENT = "absent"
    INTACT = "intact"
    BROKEN = "broken"


class RecordCodec:
    """Encodes the rows of one block."""

    def __init__(self, block: Block, order: WordOrder) -> None:
        self._values = ValueCodec(block.letters, order)
        self._of_rows = lru_cache(maxsize=64)(lambda rows: ValueCodec(rows * block.letters, order))
        self._domain = domain_of(block)
        self._parts, self._fields = _places_of([len(field.elements) for field in block.fields.values()])
        self._length = len(block.letters)
        self._make: _Places = partial(tuple.__new__, block.record)
        self.size = self._values.size
        self.canonical = self._values.canonical

    def encode(self, record: tuple[Any, ...]) -> bytes:
        """Return the row's bytes.

        Raises:
            struct.error, OverflowError: A value does not fit its register.
        """
        return self._values.pack(record if self._parts is None else chain.from_iterable(self._parts(record)))

    def encode_rows(self, records: Sequence[tuple[Any, ...]]) -> bytes:
        """Return the bytes of rows one after the other, as `encode` does of one."""
        parts = records if self._parts is None else chain.from_iterable(map(self._parts, records))
        return self._of_rows(len(records)).pack(chain.from_iterable(parts))

    def decode_rows(self, data: bytes | bytearray | memoryview, offset: int, rows: int) -> list[tuple[Any, ...]]:
        """Return the records of rows that follow each other in `data` from `offset` (bytes) on."""
        values, each = self._of_rows(rows).unpack(data, offset), self._length
        found = [values[start : start + each] for start in range(0, rows * each, each)]
        return list(map(self._make, found if self._fields is None else map(self._fields, found)))

    def decode(self, data: bytes | bytearray | memoryview, offset: int = 0) -> tuple[Any, ...]:
        """Return the record in `data` at `offset` (bytes)."""
        values = self._values.unpack(data, offset)
        return self._make(values if self._fields is None else self._fields(values))

    def decode_checked(self, data: bytes | bytearray | memoryview, offset: int = 0) -> tuple[Any, ...]:
        """Return the record in `data` at `offset` (bytes), made by another program.

        Registers that have not been written yet are all 0, whatever their ranges.

        Raises:
            DomainError: A value is not one that its register can have.
        """
        values = self._values.unpack(data, offset)
        try:
            self._domain.check(values)
        except DomainError:
            if any(values):
                raise
        return self._make(values if self._fields is None else self._fields(values))

    def check(self, record: tuple[Any, ...]) -> None:
        """Check a record that has not come by the bus.

        Raises:
            DomainError: A value is not one that its register can have.
        """
        try:
            values = self._values.unpack(self.encode(record))
        except (struct.error, OverflowError) as error:
            raise DomainError(f"a value does not fit its register: {error}") from None
        self._domain.check(values)

    def encode_sealed(self, record: tuple[Any, ...]) -> bytes:
        """Return the bytes of the row with its seal."""
        raw = self.canonical(self.encode(record))
        return self.canonical(raw[:-CRC_BYTES] + _checksum(raw))  # words back in order

    def seal_of(self, data: bytes | bytearray | memoryview, offset: int = 0) -> Seal:
        """Return what the seal says of the record in `data` at `offset` (bytes)."""
        raw = self.canonical(data, offset)
        crc = raw[-CRC_BYTES:]
        if crc == _ABSENT:
            return Seal.ABSENT
        return Seal.INTACT if crc == _checksum(raw) else Seal.BROKEN


def _places_of(arrays: list[int]) -> tuple[_Places | None, _Places | None]:
    """Return what takes a record to tuples of values, and all values to its fields; None where each field is a value.

    Args:
        arrays: Elements of each field, 0 where it is a value.
    """
    if not any(arrays):
        return None, None
    parts = [place if elements else slice(place, place + 1) for place, elements in enumerate(arrays)]
    ends = list(accumulate(elements or 1 for elements in arrays))
    fields = [slice(end - elements, end) if elements else end - 1 for end, elements in zip(ends, arrays, strict=True)]
    if len(arrays) == 1:  # a getter of one place returns what is there, not a tuple of it
        return itemgetter(slice(1)), lambda values: (values,)
    return itemgetter(*parts), itemgetter(*fields)


@cache
def codec_of(block: Block, order: WordOrder = WordOrder.HIGH_FIRST) -> RecordCodec:
    """Return the (shared) codec of a block."""
    return RecordCodec(block, order)


def check_record(record: tuple[Any, ...], of: RegisterMap) -> None:
    """Check a record of a map that has not come by the bus, but from a file.

    Raises:
        DomainError: A value is not one that its register can have.
    """
    codec_of(of.block_of(type(record))).check(record)


def as_transmitted(record: R, of: RegisterMap) -> R:
    """Return a record of a map as its reader sees it after a journey over the bus: each float in single precision."""
    codec = codec_of(of.block_of(type(record)))
    return cast("R", codec.decode(codec.encode(record)))


def blank(record: type[R], of: RegisterMap) -> R:
    """Return the record of a map whose registers are all 0."""
    block = of.block_of(record)
    return cast("R", codec_of(block).decode(bytes(2 * block.row_words)))


def sealed(record: R, of: RegisterMap) -> R:
    """Return a record of a map with its field `crc`, the last one, filled in."""
    crc = _checksum(codec_of(of.block_of(type(record))).encode(record))
    return cast("R", record._replace(crc=int.from_bytes(crc, "big")))  # type: ignore[attr-defined] # a NamedTuple


def _checksum(raw: bytes) -> bytes:
    return (zlib.crc32(raw[:-CRC_BYTES]) or 1).to_bytes(CRC_BYTES, "big")


@lru_cache(maxsize=256)
def to_words(text: str, words: int) -> tuple[int, ...]:
    """Return a text as `words` register values; what is too long is cut off."""
    raw = _printable(text).encode("ascii")[: 2 * words].ljust(2 * words, b"\0")
    return tuple(int.from_bytes(raw[place : place + 2], "big") for place in range(0, 2 * words, 2))


def from_words(words: tuple[int, ...]) -> str:
    """Return the text that register values hold."""
    raw = b"".join(word.to_bytes(2, "big") for word in words).rstrip(b"\0")
    return _printable(raw.decode("ascii", errors="replace"))


def _printable(text: str) -> str:
    return "".join(character if " " <= character <= "~" else "?" for character in text)
