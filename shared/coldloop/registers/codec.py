"""Records to register words and back."""

import struct
from collections.abc import Iterable
from enum import StrEnum
from functools import cache
from typing import Any, TypeVar, cast

from coldloop.registers.declaration import Block, RegisterMap
from coldloop.registers.domain import DomainError, domain_of

R = TypeVar("R", bound=tuple[Any, ...])


class WordOrder(StrEnum):
    """Which half of a 32-bit value is at the lower address."""

    HIGH_FIRST = "high-first"
    LOW_FIRST = "low-first"  # the habit of Schneider's PLCs


class ValueCodec:
    """Packs a run of registers, given by their `struct` letters, as they travel on the bus."""

    def __init__(self, letters: str, order: WordOrder) -> None:
        self._struct = struct.Struct(">" + letters)
        self._swaps = _swapped_words(letters) if order is WordOrder.LOW_FIRST else None
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

    def canonical(self, raw: bytes | bytearray | memoryview) -> bytes | bytearray | memoryview:
        """Return the same values with the high words first, bit for bit."""
        return raw if self._swaps is None else self._reordered(raw)

    def _reordered(self, raw: bytes | bytearray | memoryview) -> bytes:
        words = self._words.unpack(raw)
        return self._words.pack(*[words[source] for source in self._swaps or ()])


class RecordCodec:
    """Encodes the rows of one block."""

    def __init__(self, block: Block, order: WordOrder) -> None:
        self._values = ValueCodec(block.letters, order)
        self._record = block.record
        self._domain = domain_of(block)
        self._arrays = [len(field.elements) for field in block.fields.values()]
        self._flat = not any(self._arrays)
        self.size = self._values.size

    def encode(self, record: tuple[Any, ...]) -> bytes:
        """Return the row's bytes.

        Raises:
            struct.error, OverflowError: A value does not fit its register.
        """
        return self._values.pack(record if self._flat else self._flattened(record))

    def decode(self, data: bytes | bytearray | memoryview, offset: int = 0) -> tuple[Any, ...]:
        """Return the record in `data` at `offset` (bytes)."""
        return self._made_of(self._values.unpack(data, offset))

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
        return self._made_of(values)

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

    def _made_of(self, values: tuple[Any, ...]) -> tuple[Any, ...]:
        return self._record(*(values if self._flat else self._nested(values)))

    def canonical(self, data: bytes | bytearray | memoryview, offset: int = 0) -> bytes | bytearray | memoryview:
        """Return the row's bytes that stand in `data` at `offset`, with the high words first, bit for bit."""
        return self._values.canonical(data[offset : offset + self.size])

    def _flattened(self, record: tuple[Any, ...]) -> list[Any]:
        flat: list[Any] = []
        for value, elements in zip(record, self._arrays, strict=True):
            if elements:
                flat += value
            else:
                flat.append(value)
        return flat

    def _nested(self, values: tuple[Any, ...]) -> list[Any]:
        nested: list[Any] = []
        start = 0
        for elements in self._arrays:
            nested.append(values[start : start + elements] if elements else values[start])
            start += elements or 1
        return nested


def _swapped_words(letters: str) -> list[int]:
    swapped: list[int] = []
    for letter in letters:
        position = len(swapped)
        swapped += [position] if letter == "H" else [position + 1, position]
    return swapped


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
