"""The registers of one server, held in memory, with every check that a write must pass."""

from bisect import bisect_left
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

from coldloop.registers.codec import Domain, DomainError, RecordCodec, Seal, ValueCodec, WordOrder, codec_of
from coldloop.registers.declaration import Block, Field, Kind, RegisterMap, Role

R = TypeVar("R", bound=tuple[Any, ...])

FIRST_HALF, SECOND_HALF = 1, 2
ALL_ROLES = frozenset(Role)
MAX_SPANS = 512
"""Ranges that clients write to are remembered up to this number, and those that they read."""


class Caller(NamedTuple):
    """Who makes a request: its name in messages, its roles, and which connection of the server it is."""

    name: str
    roles: frozenset[Role]
    connection: int = 0

    @property
    def station(self) -> str:
        """Name without the port: what stays when the same client connects again."""
        address, _, rest = self.name.partition(" ")
        return f"{address.rpartition(':')[0] or address} {rest}"


ANYBODY = Caller("program", ALL_ROLES)
"""Who may write everything: the program itself, and tests."""


class RefusedAccessError(Exception):
    """A read or write that the map does not allow; its kind says the Modbus exception code."""

    exception_code: int


class IllegalFunctionError(RefusedAccessError):
    """Exception 01: a function that is not served."""

    exception_code = 1


class ForbiddenWriteError(RefusedAccessError):
    """Exception 01: a register that another role writes, as Modbus/TCP Security asks for where a role is refused."""

    exception_code = 1


class IllegalAddressError(RefusedAccessError):
    """Exception 02: a register that does not exist, or may not be written."""

    exception_code = 2


class IllegalValueError(RefusedAccessError):
    """Exception 03: a value outside its range, not finite, or half of a 32-bit register pair."""

    exception_code = 3


class BusyError(RefusedAccessError):
    """Exception 06: another client holds the lease of this role."""

    exception_code = 6


Judge = Callable[[Any, int, Caller], None]
"""Takes a record that a write would result in, its row and who writes; raises `RefusedAccessError` to refuse it."""


class RegisterBank:
    """Memory of one register map.

    The program behind the server reads and writes whole records (`get`, `put`); the server reads and writes words
    (`read`, `write`). Both are atomic: nothing here awaits.

    A write is judged as the whole records that it would result in, also when it changes a part of them: by the declared
    ranges, by their seals, and by the judges of the program. Nothing is stored unless all of it may be.
    """

    def __init__(self, register_map: RegisterMap, order: WordOrder = WordOrder.HIGH_FIRST) -> None:
        self.map = register_map
        self.order = order
        self._memory = bytearray(2 * 0x10000)
        self._view = memoryview(self._memory)
        self._writable = bytearray(0x10000)
        self._halves = bytearray(0x10000)
        self._places: dict[type[tuple[Any, ...]], tuple[Block, RecordCodec]] = {}
        self._checks: list[tuple[int, Kind, Field, str]] = []
        self._spans: dict[tuple[int, int], _Span] = {}
        self._judges: dict[type[tuple[Any, ...]], tuple[Judge, bool]] = {}
        self._live: dict[type[tuple[Any, ...]], Callable[[], None]] = {}
        """Functions that bring a record up to date, by its type."""
        self._read_spans: dict[tuple[int, int], list[Callable[[], None]]] = {}
        """The same for the words that clients read."""
        for block in register_map.blocks:
            size, codec = block.end - block.address, codec_of(block, order)
            self._places[block.record] = block, codec
            if block.writer is not None:
                self._writable[block.address : block.end] = b"\1" * size
            elif block.sealed:  # no seal is damage to those who read, also before there is anything
                self.put_sealed(codec.decode(bytes(2 * size)))
            for row in range(block.rows):
                for register, (_, field) in zip(block.registers(row), block.elements, strict=True):
                    if register.kind.words == 2:
                        self._halves[register.address : register.address + 2] = bytes((FIRST_HALF, SECOND_HALF))
                    if block.writer is not None:
                        self._checks.append((register.address, register.kind, field, f"{block.name}.{register.name}"))
        self._check_addresses = [address for address, *_ in self._checks]

    def get(self, record: type[R], row: int = 0) -> R:
        """Return a row of the block that holds `record`."""
        if record in self._live:
            self._live[record]()
        block, codec = self._places[record]
        return cast("R", codec.decode(self._memory, 2 * block.address + row * codec.size))

    def get_rows(self, record: type[R], count: int) -> list[R]:
        """Return the first rows of the block that holds `record`."""
        block, codec = self._places[record]
        return cast("list[R]", codec.decode_rows(self._memory, 2 * block.address, count))

    def put(self, record: tuple[Any, ...], row: int = 0) -> None:
        """Store a row of the block that holds this type of record."""
        block, codec = self._places[type(record)]
        start = 2 * block.address + row * codec.size
        self._memory[start : start + codec.size] = codec.encode(record)

    def put_sealed(self, record: tuple[Any, ...]) -> None:
        """Store the row of a sealed block, with its seal."""
        block, codec = self._places[type(record)]
        start = 2 * block.address
        self._memory[start : start + codec.size] = codec.encode_sealed(record)

    def judged_by(self, judge: Judge, *records: type[tuple[Any, ...]], every_row: bool = True) -> None:
        """Let `judge` have a say in what clients write to the blocks of these records: in every row, or in the first.

        The first is enough where the judge asks who writes, and not what.
        """
        for record in records:
            self._judges[record] = judge, every_row
        self._spans.clear()

    def keep_fresh(self, record: type[tuple[Any, ...]], present: Callable[[], tuple[Any, ...] | None]) -> None:
        """Store `present()`, sealed where the block is, whenever somebody reads from the block that holds `record`.

        None leaves it as it is. What changes in each tick, and is read now and then, costs nothing in between.
        """
        block, _ = self._places[record]
        store = self.put_sealed if block.sealed else self.put

        def refresh() -> None:
            newest = present()
            if newest is not None:
                store(newest)

        self._live[record] = refresh
        self._read_spans.clear()

    def check_readable(self, address: int, count: int) -> None:
        """Check that `count` words from `address` on may be read: all up to the end of the map, gaps included.

        Raises:
            IllegalAddressError: They reach beyond the end of the map.
        """
        if address + count > self.map.end:
            raise IllegalAddressError(
                f"no register at some of {address}..{address + count - 1}: the map ends at {self.map.end - 1}"
            )

    def read(self, address: int, count: int) -> bytes:
        """Return `count` words from `address` on; words in the gaps between blocks are 0.

        Raises:
            IllegalAddressError: They reach beyond the end of the map.
        """
        stale = self._read_spans.get((address, count))
        for refresh in self._read_span(address, count) if stale is None else stale:
            refresh()
        return bytes(self._view[2 * address : 2 * (address + count)])

    def _read_span(self, address: int, count: int) -> list[Callable[[], None]]:
        """Return what brings the words that are to be read up to date, and remember it."""
        self.check_readable(address, count)
        if len(self._read_spans) >= MAX_SPANS:
            self._read_spans.clear()
        self._read_spans[address, count] = found = [
            refresh
            for record, refresh in self._live.items()
            if address < self._places[record][0].end and self._places[record][0].address < address + count
        ]
        return found

    def write(self, address: int, data: bytes, caller: Caller = ANYBODY) -> list[Block]:
        """Judge and store words, high byte first, from `address` on; return the blocks that they fall in.

        Raises:
            IllegalAddressError: A register does not exist or is read-only.
            ForbiddenWriteError: A register is not for the roles of the caller to write.
            IllegalValueError: A value is out of range, half of a 32-bit value, or does not fit the rest of its record.
            BusyError: Another client holds the lease of the role.
        """
        words = len(data) // 2
        span = self._spans.get((address, words))
        if span is None:
            span = self._make_span(address, words, caller.roles)
            if len(self._spans) >= MAX_SPANS:
                self._spans.clear()
            self._spans[address, words] = span
        elif not span.writers <= caller.roles:
            raise _forbidden(span.blocks, caller.roles)
        image = data
        if span.first != address or span.end != address + words:  # a part of a record: the rest stays
            offset = 2 * (address - span.first)
            image = bytes(self._memory[2 * span.first : 2 * address]) + data
            image += self._memory[2 * span.first + offset + len(data) : 2 * span.end]
        try:
            span.domain.check(span.codec.unpack(image))
        except DomainError as error:
            raise IllegalValueError(str(error)) from None
        for codec, offset, name in span.sealed:
            if codec.seal_of(image, offset) is Seal.BROKEN:
                raise IllegalValueError(f"the CRC of block '{name}' is not that of its registers: write all of them")
        for judge, codec, offset, row in span.judged:
            judge(codec.decode(image, offset), row, caller)
        self._memory[2 * span.first : 2 * span.end] = image
        return span.blocks

    def _make_span(self, address: int, words: int, roles: frozenset[Role]) -> "_Span":
        end = address + words
        if end > 0x10000 or self._writable.find(0, address, end) >= 0:
            raise IllegalAddressError(f"no writable register at some of {address}..{end - 1}")
        blocks = [block for block in self.map.blocks if block.address < end and address < block.end]
        writers = frozenset(block.writer for block in blocks if block.writer is not None)
        if not writers <= roles:  # before anything else: who may not write learns nothing by trying
            raise _forbidden(blocks, roles)
        if self._halves[address] == SECOND_HALF or self._halves[end - 1] == FIRST_HALF:
            raise IllegalValueError(
                f"a 32-bit register is written whole or not at all, {address}..{end - 1} halves one"
            )
        rows = [(block, row) for block in blocks for row in _touched_rows(block, address, end)]
        first = rows[0][0].address + rows[0][1] * rows[0][0].row_words
        end = rows[-1][0].address + (rows[-1][1] + 1) * rows[-1][0].row_words
        checks = self._checks[bisect_left(self._check_addresses, first) : bisect_left(self._check_addresses, end)]
        sealed: list[tuple[RecordCodec, int, str]] = []
        judged: list[tuple[Judge, RecordCodec, int, int]] = []
        before: Block | None = None
        for block, row in rows:
            codec, offset = self._places[block.record][1], 2 * (block.address + row * block.row_words - first)
            if block.sealed:
                sealed.append((codec, offset, block.name))
            judge, every_row = self._judges.get(block.record, (None, False))
            if judge is not None and (every_row or block is not before):
                judged.append((judge, codec, offset, row))
            before = block
        values = ValueCodec("".join(kind.letter for _, kind, _, _ in checks), self.order)
        domain = Domain([field for *_, field, _ in checks], [name for *_, name in checks])
        return _Span(first, end, values, domain, blocks, writers, sealed, judged)


class _Span(NamedTuple):
    """Properties of a writable range of words, whatever is written to it."""

    first: int
    """Address of the first record that it falls in."""
    end: int
    """Behind the last one."""
    codec: ValueCodec
    domain: Domain
    blocks: list[Block]
    writers: frozenset[Role]
    sealed: list[tuple[RecordCodec, int, str]]
    """Codec, offset in bytes, and block of each record that has a seal."""
    judged: list[tuple[Judge, RecordCodec, int, int]]
    """Judge, codec, offset in bytes, and row of each record that is judged."""


def _touched_rows(block: Block, address: int, end: int) -> range:
    first = max(0, address - block.address) // block.row_words
    last = (min(end, block.end) - 1 - block.address) // block.row_words
    return range(first, last + 1)


def _forbidden(blocks: list[Block], roles: frozenset[Role]) -> ForbiddenWriteError:
    block = next(block for block in blocks if block.writer not in roles)
    own = ", ".join(sorted(roles)) or "none"
    return ForbiddenWriteError(f"block '{block.name}' is written by the {block.writer}; roles of this client: {own}")
