"""Answers and requests that say nonsense, their seals intact: what a confused peer sends."""

import math
import random
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, Final

from coldloop.registers.codec import RecordCodec, Seal, codec_of
from coldloop.registers.declaration import Block, Field, Kind, RegisterMap
from coldloop_chaos.faults import Direction
from tests.harness.records import map_of

READS: Final = (3, 23)
HEAD: Final = 9
"""Bytes of an answer before the words that were read: MBAP header, function code, byte count."""
FLOATS: Final = (math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-45, -0.0, -1e9, 1e9, 0.0)
INTEGERS: Final = {Kind.U16: (0, 1, 0x7FFF, 0xFFFF), Kind.U32: (0, 1, 2**31 - 1, 2**31, 2**32 - 2**16, 2**32 - 1)}

Change = Callable[[tuple[Any, ...]], tuple[Any, ...]]
"""Takes a record; returns another one."""


def record_in(answer: bytes, block: Block) -> tuple[Any, ...] | None:
    """Return the record of a sealed block that an answer carries, if it is that."""
    codec = codec_of(block)
    if len(answer) != HEAD + codec.size or answer[7] not in READS or codec.seal_of(answer, HEAD) is not Seal.INTACT:
        return None
    return codec.decode(answer, HEAD)


def with_record(answer: bytes, codec: RecordCodec, record: tuple[Any, ...]) -> bytes:
    """Return an answer with another record, sealed."""
    return answer[:HEAD] + codec.encode_sealed(record)


def changed(answer: bytes, block: Block, change: Change) -> bytes:
    """Return an answer whose record, if it carries one of this block, is changed."""
    record = record_in(answer, block)
    return answer if record is None else with_record(answer, codec_of(block), change(record))


def values_of(field: Field) -> tuple[float, ...]:
    """Return the values with which a field is poisoned."""
    return FLOATS if field.kind is Kind.F32 else INTEGERS[field.kind]


def poisons(record: type[tuple[Any, ...]]) -> Iterator[tuple[str, Change]]:
    """Yield what each field of a record but its seal can be changed into, with words for it; of arrays one element."""
    for place, (name, field) in enumerate(map_of(record).block_of(record).fields.items()):
        if name == "crc":
            continue
        for value in values_of(field):
            yield f"{name} = {value}", _setting(place, field, value)


def _setting(place: int, field: Field, value: float) -> Change:
    def change(record: tuple[Any, ...]) -> tuple[Any, ...]:
        new = (value, *record[place][1:]) if field.elements else value
        return type(record)(*record[:place], new, *record[place + 1 :])

    return change


class PoisonedReads:
    """Changes, in a share of a server's answers, one field of one record that is in them; seals are made to fit.

    Args:
        register_map: Of the server.
        seed: Decides which answers, records and fields, and what they say then.
    """

    def __init__(self, register_map: RegisterMap, seed: str) -> None:
        self.share = 0.0
        self.made: Counter[str] = Counter()
        """How often a record was changed, by its name."""
        self._map = register_map
        self._draw = random.Random(seed)  # noqa: S311 not for secrets
        self._asked: dict[bytes, tuple[int, int]] = {}

    def __call__(self, way: Direction, frame: bytes) -> bytes:
        """Return a frame, or another one in its place."""
        if way is Direction.REQUESTS:
            if frame[7] in READS:
                self._asked[frame[:2]] = struct.unpack_from(">HH", frame, 8)
            return frame
        first, count = self._asked.pop(frame[:2], (0, 0))
        if frame[7] not in READS or len(frame) != HEAD + 2 * count or self._draw.random() >= self.share:
            return frame
        rows = list(self._rows(first, count))
        return self._poisoned(frame, *self._draw.choice(rows)) if rows else frame

    def _rows(self, first: int, count: int) -> Iterator[tuple[Block, int]]:
        """Yield which rows are wholly in the answer to a read, with the byte at which they begin."""
        for block in self._map.blocks:
            begin = max(0, -(-(first - block.address) // block.row_words))
            end = min(block.rows, (first + count - block.address) // block.row_words)
            for row in range(begin, end):
                yield block, HEAD + 2 * (block.address + row * block.row_words - first)

    def _poisoned(self, frame: bytes, block: Block, begin: int) -> bytes:
        codec, fields = codec_of(block), block.fields
        name = self._draw.choice([name for name in fields if name != "crc"])
        change = _setting(list(fields).index(name), fields[name], self._draw.choice(values_of(fields[name])))
        record = change(codec.decode(frame, begin))
        self.made[f"{block.name}.{name}"] += 1
        data = codec.encode_sealed(record) if block.sealed else codec.encode(record)
        return frame[:begin] + data + frame[begin + codec.size :]
