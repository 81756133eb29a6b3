"""The registers of one server, held in memory, with every check that a write must pass."""

import math
import struct
from bisect import bisect_left
from dataclasses import replace
from typing import Any, TypeVar, cast

from coldloop.registers.codec import RecordCodec, WordOrder, codec_of
from coldloop.registers.declaration import Block, Field, Kind, RegisterMap, fields_of

R = TypeVar("R", bound=tuple[Any, ...])

FIRST_HALF, SECOND_HALF = 1, 2


class RefusedAccessError(Exception):
    """A read or write that the map does not allow; carries the Modbus exception code."""

    def __init__(self, exception_code: int, reason: str) -> None:
        super().__init__(reason)
        self.exception_code = exception_code


class IllegalAddressError(RefusedAccessError):
    """Exception 02: a register that does not exist, or may not be written."""

    def __init__(self, reason: str) -> None:
        super().__init__(2, reason)


class IllegalValueError(RefusedAccessError):
    """Exception 03: a value outside its range, not finite, or half of a 32-bit register pair."""

    def __init__(self, reason: str) -> None:
        super().__init__(3, reason)


class RegisterBank:
    """Memory of one register map.

    The program behind the server reads and writes whole records (`get`, `put`); the server reads and writes words
    (`read`, `write`). Both are atomic: nothing here awaits.
    """

    def __init__(self, register_map: RegisterMap, order: WordOrder = WordOrder.HIGH_FIRST) -> None:
        self.map = register_map
        self.order = order
        self._memory = bytearray(2 * 0x10000)
        self._declared = bytearray(0x10000)
        self._writable = bytearray(0x10000)
        self._halves = bytearray(0x10000)
        self._places: dict[type[tuple[Any, ...]], tuple[Block, RecordCodec]] = {}
        self._checks: list[tuple[int, Kind, Field, str]] = []
        for block in register_map.blocks:
            self._declare(block)
        self._check_addresses = [address for address, *_ in self._checks]

    def _declare(self, block: Block) -> None:
        size = block.end - block.address
        self._declared[block.address : block.end] = b"\1" * size
        self._places[block.record] = block, codec_of(block, self.order)
        if block.writer is not None:
            self._writable[block.address : block.end] = b"\1" * size
        fields = {name: _with_stored_bounds(field) for name, field in fields_of(block.record).items()}
        for row in range(block.rows):
            for register in block.registers(row):
                if register.kind.words == 2:
                    self._halves[register.address] = FIRST_HALF
                    self._halves[register.address + 1] = SECOND_HALF
                if block.writer is not None:
                    field = fields[register.name.split(".")[0]]
                    self._checks.append((register.address, register.kind, field, f"{block.name}.{register.name}"))

    def get(self, record: type[R], row: int = 0) -> R:
        """Return a row of the block that holds `record`."""
        block, codec = self._places[record]
        return cast("R", codec.decode(self._memory, 2 * block.address + row * codec.size))

    def put(self, record: tuple[Any, ...], row: int = 0) -> None:
        """Store a row of the block that holds this type of record."""
        block, codec = self._places[type(record)]
        start = 2 * block.address + row * codec.size
        self._memory[start : start + codec.size] = codec.encode(record)

    def read(self, address: int, count: int) -> bytes:
        """Return `count` words from `address` on.

        Raises:
            IllegalAddressError: One of them is not declared.
        """
        end = address + count
        if end > 0x10000 or self._declared.find(0, address, end) >= 0:
            raise IllegalAddressError(f"no register at some of {address}..{end - 1}")
        return bytes(self._memory[2 * address : 2 * end])

    def check_write(self, address: int, data: bytes) -> None:
        """Raise what `write` would raise, store nothing.

        Raises:
            IllegalAddressError: A register does not exist or is read-only.
            IllegalValueError: A value is out of range, or half of a 32-bit value.
        """
        end = address + len(data) // 2
        if end > 0x10000 or self._writable.find(0, address, end) >= 0:
            raise IllegalAddressError(f"no writable register at some of {address}..{end - 1}")
        if self._halves[address] == SECOND_HALF or self._halves[end - 1] == FIRST_HALF:
            raise IllegalValueError(
                f"a 32-bit register is written whole or not at all, {address}..{end - 1} halves one"
            )
        for register_address, kind, field, name in self._checks[
            bisect_left(self._check_addresses, address) : bisect_left(self._check_addresses, end)
        ]:
            start = 2 * (register_address - address)
            _check_value(self._value(kind, data[start : start + 2 * kind.words]), field, name)

    def write(self, address: int, data: bytes) -> list[Block]:
        """Check and store words from `address` on; return the blocks that they fall in."""
        self.check_write(address, data)
        end = address + len(data) // 2
        self._memory[2 * address : 2 * end] = data
        return [block for block in self.map.blocks if block.address < end and address < block.end]

    def _value(self, kind: Kind, raw: bytes) -> float:
        if self.order is WordOrder.LOW_FIRST and kind.words == 2:
            raw = raw[2:] + raw[:2]
        return cast("float", struct.unpack(">" + kind.letter, raw)[0])


def _check_value(value: float, field: Field, name: str) -> None:
    if not math.isfinite(value):
        raise IllegalValueError(f"{name} is not a finite number")
    if field.low is not None and value < field.low:
        raise IllegalValueError(f"{name} = {value:g} is below {field.low:g} {field.unit}".rstrip())
    if field.high is not None and value > field.high:
        raise IllegalValueError(f"{name} = {value:g} is above {field.high:g} {field.unit}".rstrip())


def _with_stored_bounds(field: Field) -> Field:
    """Round the bounds as values are rounded: 0.01 is stored as a little less, and is still in a range from 0.01."""
    if field.kind is not Kind.F32:
        return field
    low, high = (
        None if bound is None else struct.unpack("f", struct.pack("f", bound))[0] for bound in (field.low, field.high)
    )
    return replace(field, low=low, high=high)
